"""Which sensor set-up is how exact: joints and angles of simulated takes by the number of cameras, and by sensors.

Persons, motions, noise and errors of calibration are those of `mixed` (`mixed_takes`): recorded motions,
MediaPipe's points with 3 px of noise that drifts, 10 % outliers and 10 % missing, cameras 0.1 degree and 3 mm off. All
goes through `kinefit.track_take` with the defaults. Draws from `FIRST` on were used for nothing else.
Joints: mean distance of the joint centres from the truth; angles: mean of those whose stated standard
deviation is below 10 degrees.
"""

from __future__ import annotations

import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.accuracy.mixed.mixed_runs import MIXES
from benchmarks.accuracy.mixed.mixed_takes import RATE, Recording, detected, record, take_text, write
from benchmarks.figures import LEFT_OUT, amount, figure
from benchmarks.scenes.simulated import calibrated, write_cameras
from benchmarks.scenes.takes import tracked
from kinefit import Motion
from kinefit.simulation import studio_rig
from kinefit.simulation.evaluation import angle_errors, joint_errors

FIRST, DRAWS, SURE = 7000, 8, 10.0  # [degrees]
AGAIN = 100_000  # added to the draw whose noise a second take has
CAMERAS = (2, 3, 4, 6, 8)
SENSORS = ("cameras", "cameras_silhouettes", "cameras_depth", "cameras_markers", "depth_alone", "markers_sparse",
           "markers_alone")  # fmt: skip


def run() -> None:
    """Print the table."""
    draws = range(FIRST, FIRST + amount(DRAWS, 1))
    joints, angles = {}, {}
    for draw in draws:
        recording = record(draw, amount(90, 10))
        with tempfile.TemporaryDirectory() as folder:
            write(recording, Path(folder))
            runs = {f"{n} cameras": around(recording, Path(folder), n, draw) for n in amount(CAMERAS, CAMERAS[:2])}
            runs |= {mix: take_text(Path(folder), MIXES[mix]) for mix in amount(SENSORS, SENSORS[-1:])}
            for name, text in runs.items():
                mm, degrees = off(recording, tracked(text)[0])
                joints.setdefault(name, []).append(mm)
                angles.setdefault(name, []).append(degrees)
                print(f"draw {draw}, {name}: {mm:.1f} mm, {degrees:.1f} degrees", flush=True)
    for name, values in joints.items():
        error = np.std(values) / np.sqrt(max(len(values) - 1, 1))
        told = f"{np.mean(values):.1f} +- {error:.1f} mm, worst draw {np.max(values):.1f} mm"
        print(f"{name}: joints {told}, angles {np.nanmean(angles[name]):.1f} degrees, {len(values)} draws")
    for few, more in pairwise(CAMERAS):
        a, b = joints.get(f"{few} cameras"), joints.get(f"{more} cameras")
        ratio = float(np.mean(b) / np.mean(a)) if a and b else None
        figure(f"setup_{more}_over_{few}_cameras", ratio, "", "<= 1", LEFT_OUT)


def around(recording: Recording, folder: Path, cameras: int, draw: int, seen: Motion | None = None) -> str:
    """Take text of so many cameras around the same motion, each as wrong as those of the recording.

    With `seen` the same cameras saw this motion, with noise of its own.
    """
    random = np.random.default_rng([31, draw, cameras])
    rig = studio_rig(recording.truth, cameras=cameras)
    points = detected(seen or recording.truth, rig, draw + AGAIN * (seen is not None), cameras=rig.names)
    return write_cameras(folder, calibrated(rig, random), points, RATE, f"{cameras}_")


def off(recording: Recording, motion) -> tuple[float, float]:
    """[mm], [degrees] of the joints and sure angles of a motion from the truth."""
    truth = recording.truth
    turn, away = np.abs(angle_errors(truth, motion)), joint_errors(truth, motion)
    motion = motion if motion.up == truth.up else motion.turned(truth.up)
    sure = np.degrees(motion.dof_std[:, 6:]) < SURE
    return 1e3 * float(away.mean()), float(turn[sure].mean()) if sure.any() else np.nan
