"""Fit limb lengths and girths to the first depth frames.

Measured points should lie on the nearest surface, and the body's contour on the person's contour in the image.
`fit_subject` finds poses of a few frames, lengths and girths jointly.

Estimate the detectors' bias by direction of view from frames with known poses, without ground truth.

Residuals r of a keypoint in the cameras c of one frame are r_c = J_c (s + e(d_c)) + noise. The error s of the body's
point is free in every frame. The bias e is the same in all frames, so only disagreement between cameras determines it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.bodies.surfaces.places import SurfaceAnchors
from kinefit.errors import ObservationError
from kinefit.fitting.subject import fit as joint
from kinefit.fitting.subject.parameters import Parameters, SegmentScales
from kinefit.fitting.subject.subject import SubjectFit
from kinefit.fitting.subject.surfaces import Girths
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import PointCloud
from kinefit.observations.recordings import mirror_name
from kinefit.sensors.base import Matched, Measurement, matched_by, rows_at
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.views import MIRRORED, TERMS, ViewBias, directions, trunks
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_view import DepthView, outside, splat, view_of
from kinefit.sensors.surfaces.point_cloud import PointCloudSensor, SurfacePairs
from kinefit.solving.rows import AnyRows

# Chosen on ten simulated people in three postures each, with pose errors of 5° and 3 cm; the figure `size_lengths` has
# four of them.
_START_LOG_STATURES = (-0.1, 0.0, 0.1)  # closest points slide along limbs, so lengths change slowly
_ROUNDS_PER_START = 5
_ROUNDS_OF_BEST = 12
_COARSE_ITERATIONS = 1, 2  # see `fit_subject`
_INDEPENDENT_SHARE = 0.3  # of a frame's errors: neighbours share folds of cloth and the model's form
_POSTURE_PRIOR_SHARE = 0.1  # with less, poses bend to fit wrong lengths (3 of ten people, 0.5 % worse)
_CONTOUR_SIGMA_RATIO = 2.5  # to a point's: with 0.6, 1, 1.6, 2.5 lengths err by 2.5, 2.0, 2.0, 1.8 %
_MAX_CONTOUR_COSINE = 0.5  # of normal and line of sight; elsewhere moving the surface along its normal does not help
_MAX_INSIDE_COSINE = 0.25  # the same inside the contour: a sample there is within 3 % of a radius of the body's own
_INSIDE_REACH_RATIO = 0.5  # reach inside the contour; 0, 0.5, 1, 1.7 explain 70, 74, 70, 71 % of a person (Kinect)


def fit_surfaces(
    body: Body,
    clouds: Sequence[ArrayLike],
    states: Sequence[BodyState],
    *,
    camera: Camera | None = None,
    views: Sequence[DepthView] = (),
    sigma: float = 0.01,
    points: int = 500,
    start: NDArray | None = None,
) -> SubjectFit:
    """Fit lengths and girths of a body to point clouds of the person, with poses known approximately.

    Parameters
    ----------
    body : Body with surfaces; without cylinders the lengths alone are fitted
    clouds : K x (N, 3) [m] points on the person, in the world
    states : K poses
    camera : Camera of the sensor, the same for all clouds: surfaces that face away from it get no points, and empty
        pixels around the person limit the girths
    views : K views of whole depth images, instead of a camera
    sigma : float [m], standard deviation of a point: noise, cloth
    points : int, number of points used of each cloud
    start : (p,) parameters to start from, of an earlier fit; default: three statures are tried

    Returns
    -------
    SubjectFit
        Its parameters are those of `SegmentScales` and `Girths`. Unobserved ones keep the prior's standard deviation.

    Raises
    ------
    ObservationError
        No clouds, other numbers of clouds than of states, or empty ones.
    BodyError
        The body has no surfaces.
    """
    if not len(clouds) or len(clouds) != len(states):
        raise ObservationError(f"{len(clouds)} clouds but {len(states)} states", remedy="Give one state a cloud.")
    given = [x[np.isfinite(x).all(axis=1)] for x in (np.asarray(c, float).reshape(-1, 3) for c in clouds)]
    if not all(map(len, given)):
        raise ObservationError("a cloud has no points", remedy="Leave out this frame.")
    if camera is not None and not views:
        views = [_view(x, camera) for x in given]
    settings = replace(TrackSettings(), points=points)
    sensor, rng, rig = PointCloudSensor("depth", sigma, settings), np.random.default_rng(0), Rig(())
    steps: list[list[Measurement]] = []
    for k, (x, state) in enumerate(zip(given, states)):
        eye = views[k].viewpoint if views else None
        frame = PointCloud("depth", 0.0, x[rng.permutation(len(x))[:points]], on_body=True, viewpoint=eye)
        steps.append([sensor.prepare(frame, Scene(body, state, rig)), *(_Contour(v, sensor) for v in views[k : k + 1])])
    parameters: list[Parameters] = [SegmentScales(body)]
    if any(isinstance(s, TaperedCylinder) for s in body.surfaces):
        parameters.append(Girths(body))
    groups = np.arange(sum(len(p.names) for p in parameters)) < len(body.scale_groups)

    def fitted(states: Sequence[BodyState], start: NDArray, rounds: int, reach: Sequence[float]) -> SubjectFit:
        return joint.fit_subject(
            body, rig, steps, states, parameters, start=start, reach=reach, rounds=rounds,
            looks=_INDEPENDENT_SHARE * len(steps), posture=_POSTURE_PRIOR_SHARE, coarse=_COARSE_ITERATIONS,
        )  # fmt: skip

    if start is not None:
        return fitted(states, start, _ROUNDS_PER_START, joint.REACH[-1:])
    tried = [fitted(states, size * groups, _ROUNDS_PER_START, joint.REACH) for size in _START_LOG_STATURES]
    best = min(tried, key=lambda found: _misfit(found, steps))
    return fitted(best.states, best.mean, _ROUNDS_OF_BEST, joint.REACH[-1:])


def _misfit(found: SubjectFit, steps: Sequence[Sequence[Measurement]]) -> float:
    """Weight of contour samples off their place, minus that of explained points; comparable between fits."""
    total, scale = 0.0, joint.REACH[-1]
    for state, measurements in zip(found.states, steps):
        scene = Scene(found.body, state, found.rig)
        for m in measurements:
            for rows in rows_at(matched_by(m, scene, joint.REACH[0]), scene):
                explained = 1.0 / (1.0 + np.square(rows.residual / scale))
                total += float(rows.weight @ (float(isinstance(m, _Contour)) - explained))
    return total


def _view(cloud: NDArray, camera: Camera) -> DepthView:
    depth, small = splat(cloud, camera)
    return view_of(depth, depth > 0, small)


class _Contour(Measurement):
    """The person's contour in a view: the body's occluding contour should lie on it.

    Without the pull from inside the contour, the body stays too small: points beyond it are too far to be matched.
    """

    settled = False

    def __init__(self, view: DepthView, of: PointCloudSensor) -> None:
        self.sensor, self.time, self._view, self._of = "contour", 0.0, view, of

    def match(self, scene: Scene, reach: float) -> Matched:
        """Match surface samples outside the person's contour, and little inside it, to it along their normals."""
        samples, f = scene.surface.samples, scene.frames[scene.surface.samples.segment]
        R = f[:, :9].reshape(-1, 3, 3)
        x = np.einsum("nij,jn->ni", R, samples.point) + f[:, 9:]
        n = np.einsum("nij,jn->ni", R, samples.normal)
        out, trust = outside(self._view, x)
        sight = x - self._view.viewpoint
        largest = np.where(out < 0.0, _MAX_INSIDE_COSINE, _MAX_CONTOUR_COSINE)
        is_contour = np.abs(np.einsum("ni,ni->n", n, sight)) < largest * np.linalg.norm(sight, axis=1)
        is_near = (out > -_INSIDE_REACH_RATIO * reach) & (out < 2.0 * reach)
        use = is_near & (trust > 0.0) & is_contour & ~scene.surface.fingers
        place, normal = (np.ascontiguousarray(a[:, use].T) for a in (samples.point, samples.normal))
        anchors = SurfaceAnchors(scene.body, samples.segment[use], place, normal)
        patches = float(scene.surface.areas.sum()) / (self._of.settings.patch**2 * len(samples))
        weight = trust[use] * min(patches, 1.0) / (_CONTOUR_SIGMA_RATIO * self._of.sigma) ** 2
        return _Receding(SurfacePairs(anchors, x[use] - out[use, None] * n[use], weight, reach, True))


