"""Where cameras stand, from the people in view alone: their own keypoints are the calibration object.

Which way is up and where the floor is, from a person who stands and walks on it.

A first rig from pixels that cameras have in common, with no pose known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked, renamed
from kinefit.bodies import Body, PointSet
from kinefit.bodies.limbs import rigid_pairs
from kinefit.bodies.motion import rotation_between_up
from kinefit.errors import CalibrationError
from kinefit.fitting.multiview.association import person_records
from kinefit.fitting.smoothing.foot_contacts import fit_plane, upward
from kinefit.fitting.subject.subject import Progress
from kinefit.fitting.tracking.recording import spread
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import triangulate, triangulate_robust
from kinefit.observations import KEYPOINT_SIGMA, Keypoints
from kinefit.rigs.people.skeletons import first_cameras, in_step, steady_person
from kinefit.rigs.refine.gauge import resized
from kinefit.rigs.refine.refine import Length, check_input, length_of, prior_sigma, refine_from
from kinefit.rigs.refine.result import PersonSighting, PersonTrial, Refinement
from kinefit.sensors.channels import Channels, make_channels
from kinefit.solving.bundle.adjust import BundleState, adjust
from kinefit.solving.bundle.cameras import FOCAL, TIME, CameraPrior, PointPixels
from kinefit.solving.bundle.shape import PointProblem

_MIN_COMMON_KEYPOINTS = 50  # keypoints that two cameras must have in common
_MAX_KEYPOINTS = 4000  # of them that take part
_MIN_RAY_ANGLE = np.radians(3.0)  # angle between two cameras' rays below which they tell no distance
_MAX_INLIER_SIGMAS = 3.0  # standard deviations of a keypoint that agrees


def first_rig(rig: Rig, uv: NDArray, sigma: float) -> Rig:
    """Poses of all cameras of a rig up to place, turn and scale; the poses it has are not used.

    The pair with the most keypoints that agree, seen from the most different sides, comes first (essential matrix by
    consensus: D. Nister, An efficient solution to the five-point relative pose problem, 2004); then, one by one, the
    camera that sees the most of the points known so far (V. Lepetit et al., EPnP, 2009).

    Parameters
    ----------
    uv : (P, C, 2) [px] of points that one or more cameras saw, NaN where unseen.
    sigma : float [px] standard deviation of a pixel.

    Raises
    ------
    CalibrationError
        Too few points in common, no pair of cameras far enough apart, or a camera that agrees with no other.
    """
    flat = np.stack([_normalised(camera, uv[:, c]) for c, camera in enumerate(rig)], axis=1)
    pairs = {
        (i, j): found
        for i in range(len(rig)) for j in range(i + 1, len(rig))
        if (found := _relative_pose(rig, flat, i, j, sigma)) is not None
    }
    if not pairs:
        raise CalibrationError(
            "no two cameras see enough of the same person from different sides",
            remedy="Place the cameras 20 degrees apart or more, and record someone who moves about in view of all.",
        )
    first = max(pairs, key=lambda pair: pairs[pair][1])
    poses: dict[int, NDArray] = {first[0]: np.eye(4), first[1]: pairs[first][0]}
    while len(poses) < len(rig):
        x = _points(rig, poses, uv, sigma)
        trials = {c: _laid_on(rig.cameras[c], flat[:, c], x, sigma) for c in range(len(rig)) if c not in poses}
        best = max(trials, key=lambda c: trials[c][1])
        if trials[best][1] < _MIN_COMMON_KEYPOINTS:
            names = ", ".join(rig.names[c] for c in trials)
            raise CalibrationError(
                f"the keypoints of {names} agree with no other camera", place=f"camera {rig.names[best]}",
                remedy="Check that its intrinsics are right, and that it is in step and sees the same person.",
            )
        poses[best] = trials[best][0]
    return Rig(tuple(camera.with_pose(poses[c]) for c, camera in enumerate(rig)))


def _normalised(camera: Camera, uv: NDArray) -> NDArray:
    """(P, 2) undistorted, on the plane at distance 1; NaN where unseen."""
    ray = camera.with_pose(np.eye(4)).ray(uv)
    return np.where(ray[:, 2:] > 1e-6, ray[:, :2] / np.where(ray[:, 2:] > 1e-6, ray[:, 2:], 1.0), np.nan)


def _thinned(index: NDArray, most: int = _MAX_KEYPOINTS) -> NDArray:
    return index[spread(len(index), most)]


def _relative_pose(rig: Rig, flat: NDArray, i: int, j: int, sigma: float) -> tuple[NDArray, float] | None:
    """T_j_i (4, 4), translation of length 1, and how good a start the pair is; None where it is none."""
    both = _thinned(np.flatnonzero(np.isfinite(flat[:, [i, j]]).all(axis=(1, 2))))
    if len(both) < _MIN_COMMON_KEYPOINTS:
        return None
    a, b = np.ascontiguousarray(flat[both, i]), np.ascontiguousarray(flat[both, j])
    focal = np.mean([rig.cameras[c].matrix[0, 0] for c in (i, j)])
    cv2.setRNGSeed(0)
    E, mask = cv2.findEssentialMat(
        a, b, np.eye(3), method=cv2.RANSAC, prob=0.99999, threshold=_MAX_INLIER_SIGMAS * sigma / focal, maxIters=3000
    )
    if E is None or E.shape != (3, 3):
        return None
    count, R, t, mask = cv2.recoverPose(E, a, b, np.eye(3), mask=mask)
    if count < _MIN_COMMON_KEYPOINTS:
        return None
    T = se3.transform(R, t.ravel())
    agreed = mask.ravel() > 0
    rays = np.stack([np.append(p, 1.0) for p in a[agreed]]), np.stack([np.append(p, 1.0) for p in b[agreed]]) @ R
    cosine = np.sum(rays[0] * rays[1], axis=1) / np.linalg.norm(rays[0], axis=1) / np.linalg.norm(rays[1], axis=1)
    angle = float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return (T, count * np.sin(angle)) if _MIN_RAY_ANGLE < angle < np.pi - _MIN_RAY_ANGLE else None


def _points(rig: Rig, poses: dict[int, NDArray], uv: NDArray, sigma: float) -> NDArray:
    """(P, 3) points on which two of the cameras known so far agree, NaN elsewhere."""
    known = sorted(poses)
    part = Rig(tuple(rig.cameras[c].with_pose(poses[c]) for c in known))
    return triangulate_robust(part, uv[:, known], max_residual_px=_MAX_INLIER_SIGMAS * sigma)[0]


def _laid_on(camera: Camera, flat: NDArray, x: NDArray, sigma: float) -> tuple[NDArray, int]:
    """T_camera_world (4, 4) of a camera that sees points x (P, 3), and how many agree."""
    both = _thinned(np.flatnonzero(np.isfinite(flat).all(axis=1) & np.isfinite(x).all(axis=1)))
    if len(both) < _MIN_COMMON_KEYPOINTS:
        return np.eye(4), 0
    cv2.setRNGSeed(0)
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(x[both]), np.ascontiguousarray(flat[both]), np.eye(3), None, iterationsCount=1000,
        reprojectionError=_MAX_INLIER_SIGMAS * sigma / camera.matrix[0, 0], confidence=0.9999, flags=cv2.SOLVEPNP_EPNP,
    )
    if not ok or inliers is None or len(inliers) < _MIN_COMMON_KEYPOINTS:
        return np.eye(4), 0
    chosen = both[inliers.ravel()]
    turn, shift = cv2.solvePnPRefineLM(x[chosen], flat[chosen], np.eye(3), None, turn, shift)
    return se3.transform(se3.exp_so3(turn.ravel()), shift.ravel()), len(chosen)


_MAX_FOOT_HEIGHT_M = 0.12  # [m] points this little above the soles are the foot's
_FLAT = 0.02  # [m] how well a foot on the floor tells its height
_STEPS = 20.0  # looks at the floor that are news, over a take
_MAX_SUPPORT_DIFFERENCE_M = 0.03  # [m] the lower foot bears more than one this much higher
_STANCE_PERCENT = 20  # per cent of frames in which the lower foot surely stands


def settled(
    rig: Rig, x_world: NDArray, rest_height: NDArray, *, balance: NDArray | None = None, up: str = "z"
) -> Rig:
    """The rig in a world that stands on the floor: origin below the person's mean place, height zero on the floor.

    Up is the mean direction from the standing foot to the centre of mass: who does not fall keeps one above the other.
    Then the floor under the feet corrects it where they walked about. For z up, x points to the first camera.

    Parameters
    ----------
    x_world : (F, K, 3) [m] points of the person, NaN where unknown.
    rest_height : (K,) [m] height of each point above the soles when standing.
    balance : (F, 3) [m] centre of mass; default: unknown, and up is how the whole body stands.
    up : str, vertical axis of the result.
    """
    R = _upright(upward(x_world, rest_height))
    for _ in range(3 if balance is not None else 0):
        R = _upright(R.T @ np.nanmean(balance @ R.T - _stand(x_world @ R.T, rest_height), axis=0))
    for _ in range(3):
        low, height = _soles(x_world @ R.T, rest_height)
        if len(low) >= 3:
            fit, _ = fit_plane(low, height, np.full(len(low), _STEPS / len(low) / _FLAT**2))
            R = _upright(R.T @ np.append(-fit[:2], 1.0))
    x = x_world @ R.T
    _, height = _soles(x, rest_height)
    ground = float(np.percentile(height, _STANCE_PERCENT)) if len(height) else float(np.nanmin(x[..., 2]))
    middle = np.nanmedian(x.reshape(-1, 3), axis=0)
    towards = R @ rig.cameras[0].centre_world - middle
    turn = se3.exp_so3(np.array([0.0, 0.0, -np.arctan2(towards[1], towards[0])]))
    T = se3.transform(turn @ R, turn @ -np.array([middle[0], middle[1], ground]))
    return rig.moved(se3.transform(rotation_between_up("z", up), np.zeros(3)) @ T)


def _upright(up: NDArray) -> NDArray:
    """(3, 3) smallest rotation that takes a direction to z."""
    return se3.shortest_turn(up, np.array([0.0, 0.0, 1.0]))


def _stand(x: NDArray, rest_height: NDArray) -> NDArray:
    """(F, 3) where the person stands: the feet's points, the lower ones more; NaN where none is known."""
    feet = np.flatnonzero(rest_height < _MAX_FOOT_HEIGHT_M)
    height = x[:, feet, 2] - rest_height[feet]
    low = np.min(np.where(np.isfinite(height), height, np.inf), axis=1, keepdims=True, initial=np.inf)
    above = np.where(np.isfinite(height), height - low, 0.0)
    weight = np.where(np.isfinite(height), np.exp(-above / _MAX_SUPPORT_DIFFERENCE_M), 0.0)
    total = weight.sum(axis=1, keepdims=True)
    mean = np.einsum("fk,fkd->fd", weight, np.nan_to_num(x[:, feet])) / np.where(total > 0, total, 1.0)
    return np.where(total > 0, mean, np.nan)


