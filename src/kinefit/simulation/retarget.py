"""Put motions on other bodies: recorded skeletons by their bones, known motions by common landmarks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState, PointSet, load_body
from kinefit.bodies.motion import Motion
from kinefit.errors import BodyError, ObservationError, choices
from kinefit.findings import FINDINGS, as_records
from kinefit.geometry import se3
from kinefit.observations import SkeletonMotion
from kinefit.simulation.skeletons import BoneDirections, bone_directions, steps
from kinefit.solving.correspondences import point_rows, prediction_rows, prior_rows
from kinefit.solving.least_squares import Fit, levenberg_marquardt

_TARGET_STD = 0.001  # [m]; small relative to a bone, so that priors determine only what targets do not
_POSTURE_STD = 0.5  # [rad] of the angles about the default posture: determines the rotation of a straight arm
_CHANGE_STD = 0.2  # [rad] of the angles from frame to frame
_EXTREMITY_STD = 0.004  # [m] of targets of hands and feet, which recordings often bend beyond joint limits
_MAX_GOOD_COST = 1000.0  # of a frame that is fitted well
_QUALITIES = ("dof_std", "joint_std", "quality", "segment_quality")
_ANCHOR_CANDIDATES = 5  # frames tried as the first one
_ARM_STARTS = ((-1.2, 1.3), (0.0, 1.3), (1.2, 1.3))  # [rad] rotation of the upper arm, pronation
_CHAIN = (("thigh", "shank"), ("shank", "foot"), ("foot", "toes"), ("upperarm", "forearm"), ("forearm", "hand"))
_POINTS = ("skull_vertex", "l_tragion", "r_tragion") + tuple(
    f"{side}_{name}" for side in "lr" for name in ("digit_2", *(f"metacarpal_phalanx_{k}" for k in (2, 3, 5)))
)
_EXTREMITIES = tuple(f"toes_{side}" for side in "lr") + _POINTS[3:]


@checked
def retarget(
    skeleton: SkeletonMotion, body: Body | None = None, *, rate: float | None = None,
    names: Mapping[str, str] | None = None,
) -> Motion:
    """Retarget a recorded skeleton to a body: same bone directions, the body's own lengths.

    Target points follow from joint to joint, with the body's lengths along the recorded directions. The body is fitted
    to them within its joint limits. The root's path is scaled by the length of the legs.

    Parameters
    ----------
    skeleton : SkeletonMotion
        Of a family of `bodies.joint_names.FAMILIES`, or with joints given by `names`.
    body : Body, optional
        The catalogue's "humanoid" (default), or a body with the same segments and landmarks.
    rate : float [Hz], optional
        Of the result; default: the recorded one.
    names : segment -> name of its joint, optional
        See `bodies.joint_names.recorded_joints`.

    Returns
    -------
    Motion
        Y up, standard deviations zero, qualities one. Its provenance holds a finding if the trunk's zero is doubtful.

    Raises
    ------
    ObservationError
        The skeleton is of no known family (the message lists the missing joints), or no pose of it is upright: see
        `skeletons.bone_directions`.
    BodyError
        The body lacks segments or landmarks of the humanoid.
    """
    body = load_body("humanoid") if body is None else body
    bones = bone_directions(skeleton, names)
    if rate is not None and rate != skeleton.rate:
        bones = bones.resampled(rate)
    points, targets, Ts_world_root = _targets(body, bones)
    angles = np.empty((len(bones), len(body.tree.coordinates)))
    roots = np.empty((len(bones), 4, 4))

    def follow(frames: Iterable[int], state: BodyState) -> None:
        for frame in frames:
            start = BodyState(Ts_world_root[frame], state.angles)
            fit = _fit(body, start, points, targets[frame], change=_CHANGE_STD)
            if fit.equations.cost > _MAX_GOOD_COST:  # a joint is at its limit: try other angles of the same rotation
                starts = _equivalent_shoulders(body, start)
                fits = [_fit(body, s, points, targets[frame], change=np.inf) for s in starts]
                other = min(fits, key=lambda f: f.equations.cost)
                fit = other if other.equations.cost < 0.5 * fit.equations.cost else fit
            state = fit.state
            roots[frame], angles[frame] = state.T_world_root, state.angles

    anchor, state = _anchor(body, points, targets, Ts_world_root)
    follow(range(anchor, -1, -1), state)
    follow(range(anchor + 1, len(bones)), state)
    name = skeleton.source.replace("\\", "/").rpartition("/")[2].partition(".")[0]
    motion = known_motion(body, bones.rate, roots, angles, name=name or "motion")
    return replace(motion, provenance={FINDINGS: as_records([bones.doubt])}) if bones.doubt else motion


@checked
def known_motion(
    body: Body, rate: float, Ts_world_root: NDArray, angles: NDArray, *, up: str = "y", name: str = "motion"
) -> Motion:
    """Motion from roots (F, 4, 4) [m] and angles (F, D) [rad], with standard deviations zero and qualities one."""
    frames, segments = len(angles), len(body.tree.segments)
    return Motion(
        body=body, rate=rate, times=np.arange(frames) / rate, Ts_world_root=Ts_world_root, angles=angles,
        dof_std=np.zeros((frames, body.tree.n_dofs)), joint_std=np.zeros((frames, segments, 3)),
        quality=np.ones(frames), segment_quality=np.ones((frames, segments)), up=up, name=name,
    )


def _fit(body: Body, start: BodyState, points: PointSet, target: NDArray, *, change: float) -> Fit:
    sigma = np.where([name in _EXTREMITIES for name in points.names], _EXTREMITY_STD, _TARGET_STD)
    return fit_to_points(body, start, points, target, sigma=sigma, change=change)


def fit_to_points(
    body: Body, start: BodyState, points: PointSet, target: NDArray, *, sigma: ArrayLike, change: float
) -> Fit:
    """Fit a state to targets (K, 3) [m] of points of a body, with priors on the posture and on changes from the start.

    Parameters
    ----------
    sigma : scalar or (K,) [m] of the targets
    change : float [rad], standard deviation of the angles about those of the start
    """
    of_change = np.concatenate([np.full(6, np.inf), np.full(len(start.angles), change)])

    def make_rows(state: BodyState) -> tuple:
        return (
            point_rows(body, state, points, target, sigma=sigma),
            prior_rows(body, state, sigma=_POSTURE_STD),
            prediction_rows(body, state, start, sigma=of_change),
        )

    return levenberg_marquardt(body, start, make_rows, tolerance=1e-6)


def _equivalent_shoulders(body: Body, state: BodyState) -> list[BodyState]:
    """States with the same shoulder rotations by other angles: (a, b, c) about z, x, y is (a ± π, π - b, c ± π)."""
    states = []
    for sides in ("l", "r", "lr"):
        angles = np.array(state.angles)
        for side in sides:
            d = [body.tree.coordinate(f"{name}_{side}") for name in ("arm_flex", "arm_add", "arm_rot")]
            turned = np.array([np.pi, np.pi, np.pi]) + angles[d] * (1.0, -1.0, 1.0)
            middle = 0.5 * (body.tree.lower[d] + body.tree.upper[d])
            angles[d] = turned - 2 * np.pi * np.round((turned - middle) / (2 * np.pi))
        states.append(BodyState(state.T_world_root, angles))
    return states


def _anchor(body: Body, points: PointSet, targets: NDArray, Ts_world_root: NDArray) -> tuple[int, BodyState]:
    """The best fitted of a few frames, each from several starts, and its state.

    Arms have false solutions with elbow and shoulder turned the wrong way; several starts find the right one.
    """
    best, where, least = body.rest_state(Ts_world_root[0]), 0, np.inf
    for frame in np.unique(np.linspace(0, len(targets) - 1, _ANCHOR_CANDIDATES).astype(int)):
        for turns in product(_ARM_STARTS, repeat=2):
            start = np.array(body.rest_state().angles)
            for side, (rotation, pronation) in zip("lr", turns):
                bent = {"arm_rot": rotation, "pro_sup": pronation, "elbow_flex": 0.8, "knee_angle": 0.3}
                for name, value in bent.items():
                    start[body.tree.coordinate(f"{name}_{side}")] = value
            fit = _fit(body, BodyState(Ts_world_root[frame], start), points, targets[frame], change=np.inf)
            if fit.equations.cost < least:
                best, where, least = fit.state, int(frame), fit.equations.cost
    return where, best


def _targets(body: Body, bones: BoneDirections) -> tuple[PointSet, NDArray, NDArray]:
    """K points of the body, their targets (F, K, 3) [m], and the root's pose (F, 4, 4)."""
    tree = body.tree
    lacking = [name for name in _POINTS if name not in body.landmarks.names]
    joints = [f"{name}_{side}" for pair in _CHAIN for name in pair for side in "lr"]
    joints += ["abdomen", "thorax", "head", "clavicle_l", "clavicle_r"]
    lacking += [name for name in joints if name not in tree.segments]
    if lacking:
        raise BodyError(
            choices("segment or landmark", lacking[0], (*tree.segments, *body.landmarks.names)),
            remedy="Use the humanoid of the catalogue, or a body with its segments and landmarks.",
        )
    offset = {name: tree.offsets[tree.segment(name)] for name in tree.segments}
    local = {name: body.landmarks.points[body.landmarks.index(name)] for name in _POINTS}
    place: dict[str, NDArray] = {}  # of joints (by segment) and landmarks, (F, 3)

    hips = 0.5 * (offset["thigh_l"] + offset["thigh_r"])
    leg = 0.5 * sum(float(np.linalg.norm(offset[f"{name}_{side}"])) for name in ("shank", "foot") for side in "lr")
    R = _frames(bones.bones["pelvis"], bones.across["pelvis"], bones.upright["pelvis"], keep_across=True)
    origin = bones.hip_centre * (leg / bones.leg_length) - R @ hips
    Ts_world_root = se3.transform(R, origin)
    for name in ("thigh_l", "thigh_r", "abdomen"):
        place[name] = origin + R @ offset[name]

    R = _frames(bones.bones["abdomen"], bones.across["pelvis"] + bones.across["thorax"], bones.upright["abdomen"])
    place["thorax"] = place["abdomen"] + R @ offset["thorax"]
    R = _frames(bones.bones["thorax"], bones.across["thorax"], bones.upright["thorax"])
    for name in ("head", "clavicle_l", "clavicle_r"):
        place[name] = place["thorax"] + R @ offset[name]
    for side in "lr":
        turn = R @ _turn_from_median(bones.bones[f"clavicle_{side}"], R)
        place[f"upperarm_{side}"] = place[f"clavicle_{side}"] + turn @ offset[f"upperarm_{side}"]
    R = _frames(bones.bones["head"], bones.across["head"], bones.upright["head"])
    for name in ("skull_vertex", "l_tragion", "r_tragion"):
        place[name] = place["head"] + R @ local[name]

    for side in "lr":
        for parent, child in _CHAIN:
            length = np.linalg.norm(offset[f"{child}_{side}"])
            place[f"{child}_{side}"] = place[f"{parent}_{side}"] + length * bones.bones[f"{parent}_{side}"]
        tip = f"{side}_digit_2"
        place[tip] = place[f"toes_{side}"] + np.linalg.norm(local[tip]) * bones.bones[f"toes_{side}"]
        knuckle = local[f"{side}_metacarpal_phalanx_3"]
        thumb = bones.across[f"hand_{side}"] * (1.0 if side == "r" else -1.0)
        R = _frames(bones.bones[f"hand_{side}"], thumb, knuckle[:2] / np.linalg.norm(knuckle[:2]))
        for k in (2, 3, 5):
            name = f"{side}_metacarpal_phalanx_{k}"
            place[name] = place[f"hand_{side}"] + R @ local[name]

    segments = [body.landmarks.segments[body.landmarks.index(n)] if n in local else tree.segment(n) for n in place]
    points = PointSet(tuple(place), np.array(segments), np.array([local.get(n, np.zeros(3)) for n in place]))
    return points, np.stack(list(place.values()), axis=1), Ts_world_root


