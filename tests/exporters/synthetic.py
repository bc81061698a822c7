"""A smooth made-up motion of the whole humanoid, with residuals: for tests of files."""

from dataclasses import replace

import numpy as np

from kinefit.bodies import load_body
from kinefit.bodies.motion import Motion, Residuals
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera


def smooth_motion(frames=40, rate=60.0, up="y", seed=0, turns=1.2, body=None):
    """Every angle swings within its limits, the root walks and turns by `turns` whole turns about the vertical."""
    rng = np.random.default_rng(seed)
    body = body or load_body("humanoid").scaled(1 + 0.1 * rng.uniform(-1, 1, len(load_body("humanoid").scale_groups)))
    tree, t = body.tree, np.arange(frames) / rate
    lower, upper = np.clip(tree.lower, -3.0, 3.0), np.clip(tree.upper, -3.0, 3.0)
    phase, speed = rng.uniform(0, 2 * np.pi, len(lower)), rng.uniform(1, 6, len(lower))
    angles = 0.5 * (lower + upper) + 0.45 * (upper - lower) * np.sin(np.outer(t, speed) + phase)
    about_y = np.outer(np.linspace(0, 2 * np.pi * turns, frames), [0, 1, 0])
    R = se3.exp_so3(about_y) @ se3.exp_so3(0.4 * np.sin(np.outer(t, [3, 2, 5])))
    Ts = se3.transform(R, np.stack([0.8 * t, 0.95 + 0.05 * np.sin(5 * t), 0.3 * np.sin(2 * t)], 1))
    S, D = len(tree.segments), len(tree.coordinates)
    dof_std = rng.uniform(0.001, 0.02, (frames, 6 + D))
    dof_std[3:5, 6] = np.inf
    motion = Motion(
        body=body, rate=rate, times=2.0 + t, Ts_world_root=Ts, angles=angles, dof_std=dof_std,
        joint_std=rng.uniform(0.002, 0.01, (frames, S, 3)), quality=rng.uniform(0.5, 1, frames),
        segment_quality=np.where(rng.uniform(size=(frames, S)) < 0.02, 0.0, 1.0), name="made up",
    )
    return with_residuals(motion, [a_camera(f"cam {k}", 0.7 * k) for k in range(2)], rng).turned(up)


def a_camera(name, turn, size=(320, 480)):
    """A camera about 4 m away that looks at the middle of the walk."""
    z = np.array([np.cos(turn), 0.0, np.sin(turn)])
    R = np.stack([np.cross([0, -1, 0], z), [0, -1, 0], z])
    T = se3.transform(R, -R @ (np.array([0.3, 0.95, 0.0]) - 4.0 * z))
    focal = 0.9 * size[1]
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    return Camera(name, size, K, [-0.1, 0.02, 0.001, 0.0], T_camera_world=T)


def with_residuals(motion, cameras, rng):
    """Residuals of keypoints of all cameras and of some markers."""
    out = {}
    for camera in cameras:
        points = motion.body.keypoints("BODY_25B")
        values = rng.normal(0, 3, (len(motion), len(points), 2))
        values[rng.uniform(size=values.shape[:2]) < 0.1] = np.nan
        out[camera.name] = Residuals(
            points.names, points.segments, values,
            np.where(np.isnan(values[..., 0]), 0.0, rng.uniform(0, 1, values.shape[:2])), "px",
            camera.project(motion.positions(points)) + values, rng.uniform(size=len(motion)) < 0.2,
        )
    markers = motion.body.markers("HANIM_45")
    values = rng.normal(0, 0.01, (len(motion), len(markers), 3))
    out["markers/1"] = Residuals(
        markers.names, markers.segments, values, np.ones(values.shape[:2]), "m", motion.positions(markers) + values,
        np.zeros(len(motion), bool),
    )
    return replace(motion, residuals=out)