def _soles(x: NDArray, rest_height: NDArray) -> tuple[NDArray, NDArray]:
    """Horizontal place (M, 2) and height (M,) of the lower foot's sole in every frame in which it hardly moves."""
    feet = np.flatnonzero(rest_height < _MAX_FOOT_HEIGHT_M)
    at = x[:, feet] - np.array([0.0, 0.0, 1.0]) * rest_height[feet, None]
    known = np.isfinite(at).all(axis=(1, 2)) if len(feet) else np.zeros(len(x), bool)
    at = at[known]
    if len(at) < 2:
        return np.zeros((0, 2)), np.zeros(0)
    lowest = np.argmin(at[..., 2], axis=1)
    point = at[np.arange(len(at)), lowest]
    move = np.linalg.norm(np.gradient(at, axis=0), axis=-1)[np.arange(len(at)), lowest]
    still = move <= np.median(move)
    return point[still, :2], point[still, 2]


_MIN_CONFIDENCE = 0.3  # confidence of a keypoint that takes part in the start
_MAX_POINTS = 2500  # points in space of the start
_MAX_OTHER_POINTS = 1000  # of further people, besides the one whose body is fitted
_FLAT_POSE_SIGMAS = 20.0, 3.0  # [m], [rad] no prior to speak of
GUESSED_FOCAL_SIGMA = 0.25  # of a focal length's logarithm: 64 degrees stand for 52 to 78 (one standard deviation)
STATED_FOCAL_SIGMA = 0.1  # the same, of a stated one: the crop of videos differs by as much
_CLOCKS, _NEAR_CLOCKS = 2.0, 0.05  # [s] clocks of cameras that were started by hand; what the first look leaves
_LOSS_SIGMAS = 8.0, 4.0, 2.0, 1.0  # standard deviations of a keypoint at which the robust loss begins, and ends
_CORRELATED_PIXELS = 20.0  # pixels of a detector that tell as much of a lens as one: their errors come together
_BEFORE = 0.05  # of the rig's size: points nearer to a camera are triangulated badly
_MAX_RAY_SIGMAS = 5.0  # standard deviations within which the cameras' rays meet, before they are adjusted


