"""Joint angles of ten movements, as functions of the times u (F,) in 0..1 of the movement's duration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class PostureSequence:
    """Joint angles and the trunk's rotation over time.

    Parameters
    ----------
    degrees : coordinate -> (F,) or one [deg]
    lean, roll, heading : (F,) or one [deg]
        Of the root: forward, to the right, to the left about the vertical.
    """

    degrees: Mapping[str, ArrayLike]
    lean: ArrayLike = 0.0
    roll: ArrayLike = 0.0
    heading: ArrayLike = 0.0


def _ease(u: NDArray, start: float, end: float) -> NDArray:
    """0 before `start`, 1 after `end`, with a smooth transition (quintic)."""
    v = np.clip((u - start) / (end - start), 0.0, 1.0)
    return v * v * v * (v * (6.0 * v - 15.0) + 10.0)


def _held(u: NDArray, up: float = 0.3, down: float = 0.7) -> NDArray:
    """0, then 1 from `up` to `down`, then 0."""
    return _ease(u, 0.02, up) * (1.0 - _ease(u, down, 0.98))


def _swings(u: NDArray, count: float) -> NDArray:
    return np.sin(2.0 * np.pi * count * u)


def _standing(**changed: ArrayLike) -> dict[str, ArrayLike]:
    """Joint angles [deg] of a standing person with hanging arms, with some changed."""
    out: dict[str, ArrayLike] = {"neck_extension": 0.0}
    for side in "lr":
        out |= {f"arm_add_{side}": -9.0, f"elbow_flex_{side}": 14.0, f"pro_sup_{side}": 80.0}
        out |= {f"hip_adduction_{side}": -3.0}
    return out | changed


def point(u: NDArray) -> PostureSequence:
    """The right arm points ahead, then sweeps outward and back; u (F,) in 0..1."""
    b, sweep = _held(u), _ease(u, 0.35, 0.5) * (1.0 - _ease(u, 0.5, 0.68))
    return PostureSequence(
        _standing(
            arm_flex_r=78 * b - 10 * sweep, arm_add_r=-9 - 5 * b - 45 * sweep, elbow_flex_r=14 - 8 * b,
            neck_rotation=-15 * b - 20 * sweep,
        ),
        heading=-6 * b,
    )  # fmt: skip


def walk(u: NDArray) -> PostureSequence:
    """Two and a half strides forwards; u (F,) in 0..1."""
    go = _ease(u, 0.0, 0.15) * (1.0 - _ease(u, 0.85, 1.0))
    phase = 2.0 * np.pi * 2.5 * u
    degrees = _standing(arm_flex_r=-20 * go * np.sin(phase), arm_flex_l=20 * go * np.sin(phase))
    for side, sign in (("r", 1.0), ("l", -1.0)):
        swing = np.maximum(sign * np.cos(phase), 0.0) ** 2  # while the leg comes forward
        degrees[f"hip_flexion_{side}"] = go * (sign * 18 * np.sin(phase) + 12 * swing)
        degrees[f"knee_angle_{side}"] = go * (6 + 45 * swing)
        degrees[f"ankle_angle_{side}"] = go * 5 * swing
        degrees[f"elbow_flex_{side}"] = 14 + go * (10 - sign * 8 * np.sin(phase))
    return PostureSequence(degrees, lean=3 * go, heading=4 * go * np.sin(phase))


def wave(u: NDArray) -> PostureSequence:
    """The right hand, raised next to the head, waves four times; u (F,) in 0..1."""
    b = _held(u, 0.25, 0.75)
    swing = b * _swings(u - 0.25, 8.0) * _ease(u, 0.2, 0.3) * (1.0 - _ease(u, 0.7, 0.8))
    return PostureSequence(
        _standing(
            arm_flex_r=15 * b, arm_add_r=-9 - 66 * b, arm_rot_r=-75 * b, elbow_flex_r=14 + 66 * b + 28 * swing,
            pro_sup_r=80 - 60 * b, neck_bending=4 * swing,
        ),
    )  # fmt: skip


def shake_hands(u: NDArray) -> PostureSequence:
    """The right hand is held out and shaken up and down three times; u (F,) in 0..1."""
    b = _held(u)
    shake = _swings(u - 0.3, 7.5) * _ease(u, 0.28, 0.38) * (1.0 - _ease(u, 0.62, 0.72))
    return PostureSequence(
        _standing(arm_flex_r=30 * b + 8 * shake, elbow_flex_r=14 + 40 * b + 10 * shake, neck_extension=-4 * b),
        lean=6 * b, heading=5 * b,
    )  # fmt: skip


def bow(u: NDArray) -> PostureSequence:
    """A deep bow from the hips; u (F,) in 0..1."""
    b = _held(u, 0.42, 0.58)
    arms = {f"arm_flex_{side}": 18 * b for side in "lr"} | {f"hip_flexion_{side}": 55 * b for side in "lr"}
    return PostureSequence(_standing(neck_extension=-10 * b, lumbar_extension=-8 * b, **arms), lean=55 * b)


def clap(u: NDArray) -> PostureSequence:
    """Both hands clap five times in front of the chest; u (F,) in 0..1."""
    b = _held(u, 0.25, 0.75)
    apart = 0.5 - 0.5 * np.cos(2.0 * np.pi * 10.0 * (u - 0.25) * (u > 0.25) * (u < 0.75))
    arms: dict[str, ArrayLike] = {}
    for side in "lr":
        arms |= {
            f"arm_flex_{side}": 36 * b, f"arm_add_{side}": -9 * (1 - b) - 6 * b,
            f"arm_rot_{side}": b * (38 - 30 * apart), f"elbow_flex_{side}": 14 + 66 * b,
        }  # fmt: skip
    return PostureSequence(_standing(**arms))


def sit_down(u: NDArray) -> PostureSequence:
    """Sitting down onto an imaginary seat, and getting up; u (F,) in 0..1."""
    b = _held(u, 0.42, 0.62)
    bent = 4.0 * b * (1.0 - b)
    legs = {f"hip_flexion_{side}": 86 * b + 25 * bent for side in "lr"}
    legs |= {f"knee_angle_{side}": 88 * b for side in "lr"} | {f"hip_adduction_{side}": -3 - 5 * b for side in "lr"}
    legs |= {f"arm_flex_{side}": 30 * b for side in "lr"} | {f"elbow_flex_{side}": 14 + 40 * b for side in "lr"}
    return PostureSequence(_standing(**legs), lean=8 * b + 25 * bent)


def kick(u: NDArray) -> PostureSequence:
    """The right leg swings back and kicks ahead; u (F,) in 0..1."""
    back, kicked = _ease(u, 0.05, 0.35) * (1 - _ease(u, 0.38, 0.5)), _ease(u, 0.38, 0.55) * (1 - _ease(u, 0.6, 0.95))
    return PostureSequence(
        _standing(
            hip_flexion_r=-10 * back + 54 * kicked, knee_angle_r=50 * back + 8 * kicked, hip_adduction_r=-3 - 2 * back,
            hip_flexion_l=10 * back - 5 * kicked, knee_angle_l=6 * back + 4 * kicked,
            arm_flex_l=25 * kicked - 12 * back,
            arm_flex_r=18 * back - 22 * kicked, arm_add_l=-9 - 16 * kicked, arm_add_r=-9 - 16 * kicked,
            elbow_flex_l=14 + 16 * kicked,
        ),
        lean=8 * back - 8 * kicked, heading=6 * kicked,
    )  # fmt: skip


def squat(u: NDArray) -> PostureSequence:
    """A squat with the arms held ahead; u (F,) in 0..1."""
    b = _held(u, 0.45, 0.55)
    legs = {f"hip_flexion_{side}": 92 * b for side in "lr"} | {f"knee_angle_{side}": 96 * b for side in "lr"}
    legs |= {f"hip_adduction_{side}": -3 - 9 * b for side in "lr"} | {f"ankle_angle_{side}": 28 * b for side in "lr"}
    legs |= {f"arm_flex_{side}": 68 * b for side in "lr"}
    return PostureSequence(_standing(neck_extension=16 * b, **legs), lean=28 * b)


def arms_at_sensor(u: NDArray) -> PostureSequence:
    """Both arms are stretched straight ahead, towards the sensor, and held; u (F,) in 0..1."""
    b, sway = _held(u, 0.3, 0.75), _swings(u, 3.0)
    arms = {
        f"{name}_{side}": value
        for side in "lr"
        for name, value in (("arm_flex", 88 * b + 4 * b * sway), ("arm_add", -9 + 9 * b), ("elbow_flex", 14 - 12 * b))
    }
    return PostureSequence(_standing(**arms), lean=2 * b)


MOVEMENTS: Mapping[str, Callable[[NDArray], PostureSequence]] = {
    f.__name__: f for f in (point, walk, wave, shake_hands, bow, clap, sit_down, kick, squat, arms_at_sensor)
}
