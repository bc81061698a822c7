"""Steps, strides and events of real walks from four simulated cameras, and from markers, by `kinefit.track_take`.

    python -m benchmarks gait gait_video

The walks are those of `gait_events`, as measured by their markers: that motion is the truth, at 60 Hz. Four cameras of
1920x1088 px see all of it, 0.1 degree and 3 mm off, with MediaPipe's points as in `mixed_takes`: 3 px of noise, 2 px of
drift over half a second, 10 % outliers, 10 % missing, each point 8 mm from its place on the body. All is tracked with
the defaults. Steps and strides are compared with those of the truth; contacts and toe-offs with force plates. The same
walks are seen by 45 markers, each 8 mm from its place on the body, with 1 mm of noise and 2 % gaps. What was chosen,
was chosen on HC002D, HC036A and HC050A; the figures are of HC030A, HC044A and the adult of `gait_omcs`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy.gait.gait_events import (
    PRINTED,
    Event,
    file_of,
    fitted,
    missed,
    plate_events,
    print_events,
    print_held,
)
from benchmarks.accuracy.mixed.mixed_takes import detected, marked, with_own_points
from benchmarks.figures import amount, figure
from benchmarks.scenes.simulated import calibrated, write_cameras
from benchmarks.scenes.takes import tracked
from kinefit import Motion
from kinefit.errors import ObservationError
from kinefit.exporters.c3d_file import write_markers
from kinefit.exporters.gait.record import Stretch, gait_record
from kinefit.readers.markers import read_markers
from kinefit.simulation import known_motion, resampled, studio_rig

RATE, DRAWS, SIZE = 60.0, 2, (1920, 1088)  # [Hz], noises and people's points for each walk, [px]
QUANTITIES = {"step": "step length [m]", "stride": "stride length [m]"}
GOALS = {"video": {"step": "<= 16", "stride": "<= 12"}, "marked": {"step": "<= 5", "stride": "<= 5"}}  # [mm]
_SAME_S = 0.12  # [s] between the contacts of one stride in two motions


def run() -> None:
    """Print the figures of the walks that were kept back."""
    lengths = {(sensor, kind): list[tuple[float, float]]() for sensor in GOALS for kind in QUANTITIES}
    times = {kind: list[tuple[float, float]]() for kind in ("contact", "off")}
    for name in PRINTED[: amount(None, 1)]:
        path = file_of(name)
        if path is None:
            continue
        measured, events = fitted(path), plate_events(path, read_markers(path))
        for draw in range(amount(DRAWS, 1)):
            random = np.random.default_rng([51, draw, len(measured)])
            truth = of_person(measured, random)
            motions = {"video": by_cameras(truth, draw, random), "marked": by_markers(truth, random)}
            for sensor, motion in motions.items():
                for kind, pairs in differences(truth, motion).items():
                    lengths[sensor, kind] += pairs
            for kind, pairs in _of_events(motions["video"], events, measured.times[0]).items():
                times[kind] += pairs
    for (sensor, kind), pairs in lengths.items():
        reason = "" if pairs else "no recording"
        error, std = 1e3 * np.array(pairs).reshape(-1, 2).T
        print(f"# {sensor}: {len(error)} {kind}s")
        rms = float(np.sqrt(np.mean(np.square(error)))) if pairs else None
        figure(f"gait_{sensor}_{kind}_mm", rms, "mm RMS", GOALS[sensor][kind], reason)
        print_held(f"gait_{sensor}_{kind}", error, std, reason)
    for kind, pairs in times.items():
        print_events(f"gait_video_{kind}", np.array(pairs).reshape(-1, 2))


def of_person(measured: Motion, random: np.random.Generator) -> Motion:
    """A measured walk as a person with own keypoints walks it."""
    even = resampled(measured.turned("y"), RATE)
    return known_motion(with_own_points(measured.body, random), RATE, even.Ts_world_root, even.angles)


def by_cameras(truth: Motion, draw: int, random: np.random.Generator) -> Motion:
    """A walk as four cameras measure it."""
    rig = studio_rig(truth, size=SIZE)
    told = calibrated(rig, random)
    with tempfile.TemporaryDirectory() as folder:
        text = write_cameras(Path(folder), told, detected(truth, rig, draw, cameras=rig.names), RATE)
        return tracked(text)[0]


def by_markers(truth: Motion, random: np.random.Generator) -> Motion:
    """A walk as 45 markers measure it."""
    with tempfile.TemporaryDirectory() as folder:
        write_markers(replace(marked(truth, random), rate=RATE), Path(folder) / "markers.trc")
        return tracked(f'[take]\nrate = {RATE}\nup = "y"\n[[markers]]\nfile = "{folder}/markers.trc"\n')[0]


def differences(truth: Motion, motion: Motion) -> dict[str, list[tuple[float, float]]]:
    """{"step" or "stride": (error, its standard deviation) [m] of all that both motions have}."""
    out = {name: list[tuple[float, float]]() for name in QUANTITIES}
    for true, one in _pairs(truth, motion):
        for name, quantity in QUANTITIES.items():
            if quantity in true.values and quantity in one.values:
                value, std = one.values[quantity]
                out[name].append((value - true.values[quantity][0], std))
    return out


def _pairs(truth: Motion, motion: Motion) -> Iterator[tuple[Stretch, Stretch]]:
    try:
        found = gait_record({"walk": motion}).stretches
    except ObservationError:
        return
    for true in gait_record({"walk": truth}).stretches:
        for one in found:
            apart = max(abs(one.start - true.start), abs(one.stop - true.stop))
            if (one.kind, one.side) == (true.kind, true.side) and apart < _SAME_S:
                yield true, one


def _of_events(motion: Motion, events: list[Event], start: float) -> dict[str, list[tuple[float, float]]]:
    """{kind: (error, its standard deviation) [s]} of events by the clock of a recording that begins at `start` [s]."""
    out: dict[str, list[tuple[float, float]]] = {}
    for event in events:
        out.setdefault(event.kind, []).append(missed(motion, replace(event, time=event.time - start)))
    return out