@renamed(accuracy="sigma")
@checked
def calibrate_people(
    cameras: Sequence[Camera],
    keypoints: Sequence[Keypoints],
    body: Body,
    *,
    height: float | None = None,
    known_length: Length | None = None,
    focal: bool | Sequence[float] = False,
    time_offsets: bool | float = False,
    up: str = "z",
    sigma: float = KEYPOINT_SIGMA,
    progress: Progress | None = None,
) -> Refinement:
    """Poses of cameras whose intrinsics are known, from a person who moves in front of them.

    Where a network lifted people to space in each camera, these skeletons are laid on each other: turns, clocks and
    distances come from them (`first_cameras`). Else essential matrices choose the pair to start from, and the other
    cameras are laid on its points (`first_rig`). Free points, then the body of one person with its constant bone
    lengths and the free points of the others are adjusted together with all cameras.

    Parameters
    ----------
    cameras : their names, sizes, matrices and distortions; poses are not used.
    keypoints : records of the same number of frames and the same rate.
    body : Body, generic.
    height : float [m] stature of the person: sets the scale; default: the generic body's bones.
    known_length : (point, point, [m]) of the body: sets the scale instead.
    focal : bool or (C,) floats, the cameras' lenses are guesses: estimate focal lengths, too; how far each may be off,
        as a share of it, default 0.25.
    time_offsets : bool or float [s], estimate time offsets, too: up to so much, default 2 s, with `lifted` keypoints,
        else a few frames.
    up : str, vertical axis that the world shall have.

    Raises
    ------
    CalibrationError
        Too few common keypoints, a camera that fits no other, cameras too close together, too little motion.
    ObservationError
        Streams that differ; a height or length that cannot be.
    """
    step = progress or (lambda *_: None)
    given = Rig(tuple(camera.with_pose(np.eye(4)) for camera in cameras))
    check_input(given, keypoints, height, known_length)
    step("first cameras", 0, 2)
    late = np.zeros(len(given), int)
    rate, frames = keypoints[0].rate, len(keypoints[0])
    first: Rig | None = None
    others: Sequence[Sequence[Keypoints]] = ()
    if all(record.lifted is not None for record in keypoints):
        start = first_cameras(cameras, keypoints, within=_CLOCKS if time_offsets is True else float(time_offsets))
        first, alone, others, late = start.rig, list(start.people), start.others, start.frames_late
    else:
        alone = [steady_person(record) for record in keypoints]
    keypoints = [in_step(record, n, frames) for record, n in zip(keypoints, late, strict=True)]
    seen = [_common(body, given, one, late, frames, sigma) for one in (alone, *others)]
    (points, uv), *further = seen
    rig = first or first_rig(given, uv.reshape(-1, len(given), 2), sigma)
    step("first cameras", 1, 2)
    focal_sigma = np.broadcast_to(GUESSED_FOCAL_SIGMA if focal is True else focal, len(given)).astype(float)
    clock = _NEAR_CLOCKS if time_offsets else 0.0
    rig, x = _adjusted(rig, given, [u for _, u in seen], sigma, focal=focal_sigma, clock=clock, rate=rate)
    factor = _whole_scale(body, points, x, height)
    rig = settled(resized(rig, factor), factor * x, _above_soles(body, points), up=up)
    step("first cameras", 2, 2)
    prior_std = prior_sigma(len(rig), focal=bool(focal_sigma.any()), distortion=False, time_offsets=bool(time_offsets))
    prior_std[:, :3], prior_std[:, 3:6], prior_std[:, FOCAL] = *_FLAT_POSE_SIGMAS, focal_sigma
    prior = CameraPrior(Rig(tuple(replace(a, matrix=b.matrix) for a, b in zip(rig, given, strict=True))), prior_std)

    def stand(rig: Rig, seen: PersonSighting) -> tuple[Rig, str]:
        return _on_the_floor(rig, seen, body, height, known_length, up)

    trial = PersonTrial(keypoints, body, up, sigma)
    free = free_points(rig, [u for _, u in further], sigma)
    found = refine_from(rig, trial, prior, stand, free=free, progress=progress, from_scratch=True)
    offsets = {name: found.time_offsets[name] + float(n) / rate for name, n in zip(rig.names, late, strict=True)}
    clocks = {name: replace(found.cameras[name], time=offsets[name]) for name in rig.names}
    return replace(found, time_offsets=offsets, cameras=clocks)