@dataclass(frozen=True, eq=False)
class _Receding(Matched):
    """Surface samples near the person's contour, paired with places on it."""

    pairs: SurfacePairs
    of_points = False
    shows_surface = True

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row for each sample."""
        return [self.pairs.rows(scene)]


_COEFFICIENT_PRIOR_STD = 0.01  # [m]: of 1, 1.4 and 2 cm the best on three recordings of the built-in network
# (benchmark `people_bias`); 2 cm gains more on two of them, and loses 7 % on the third
_NOISE_STD = 0.01  # [m] of a keypoint's remaining error: frames of a take are alike, so all count as one measurement
_POINT_STD = 0.03  # [m] of s, the error of a fitted body's point in a frame
_OUTLIER_SIGMAS = 2.0  # at which a keypoint's weight falls to 1/4
_ROUNDS = 4  # of reweighting
_MIN_CAMERAS = 3  # that detect a point; two disagree as much where the body is wrong
_MAX_FOLLOWED_SHARE = 0.5  # of a point's bias that counts as explained
_MAX_FRAMES = 13  # of a take
_MIRROR = np.diag([1.0, 1.0, -1.0])  # of a left point's axes


@dataclass(frozen=True, eq=False)
class SeenFrames:
    """K frames of a take at known poses.

    Parameters
    ----------
    body : Body
    channels : N channels of keypoints
    states : K poses
    uv : (K, N, 2) [px], left-right swaps corrected
    confidence : (K, N), 0 where undetected
    """

    body: Body
    channels: Channels
    states: Sequence[BodyState]
    uv: NDArray
    confidence: NDArray

    def few(self) -> SeenFrames:
        """At most `_MAX_FRAMES` of the frames, evenly spaced."""
        chosen = np.unique(np.linspace(0, len(self.states) - 1, min(_MAX_FRAMES, len(self.states))).astype(int))
        states = [self.states[k] for k in chosen]
        return SeenFrames(self.body, self.channels, states, self.uv[chosen], self.confidence[chosen])


@dataclass(frozen=True, eq=False)
class _PointRows:
    """Rows of L points, each in K frames and C cameras: r = X s + A c, two rows for each camera, whitened.

    A left point shares the coefficients of the right one; `lead` (L,) is the number of the right one.
    """

    lead: NDArray
    A: NDArray  # (L, K, 2C, 15)
    X: NDArray  # (L, K, 2C, 3)
    r: NDArray  # (L, K, 2C)

    def equations(self, c: NDArray) -> tuple[NDArray, NDArray]:
        """Normal equations (L, 15, 15), (L, 15) with s eliminated, averaged over frames; weights at c (L, 15)."""
        w = self._weight(c)
        A, X, r = self.A * w[..., None], self.X * w[..., None], self.r * w
        shift = np.linalg.solve(_shift_information(X), X.swapaxes(2, 3) @ np.concatenate([A, r[..., None]], axis=3))
        H = A.swapaxes(2, 3) @ (A - X @ shift[..., :-1])
        b = (A.swapaxes(2, 3) @ (r[..., None] - X @ shift[..., -1:]))[..., 0]
        frames = np.maximum(np.count_nonzero(self.X.any(axis=(2, 3)), axis=1), 1)
        return H.sum(axis=1) / frames[:, None, None], b.sum(axis=1) / frames[:, None]

    def _weight(self, c: NDArray) -> NDArray:
        """(L, K, 2C) square root of the robust weight of every row."""
        residual = self.r - (self.A @ c[:, None, :, None])[..., 0]
        s = np.linalg.solve(_shift_information(self.X), self.X.swapaxes(2, 3) @ residual[..., None])
        residual = residual - (self.X @ s)[..., 0]
        square = np.square(residual).reshape(*residual.shape[:2], -1, 2).sum(axis=3)
        return np.repeat(1.0 / (1.0 + square / _OUTLIER_SIGMAS**2), 2, axis=2)


def _shift_information(X: NDArray) -> NDArray:
    return np.eye(3) / _POINT_STD**2 + X.swapaxes(2, 3) @ X


def learn_view_bias(takes: Sequence[SeenFrames]) -> ViewBias:
    """Estimate the biases common to some takes, of points that three cameras detect in the same frame.

    Parameters
    ----------
    takes : each counts as one measurement of each side of a person
    """
    keys: dict[tuple[str, str], int] = {}
    rows_of_takes = [rows for take in takes if (rows := _point_rows(take.few(), keys)) is not None]
    if not keys:
        return ViewBias()
    # A point in the middle is its own mirror image: antisymmetric coefficients are 0.
    paired = np.array([mirror_name(point) != point for _, point in keys])
    prior = np.where((MIRRORED.ravel() > 0) | paired[:, None], _COEFFICIENT_PRIOR_STD, 1e-9)
    errors = np.zeros(len(keys))
    c: NDArray = np.zeros(prior.shape)
    for _ in range(_ROUNDS):
        H, b = np.zeros((*prior.shape, 3 * TERMS)), np.zeros(prior.shape)
        H[:, np.arange(3 * TERMS), np.arange(3 * TERMS)] = prior**-2.0
        for rows in rows_of_takes:
            take_H, take_b = rows.equations(c[rows.lead])
            np.add.at(H, rows.lead, take_H)
            np.add.at(b, rows.lead, take_b)
        c = np.linalg.solve(H, b[..., None])[..., 0]
    for rows in rows_of_takes:
        np.add.at(errors, rows.lead, np.count_nonzero(rows.X.any(axis=(1, 3)), axis=1))
    measured = np.sum(1.0 - np.diagonal(np.linalg.inv(H), axis1=1, axis2=2) / np.square(prior), axis=1)
    sets: dict[str, dict[str, NDArray]] = {}
    followed: dict[str, dict[str, float]] = {}
    for (name, point), k in keys.items():
        other, found = mirror_name(point), c[k].reshape(TERMS, 3)
        share = min(float(measured[k] / errors[k]), _MAX_FOLLOWED_SHARE)
        points, shares = sets.setdefault(name, {}), followed.setdefault(name, {})
        points[other], shares[other] = found * MIRRORED, share
        points[point], shares[point] = found, share
    return ViewBias(sets, followed)


def _point_rows(take: SeenFrames, keys: dict[tuple[str, str], int]) -> _PointRows | None:
    """Rows of every point of a take that three cameras detect; None for no point.

    Pairs of points that `keys` lacks are added to it, by the right one's name.
    """
    body, channels = take.body, take.channels
    points = channels.with_points(body).points
    x = np.stack([body.positions(state, points) for state in take.states])
    frames = np.stack([body.tree.forward(s.T_world_root, s.angles)[0] for s in take.states])
    K, C, L = len(x), len(channels.rig), len(points)
    A, X, r = np.zeros((L, K, C, 2, 3 * TERMS)), np.zeros((L, K, C, 2, 3)), np.zeros((L, K, C, 2))
    names = [(name, points.names[k]) for name, span in channels.sets.items() for k in range(span.start, span.stop)]
    is_left = np.array([_right_of(point) != point for _, point in names])
    axes = frames[:, trunks(body.tree)[points.segments], :9].reshape(K, L, 3, 3) @ np.where(
        is_left[:, None, None], _MIRROR, np.eye(3)
    )
    for c, camera in enumerate(channels.rig):
        in_camera = np.flatnonzero(channels.camera == c)
        k = channels.column[in_camera]
        fitted, J = camera.project_with_jacobian(x[:, k])
        d = camera.centre_world - x[:, k]
        d = ((d / np.linalg.norm(d, axis=2)[..., None])[:, :, None] @ axes[:, k])[:, :, 0]
        J, gap = J @ axes[:, k], take.uv[:, in_camera] - fitted
        scale = np.sqrt(0.5 * np.square(J).sum(axis=(2, 3)))  # [px/m]
        confidence = take.confidence[:, in_camera]
        known = (confidence > 0) & np.isfinite(gap).all(axis=2) & (scale > 0)
        weight = np.where(known, np.sqrt(confidence) / (_NOISE_STD * np.where(known, scale, 1.0)), 0.0)
        J = np.where(known[..., None, None], J, 0.0) * weight[..., None, None]
        X[k, :, c] = J.swapaxes(0, 1)
        by_direction = J[:, :, :, None, :] * directions(d)[:, :, None, :, None]
        A[k, :, c] = by_direction.reshape(*J.shape[:3], 3 * TERMS).swapaxes(0, 1)
        r[k, :, c] = (np.where(known[..., None], gap, 0.0) * weight[..., None]).swapaxes(0, 1)
    enough = np.count_nonzero(X.any(axis=(3, 4)), axis=2) >= _MIN_CAMERAS
    used = np.flatnonzero(enough.any(axis=1))
    if not len(used):
        return None
    parts = [np.where(enough[(...,) + (None,) * (v.ndim - 2)], v, 0.0)[used] for v in (A, X, r)]
    lead = [keys.setdefault((names[k][0], _right_of(names[k][1])), len(keys)) for k in used]
    return _PointRows(np.array(lead), *(v.reshape(len(used), K, 2 * C, *v.shape[4:]) for v in parts))


def _right_of(point: str) -> str:
    """Name of the right point of a pair."""
    other = mirror_name(point)
    is_left = (point[:1] == "L" and other[:1] == "R") or "left" in point
    return other if is_left else point
