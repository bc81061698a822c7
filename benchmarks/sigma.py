"""Ranges of motion against truth, and how wide their error bars are: `python -m benchmarks.sigma`.

Simulated takes of `benchmarks.setups` (people, motions, detector and calibration errors as told there), through
`kinefit.track_take` with the defaults. Draws from `FIRST` on serve nothing else.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figures import LEFT_OUT, amount, figure, run_parts
from benchmarks.mixed_runs import MIXES
from benchmarks.mixed_takes import marked, record, take_text, write
from benchmarks.setups import around
from kinefit import Motion, track_take
from kinefit.evaluation import angle_errors
from kinefit.exporters.c3d_file import write_markers
from kinefit.exporters.report.angles import changes, ranges_of

PARTS = {
    "sigma": "ranges of motion of five joints, from two and four cameras and from markers",
    "sigma_changes": "changes of ranges between two takes of one person, from the same set-ups",
}
FIRST, DRAWS, FRAMES = 9000, 40, 90
JOINTS = {"hip": "hip_flexion", "knee": "knee_angle", "ankle": "ankle_angle", "shoulder": "arm_flex",
          "elbow": "elbow_flex"}  # fmt: skip
SETUPS = ("2 cameras", "4 cameras", "markers")
MOVES = np.radians(3.0)  # the least range of a joint that takes part
FIRST_TWIN, TWINS, CHANGES = 9100, 20, (5.0, 10.0, 20.0)  # [deg] two joints change by each, four do not
MOST_FALSE, LEAST_FOUND = 5.0, 90.0  # [%]


def of_draw(draw: int) -> dict[str, list[tuple[str, float, float, float]]]:
    """{set-up: joint, error of the range, its standard deviation, that of independent ends [deg]} of one draw."""
    recording, out = record(draw, amount(FRAMES, 20), depth=False), {}
    with tempfile.TemporaryDirectory() as folder:
        write(recording, Path(folder))
        for setup in amount(SETUPS, SETUPS[:1]):
            count = setup.partition(" ")[0]
            text = (
                around(recording, Path(folder), int(count), draw) if count.isdigit()
                else take_text(Path(folder), MIXES["markers_alone"])
            )  # fmt: skip
            path = Path(folder) / f"{setup.replace(' ', '_')}.toml"
            path.write_text(text)
            out[setup] = errors(recording.truth, track_take(path)[0])
    return out


def errors(truth: Motion, motion: Motion) -> list[tuple[str, float, float, float]]:
    """Joint, error [deg] of its range between the frames of the motion's ends, σ [deg] and σ of independent ends."""
    found, alone, out = ranges_of(motion), ranges_of(replace(motion, lasting=None)), []
    away = angle_errors(truth, motion)
    for joint, stem in JOINTS.items():
        for side, one in found.get(stem, {}).items():
            if one is not None:
                low, high = one.ends
                off = away[high, one.coordinate - 6] - away[low, one.coordinate - 6]
                out.append((joint, off, one.span[1] / 2, alone[stem][side].span[1] / 2))
    return out


def run() -> None:
    """Print coverage and width for every set-up and joint."""
    draws = [of_draw(draw) for draw in range(FIRST, FIRST + amount(DRAWS, 1))]
    for setup in SETUPS:
        found = [one for draw in draws for one in draw.get(setup, ())]
        tag, wide = setup.replace(" ", "_"), []
        for joint in JOINTS:
            off, std, alone = (np.array([one[k] for one in found if one[0] == joint]) for k in (1, 2, 3))
            if len(off):
                rms, inside = np.sqrt(np.mean(off**2)), 100 * np.mean(np.abs(off) <= 1.96 * std)
                print(f"# {setup}, {joint}: off by {rms:.1f}, bars {np.mean(std):.1f} deg (independent ends "
                      f"{np.mean(alone):.1f}), inside {inside:.0f} %, {len(off)} ranges", flush=True)  # fmt: skip
                wide.append(float(np.mean(std) / rms))
        off, std = (np.array([one[k] for one in found]) for k in (1, 2))
        inside = 100 * float(np.mean(np.abs(off) <= 1.96 * std)) if len(off) else None
        figure(f"sigma_ranges_{tag}_inside_least", inside, "% in 95 % bars", ">= 90", LEFT_OUT)
        figure(f"sigma_ranges_{tag}_inside_most", inside, "% in 95 % bars", "<= 98", LEFT_OUT)
        figure(f"sigma_ranges_{tag}_width", max(wide, default=None), "mean sigma over RMS error", "<= 1.5", LEFT_OUT)


def changed(truth: Motion, joints: Sequence[str], changes: Sequence[float]) -> Motion:
    """The motion with ranges of some coordinates that are wider by `changes` [deg], about their middles."""
    angles = np.array(truth.angles)
    for joint, change in zip(joints, changes):
        values = angles[:, truth.body.tree.coordinates.index(joint)]  # a view
        middle, span = (values.max() + values.min()) / 2, np.ptp(values)
        values[:] = middle + (values - middle) * (1.0 + np.radians(change) / span)
    return replace(truth, angles=angles)


def changes_of_draw(draw: int) -> dict[str, list[tuple[float, float, float]]]:
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
                path = Path(folder) / f"{setup.replace(' ', '_')}.toml"
                path.write_text(text)
                motions.append(track_take(path)[0])
            out[setup] = [
                (given.get(f"{stem}_{side[0]}", 0.0), *one.change)
                for stem, side, one in ((*key, one) for key, one in changes(*motions).items())
                if f"{stem}_{side[:1]}" in names and one.change
            ]  # fmt: skip
    return out


def run_changes() -> None:
    """Print false alarms, and how many changes of each size were found."""
    draws = [changes_of_draw(draw) for draw in range(FIRST_TWIN, FIRST_TWIN + amount(TWINS, 1))]
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
        goal = f">= {LEAST_FOUND:.0f}" if setup == "4 cameras" else ""
        figure(f"sigma_changes_{tag}_found", share.get(10.0), "% of changes of 10 deg", goal, LEFT_OUT)
        smallest = float(np.median(twice)) if len(found) else None
        figure(f"sigma_changes_{tag}_smallest", smallest, "deg, median of the smallest change found", "", LEFT_OUT)


if __name__ == "__main__":
    run_parts(PARTS)