def _common(
    body: Body, rig: Rig, one: Sequence[Keypoints], late: NDArray, frames: int, sigma: float
) -> tuple[PointSet, NDArray]:
    """Points of one person, and (F, K, C, 2) [px] where each camera saw them, by whole frames in step."""
    moved = [in_step(record, int(n), frames) for record, n in zip(one, late, strict=True)]
    records = person_records(moved, [np.zeros(frames, int) for _ in moved])
    channels = make_channels(body, rig, records, [sigma] * len(moved))
    return channels.points, common_pixels(channels)


def free_points(rig: Rig, people: Sequence[NDArray], sigma: float) -> PointPixels:
    """Points of more people (F, K, C, 2) [px] each, free in every frame: those that cameras agree on.

    They tell of the cameras wherever these people were, and nothing of bodies.
    """
    flat = np.concatenate([np.zeros((0, len(rig), 2)), *(uv.reshape(-1, len(rig), 2) for uv in people)])
    agree = triangulate_robust(rig, flat, max_residual_px=2.0 * _MAX_RAY_SIGMAS * sigma)[1]
    good = _thinned(np.flatnonzero(agree.sum(axis=1) >= 2), _MAX_OTHER_POINTS)
    point, camera = np.nonzero(agree[good] & np.isfinite(flat[good]).all(axis=-1))
    return PointPixels(camera, point, flat[good][point, camera], np.full(len(point), sigma**-2))


