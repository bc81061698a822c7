"""Simulated takes of people with gear: motions in which every closure holds, and what cameras' detectors would see."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount
from benchmarks.scenes.simulated import without
from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.motion import Motion
from kinefit.bodies.parts import with_dimensions
from kinefit.bodies.tree import Closure
from kinefit.fitting.tracking.recording import Recording
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import known_motion, simulate_keypoints, studio_rig
from kinefit.solving.closed import CLOSED, closed_fit
from kinefit.solving.correspondences import prior_rows
from kinefit.solving.correspondences.closures import closed_at
from kinefit.solving.least_squares import levenberg_marquardt
from kinefit.solving.rows import AnyRows, DofRows, ParameterRows

_SIDE = re.compile("^[LR](?=[A-Z])|left|right")
LEG = ("LKnee", "LAnkle", "LBigToe", "LSmallToe", "LHeel")
PLACED = "driven"
RATE = 50.0
SET, SHIFT = "BODY_25B", 0.01
"""The detector's points, and how far [m] they are from those of the body, one standard deviation along each axis."""

DRIFT = 2.0
"""[px] standard deviation of what a detector's errors have that lasts, beside as much noise as is told."""


@dataclass(frozen=True, eq=False)
class Take:
    """A simulated take.

    Parameters
    ----------
    truth : Motion, of the person's own body
    generic : Body to track with, of usual size and gear
    recording : Recording of keypoints
    hidden : (F,) bool, frames in which nothing of the left leg is seen
    """

    truth: Motion
    generic: Body
    recording: Recording
    hidden: NDArray


def cyclist(
    seed: int, *, seconds: float = 3.0, cameras: int = 4, leg: bool = False, noise: float = 3.0, rate: float = RATE,
    rise: tuple[float, float] | None = None,
) -> Take:  # fmt: skip
    """Somebody who pedals on a bike that stands, seen by cameras about it, and rises from the saddle in between."""
    random = np.random.default_rng(seed)
    generic = load_body("cyclist")
    person = another_person(generic, random)
    turn = random.uniform(-np.pi, np.pi)
    T = se3.transform(se3.exp_so3(np.array([0.0, turn, 0.0])), np.array([*random.uniform(-0.3, 0.3, 1), 0.28, 0.1]))
    person = _known_stand(person, T)
    cadence, start = random.uniform(70.0, 95.0) / 60.0 * 2.0 * np.pi, random.uniform(0.0, 2.0 * np.pi)
    names = person.tree.coordinates
    wave = waves(random, len(names))
    usual = posture_of(person, CYCLING)

    def drive(t: float) -> tuple[Body, ParameterRows, dict[int, float]]:
        posture = usual + wave(t) * wandering(person)
        turned = {6 + names.index("crank_angle"): start + cadence * t}
        return person if rise is None else _risen(person, t, rise), towards(person, posture), turned

    return from_drive(generic, drive, seconds, cameras, seed, leg, noise, rate=rate)


RISE_S, RISEN = 0.4, (0.09, 0.07, 0.0)
"""[s] in which a rider rises from the saddle, or sits down; [m] of the hips from it then, in the bike's frame."""


def _risen(person: Body, t: float, between: tuple[float, float]) -> Body:
    """The rider with the point that holds the hips above the saddle, between two times [s]."""
    share = float(np.clip(min(t - between[0], between[1] - t) / RISE_S, 0.0, 1.0))
    points = np.array(person.landmarks.points)
    points[person.landmarks.names.index("saddle")] += share * share * (3.0 - 2.0 * share) * np.array(RISEN)
    return replace(person, landmarks=replace(person.landmarks, points=points))


