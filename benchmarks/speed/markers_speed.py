"""Time of identification and fitting together, and of a large set's frames.

Time is the processor's of one core, so that what else a machine does is not counted; compiled kernels are there.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import time
from dataclasses import replace

import numpy as np

from benchmarks.figures import NotMeasured, amount, each, figure
from benchmarks.scenes.marker_takes import broken, counts, load, shuffled
from benchmarks.timing import timed
from kinefit import Markers, fit_marker_subject, fit_markers, identify, identify_take, learn_model, load_body
from kinefit.markers.model.model import MarkerModel

LARGE = "nimblephysics/data__osim__WeirdFormatTests__markers.trc"
"""61 markers, most of them in clusters."""

FRAMES = amount(20, 2)


def run() -> None:
    """Print every figure."""
    each(large_set, whole_take)


def large_set() -> None:
    """Frames of a take of 61 markers one by one, a model learnt from the take's other part; then with 20 ghosts."""
    taught, asked = load((LARGE, 0.0, 0.45)), load((LARGE, 0.55, 1.0))
    for name, ghosts in (("markers_large_61", 0), ("markers_large_61_ghosts_20", 20)):
        if taught is None or asked is None:
            figure(name, None, "ms a frame, slowest", "<= 200", "the recording is absent")
            continue
        model, rng = learn_model(taught), np.random.default_rng(0)
        identify(model, shuffled(asked, model.labels, 0, rng)[0])  # compiled
        times, counted = [], np.zeros(3, int)
        for f in np.unique(np.linspace(0, len(asked) - 1, FRAMES).astype(int)):
            points, truth = shuffled(asked, model.labels, int(f), rng, ghosts=ghosts)
            with timed(times, 1e3):
                found = identify(model, points).assignment
            counted += counts(found, truth)
        share = 100 * counted[0] / counted[2]
        print(f"# {len(model)} markers: median {np.median(times):.0f} ms, {share:.1f} % of labels right")
        figure(name, max(times), "ms a frame, slowest", "<= 200")


def whole_take() -> None:
    """60 s at 120 Hz of 41 markers, a break dancer's take forwards and backwards, its trajectories broken."""
    file = "mocaprecovery/data__85_12.c3d"
    taught, take = load((file, 0.0, 0.45)), load((file, 0.0, 1.0))
    if taught is None or take is None:
        raise NotMeasured("the recording is absent")
    x = np.concatenate([take.positions, take.positions[::-1]])[: amount(7200, 200)]
    labelled = replace(take, positions=x, residual=None)
    model = learn_model(taught)
    both(model, broken(replace(labelled, positions=x[: amount(240, 60)])).markers)  # compiled
    points = broken(labelled).markers
    named, fitted, smoothed = both(model, points)
    print(f"# 60 s: {len(points)} frames of {len(labelled.names)} markers in {len(points.names)} columns")
    print(f"# identified in {named:.1f} s, fitted in {fitted:.1f} s, smoothed as well in {smoothed:.1f} s")
    figure("markers_60s", named + fitted, "s", "<= 12")
    figure("markers_60s_smoothed", named + smoothed, "s", "<= 40")


def both(model: MarkerModel, points: Markers) -> tuple[float, float, float]:
    """Points to labels to angles: seconds of the processor for labels, for person and poses, and with smoothing."""
    start = time.process_time()
    labelled = identify_take(model, points).markers(points)
    named = time.process_time()
    subject = fit_marker_subject(load_body("humanoid"), labelled)
    sized = time.process_time()
    fit_markers(subject, labelled, smooth=False)
    fitted = time.process_time()
    fit_markers(subject, labelled)
    return named - start, fitted - named, time.process_time() - fitted + sized - named
