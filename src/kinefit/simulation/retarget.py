"""A recorded motion of any known skeleton, put onto the humanoid by the directions of its bones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState, PointSet, load_body
from kinefit.correspondences import point_rows, prediction_rows, prior_rows
from kinefit.errors import BodyError, ObservationError, choices
from kinefit.geometry import se3
from kinefit.motion import Motion
from kinefit.observations import SkeletonMotion
from kinefit.simulation.skeletons import BoneDirections, bone_directions, steps
from kinefit.solvers.least_squares import Fit, levenberg_marquardt

_ACCURACY = 0.001  # [m] of the target points; small beside a bone, so that the priors only fill in what is free
_POSTURE = 0.5  # [rad] spread of the angles about the usual posture: decides the turn of a straight arm
_CHANGE = 0.2  # [rad] spread of their change from frame to frame
_LOOSE = 0.004  # [m] the same of hands and feet, which recordings often have bent further than a joint goes
_POOR = 1000.0  # cost of a frame that is not fitted well
_QUALITIES = ("dof_std", "joint_std", "quality", "segment_quality")
_ANCHORS = 5  # frames tried to begin with
_STARTS = ((-1.2, 1.3), (0.0, 1.3), (1.2, 1.3))  # [rad] turn of the upper arm, pronation
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
    """Motion of a body whose bones point where those of a recorded skeleton do; it keeps its own lengths.

    Target points are found by walking from joint to joint with the body's lengths along the recorded directions, and
    the body is fitted to them within its joint limits. The root's way is scaled by the length of the legs.

    Parameters
    ----------
    skeleton : SkeletonMotion
        Of a family of `bodies.joint_names.FAMILIES`, or of names that `names` tells.
    body : Body, optional
        The catalogue's "humanoid" (default), or one of the same segments and landmarks.
    rate : float [Hz], optional
        Of the result; default: the recorded one.
    names : segment -> name of its joint, optional
        As of `bodies.joint_names.recorded_joints`.

    Returns
    -------
    Motion
        Y up, standard deviations zero, qualities one.

    Raises
    ------
    ObservationError
        The skeleton is of no known family; the message tells which joints lack.
    BodyError
        The body is not made like the humanoid.
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
            fit = _fit(body, start, points, targets[frame], change=_CHANGE)
            if fit.equations.cost > _POOR:  # a joint ran into its limit: is there another way to get there?
                fits = [_fit(body, s, points, targets[frame], change=np.inf) for s in _other_ways(body, start)]
                other = min(fits, key=lambda f: f.equations.cost)
                fit = other if other.equations.cost < 0.5 * fit.equations.cost else fit
            state = fit.state
            roots[frame], angles[frame] = state.T_world_root, state.angles

    anchor, state = _anchor(body, points, targets, Ts_world_root)
    follow(range(anchor, -1, -1), state)
    follow(range(anchor + 1, len(bones)), state)
    name = skeleton.source.replace("\\", "/").rpartition("/")[2].partition(".")[0]
    return known_motion(body, bones.rate, roots, angles, name=name or "motion")


def known_motion(
    body: Body, rate: float, Ts_world_root: NDArray, angles: NDArray, *, up: str = "y", name: str = "motion"
) -> Motion:
    """Motion that is known exactly: roots (F, 4, 4) [m], angles (F, D) [rad]; deviations zero, qualities one."""
    frames, segments = len(angles), len(body.tree.segments)
    return Motion(
        body=body, rate=rate, times=np.arange(frames) / rate, Ts_world_root=Ts_world_root, angles=angles,
        dof_std=np.zeros((frames, body.tree.n_dofs)), joint_std=np.zeros((frames, segments, 3)),
        quality=np.ones(frames), segment_quality=np.ones((frames, segments)), up=up, name=name,
    )


def _fit(body: Body, start: BodyState, points: PointSet, target: NDArray, *, change: float) -> Fit:
    accuracy = np.where([name in _EXTREMITIES for name in points.names], _LOOSE, _ACCURACY)
    return fit_to_points(body, start, points, target, sigma=accuracy, change=change)


def fit_to_points(
    body: Body, start: BodyState, points: PointSet, target: NDArray, *, sigma: ArrayLike, change: float
) -> Fit:
    """The state that brings points of a body to targets (K, 3) [m] with `sigma` [m], and leaves the rest as it was.

    `change` : float [rad] spread of the angles about those of the start.
    """
    of_change = np.concatenate([np.full(6, np.inf), np.full(len(start.angles), change)])

    def make_rows(state: BodyState) -> tuple:
        return (
            point_rows(body, state, points, target, sigma=sigma),
            prior_rows(body, state, sigma=_POSTURE),
            prediction_rows(body, state, start, sigma=of_change),
        )

    return levenberg_marquardt(body, start, make_rows, tolerance=1e-6)