def snowboarder(
    seed: int, *, seconds: float = 3.0, cameras: int = 7, leg: bool = False, noise: float = 3.0,
    gear: Mapping[str, float] | None = None, rate: float = RATE, about_jump: bool = False,
) -> Take:  # fmt: skip
    """Somebody who carves and jumps on a board, which may have other dimensions [m, rad] than the catalogue's.

    The take lasts from 0 s on, or so long about the jump and the turn in it.
    """
    random = np.random.default_rng(seed)
    generic = load_body("snowboarder")
    person = with_dimensions(another_person(generic, random), gear or {})
    wave, usual = waves(random, len(person.tree.coordinates)), posture_of(person, RIDING)
    phase, speed, jump = random.uniform(0.0, 2.0 * np.pi), random.uniform(0.7, 1.1), random.uniform(1.2, 2.4)

    def drive(t: float) -> tuple[Body, ParameterRows, dict[int, float]]:
        lean = 0.35 * np.sin(2.0 * np.pi * 0.5 * t + phase)
        air = max(0.0, 1.0 - ((t - jump) / 0.3) ** 2) * 0.45
        yaw = 0.5 * np.sin(2.0 * np.pi * 0.25 * t + phase) + 0.8 * np.clip((t - jump + 0.3) / 0.6, 0.0, 1.0)
        R = se3.exp_so3(np.array([0.0, yaw, 0.0])) @ se3.exp_so3(np.array([0.0, 0.0, lean]))
        place = np.array([0.5 * np.sin(phase + t), 0.1 + air, speed * (t - 0.5 * seconds)])
        held = Closure(PLACED, "rigid", "right_binding", place=tuple(place), turn=tuple(se3.log_so3(R)), hard=True)
        body = replace(person, closures=(*person.closures, held))
        crouch = 0.35 * np.sin(2.0 * np.pi * 0.6 * t + phase) - 0.9 * air
        posture = usual + wave(t) * wandering(person)
        names = person.tree.coordinates
        for name, share in (("hip_flexion", 1.0), ("knee_angle", 1.2)):
            for side in "lr":
                posture[names.index(f"{name}_{side}")] += share * crouch
        return body, towards(person, posture), {}

    begin = jump - 0.5 * amount(seconds, min(seconds, 1.0)) if about_jump else 0.0
    return from_drive(generic, drive, seconds, cameras, seed, leg, noise, person, rate=rate, begin=begin)


CYCLING = {
    "lumbar_extension": -25, "thorax_extension": -12, "neck_extension": 25, "arm_flex_r": 70, "arm_flex_l": 70,
    "arm_add_r": -8, "arm_add_l": -8, "elbow_flex_r": 20, "elbow_flex_l": 20, "hip_flexion_r": 70,
    "hip_flexion_l": 70, "knee_angle_r": 70, "knee_angle_l": 70,
}  # fmt: skip
RIDING = {
    "lumbar_extension": -15, "neck_rotation": 40, "arm_flex_r": 30, "arm_flex_l": 30, "arm_add_r": -50,
    "arm_add_l": -50, "elbow_flex_r": 45, "elbow_flex_l": 45, "hip_flexion_r": 50, "hip_flexion_l": 50,
    "knee_angle_r": 60, "knee_angle_l": 60, "ankle_angle_r": 10, "ankle_angle_l": 10, "hip_adduction_r": -15,
    "hip_adduction_l": -15,
}  # fmt: skip
"""[deg] postures about which people move."""


def another_person(generic: Body, random: np.random.Generator, points_of: str = SET) -> Body:
    """Somebody of another size, each length by itself, whose points a detector sees where it was taught to."""
    size = random.normal(1.0, 0.04)
    body = generic.scaled(size * np.exp(random.normal(0.0, 0.03, len(generic.scale_groups))))
    points, shifts = body.keypoints(points_of), dict[str, NDArray]()
    pairs = [(_SIDE.sub("", name), _SIDE.search(name)) for name in points.names]
    for name, _ in pairs:
        shifts.setdefault(name, random.normal(scale=SHIFT, size=3))
    side = np.array([[1.0, 1.0, 0.0 if s is None else -1.0 if s[0] in ("L", "left") else 1.0] for _, s in pairs])
    return body.with_keypoints(points_of, points.points + np.stack([shifts[name] for name, _ in pairs]) * side)


def _known_stand(body: Body, T: NDArray) -> Body:
    """The body whose bike stands where it does."""
    at, turn = tuple(T[:3, 3].tolist()), tuple(se3.log_so3(T[:3, :3]).tolist())
    closures = tuple(
        replace(c, place=at, turn=turn, place_std=0.0, turn_std=0.0) if c.name == "stand" else c for c in body.closures
    )
    return replace(body, closures=closures)


def posture_of(body: Body, degrees: dict[str, float]) -> NDArray:
    out = np.array(body.tree.usual)
    for name, value in degrees.items():
        out[body.tree.coordinate(name)] = np.radians(value)
    return out


def wandering(body: Body) -> NDArray:
    """(D,) [rad] how far each coordinate of the person wanders about its posture."""
    named = [c.rsplit("_", 1)[0] for c in body.tree.coordinates]
    return np.radians([{"neck_rotation": 15.0, "ankle_angle": 8.0, "arm_add": 6.0}.get(c, 3.0) for c in named])


def towards(body: Body, posture: NDArray) -> ParameterRows:
    """Rows whose residuals are the angles of a posture (D,) [rad], of ten degrees each."""
    held = np.flatnonzero(np.isfinite(body.tree.spread))
    return ParameterRows(6 + held, posture[held], np.full(len(held), np.radians(10.0) ** -2))