def common_pixels(channels: Channels) -> NDArray:
    """(F, K, C, 2) [px] of every point in every camera, NaN where unseen or unsure."""
    out = np.full((len(channels.uv), len(channels.points), len(channels.rig), 2), np.nan)
    sure = np.where((channels.confidence > _MIN_CONFIDENCE)[..., None], channels.uv, np.nan)
    out[:, channels.column, channels.camera] = sure
    return out


def _adjusted(
    rig: Rig, given: Rig, people: Sequence[NDArray], sigma: float, *, focal: NDArray, clock: float, rate: float
) -> tuple[Rig, NDArray]:
    """The rig adjusted with free points, from coarse to fine, and the first person's points (F, K, 3) in its units.

    focal: (C,) standard deviations of the logarithms of the lenses' focal lengths about the given ones, clock [s] of
    what is left of the cameras' offsets; 0 holds them.
    """
    flat = np.concatenate([uv.reshape(-1, len(rig), 2) for uv in people])
    speed = np.concatenate([np.gradient(uv, axis=0).reshape(-1, len(rig), 2) for uv in people])
    speed = np.nan_to_num(speed * rate)
    many = _thinned(np.flatnonzero(np.isfinite(flat).all(axis=-1).sum(axis=1) >= 2), _MAX_POINTS)
    offsets = np.zeros(len(rig))
    for coarse in _LOSS_SIGMAS:
        size = float(np.linalg.norm(np.ptp([c.centre_world for c in rig], axis=0)))
        x = triangulate(rig, flat[many])
        seen = np.isfinite(flat[many]).all(axis=-1)
        ahead = np.stack([se3.apply(c.T_camera_world, x)[:, 2] for c in rig], axis=1) > _BEFORE * size
        good = np.isfinite(x).all(axis=1) & (ahead | ~seen).all(axis=1)
        point, camera = np.nonzero(seen[good])
        chosen = many[good][point], camera
        weight = np.full(len(point), (coarse * sigma) ** -2)
        pixels = PointPixels(camera, point, flat[chosen], weight, speed[chosen] if clock else None)
        prior_std = prior_sigma(len(rig), focal=False, distortion=False, time_offsets=False)
        prior_std[:, :3], prior_std[:, 3:6] = 10.0 * size, _FLAT_POSE_SIGMAS[1]
        prior_std[:, FOCAL] = focal / np.sqrt(_CORRELATED_PIXELS)
        prior_std[1:, TIME] = clock
        mean = Rig(tuple(replace(a, matrix=b.matrix) for a, b in zip(rig, given, strict=True)))
        found = adjust(BundleState(rig, offsets, x[good]), CameraPrior(mean, prior_std), PointProblem(pixels)).state
        rig, offsets = found.rig, found.offsets
    first = people[0].reshape(-1, len(rig), 2)
    x = triangulate_robust(rig, first, max_residual_px=_MAX_RAY_SIGMAS * sigma)[0]
    return rig, x.reshape(*people[0].shape[:2], 3)


