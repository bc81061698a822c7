"""Fit bone lengths and landmark offsets of keypoints to frames spread over a take.

Estimate the detectors' bias by direction of view from frames with known poses, without ground truth.

Residuals r of a keypoint in the cameras c of one frame are r_c = J_c (s + e(d_c)) + noise. The error s of the body's
point is free in every frame. The bias e is the same in all frames, so only disagreement between cameras determines it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import TrackingError
from kinefit.fitting.initialization.from_points import first_scales, pose_from_points
from kinefit.fitting.subject import fit as joint
from kinefit.fitting.subject import parameters as kinds
from kinefit.fitting.subject.fit import MatchedFrames, Worlds
from kinefit.fitting.subject.subject import CameraExtrinsics, Progress, Subject, SubjectFit
from kinefit.geometry.losses import geman_mcclure
from kinefit.observations import KEYPOINTS
from kinefit.observations.recordings import mirror_name
from kinefit.sensors.channels import Channels, fitted_pixels
from kinefit.sensors.points import views
from kinefit.sensors.points.keypoints import KeypointMeasurement, KeypointSensor, Layout
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import CameraErrors
from kinefit.solving.equations import inverse

_COEFFICIENT_PRIOR_STD = 0.01  # [m]: of 1, 1.4 and 2 cm the best on three recordings of the built-in network
# (benchmark `people_bias`); 2 cm gains more on two of them, and loses 7 % on the third
_NOISE_STD = 0.01  # [m] of a keypoint's remaining error: frames of a take are alike, so all count as one measurement
_POINT_STD = 0.03  # [m] of s, the error of a fitted body's point in a frame
_OUTLIER_SIGMAS = 2.0  # at which a keypoint's weight falls to 1/4
_BIAS_ROUNDS = 4  # of reweighting
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


def learn_view_bias(takes: Sequence[SeenFrames]) -> views.ViewBias:
    """Estimate the biases common to some takes, of points that three cameras detect in the same frame.

    Parameters
    ----------
    takes : each counts as one measurement of each side of a person
    """
    keys: dict[tuple[str, str], int] = {}
    rows_of_takes = [rows for take in takes if (rows := _point_rows(take.few(), keys)) is not None]
    if not keys:
        return views.ViewBias()
    # A point in the middle is its own mirror image: antisymmetric coefficients are 0.
    paired = np.array([mirror_name(point) != point for _, point in keys])
    prior = np.where((views.MIRRORED.ravel() > 0) | paired[:, None], _COEFFICIENT_PRIOR_STD, 1e-9)
    errors = np.zeros(len(keys))
    c: NDArray = np.zeros(prior.shape)
    for _ in range(_BIAS_ROUNDS):
        H, b = np.zeros((*prior.shape, 3 * views.TERMS)), np.zeros(prior.shape)
        H[:, np.arange(3 * views.TERMS), np.arange(3 * views.TERMS)] = prior**-2.0
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
        other, found = mirror_name(point), c[k].reshape(views.TERMS, 3)
        share = min(float(measured[k] / errors[k]), _MAX_FOLLOWED_SHARE)
        points, shares = sets.setdefault(name, {}), followed.setdefault(name, {})
        points[other], shares[other] = found * views.MIRRORED, share
        points[point], shares[point] = found, share
    return views.ViewBias(sets, followed)


def _point_rows(take: SeenFrames, keys: dict[tuple[str, str], int]) -> _PointRows | None:
    """Rows of every point of a take that three cameras detect; None for no point.

    Pairs of points that `keys` lacks are added to it, by the right one's name.
    """
    body, channels = take.body, take.channels
    points = channels.with_points(body).points
    x = np.stack([body.positions(state, points) for state in take.states])
    frames = np.stack([body.tree.forward(s.T_world_root, s.angles)[0] for s in take.states])
    K, C, L = len(x), len(channels.rig), len(points)
    A, X, r = np.zeros((L, K, C, 2, 3 * views.TERMS)), np.zeros((L, K, C, 2, 3)), np.zeros((L, K, C, 2))
    names = [(name, points.names[k]) for name, span in channels.sets.items() for k in range(span.start, span.stop)]
    is_left = np.array([_right_of(point) != point for _, point in names])
    axes = frames[:, views.trunks(body.tree)[points.segments], :9].reshape(K, L, 3, 3) @ np.where(
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
        by_direction = J[:, :, :, None, :] * views.directions(d)[:, :, None, :, None]
        A[k, :, c] = by_direction.reshape(*J.shape[:3], 3 * views.TERMS).swapaxes(0, 1)
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


_OFFSET_PRIOR_STDS = 0.01, 0.005  # [m] of landmark offsets on long and on short segments, before a take is fitted
_POSTURE_PRIOR_SHARE = 0.1  # frames of a take are a few independent postures at most
_SHAPE_VARIANCE_FACTOR = 1.2  # of fitted shapes: their covariance takes limits, weights and priors as known.
# With 1.0, 1.2 and 1.6 intervals of 95 % hold 95.5, 96.5 and 97.7 % of the joints of twenty known people with BODY_25B
# (benchmark `error_bars`); the worst group of angles 88, 89 and 91 %. MEDIAPIPE_33 is the check.
_ROUNDS = 2  # of fits with a better prior standard deviation; it changes by less than a tenth from then on
_MAX_POINT_DISTANCE = 0.15  # [m] median distance from triangulated points of a plausible pose


def fit_subject(
    body: Body,
    channels: Channels,
    *,
    frames: int = 25,
    height: float | None = None,
    trial: Subject | None = None,
    cameras: CameraErrors | CameraExtrinsics | None = None,
    view_bias: bool = False,
    progress: Progress | None = None,
) -> Subject:
    """Fit bone lengths and landmark offsets of keypoints, with no pose given.

    Parameters
    ----------
    body : Body, generic
    channels : keypoints of all cameras
    frames : int, number of frames used, spread over the take
    height : float [m] of the person: lengths that no two points measure scale with it
    trial : subject of another trial of the same person: its lengths and their covariance are the prior
    cameras : standard deviations of the calibration, or camera parameters of an earlier fit if the rig already has the
        poses that it found: cameras are fitted too; default: the calibration is exact
    view_bias : whether the detectors' bias by direction of view is estimated, of points that three cameras detect
    progress : called with the name of the work, the steps done and all steps

    Raises
    ------
    TrackingError
        No frame shows enough of the person in two cameras.
    """
    shown = np.flatnonzero(np.isfinite(channels.uv).any(axis=(1, 2)))
    chosen = shown[np.unique(np.linspace(0, len(shown) - 1, min(max(frames, 1), len(shown))).astype(int))]
    if progress:
        progress("bone lengths", 0, 1)
    x = views.triangulated(channels, chosen)
    scales = first_scales(body, channels.points, x, height=height) if trial is None else trial.scales
    near = body.scaled(scales)
    sized = channels.with_points(near)
    states: dict[int, BodyState] = {}
    for i, f in enumerate(chosen):
        state = _pose(near, sized, x[i], next(reversed(states.values()), None))
        if state is not None:
            states[int(f)] = state
        if progress:
            progress("bone lengths", i + 1, len(chosen) + 1)
    if not states:
        raise TrackingError(
            "no frame shows enough of the person in two cameras",
            remedy="Check calibration and clocks of the cameras with kinefit check.",
        )
    weight = _weights(near, sized, states)
    sensor, layout = KeypointSensor(channels.rig, {}, 0.0, geman_mcclure(), joint.REACH[0]), Layout(channels, body)
    variance = np.square(channels.sigma)
    sides = channels.sides_known
    steps = [
        [KeypointMeasurement(sensor, layout, channels.uv[f], w * variance, 0.0, None if sides is None else sides[f])]
        for f, w in zip(states, weight)
    ]
    whole = height / body.stature if height and body.stature else None
    lengths = kinds.SegmentScales(body, whole, about=float(np.median(scales)))
    if trial is not None and trial.covariance is not None:
        known = trial.covariance[: len(scales), : len(scales)]
        lengths = kinds.KnownLengths(body, scales=trial.scales, covariance=known)
    if isinstance(cameras, CameraErrors):
        cameras = CameraExtrinsics.of(
            cameras, channels.rig, tuple(channels.rig.names[c] for c in np.unique(channels.camera))
        )  # fmt: skip
    found, covariance, bias = _fitted(body, channels, steps, list(states.values()), lengths, scales, cameras, view_bias)
    if progress:
        progress("bone lengths", len(chosen) + 1, len(chosen) + 1)
    sets = tuple(name for name in channels.sets if name)
    scales = np.exp(found.mean[: len(scales)])
    return Subject(found.body, scales, found, covariance, sets=sets, view_bias=bias, frames=tuple(states))


def _fitted(
    body: Body, channels: Channels, steps: Sequence[Sequence[KeypointMeasurement]], states: Sequence[BodyState],
    lengths: kinds.SegmentScales, scales: NDArray, cameras: CameraExtrinsics | None, by_view: bool,
) -> tuple[SubjectFit, NDArray, views.ViewBias]:  # fmt: skip
    """Fit lengths, points, gear and cameras; returns the fit, its covariance, and the detectors' bias by view.

    The standard deviation of landmark offsets is estimated from the take (`place_spread`), starting from
    `_OFFSET_PRIOR_STDS`, separately for short segments (fingers). The bias by view is estimated in the first round, and
    removed in later ones. Detector bias would move cameras: the weight of their calibration is raised by the excess of
    the round before.
    """
    spread, excess_of, start, gear, bias = np.array(_OFFSET_PRIOR_STDS), 1.0, None, kinds.Gear(body), views.ViewBias()
    sets = [name for name in channels.sets if name]
    shares = [body.offset_shares[body.keypoints(name).segments] for name in sets]
    bare = body if body.morphs else replace(body, surfaces=(), skin=None)  # saves scaling surfaces
    cameras = cameras and replace(cameras, rig=channels.rig)
    for k in range(_ROUNDS):
        offsets = [
            kinds.PointOffsets(body, name, spread[(own < 1.0).astype(int)] * own) for name, own in zip(sets, shares)
        ]
        has_gear = k > 0 and bool(gear.names)  # gear starts from poses of the first round
        parameters: list[kinds.Parameters] = [lengths, *[gear] * has_gear, *offsets]
        of_body = sum(len(kind.names) for kind in parameters)
        before = of_body - sum(len(kind.names) for kind in offsets)
        if cameras is not None:
            parameters.append(cameras.tighter(excess_of**-0.5))
        if start is None:
            of_points = [kind.mean for kind in parameters[1:] if not isinstance(kind, CameraExtrinsics)]
            start = np.concatenate([np.log(scales), *of_points, np.zeros(0 if cameras is None else len(cameras.names))])
        elif has_gear and k == 1:
            start = np.concatenate([start[: len(scales)], gear.start(states), start[len(scales) :]])
        found = joint.fit_subject(
            bare, channels.rig, steps, states, parameters, start=start, rounds=1, looks=len(steps),
            posture=_POSTURE_PRIOR_SHARE,
        )  # fmt: skip
        start, states, prior = found.mean, found.states, found.prior.information.copy()
        prior[of_body:, of_body:] /= excess_of
        if k == 0 and by_view:
            bias, steps = _without_bias(body, channels, found, steps)
        if k == 0 and len(channels.sets) > 1:
            steps = _by_detector(channels, found, steps)
        excess_of = _excess(found, steps)
        covariance = inverse(prior + found.information / excess_of)
        moved, share = found.mean - found.prior.mean, np.full(len(prior), np.nan)
        of_points = [kind.values_of(own[:, None].repeat(3, axis=1)) for kind, own in zip(offsets, shares)]
        share[before:of_body] = np.concatenate(of_points)
        for short, of in enumerate((share == 1.0, share < 1.0)):
            open_to = np.flatnonzero(of & np.isclose(np.diag(prior) * share**2, spread[short] ** -2))
            offset, variance = moved[open_to] / share[open_to], np.diag(covariance)[open_to] / share[open_to] ** 2
            spread[short] = kinds.place_spread(offset, variance, spread[short], _OFFSET_PRIOR_STDS[short])
        if cameras is not None:
            measured, own = found.information / excess_of, slice(of_body, len(moved))
            cameras = cameras.with_errors_of(own, moved, measured, found.prior.information / excess_of)
            prior[own, own] = cameras.information
            covariance = inverse(prior + measured)
        excess_of = max(excess_of, 1.0)
    prior_world = kinds.World(body, channels.rig)
    found = replace(found, body=Worlds(prior_world, parameters).at(found.mean).body, prior_world=prior_world)
    if cameras is not None:
        found = replace(found, parameters=(*parameters[:-1], cameras))
    wider = np.ones(len(covariance))  # gear has the prior of its file: its standard deviation is not above that
    wider[: len(scales)] = wider[before:of_body] = _SHAPE_VARIANCE_FACTOR**0.5
    return found, wider[:, None] * covariance * wider, bias


def _without_bias(
    body: Body, channels: Channels, found: SubjectFit, steps: Sequence[Sequence[KeypointMeasurement]]
) -> tuple[views.ViewBias, list[Sequence[KeypointMeasurement]]]:
    """Estimate the detectors' bias by view from fitted frames; returns it, and the frames with it removed."""
    scenes = [Scene(found.body, state, channels.rig) for state in found.states]
    matched = [m.match(scene, joint.REACH[-1]) for (m,), scene in zip(steps, scenes)]
    uv, weight = (np.stack([getattr(m, name) for m in matched]) for name in ("uv", "weight"))
    frames = SeenFrames(found.body, channels, found.states, uv, weight * np.square(channels.sigma))
    bias = learn_view_bias([frames])
    layout = Layout(bias.known_to(channels), body)
    return bias, [
        [KeypointMeasurement(m.of, layout, m.uv, m.confidence, m.time, m.sides_known) for m in several]
        for several in steps
    ]


