"""The main job: keypoints of calibrated video -> motion. `python -m benchmarks video tracking`.

Figures on the real balancing trial (four cameras, 100 frames), and on recorded motions projected into four cameras.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import LEFT_OUT, NotMeasured, amount, each, figure, quick, recording
from benchmarks.scenes.balancing import TRIAL, trial_text
from benchmarks.scenes.held_out import sides_right
from benchmarks.scenes.motions import library
from benchmarks.timing import took
from kinefit import Keypoints, Motion, Recording, Rig, load_body, load_observations, read_take, track
from kinefit.simulation import simulate_keypoints, studio_rig
from kinefit.simulation.evaluation import angle_errors, coverage, joint_errors

DETECTORS = ("openpose", "mediapipe")
FRAMES = amount("== 100", "== 12")
GOALS = {"openpose": 9.0, "mediapipe": 11.0}
NOISE = {"noise_px": 3.0, "outliers": 0.1, "missing": 0.1}


def take_text(folder: Path, detector: str) -> str:
    """Take file of the real trial with one detector's keypoints."""
    return trial_text(folder, detector=detector, head='name = "balancing"\n' + amount("", "frames = [0, 12]\n"))


@dataclass(frozen=True)
class Trial:
    """One detector's real trial."""

    take: Path
    rig: Rig
    keypoints: tuple[Keypoints, ...]

    @property
    def recording(self) -> Recording:
        """What a track is made of."""
        return Recording.of_keypoints(self.rig, self.keypoints)


def read_trial(folder: Path, detector: str, where: Path) -> Trial:
    """Write the take file into a folder and read what it names."""
    path = where / f"{detector}.toml"
    path.write_text(take_text(folder, detector), encoding="utf-8")
    seen = load_observations(read_take(path))
    assert seen.rig is not None
    return Trial(path, seen.rig, seen.keypoints)


def median_residual(motion: Motion) -> float:
    """[px] over all cameras, frames and keypoints, outliers too."""
    return float(np.nanmedian(np.concatenate([r.norms.ravel() for r in motion.residuals.values()])))


def held_out(trial: Trial, whole: Motion) -> dict[str, NDArray]:
    """(F, K, 2) [px] in each camera: what it saw minus the motion tracked from the other three.

    The person and the sides are those of the whole track; body and points are fitted without the camera.
    """
    out = {}
    for camera, record in list(zip(trial.rig.names, trial.keypoints, strict=True))[: amount(None, 1)]:
        others = tuple(n for n in trial.rig.names if n != camera)
        seen = [k for k in trial.keypoints if k.camera != camera]
        motion = track(Recording.of_keypoints(trial.rig.select(others), seen), load_body("humanoid"))
        residuals = whole.residuals[camera]
        one = record.of_one(np.zeros(len(record), np.int64))
        channels, fitted = sides_right(motion, trial.rig.select((camera,)), [one])
        place = [channels.points.names[c] for c in channels.column]
        out[camera] = residuals.measured - fitted[:, [place.index(n) for n in residuals.names]]
    return out


def wall(trial: Trial) -> float:
    """Seconds from keypoints to motion frame by frame, once the kernels are there."""
    return took(lambda: track(trial.recording, load_body("humanoid"), smooth=False), clock=time.perf_counter)[1]


def middle(errors: NDArray) -> float:
    """Median length of vectors (..., 2)."""
    return float(np.nanmedian(np.linalg.norm(errors, axis=-1)))


def real_trial(folder: Path, where: Path) -> None:
    """Residuals, held-out cameras, swaps, lengths and speed on the real recording."""
    for detector in amount(DETECTORS, DETECTORS[-1:]):
        trial = read_trial(folder, detector, where)
        motion = track(trial.recording, load_body("humanoid"))
        seconds = min(wall(trial) for _ in range(amount(5, 1)))
        residual = median_residual(motion)
        per_camera = {name: round(float(np.nanmedian(r.norms)), 1) for name, r in motion.residuals.items()}
        swaps = {name: int(r.swapped.sum()) for name, r in motion.residuals.items()}
        print(f"# {detector}: residual per camera {per_camera} px, swapped frames {swaps}")
        figure(f"video_residual_{detector}", residual, "px", f"<= {GOALS[detector]:g}")
        errors = held_out(trial, motion)
        shifts = {n: np.nanmedian(e, axis=(0, 1)) for n, e in errors.items()}
        outside = middle(np.concatenate([e.reshape(-1, 2) for e in errors.values()]))
        per_camera = {n: round(middle(e), 1) for n, e in errors.items()}
        constant = {n: s.round(1).tolist() for n, s in shifts.items()}
        print(f"# {detector}: held out {per_camera} px, of that a constant shift of {constant} px")
        figure(f"video_held_out_{detector}", outside, "px", f"<= {1.5 * GOALS[detector]:g}")
        figure(f"video_held_out_ratio_{detector}", outside / residual, "x", "<= 1.5")
        figure(f"video_frames_tracked_{detector}", float((motion.quality > 0.3).sum()), "frames", FRAMES)
        joints = motion.segment_poses()[..., :3, 3]
        lengths = np.linalg.norm(joints[:, 1:] - joints[:, motion.body.tree.parents[1:]], axis=2)
        figure(f"video_bone_length_change_{detector}", 1e3 * float(np.ptp(lengths, axis=0).max()), "mm", "<= 0.001")
        figure(f"video_speed_{detector}", len(motion) / seconds, "frames/s", ">= 300")
        if detector == "mediapipe":
            cam02 = None if quick() else float(swaps["cam02"])
            figure("video_swaps_cam02", cam02, "frames", ">= 26", LEFT_OUT)
            figure("video_swaps_elsewhere", float(sum(swaps.values()) - swaps["cam02"]), "frames", "<= 0")


