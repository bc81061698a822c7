"""A synthetic motion without a recording: a squat while one hand waves."""

from __future__ import annotations

import numpy as np

from kinefit.bodies import Body, load_body
from kinefit.geometry import se3
from kinefit.motion import Motion
from kinefit.simulation.retarget import known_motion


def squat_and_wave(body: Body | None = None, *, rate: float = 30.0, duration: float = 2.0, up: str = "z") -> Motion:
    """Motion of a person who squats once with flat feet, waves with the right hand and looks around.

    Parameters
    ----------
    body : Body, optional
        The catalogue's "humanoid" (default), or one with its coordinates.
    rate : float [Hz]
    duration : float [s]
    up : str
        Vertical axis of the world; the floor is at height zero.
    """
    body = load_body("humanoid") if body is None else body
    t = np.arange(round(rate * duration)) / rate
    phase = t / duration
    depth = 0.5 * (1 - np.cos(2 * np.pi * phase))  # 0 .. 1 .. 0
    raised = np.sin(np.pi * np.clip(phase * 1.6 - 0.1, 0, 1)) ** 2
    wave = np.sin(2 * np.pi * 1.5 * t)
    look = np.sin(2 * np.pi * phase)
    degrees = {
        "lumbar_extension": -12 * depth, "thorax_extension": 3 * look, "thorax_rotation": 8 * look,
        "neck_extension": 20 * depth, "neck_rotation": 30 * look, "neck_bending": 6 * wave * raised,
        "clav_elev_r": 10 * raised, "arm_flex_r": 15 * raised, "arm_add_r": -8 - 60 * raised,
        "arm_rot_r": -75 * raised,
        "elbow_flex_r": 15 + (65 + 25 * wave) * raised, "pro_sup_r": 80 - 60 * raised,
        "wrist_flex_r": 10 * wave * raised,
        "arm_flex_l": 70 * depth, "arm_add_l": -8 - 4 * look, "elbow_flex_l": 15 + 20 * depth, "pro_sup_l": 80 + 0 * t,
    }
    for side in "lr":
        degrees |= {
            f"hip_flexion_{side}": 5 + 80 * depth, f"hip_adduction_{side}": -4 - 8 * depth,
            f"knee_angle_{side}": 10 + 85 * depth, f"ankle_angle_{side}": 5 + 25 * depth,
            f"subtalar_angle_{side}": 2 * depth,
        }
    angles = np.zeros((len(t), len(body.tree.coordinates)))
    for name, values in degrees.items():
        angles[:, body.tree.coordinate(name)] = np.radians(values)
    angles = np.clip(angles, body.tree.lower, body.tree.upper)
    lean = np.zeros((len(t), 3))
    lean[:, 2] = -np.radians(20.0) * depth
    Ts_world_root = se3.transform(se3.exp_so3(lean), np.zeros((len(t), 3)))
    feet = body.trajectories(Ts_world_root, angles, body.landmarks.select(("l_ankle", "r_ankle"))).mean(axis=1)
    heel = body.points_rest(body.landmarks.select(("r_heel", "r_ankle")))
    Ts_world_root[:, :3, 3] = [0.0, heel[1, 1] - heel[0, 1], 0.0] - feet
    return known_motion(body, rate, Ts_world_root, angles, name="squat_and_wave").turned(up)