def _other_ways(body: Body, state: BodyState) -> list[BodyState]:
    """The same turns of the shoulders by other angles: (a, b, c) about z, x, y is (a ± π, π - b, c ± π)."""
    ways = []
    for sides in ("l", "r", "lr"):
        angles = np.array(state.angles)
        for side in sides:
            d = [body.tree.coordinate(f"{name}_{side}") for name in ("arm_flex", "arm_add", "arm_rot")]
            turned = np.array([np.pi, np.pi, np.pi]) + angles[d] * (1.0, -1.0, 1.0)
            middle = 0.5 * (body.tree.lower[d] + body.tree.upper[d])
            angles[d] = turned - 2 * np.pi * np.round((turned - middle) / (2 * np.pi))
        ways.append(BodyState(state.T_world_root, angles))
    return ways


def _anchor(body: Body, points: PointSet, targets: NDArray, Ts_world_root: NDArray) -> tuple[int, BodyState]:
    """The frame, among a few, that is fitted best from some start, and its state.

    Arms have solutions with elbow and shoulder turned the wrong way; many starts find the right one.
    """
    best, where, least = body.rest_state(Ts_world_root[0]), 0, np.inf
    for frame in np.unique(np.linspace(0, len(targets) - 1, _ANCHORS).astype(int)):
        for turns in product(_STARTS, repeat=2):
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
    """Points (K) of the body, where they should be (F, K, 3) [m], and the root's pose (F, 4, 4)."""
    tree = body.tree
    lacking = [name for name in _POINTS if name not in body.landmarks.names]
    joints = [f"{name}_{side}" for pair in _CHAIN for name in pair for side in "lr"]
    joints += ["abdomen", "thorax", "head", "clavicle_l", "clavicle_r"]
    lacking += [name for name in joints if name not in tree.segments]
    if lacking:
        raise BodyError(
            choices("segment or landmark", lacking[0], (*tree.segments, *body.landmarks.names)),
            remedy="Motions are retargeted to bodies made like the catalogue's humanoid.",
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
        turn = R @ _turn_from_usual(bones.bones[f"clavicle_{side}"], R)
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

    Where those are not at right angles, the bone is kept and the other turned; or the other way round.
    """
    first, second = (across, bone) if keep_across else (bone, across)
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = second - np.sum(first * second, axis=1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    z, along = (first, second) if keep_across else (second, first)
    beside = np.cross(z, along)
    forward, up = rest
    return np.stack([forward * along - up * beside, up * along + forward * beside, z], axis=-1)


def _turn_from_usual(directions: NDArray, R: NDArray) -> NDArray:
    """Smallest rotations (F, 3, 3) in the frames R (F, 3, 3) from the usual (median) direction to each (F, 3)."""
    local = (directions[:, None] @ R)[:, 0]
    return se3.shortest_turn(np.median(local, axis=0), local)


def cut(motion: Motion, start: int, stop: int | None = None) -> Motion:
    """Frames [start, stop) of a motion, as of a Python slice; its time begins at zero.

    Raises
    ------
    ObservationError
        No frames are left.
    """
    rows = slice(start, stop)
    if not len(motion.times[rows]):
        raise ObservationError(
            f"no frames between {start} and {stop} of '{motion.name}'",
            remedy=f"It has the frames 0 to {len(motion) - 1}.",
        )
    residuals = {
        name: replace(
            r, values=r.values[rows], weights=r.weights[rows], measured=r.measured[rows], swapped=r.swapped[rows]
        )
        for name, r in motion.residuals.items()
    }
    times = motion.times[rows]
    arrays = {name: getattr(motion, name)[rows] for name in ("Ts_world_root", "angles", *_QUALITIES)}
    return replace(motion, times=times - times[:1], residuals=residuals, **arrays)


def resampled(motion: Motion, rate: float) -> Motion:
    """A motion at another rate [Hz]: angles and the root's place linearly, its turn along the shortest way.

    Deviations and qualities are those of the worse neighbour; residuals are left out.

    Raises
    ------
    ObservationError
        The rate is not positive.
    """
    at = steps(len(motion), motion.rate, rate)
    low = np.minimum(at.astype(int), len(motion) - 1)
    high, share = np.minimum(low + 1, len(motion) - 1), at - low
    A, B = motion.Ts_world_root[low], motion.Ts_world_root[high]
    step = se3.log_so3(B[:, :3, :3] @ A[:, :3, :3].swapaxes(1, 2))
    R = se3.exp_so3(share[:, None] * step) @ A[:, :3, :3]
    origin = A[:, :3, 3] + share[:, None] * (B[:, :3, 3] - A[:, :3, 3])
    angles = motion.angles[low] + share[:, None] * (motion.angles[high] - motion.angles[low])
    ends = {name: (getattr(motion, name)[low], getattr(motion, name)[high]) for name in _QUALITIES}
    worse = {name: (np.maximum if name.endswith("std") else np.minimum)(*pair) for name, pair in ends.items()}
    return replace(
        motion, rate=rate, times=motion.times[0] + np.arange(len(at)) / rate, Ts_world_root=se3.transform(R, origin),
        angles=angles, residuals={}, **worse,
    )