FIRST_FRAME = """
import sys, time
began = time.time()
from kinefit import track_take
def tell(what, done, total):
    if what == "frames" and done == 1:
        print("first frame after", time.time() - began)
track_take(sys.argv[1], progress=tell)
print("all after", time.time() - began)
"""


def start_up(take: Path, where: Path) -> None:
    """Seconds of a whole first run with an empty kernel cache, and until the first frame of a later run."""
    if quick():
        raise NotMeasured(LEFT_OUT)
    environment = {**os.environ, "KINEFIT_CACHE": str(where / "cache")}
    texts = []
    for _ in range(3):
        command = [sys.executable, "-c", FIRST_FRAME, str(take)]
        texts.append(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)
    told = [{line.split(" after ")[0]: float(line.split()[-1]) for line in text.splitlines()} for text in texts]
    figure("video_first_run", told[0]["all"], "s", "<= 30")
    figure("video_later_start", min(t["first frame"] for t in told[1:]), "s", "<= 3")


def library_tracked(
    keypoint_set: str, *, smooth: bool = True
) -> Iterator[tuple[str, Motion, Motion, tuple[float, float, float]]]:
    """Each recorded motion: its name, the truth, what keypoints of four cameras with noise, outliers and gaps give, and
    mean errors of joints [mm], of angles, and of those with a standard deviation below 10 degrees [deg].
    """
    for number, (name, truth) in enumerate(library().items()):
        rig = studio_rig(truth)
        keypoints = simulate_keypoints(truth, rig, keypoint_set, seed=number, **NOISE)
        recording = Recording.of_keypoints(rig, keypoints, sigma=NOISE["noise_px"], up="y")
        motion = track(recording, load_body("humanoid"), smooth=smooth)
        turns = np.where(np.isfinite(motion.dof_std[:, 6:]), np.abs(angle_errors(truth, motion)), np.nan)
        sure = float(np.nanmean(turns[motion.dof_std[:, 6:] < np.radians(10)]))
        yield name, truth, motion, (1e3 * float(joint_errors(truth, motion).mean()), float(np.nanmean(turns)), sure)


def synthetic(keypoint_set: str) -> None:
    """Joint centres and angles of twenty recorded motions, from keypoints with noise, outliers and gaps."""
    joints, angles, sure, inside = [], [], [], []
    for name, truth, motion, errors in library_tracked(keypoint_set, smooth=False):
        for of, error in zip((joints, angles, sure), errors):
            of.append(error)
        inside.append(coverage(truth, motion))
        print(
            f"# {keypoint_set} {name}: {joints[-1]:.1f} mm, {angles[-1]:.2f} deg, within 2 sigma: "
            f"{100 * inside[-1].joints:.0f} % of joints, {100 * inside[-1].angles:.0f} % of angles", flush=True,
        )  # fmt: skip
    absent = "the recorded motions are absent"
    tag = keypoint_set.lower()
    count = None if quick() else float(len(joints)) or None
    figure(f"video_synthetic_motions_{tag}", count, "motions", "== 20", LEFT_OUT if quick() else absent)
    figure(f"video_synthetic_joints_{tag}", float(np.mean(joints)) if joints else None, "mm", "<= 12", absent)
    figure(f"video_synthetic_angles_{tag}", float(np.mean(angles)) if angles else None, "deg", "<= 3", absent)


def run() -> None:
    """Print every figure of tracking."""
    each(_real)
    for keypoint_set in amount(("BODY_25B", "MEDIAPIPE_33"), ("BODY_25B",)):
        synthetic(keypoint_set)


def _real() -> None:
    folder = recording(TRIAL)
    with tempfile.TemporaryDirectory() as where:
        real_trial(folder, Path(where))
        start_up(Path(where) / "mediapipe.toml", Path(where))
