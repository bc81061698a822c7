"""Ten synthetic movements by their postures, and people who perform them: P2's experiment (P2 5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, TaperedCylinder, load_body
from kinefit.bodies.motion import Motion
from kinefit.errors import ObservationError, choices
from kinefit.geometry import se3
from kinefit.simulation.retarget import known_motion


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


DURATION = 4.0  # [s] at speed 1
_SUPPORT_HEIGHT = 0.02  # [m] of a foot being lifted, over which its share of the support decays
_MAX_FOOT_HEIGHT = 0.04  # of the stature: ankles are higher
_SOLE_THICKNESS = 0.015  # [m] of a foot below the axis of its toes


@dataclass(frozen=True, eq=False)
class Performer:
    """A person, the speed of the movement, and the direction of the sensor.

    Parameters
    ----------
    body : Body
    speed : float, 1 for the default duration of four seconds
    azimuth : float [rad]
        Of the sensor, counter-clockwise seen from above, from the person's forward direction.
    """

    body: Body
    speed: float
    azimuth: float


@checked
def movement(name: str, body: Body | None = None, *, rate: float = 30.0, speed: float = 1.0) -> Motion:
    """One of the ten movements: point, walk, wave, shake_hands, bow, clap, sit_down, kick, squat, arms_at_sensor.

    Parameters
    ----------
    name : str
    body : Body, optional
        The catalogue's "humanoid10" (default) or "humanoid", or one with coordinates of their names.
    rate : float [Hz]
    speed : float
        The movement takes 4 s / speed.

    Returns
    -------
    Motion
        World y up, the person faces x at the start, the floor is at height zero; standard deviations zero.

    Raises
    ------
    ObservationError
        An unknown movement; a rate or speed that is not positive.
    """
    if name not in MOVEMENTS:
        raise ObservationError(choices("movement", name, MOVEMENTS))
    if not (0.0 < rate < np.inf and 0.0 < speed < np.inf):
        problem = f"rate is {rate} Hz, speed is {speed}"
        raise ObservationError(problem, remedy="Give positive numbers.")
    body = load_body("humanoid10") if body is None else body
    count = max(round(rate * DURATION / speed), 2)
    posture = MOVEMENTS[name](np.linspace(0.0, 1.0, count))
    angles = np.zeros((count, len(body.tree.coordinates)))
    for coordinate, degrees in posture.degrees.items():
        if coordinate in body.tree.coordinates:
            angles[:, body.tree.coordinate(coordinate)] = np.radians(degrees)
    angles = np.clip(angles, body.tree.lower, body.tree.upper)
    heading, lean, roll = (np.radians(np.broadcast_to(v, count)) for v in (posture.heading, posture.lean, posture.roll))
    zero = np.zeros(count)
    R = (
        se3.exp_so3(np.column_stack([zero, heading, zero]))
        @ se3.exp_so3(np.column_stack([zero, zero, -lean]))
        @ se3.exp_so3(np.column_stack([roll, zero, zero]))
    )
    Ts_world_root = _planted(body, R, angles)
    return known_motion(body, rate, Ts_world_root, angles, up="y", name=name)


def people(body: Body | None = None, *, count: int = 10, seed: int = 0) -> tuple[Performer, ...]:
    """People of 1.50 to 2.00 m stature with different girths, speeds (0.6 to 1.6) and sensor azimuths (± 20 degrees).

    The values of every property are evenly spaced over its range, and combined at random. Limb lengths vary by ± 4 %
    about those of the stature, girths are 0.85 to 1.2 times as large.
    """
    body = load_body("humanoid10") if body is None else body
    random = np.random.default_rng(seed)

    def spread(low: float, high: float) -> NDArray:
        return random.permutation(np.linspace(low, high, count) if count > 1 else [0.5 * (low + high)])

    statures, girths, speeds = spread(1.5, 2.0), spread(0.85, 1.2), spread(0.6, 1.6)
    azimuths = np.radians(spread(-20.0, 20.0))
    out = []
    for stature, girth, speed, azimuth in zip(statures, girths, speeds, azimuths):
        factors = stature / body.stature * random.uniform(0.96, 1.04, len(body.scale_groups))
        out.append(Performer(_stouter(body.scaled(factors), girth), float(speed), float(azimuth)))
    return tuple(out)


def _stouter(body: Body, girth: float) -> Body:
    """The body with the half axes of all cylinders multiplied by `girth`."""
    surfaces = []
    for s in body.surfaces:
        if isinstance(s, TaperedCylinder):
            (a0, b0), (a1, b1) = s.radii
            s = replace(s, radii=((girth * a0, girth * b0), (girth * a1, girth * b1)))
        surfaces.append(s)
    return replace(body, surfaces=tuple(surfaces))


def _planted(body: Body, R_world_root: NDArray, angles: NDArray) -> NDArray:
    """T_world_root (F, 4, 4) for which the lowest foot is on the floor and does not slip."""
    Ts = se3.transform(R_world_root, np.zeros((len(angles), 3)))
    poses = body.tree.segment_poses(Ts, angles)
    feet = [np.mean([se3.apply(poses[:, k], point) for k, point in foot], axis=0) for foot in _feet(body)]
    x = np.stack(feet, axis=1)  # (F, feet, 3)
    height = x[..., 1]
    share = np.exp(-(height - height.min(axis=1, keepdims=True)) / _SUPPORT_HEIGHT)
    share /= share.sum(axis=1, keepdims=True)
    place = np.zeros((len(angles), 3))
    carried = 0.5 * (share[1:] + share[:-1])[..., None] * np.diff(x, axis=0)
    place[1:] = -np.cumsum(carried.sum(axis=1), axis=0)
    place[:, 1] = _standing_height(body) - np.sum(share * height, axis=1)
    Ts[:, :3, 3] = place
    return Ts


def _feet(body: Body) -> list[list[tuple[int, NDArray]]]:
    """Points of the left and the right foot, with their segments: the lowest cylinder ends of the rest pose."""
    tips = _tips(body)
    if not tips:
        return [[(s, np.zeros(3)) for s in range(len(body.tree.segments))]]
    x = np.array([body.tree.rest[s] + p for s, p in tips])
    low = x[:, 1] < x[:, 1].min() + _MAX_FOOT_HEIGHT * max(body.stature, 1e-3)
    sides = [low & (x[:, 2] < 0.0), low & (x[:, 2] >= 0.0)]
    return [[tip for tip, here in zip(tips, side) if here] for side in sides if side.any()]


def _standing_height(body: Body) -> float:
    """Height [m] of the middle of the feet above the floor in the rest pose."""
    low = min((body.tree.rest[s, 1] + p[1] for s, p in _tips(body)), default=0.0)
    feet = np.mean([body.tree.rest[s, 1] + p[1] for foot in _feet(body) for s, p in foot])
    return float(feet - low + _SOLE_THICKNESS)


def _tips(body: Body) -> list[tuple[int, NDArray]]:
    return [(c.segment, np.array(p)) for c in body.surfaces if isinstance(c, TaperedCylinder) for p in (c.start, c.end)]


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
