"""Changes of ranges of motion between two takes of one person: `python -m benchmarks sigma sigma_changes`.

Twins of the takes of `sigma`: the same person, cameras, calibration, marker places and movement, once as it
is, and once with the ranges of six joints larger, two each by 5, 10 and 20 degrees; other noise. Both go through
`kinefit.track_take` with the defaults, and `range_changes`, which the window shows, says what changed. The draws serve
nothing else; the bars and the test for one person were looked at on draws 8100 to 8115.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy.mixed.mixed_runs import MIXES
from benchmarks.accuracy.mixed.mixed_takes import marked, record, take_text
from benchmarks.accuracy.uncertainty.sigma import FRAMES, JOINTS, SETUPS
from benchmarks.accuracy.video.setups import around
from benchmarks.figures import LEFT_OUT, amount, figure
from benchmarks.scenes.takes import tracked
from kinefit import Motion
from kinefit.exporters import range_changes
from kinefit.exporters.c3d_file import write_markers

FIRST, TWINS, CHANGES = 9100, 20, (5.0, 10.0, 20.0)  # [deg]
MOVES = np.radians(3.0)  # the least range of a joint that takes part
MOST_FALSE, LEAST_FOUND = 5.0, 90.0  # [%]


def changed(truth: Motion, joints: Sequence[str], changes: Sequence[float]) -> Motion:
    """The motion with ranges of some coordinates that are wider by `changes` [deg], about their middles."""
    angles = np.array(truth.angles)
    for joint, change in zip(joints, changes):
        values = angles[:, truth.body.tree.coordinates.index(joint)]  # a view
        middle, span = (values.max() + values.min()) / 2, np.ptp(values)
        values[:] = middle + (values - middle) * (1.0 + np.radians(change) / span)
    return replace(truth, angles=angles)


def of_draw(draw: int) -> dict[str, list[tuple[float, float, float]]]:
    """{set-up: true change, found change, two standard deviations of it [deg]} of all joints of one draw."""
    random, frames, out = np.random.default_rng([17, draw]), amount(FRAMES, 20), {}
    recording = record(draw, frames, depth=False)
    tree = recording.truth.body.tree
    names = [f"{stem}_{side}" for stem in JOINTS.values() for side in "lr"]
    names = [n for n in names if np.ptp(recording.truth.angles[:, tree.coordinates.index(n)]) > MOVES]
    order = [names[k] for k in random.permutation(len(names))][: 2 * len(CHANGES)]
    given = dict(zip(order, np.repeat(CHANGES, 2)))
    again = changed(recording.truth, order, list(given.values()))
    noise = np.random.default_rng([19, draw])
    with tempfile.TemporaryDirectory() as folder:
        for setup in amount(SETUPS, SETUPS[:1]):
            count, motions = setup.partition(" ")[0], []
            for seen in (None, again):
                if count.isdigit():
                    text = around(recording, Path(folder), int(count), draw, seen)
                else:
                    places = np.random.default_rng([23, draw])
                    markers = marked(seen or recording.truth, places, noise)
                    write_markers(markers, Path(folder) / "markers_45.trc")
                    text = take_text(Path(folder), MIXES["markers_alone"])
                motions.append(tracked(text)[0])
            out[setup] = [
                (given.get(f"{stem}_{side[0]}", 0.0), *one.change)
                for stem, side, one in ((*key, one) for key, one in range_changes(*motions).items())
                if f"{stem}_{side[:1]}" in names and one.change
            ]  # fmt: skip
    return out


def run() -> None:
    """Print false alarms, and how many changes of each size were found."""
    draws = [of_draw(draw) for draw in range(FIRST, FIRST + amount(TWINS, 1))]
    for setup in SETUPS:
        found = np.array([one for draw in draws for one in draw.get(setup, ())]).reshape(-1, 3)
        true, change, twice = found.T
        tag, counts = setup.replace(" ", "_"), np.abs(change) > twice
        share = {size: 100.0 * float(counts[true == size].mean()) for size in (0.0, *CHANGES) if np.any(true == size)}
        if len(found):
            off = np.sqrt(np.mean(np.square(change - true)))
            told = ", ".join(f"{size:.0f} deg {share[size]:.0f} % of {np.sum(true == size)}" for size in share)
            print(f"# {setup}: counts as changed {told}; off by {off:.1f}, bars {np.mean(twice) / 2:.1f} deg, "
                  f"smallest change {np.median(twice):.1f} deg", flush=True)  # fmt: skip
        figure(f"sigma_changes_{tag}_false", share.get(0.0), "% of joints unchanged", f"<= {MOST_FALSE:.0f}", LEFT_OUT)
        goal = f">= {LEAST_FOUND:.0f}"
        figure(f"sigma_changes_{tag}_found", share.get(10.0), "% of changes of 10 deg", goal, LEFT_OUT)
        smallest = float(np.median(twice)) if len(found) else None
        figure(f"sigma_changes_{tag}_smallest", smallest, "deg, median smallest clear change", "<= 10", LEFT_OUT)
