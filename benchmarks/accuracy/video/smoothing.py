"""Whole takes at once. `python -m benchmarks video smoothing`.

Acceleration noise is the root mean square, over joints and frames, of the part above 10 Hz of the second difference of
joint centres [m/s²]: the difference is multiplied by a Hann window, its spectrum summed from 10 Hz up to half the
frame rate (Parseval), and divided by the window's mean square. The same formula is applied to the points of a rival's
TRC file (hips, knees, ankles, shoulders, elbows, wrists; low-pass filtered by the rival at 6 Hz) and to the same joint
centres of the tracked body.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.video.tracking import library_tracked, median_residual, read_trial
from benchmarks.figures import amount, each, figure, recording
from benchmarks.scenes.balancing import TRIAL
from kinefit import Motion, load_body, read_markers, track
from kinefit.bodies import PointSet
from kinefit.geometry.losses import geman_mcclure
from kinefit.simulation import cut, squat_and_wave, studio_rig
from kinefit.solving.trajectory.motion_prior import MotionPrior
from kinefit.solving.trajectory.sequence import SeenPoints
from kinefit.solving.trajectory.smoothing import smooth

JOINTS = {"Hip": "thigh", "Knee": "shank", "Ankle": "foot", "Shoulder": "upperarm", "Elbow": "forearm", "Wrist": "hand"}
RIVAL = "rival_results/pose2sim_0.10.49_openpose_refined.trc"
ABOVE = 10.0  # [Hz]
FAST = ("hand_r", "hand_l", "foot_r", "foot_l")


def acceleration_noise(x: NDArray, rate: float) -> float:
    """[m/s²] of points (F, K, 3) [m]; see the head of this file."""
    acceleration = np.diff(x, 2, axis=0) * rate**2
    window = np.hanning(len(acceleration))
    spectrum = np.abs(np.fft.rfft(acceleration * window[:, None, None], axis=0)) ** 2
    power = 2.0 * spectrum / (len(acceleration) * np.sum(window**2))
    high = np.fft.rfftfreq(len(acceleration), 1.0 / rate) >= ABOVE
    return float(np.sqrt(power[high].sum(axis=(0, 2)).mean()))


def joint_centres(motion: Motion) -> NDArray:
    """(F, 12, 3) [m] in the order of `rival_points`."""
    segments = [motion.body.tree.segment(f"{s}_{side}") for side in "rl" for s in JOINTS.values()]
    return motion.segment_poses()[..., :3, 3][:, segments]


def rival_points(path: Path) -> tuple[NDArray, float]:
    """(F, 12, 3) [m] of a TRC file, and its rate."""
    markers = read_markers(path)
    columns = [markers.names.index(side + name) for side in "RL" for name in JOINTS]
    return markers.positions[:, columns], markers.rate


def real_trial(folder: Path) -> None:
    """Noise and residual on the real recording."""
    with tempfile.TemporaryDirectory() as where:
        trial = read_trial(folder, "openpose", Path(where))
    whole = track(trial.recording, load_body("humanoid"))
    points, rate = rival_points(folder / RIVAL)
    rival = acceleration_noise(points, rate)
    ours = acceleration_noise(joint_centres(whole), whole.rate)
    print(f"# above {ABOVE:g} Hz: rival {rival:.2f}, ours {ours:.2f} m/s2")
    figure("smooth_acceleration_noise", ours / rival, "x", "<= 0.5")
    figure("smooth_residual", median_residual(whole), "px", "<= 9")


def synthetic(keypoint_set: str) -> None:
    """Joint centres, angles and peak speeds of recorded motions."""
    joints, angles, sure, peaks = [], [], [], []
    for name, truth, motion, errors in library_tracked(keypoint_set):
        for of, error in zip((joints, angles, sure), errors):
            of.append(error)
        peaks.append(np.median(peak_speeds(motion) / peak_speeds(truth)))
        print(
            f"# {keypoint_set} {name}: {joints[-1]:.1f} mm, {angles[-1]:.2f} deg, of angles surer than 10 deg "
            f"{sure[-1]:.2f} deg, peak speed of hands and feet {peaks[-1]:.2f} of the truth", flush=True,
        )  # fmt: skip
    absent, tag = "the recorded motions are absent", keypoint_set.lower()
    figure(f"smooth_joints_{tag}", float(np.mean(joints)) if joints else None, "mm", "<= 8", absent)
    figure(f"smooth_angles_{tag}", float(np.mean(angles)) if angles else None, "deg", "<= 2", absent)
    figure(f"smooth_sure_angles_{tag}", float(np.mean(sure)) if sure else None, "deg", "<= 2", absent)
    figure(f"smooth_peak_speed_{tag}", float(np.mean(peaks)) if peaks else None, "x", ">= 0.95", absent)


def peak_speeds(motion: Motion) -> NDArray:
    """(4,) [m/s] that hands and feet exceed in a fiftieth of the frames."""
    x = motion.segment_poses()[..., :3, 3][:, [motion.body.tree.segment(s) for s in FAST]]
    return np.quantile(np.linalg.norm(np.diff(x, axis=0), axis=2) * motion.rate, 0.98, axis=0)


def speed(frames: int = amount(500, 100)) -> None:
    """CPU time of one iteration over all frames, equations, factor and solution."""
    truth = cut(squat_and_wave(rate=60, duration=frames / 60 + 1), 0, frames)
    body, rig, random = truth.body, studio_rig(truth), np.random.default_rng(0)
    tree, points = body.tree, body.keypoints("BODY_25B")
    x = truth.positions(points)
    uv = np.concatenate([c.project(x.reshape(-1, 3)).reshape(*x.shape[:2], 2) for c in rig], axis=1)
    uv += 3.0 * random.normal(size=uv.shape)
    times = len(rig)
    every = PointSet(points.names * times, np.tile(points.segments, times), np.tile(points.points, (times, 1)))
    camera = np.repeat(np.arange(times), len(points))
    seen = SeenPoints(rig, every, camera, uv, np.full(uv.shape[:2], 1.0 / 9.0), geman_mcclure())
    acceleration = np.where(np.arange(tree.n_dofs) < 3, 5.0, 30.0)
    prior = MotionPrior(acceleration, (0.2, 1.0), 1.0 / truth.rate, tree.usual, tree.spread, couplings=tree.couplings)
    start = np.clip(truth.angles + 0.03 * random.normal(size=truth.angles.shape), tree.lower, tree.upper)
    spent = []
    for _ in range(amount(30, 3)):
        began = time.process_time()
        fit = smooth(body, truth.Ts_world_root, start, seen.equations(body), prior, bounds=(tree.lower, tree.upper))
        spent.append((time.process_time() - began) / fit.iterations)
    print(f"# {frames} frames of {tree.n_dofs} degrees of freedom and {len(every)} pixels; {fit.iterations} iterations")
    figure("smooth_iteration", 1e3 * min(spent), "ms", "<= 35")


def run() -> None:
    """Print every figure of smoothing."""
    one_core = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    call = f"from {__name__} import speed; speed()"
    subprocess.run([sys.executable, "-c", call], env=one_core, check=True)
    each(lambda: real_trial(recording(TRIAL)))
    for keypoint_set in amount(("BODY_25B", "MEDIAPIPE_33"), ("MEDIAPIPE_33",)):
        synthetic(keypoint_set)