def waves(random: np.random.Generator, count: int):
    """Smooth functions of time, of about unit size."""
    speed, phase = random.uniform(0.2, 0.8, (3, count)), random.uniform(0.0, 2.0 * np.pi, (3, count))
    return lambda t: np.sin(2.0 * np.pi * speed * t + phase).sum(axis=0) / np.sqrt(1.5)


def from_drive(
    generic: Body, drive, seconds: float, cameras: int, seed: int, leg: bool = False, noise: float = 3.0,
    of: Body | None = None, points: str = SET, rate: float = RATE, begin: float = 0.0,
) -> Take:  # fmt: skip
    """A take of whatever a function of time [s] says: a body, the posture it is drawn towards, coordinates it has."""
    frames = int(amount(seconds, min(seconds, 1.0)) * rate)
    states, body = list[BodyState](), generic
    for f in range(frames):
        body, towards, driven = drive(begin + f / rate)
        states.append(_solved(body, towards, driven, states[-1] if states else None))
    roots, angles = (np.stack([getattr(s, name) for s in states]) for name in ("T_world_root", "angles"))
    motion = known_motion(body if of is None else of, rate, roots, angles)
    rig = studio_rig(motion, cameras=cameras, up="y")
    seen = simulate_keypoints(
        motion, rig, points, noise_px=noise, drift_px=DRIFT, outliers=0.03, missing=0.05, seed=seed
    )
    hidden = np.zeros(frames, bool)
    if leg:
        hidden[frames // 4 : 3 * frames // 4] = True
        seen = [without(k, hidden, [k.names.index(name) for name in LEG]) for k in seen]
    recording = Recording.of_keypoints(calibrated(rig, seed), seen, sigma=noise, up="y")
    return Take(motion, generic, recording, hidden)


def calibrated(rig: Rig, seed: int) -> Rig:
    """The cameras as a calibration has them, by what the tracker takes a calibration to be off."""
    std, random = TrackSettings().camera_std, np.random.default_rng(seed + 1000)
    if std is None:
        return rig
    twists = random.normal(size=(len(rig), 6)) * np.repeat(std, 3)
    return Rig(tuple(c.with_pose(se3.exp(xi) @ c.T_camera_world) for c, xi in zip(rig, twists)))


def _solved(body: Body, towards: ParameterRows, driven: dict[int, float], last: BodyState | None) -> BodyState:
    """The pose nearest to a posture in which all closures hold exactly and driven coordinates are set."""
    n, index = body.tree.n_dofs, np.array(list(driven), int)
    wanted = np.array(list(driven.values()))

    def constraint(state: BodyState) -> tuple[NDArray, NDArray]:
        closed = closed_at(body, state)
        more = state.angles[index - 6] - wanted if len(index) else np.zeros(0)
        return np.concatenate([closed.value, more]), np.concatenate([closed.jacobian, np.eye(n)[index]])

    def rows(state: BodyState) -> list[AnyRows]:
        away = replace(towards, residual=towards.residual - state.angles[towards.index - 6])
        return [away, prior_rows(body, state)]

    def near(state: BodyState) -> list[AnyRows]:
        c, A = constraint(state)
        return [*rows(state), DofRows(A, -c, np.full(len(c), 1e4), np.full(len(c), -1))]

    if last is None:
        posture = np.array(body.default_state().angles)
        posture[towards.index - 6] = towards.residual
        fits = []
        for turn in np.arange(4) * 0.5 * np.pi:
            for crank in np.arange(4) * 0.5 * np.pi:
                start = np.array(posture)
                for name in ("right_pedal_angle", "left_pedal_angle"):
                    if name in body.tree.coordinates:
                        start[body.tree.coordinate(name)] = crank * (1 if name[0] == "r" else -1)
                if len(index):
                    start[index - 6] = wanted
                T = se3.transform(se3.exp_so3(np.array([0.0, turn, 0.0])), np.array([0.0, 1.0, 0.0]))
                first = BodyState(T, np.clip(start, body.tree.lower, body.tree.upper))
                fits.append(levenberg_marquardt(body, first, near, max_iterations=60, tolerance=1e-4))
        last = min(fits, key=lambda fit: fit.equations.cost).state
    fit = closed_fit(body, last, rows, constraint, max_iterations=30, tolerance=1e-5)
    assert np.abs(constraint(fit.state)[0]).max() <= CLOSED, "a pose that is not closed"
    return fit.state