def _by_detector(
    channels: Channels, found: SubjectFit, steps: Sequence[Sequence[KeypointMeasurement]]
) -> list[Sequence[KeypointMeasurement]]:
    """Frames whose confidences are scaled by the residuals of each keypoint set, relative to the best set.

    All detectors have one standard deviation by default. Without this the worse of two would weigh as much on lengths.
    """
    scenes = [Scene(found.body, state, channels.rig) for state in found.states]
    matched = [m.match(scene, joint.REACH[-1]) for (m,), scene in zip(steps, scenes)]
    squares = np.stack([m.squares(scene) for m, scene in zip(matched, scenes)])
    used = np.stack([m.weight > 0 for m in matched])
    spans = [(channels.column >= s.start) & (channels.column < s.stop) for s in channels.sets.values()]
    medians = np.array([np.median(squares[:, s][used[:, s]]) if used[:, s].any() else np.inf for s in spans])
    factor = np.zeros(len(channels.column))
    for span, median in zip(spans, medians, strict=True):
        factor[span] = medians.min() / median if median > 0 else 1.0
    return [
        [KeypointMeasurement(m.of, m.layout, m.uv, m.confidence * factor, m.time, m.sides_known) for m in several]
        for several in steps
    ]


def _excess(found: SubjectFit, steps: Sequence[Sequence[KeypointMeasurement]]) -> float:
    """Factor by which a channel's variance over all frames exceeds the assumed one; 1 with too few residuals.

    It scales the reported covariance, not the fit: less weight would leave the lengths to the prior.
    """
    worlds, prior = Worlds(found.prior_world, found.parameters), found.prior.information
    frames = MatchedFrames(worlds, steps, None, None, found.mean, found.states, joint.REACH[0])
    known = len(found.mean) - float(np.sum(prior * inverse(prior + found.information)))
    rows = frames.rows_of_frames(found.mean, found.states)
    return kinds.excess(rows, found.body.tree.n_dofs + known).get(KEYPOINTS, 1.0)


def _pose(body: Body, channels: Channels, x_world: NDArray, near: BodyState | None) -> BodyState | None:
    """State fitted to triangulated points, started from a neighbouring frame's, else without; None if implausible."""
    for start in (near, None) if near else (None,):
        try:
            state, distance = pose_from_points(body, channels.points, x_world, near=start)
        except TrackingError:
            return None
        if distance < (0.5 * _MAX_POINT_DISTANCE if start else _MAX_POINT_DISTANCE):
            return state
    return None


def _weights(body: Body, channels: Channels, states: dict[int, BodyState]) -> NDArray:
    """(F, N) weights of the channels, 0 for limbs whose left and right seem swapped."""
    groups = views.limb_groups(body, channels)
    weight = channels.weight[list(states)]
    for row, (f, state) in zip(weight, states.items(), strict=True):
        sides = None if channels.sides_known is None else channels.sides_known[f]
        row[views.find_swaps(channels, groups, channels.uv[f], row, fitted_pixels(body, channels, state), sides)] = 0.0
    return weight
