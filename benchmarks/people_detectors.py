"""One detector and two on the real trial, judged in a camera that the fit did not have."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.figures import LEFT_OUT, data, figure, quick
from benchmarks.held_out import cameras_left_out, median, persons
from benchmarks.tracking import Trial, read_trial
from kinefit import Motion, load_body
from kinefit.tracking.recording import Recording
from kinefit.tracking.video import track

DETECTORS = ("openpose", "mediapipe")
_GOALS = {"openpose": "<= 12", "mediapipe": "<= 13"}  # px


def run() -> None:
    """Print every figure."""
    folder = data("video_balancing_4cam")
    reason = "no recording" if folder is None else LEFT_OUT if quick() else ""
    if reason or folder is None:
        for name, goal in _GOALS.items():
            figure(f"people_held_out_{name}", None, "px", goal, reason)
        figure("people_two_detectors", None, "x the better one, its own keypoints held out", "<= 1", reason)
        return
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
