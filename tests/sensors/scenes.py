"""Cameras about a person, and postures, shared by the tests of sensors."""

import numpy as np

from kinefit.bodies import BodyState
from kinefit.geometry.camera import Camera, Rig


def ring(count=4, size=(320, 240), f=260.0, away=3.0):
    """Cameras in a ring about a person who stands at the origin."""
    cameras = []
    for k in range(count):
        turn = 2 * np.pi * k / count + 0.3
        eye = np.array([away * np.cos(turn), 1.1, away * np.sin(turn)])
        z = np.array([0.0, 0.9, 0.0]) - eye
        z /= np.linalg.norm(z)
        x = np.cross(z, [0.0, 1.0, 0.0])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3] = np.stack([x, np.cross(z, x), z])
        T[:3, 3] = -T[:3, :3] @ eye
        K = [[f, 0, size[0] / 2 - 0.5], [0, f, size[1] / 2 - 0.5], [0, 0, 1]]
        cameras.append(Camera(f"c{k}", size, K, T_camera_world=T))
    return Rig(tuple(cameras))


def at(body, **degrees):
    """The usual posture with some angles [deg] changed, standing."""
    angles = np.array(body.tree.usual)
    for name, value in degrees.items():
        angles[body.tree.coordinate(name)] = np.radians(value)
    T = np.eye(4)
    T[1, 3] = 0.95
    return BodyState(T, angles)


def posture(body, i):
    """One step of a movement of arms and a leg: two degrees a step."""
    return at(
        body, arm_flex_r=20 + 2 * i, arm_add_r=-40, elbow_flex_r=40 + 2 * i, arm_add_l=-60 - i,
        hip_flexion_l=20 + 2 * i, knee_angle_l=30 + 2 * i,
    )  # fmt: skip
