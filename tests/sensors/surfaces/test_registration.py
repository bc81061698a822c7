"""A depth camera that does not fit the videos, found and moved, or refused: simulated takes, from files to the fit."""

import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.cli.checks._refine import Refined, write_refined
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.rigs.sensors import fit_sensors
from kinefit.sensors.alignment import misfits, moved_cameras, sensor_findings
from kinefit.simulation import (
    DepthSensor,
    in_front,
    known_motion,
    movement,
    simulate_depth,
    simulate_keypoints,
    studio_rig,
)

SENSOR = DepthSensor("depth", (128, 96), 110.0, 0.5, 5.5, (0.004, 0.0008, 0.0), holes=0.01)
TURN, SHIFT = np.radians([1.0, -1.5, 0.5]), np.array([0.02, 0.01, -0.02])


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Folder with keypoints of two cameras and depth of a person who walks a metre and turns; true rig, and motion."""
    folder = tmp_path_factory.mktemp("walk")
    steps = movement("walk", load_body("humanoid"), rate=15.0, speed=2.0)
    T, u = np.array(steps.Ts_world_root), np.linspace(0.0, 1.0, len(steps))
    T[:, :3, :3] = se3.exp_so3(np.outer(np.pi * u, (0.0, 1.0, 0.0))) @ T[:, :3, :3]
    motion = known_motion(steps.body, steps.rate, T, steps.angles, up="y")
    front = in_front(motion, SENSOR.camera(), azimuth=0.7, near=SENSOR.near, far=SENSOR.far)
    cameras = studio_rig(motion, cameras=2)
    for seen in simulate_keypoints(motion, cameras, "MEDIAPIPE_33", noise_px=2.0, outliers=0.0, missing=0.0):
        values = np.concatenate([seen.points[:, 0], seen.confidence[:, 0, :, None]], axis=-1)
        np.save(folder / f"mediapipe_{seen.camera}.npy", np.nan_to_num(values))
    depth = simulate_depth(motion, front, SENSOR, room=False, seed=1)
    (folder / "depth").mkdir()
    for i in range(len(motion)):
        cv2.imwrite(str(folder / "depth" / f"{i:03d}.png"), np.round(1e3 * depth.frame(i).depth).astype(np.uint16))
    return folder, Rig((*cameras, front)), motion


def fitted(walk, tmp_path, T, frames):
    """Take, observations and the fit, with the depth camera's calibration moved by T (4, 4) in the camera's frame."""
    folder, rig, _ = walk
    camera = rig["depth"]
    told = Rig((*rig.cameras[:2], camera.with_pose(T @ camera.T_camera_world)))
    write_calibration(told, tmp_path / "calibration.toml")
    text = '[take]\nrate = 15.0\nup = "y"\n[calibration]\nfile = "calibration.toml"\n'
    for name in rig.names[:2]:
        text += f'[[camera]]\nname = "{name}"\n[[keypoints]]\ncamera = "{name}"\n'
        text += f'file = "{folder}/mediapipe_{name}.npy"\nformat = "mediapipe"\n'
    text += f'[[depth]]\nname = "depth"\nfile = "{folder}/depth"\nunit = 0.001\nrate = 15.0\nrange = [0.5, 5.5]\n'
    (tmp_path / "take.toml").write_text(text)
    take = read_take(tmp_path / "take.toml")
    seen = load_observations(take)
    (fit,) = fit_sensors(take, seen, frames=frames)
    return take, seen, fit


def left(walk, camera):
    """[deg] and [m] in the middle of the walk by which a depth camera is off."""
    _, rig, motion = walk
    T = se3.inverse(camera.T_camera_world) @ rig["depth"].T_camera_world
    x = motion.positions().reshape(-1, 3).mean(axis=0)
    return np.degrees(np.linalg.norm(se3.log_so3(T[:3, :3]))), np.linalg.norm(se3.apply(T, x) - x)


def test_a_depth_camera_that_does_not_fit_is_moved_to_where_it_belongs(walk, tmp_path):
    wrong = se3.transform(se3.exp_so3(np.radians([1.0, -1.5, 0.5])), [0.02, 0.01, -0.02])
    take, seen, fit = fitted(walk, tmp_path, wrong, frames=6)
    assert left(walk, seen.rig["depth"])[1] > 0.05
    (found,) = (f for f in sensor_findings([fit], take) if f.severity != "good")
    assert (found.severity, found.cameras) == ("fault", ("depth",))
    assert fit.doubts == ()
    turn, shift = left(walk, moved_cameras([fit], take, seen.rig)["depth"])
    assert turn < min(0.4, np.degrees(fit.bars[1]))
    assert shift < min(0.01, fit.bars[0])


def test_one_that_would_move_farther_than_is_usual_is_not_written(walk, tmp_path):
    take, seen, fit = fitted(walk, tmp_path, se3.transform(np.eye(3), [0.0, 0.0, 0.45]), frames=4)
    refined = Refined(None, misfits([fit]))
    assert refined.moved == ()
    assert re.search(r"depth: not refined, because .*it would move by 4\d cm", "\n".join(refined.summary_lines()))
    before = sorted(path.name for path in tmp_path.iterdir())
    found = SimpleNamespace(take=take, observations=seen)
    write_refined(found, refined, tmp_path / "take.toml")
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_one_that_is_upside_down_is_named_and_is_not_written(walk, tmp_path):
    over = se3.transform(se3.exp_so3(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    take, _, fit = fitted(walk, tmp_path, over, frames=4)
    (found,) = sensor_findings([fit], take)
    assert (found.severity, found.cameras) == ("fault", ("depth",))
    assert found.text.startswith("depth hangs upside down, or its pose") and "the person turned by 1" in found.text
    assert Refined(None, misfits([fit])).moved == ()