def _whole_scale(body: Body, points: PointSet, x: NDArray, height: float | None) -> float:
    """Factor that gives the person the generic body's bones, or bones in proportion to a height [m]."""
    ratios = []
    for i, j, _, length in rigid_pairs(body, points):
        distance = np.linalg.norm(x[:, i] - x[:, j], axis=1)
        if np.isfinite(distance).sum() >= 3:
            ratios.append(float(np.nanmedian(distance)) / length)
    if not ratios:
        raise CalibrationError(
            "no bone of the person can be measured", remedy="Record a person in full view of two cameras at once."
        )
    whole = height / body.stature if height and body.stature else 1.0
    return whole / float(np.median(ratios))


def _above_soles(body: Body, points: PointSet) -> NDArray:
    """(K,) [m] height of points above the soles of the body at rest."""
    lowest = min(body.points_rest(body.landmarks)[:, 1].min(), body.points_rest(points)[:, 1].min())
    return body.points_rest(points)[:, 1] - lowest


def _on_the_floor(
    rig: Rig, seen: PersonSighting, generic: Body, height: float | None, known_length: Length | None, up: str
) -> tuple[Rig, str]:
    """The rig with floor, origin and scale by the rule, and the rule."""
    body = seen.motion.body
    factor = sum(generic.segment_lengths().values()) / sum(body.segment_lengths().values())
    rule = "the scale is that of a person of mean proportions (a few per cent uncertain: give a height or a length)"
    if known_length is not None:
        a, b, metres = known_length
        factor, rule = metres / length_of(seen, a, b), f"{a} to {b} is {metres:g} m long"
    elif height is not None and body.stature > 0:
        factor, rule = height / body.stature, f"the person is {height:g} m tall"
    x = factor * seen.motion.positions()
    rig = settled(
        resized(rig, factor), x, factor * _above_soles(body, body.landmarks),
        balance=factor * seen.motion.centre_of_mass, up=up,
    )  # fmt: skip
    return rig, f"The floor is at height zero, {up} is up, the origin lies below the person's mean position; {rule}."
