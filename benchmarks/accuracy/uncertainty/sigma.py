"""Error bars against truth, of ranges of motion and of joint centres: `python -m benchmarks sigma`.

Simulated takes of `setups` (people, motions, detector and calibration errors as told there), through
`kinefit.track_take` with the defaults. Draws from `FIRST` on serve nothing else.

The expected calibration error of joint centres is the mean of |share of errors inside - level| over the levels 5, 10,
..., 95 %, in which the interval of a level is the central one of a normal distribution of the stated σ.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from benchmarks.accuracy.mixed.mixed_runs import MIXES
from benchmarks.accuracy.mixed.mixed_takes import record, take_text, write
from benchmarks.accuracy.video.setups import around
from benchmarks.figures import LEFT_OUT, amount, figure
from benchmarks.scenes.takes import tracked
from kinefit import Motion
from kinefit.exporters.report.angles import ranges_of
from kinefit.exporters.tables import split_side
from kinefit.simulation.evaluation import angle_errors

FIRST, DRAWS, FRAMES = 9000, 40, 90
JOINTS = {"hip": "hip_flexion", "knee": "knee_angle", "ankle": "ankle_angle", "shoulder": "arm_flex",
          "elbow": "elbow_flex"}  # fmt: skip
SETUPS = ("2 cameras", "4 cameras", "markers")
GROUPS = {
    "trunk": ("pelvis", "lumbar", "thorax", "head"), "shoulders": ("clavicle", "upperarm"), "elbows": ("forearm",),
    "wrists": ("hand",), "hips": ("thigh",), "knees": ("shank",), "ankles": ("foot",), "toes": ("toes",),
}  # fmt: skip
"""Joint centres by the segments that begin there."""

AXES = "along", "up", "across"  # of the walk: x, y and z of the simulated rooms
LEVELS = np.arange(0.05, 1.0, 0.05)
Bars = dict[str, NDArray]  # of each axis and group: errors over their standard deviations


def of_draw(draw: int) -> dict[str, tuple[list[tuple[str, float, float]], Bars]]:
    """{set-up: joint, error of the range, its standard deviation [deg]; bars} of one draw."""
    recording, out = record(draw, amount(FRAMES, 20), depth=False), {}
    with tempfile.TemporaryDirectory() as folder:
        write(recording, Path(folder))
        for setup in amount(SETUPS, SETUPS[:1]):
            count = setup.partition(" ")[0]
            text = (
                around(recording, Path(folder), int(count), draw) if count.isdigit()
                else take_text(Path(folder), MIXES["markers_alone"])
            )  # fmt: skip
            motion = tracked(text)[0]
            out[setup] = errors(recording.truth, motion), bars(recording.truth, motion)
    return out


def bars(truth: Motion, motion: Motion) -> Bars:
    """Errors of the joint centres that are observed, over their standard deviations."""
    motion = motion if motion.up == truth.up else motion.turned(truth.up)
    known, stems = np.isfinite(motion.joint_std), [split_side(name)[0] for name in motion.body.tree.segments]
    off = np.where(known, motion.joint_centres - truth.joint_centres, np.nan) / np.where(known, motion.joint_std, 1.0)
    of = {name: off[:, np.isin(stems, parts)] for name, parts in GROUPS.items()}
    return {name: x[np.isfinite(x)] for name, x in {**dict(zip(AXES, np.moveaxis(off, 2, 0))), **of}.items()}


def inside(off: NDArray) -> NDArray:
    """Share of errors (n,), in standard deviations, inside the intervals of all `LEVELS`."""
    return np.asarray(np.mean(np.abs(off)[:, None] <= ndtri((1.0 + LEVELS) / 2.0), axis=0))


def errors(truth: Motion, motion: Motion) -> list[tuple[str, float, float]]:
    """Joint, error [deg] of its range between the frames of the motion's ends, and its σ [deg]."""
    found, out = ranges_of(motion), []
    away = angle_errors(truth, motion)
    for joint, stem in JOINTS.items():
        for one in found.get(stem, {}).values():
            if one is not None:
                low, high = one.ends
                off = np.subtract(*away[[high, low], one.terms[1] - 6])
                out.append((joint, off, one.span[1] / 2))
    return out


def run() -> None:
    """Print coverage and width for every set-up and joint."""
    draws = [of_draw(draw) for draw in range(FIRST, FIRST + amount(DRAWS, 1))]
    for setup in SETUPS:
        found = [one for draw in draws if setup in draw for one in draw[setup][0]]
        tag, wide = setup.replace(" ", "_"), []
        for joint in JOINTS:
            off, std = (np.array([one[k] for one in found if one[0] == joint]) for k in (1, 2))
            if len(off):
                rms, share = np.sqrt(np.mean(off**2)), 100 * np.mean(np.abs(off) <= 1.96 * std)
                told = f"off by {rms:.1f}, bars {np.mean(std):.1f} deg, inside {share:.0f} %, {len(off)} ranges"
                print(f"# {setup}, {joint}: {told}", flush=True)
                wide.append(float(np.mean(std) / rms))
        off, std = (np.array([one[k] for one in found]) for k in (1, 2))
        share = 100 * float(np.mean(np.abs(off) <= 1.96 * std)) if len(off) else None
        figure(f"sigma_ranges_{tag}_inside_least", share, "% in 95 % bars", ">= 90", LEFT_OUT)
        figure(f"sigma_ranges_{tag}_inside_most", share, "% in 95 % bars", "<= 98", LEFT_OUT)
        figure(f"sigma_ranges_{tag}_width", max(wide, default=None), "mean sigma over RMS error", "<= 1.5", LEFT_OUT)
        for kind, names in (("axes", AXES), ("groups", tuple(GROUPS))):
            worst = [_miscalibration(setup, name, draws) for name in names if setup in draws[0]]
            figure(f"sigma_{tag}_{kind}_calibration", max(worst, default=None), "expected calibration error, worst of "
                   f"{len(names)} {kind}", "<= 0.05", LEFT_OUT)  # fmt: skip


def _miscalibration(setup: str, name: str, draws: list) -> float:
    """Expected calibration error of the joint centres along one axis or of one group."""
    shares = inside(np.concatenate([draw[setup][1][name] for draw in draws]))
    error = float(np.mean(np.abs(shares - LEVELS)))
    print(f"# {setup}, {name}: calibration error {error:.3f}", flush=True)
    return error
