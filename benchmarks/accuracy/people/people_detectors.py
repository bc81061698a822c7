"""One detector and two: on the real trial, judged in a camera that the fit did not have, and simulated, with truth.

Of the simulated detectors the second errs once, twice and three times as much as the first. Both have points that all
of a segment's drift together in a view, points that drift alone, and a drift that both have in common.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.video.tracking import Trial, read_trial
from benchmarks.figures import LEFT_OUT, each, figure, quick, whole_recording
from benchmarks.scenes.held_out import cameras_left_out, median, persons
from benchmarks.scenes.motions import library
from kinefit import Keypoints, Motion, load_body
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.video import track
from kinefit.simulation import cut, simulate_keypoints, studio_rig
from kinefit.simulation.evaluation import coverage, joint_errors
from kinefit.simulation.keypoints import drift

DETECTORS = ("openpose", "mediapipe")
SIMULATED = "jump 02_04", "walk 12_01", "wave"
_RATIOS = 1, 2, 3  # of the second detector's errors to the first's
_FRAMES, _SEEDS = 150, 2
_JITTER, _ALONE, _SEGMENT, _BOTH = 2.0, 2.5, 4.0, 2.0  # [px]
_LASTS = 0.5  # [s]
_GOALS = {"openpose": "<= 12", "mediapipe": "<= 13"}  # px


def run() -> None:
    """Print every figure."""
    each(_real)
    for ratio in _RATIOS:
        name, goal = f"people_two_detectors_simulated_{ratio}", "x the better one's joints"
        cases = [] if quick() else [(m, s) for m in library(list(SIMULATED)).values() for s in range(_SEEDS)]
        made = [_simulated(cut(m, 0, min(len(m), _FRAMES)), float(ratio), s) for m, s in cases]
        if not made:
            figure(name, None, goal, "<= 1", LEFT_OUT if quick() else "the recorded motions are absent")
            continue
        first, second, both, joints, angles = np.mean(made, axis=0)
        worse = sum(one[2] > min(one[:2]) for one in made)
        print(
            f"# second detector {ratio} x: {first:.1f}, {second:.1f} mm alone, {both:.1f} mm both; worse than the "
            f"better one in {worse} of {len(made)}; inside {100 * joints:.0f} % of joints, "
            f"{100 * angles:.0f} % of angles"
        )  # fmt: skip
        figure(name, both / min(first, second), goal, "<= 1")


def _simulated(truth: Motion, ratio: float, seed: int) -> tuple[float, ...]:
    """[mm] error of joints by the first detector, the second and both; of the latter, shares inside two deviations."""
    rig, random = studio_rig(truth), np.random.default_rng(seed)
    segments, keep = (len(truth), len(truth.body.tree.segments), 2), np.exp(-1.0 / (truth.rate * _LASTS))
    common = _BOTH * np.array([drift(segments, keep, random) for _ in rig])
    made = []
    for k, (keypoint_set, worse) in enumerate((("BODY_25B", 1.0), ("MEDIAPIPE_33", ratio))):
        seen = simulate_keypoints(
            truth, rig, keypoint_set, noise_px=worse * _JITTER, drift_px=worse * _ALONE, drift_time=_LASTS,
            outliers=0.03, missing=0.05, seed=2 * seed + k,
        )  # fmt: skip
        shift = common + worse * _SEGMENT * np.array([drift(segments, keep, random) for _ in rig])
        made.append(_shifted(truth, seen, shift))
    alone, other, both = (
        track(Recording.of_keypoints(rig, seen, up=truth.up), load_body("humanoid"))
        for seen in (made[0], made[1], [*made[0], *made[1]])
    )
    inside = coverage(truth, both)
    errors = (1e3 * float(joint_errors(truth, m).mean()) for m in (alone, other, both))
    return *errors, inside.joints, inside.angles


def _shifted(truth: Motion, seen: Sequence[Keypoints], shift: NDArray) -> list[Keypoints]:
    """Keypoints with what all points of a segment are shifted by (C, F, S, 2) [px]."""
    points = truth.body.keypoints(seen[0].keypoint_set)
    column = [seen[0].names.index(name) for name in points.names]
    out = []
    for record, of_camera in zip(seen, shift, strict=True):
        uv = np.array(record.points)
        uv[:, 0, column] += of_camera[:, points.segments]
        out.append(replace(record, points=uv))
    return out


def _real() -> None:
    folder = whole_recording("video_balancing_4cam")
    with tempfile.TemporaryDirectory() as where:
        trials = {name: read_trial(folder, name, Path(where)) for name in DETECTORS}
    by_itself = {name: _held_out([trials[name]], trials[name]) for name in DETECTORS}
    together = {name: _held_out(list(trials.values()), trials[name]) for name in DETECTORS}
    for name in DETECTORS:
        figure(f"people_held_out_{name}", by_itself[name], "px", _GOALS[name])
        told = f"{by_itself[name]:.2f} px by itself, {together[name]:.2f} with both"
        print(f"# keypoints of {name} in a camera left out: {told}")
    better = min(DETECTORS, key=lambda name: by_itself[name])
    ratio = together[better] / by_itself[better]
    figure("people_two_detectors", ratio, "x the better one, its own keypoints held out", "<= 1")


def _held_out(used: list[Trial], judge: Trial) -> float:
    """[px] median distance of one detector's sure keypoints in each camera from the fit to the other three."""
    rig, body = judge.rig, load_body("humanoid")

    def fitted(camera: str) -> Motion:
        seen = [k for trial in used for k in trial.keypoints if k.camera != camera]
        return track(Recording.of_keypoints(rig, seen), body)

    return median(cameras_left_out(rig, persons(rig, judge.keypoints), fitted))
