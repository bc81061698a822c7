"""Rendered depth images of known poses, shared by the tests of depth."""

import numpy as np

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.rendering import render_body
from kinefit.geometry.camera import Camera

BODY = load_body("humanoid10")
UP = np.array([0.0, 1.0, 0.0])


def camera(width=320, height=240, focal=288.0):
    """1.1 m high, 3 m in front of the origin, looking at it."""
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = -T[:3, :3] @ [0.0, 1.1, 3.0]
    K = np.array([[focal, 0, 0.5 * width - 0.5], [0, focal, 0.5 * height - 0.5], [0, 0, 1]])
    return Camera("depth", (width, height), K, T_camera_world=T)


def facing(height=0.95, yaw=0.3, **degrees):
    """A state that stands before the camera, turned by `yaw` [rad], with some angles [degrees]."""
    angles = np.array(BODY.tree.usual)
    for name, value in degrees.items():
        angles[BODY.tree.coordinate(name)] = np.radians(value)
    f = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    T = np.eye(4)
    T[:3, :3] = np.stack([f, UP, np.cross(f, UP)], axis=1)
    T[:3, 3] = 0.1, height, -0.2
    return BodyState(T, angles)


ARMS = {"arm_add_r": -75, "elbow_flex_r": 60, "arm_flex_l": 60, "arm_add_l": -20, "elbow_flex_l": 40}
ARMS |= {"hip_flexion_l": 25}


def depth_of(body, state, camera, noise=0.004, seed=0):
    """(H, W) [m] what the camera sees of a body and nothing else."""
    depth = render_body(body, state, camera).depth
    shift = noise * np.random.default_rng(seed).normal(size=depth.shape)
    return np.where(np.isfinite(depth), depth + shift, 0.0)