def _frames(bone: NDArray, across: NDArray, rest: NDArray, *, keep_across: bool = False) -> NDArray:
    """Rotations (F, 3, 3) that take z to `across` and (rest, 0) to `bone`, both (F, 3).

    If these are not orthogonal, the bone is kept and `across` made orthogonal to it; with `keep_across` vice versa.
    """
    first, second = (across, bone) if keep_across else (bone, across)
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = second - np.sum(first * second, axis=1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    z, along = (first, second) if keep_across else (second, first)
    third = np.cross(z, along)
    forward, up = rest
    return np.stack([forward * along - up * third, up * along + forward * third, z], axis=-1)


def _turn_from_median(directions: NDArray, R: NDArray) -> NDArray:
    """Smallest rotations (F, 3, 3) in the frames R (F, 3, 3) from the median direction to each (F, 3)."""
    local = (directions[:, None] @ R)[:, 0]
    return se3.shortest_turn(np.median(local, axis=0), local)


@checked
def cut(motion: Motion, start: int, stop: int | None = None) -> Motion:
    """Cut frames [start, stop) out of a motion, like a Python slice; its time starts at zero.

    Raises
    ------
    ObservationError
        No frames remain.
    """
    rows = slice(start, stop)
    if not len(motion.times[rows]):
        raise ObservationError(
            f"'{motion.name}' has no frames between {start} and {stop}",
            remedy=f"Give frames from 0 to {len(motion) - 1}.",
        )
    frames = ("values", "weights", "measured", "swapped", "rms", "count")  # rms and count of surfaces alone
    residuals = {
        name: replace(r, **{key: column[rows] for key in frames if (column := getattr(r, key)) is not None})
        for name, r in motion.residuals.items()
    }
    times = motion.times[rows]
    arrays = {name: getattr(motion, name)[rows] for name in ("Ts_world_root", "angles", *_QUALITIES)}
    return replace(motion, times=times - times[:1], residuals=residuals, **arrays)


@checked
def resampled(motion: Motion, rate: float) -> Motion:
    """Resample a motion at another rate [Hz]: angles and root position linearly, root rotation along the shortest arc.

    Standard deviations and qualities are those of the worse neighbour; residuals are dropped.

    Raises
    ------
    ObservationError
        The rate is not positive.
    """
    low, high, share = steps(len(motion), motion.rate, rate)
    A, B = motion.Ts_world_root[low], motion.Ts_world_root[high]
    step = se3.log_so3(B[:, :3, :3] @ A[:, :3, :3].swapaxes(1, 2))
    R = se3.exp_so3(share[:, None] * step) @ A[:, :3, :3]
    origin = A[:, :3, 3] + share[:, None] * (B[:, :3, 3] - A[:, :3, 3])
    angles = motion.angles[low] + share[:, None] * (motion.angles[high] - motion.angles[low])
    ends = {name: (getattr(motion, name)[low], getattr(motion, name)[high]) for name in _QUALITIES}
    worse = {name: (np.maximum if name.endswith("std") else np.minimum)(*pair) for name, pair in ends.items()}
    return replace(
        motion, rate=rate, times=motion.times[0] + np.arange(len(low)) / rate, Ts_world_root=se3.transform(R, origin),
        angles=angles, residuals={}, **worse,
    )


_LANDMARK_STD = 0.01  # [m]; small relative to a limb, so that priors determine only what landmarks do not
_MIN_LANDMARKS = 6  # in common: fewer do not determine all limbs


@checked
def on_body(motion: Motion, body: Body) -> Motion:
    """Fit another body to the landmarks of a motion that both bodies have by name.

    If the statures differ, places are scaled about the world's origin by their ratio, so the floor stays at height
    zero.

    Parameters
    ----------
    motion : Motion
    body : Body

    Returns
    -------
    Motion
        Standard deviations zero, qualities one.

    Raises
    ------
    BodyError
        Fewer than six landmarks of the same names.
    """
    names = tuple(name for name in body.landmarks.names if name in motion.body.landmarks.names)
    if len(names) < _MIN_LANDMARKS:
        raise BodyError(
            f"the bodies '{motion.body.name}' and '{body.name}' have only {len(names)} landmarks in common",
            remedy=f"Use a body with {_MIN_LANDMARKS} or more of: {', '.join(motion.body.landmarks.names)}.",
        )
    points, scale = body.landmarks.select(names), 1.0
    if body.stature > 0 and motion.body.stature > 0:
        scale = body.stature / motion.body.stature
    targets = scale * motion.positions(motion.body.landmarks.select(names))
    state, roots, angles = body.default_state(), [], []
    for frame, target in enumerate(targets):
        start = BodyState(_aligned(body, state, points, target), state.angles)
        change = _CHANGE_STD if frame else np.inf
        state = fit_to_points(body, start, points, target, sigma=_LANDMARK_STD, change=change).state
        roots.append(state.T_world_root)
        angles.append(state.angles)
    return known_motion(body, motion.rate, np.array(roots), np.array(angles), up=motion.up, name=motion.name)


def _aligned(body: Body, state: BodyState, points: PointSet, target: NDArray) -> NDArray:
    """T_world_root (4, 4) that aligns the points of a state with their targets (Kabsch)."""
    return se3.aligned(body.positions(state, points), target) @ state.T_world_root
