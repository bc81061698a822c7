"""Fit bone lengths and landmark offsets of keypoints to frames spread over a take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import TrackingError
from kinefit.fitting.initialization.from_points import first_scales, pose_from_points
from kinefit.fitting.subject import fit as joint
from kinefit.fitting.subject import parameters as kinds
from kinefit.fitting.subject.fit import MatchedFrames, Worlds
from kinefit.fitting.subject.subject import CameraExtrinsics, Progress, Subject, SubjectFit
from kinefit.fitting.subject.view_bias import SeenFrames, learn_view_bias
from kinefit.geometry.losses import geman_mcclure
from kinefit.observations import KEYPOINTS
from kinefit.sensors.channels import Channels, fitted_pixels
from kinefit.sensors.points.keypoints import KeypointMeasurement, KeypointSensor, Layout
from kinefit.sensors.points.views import ViewBias, find_swaps, limb_groups, triangulated
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import CameraErrors
from kinefit.solving.equations import inverse

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
    x = triangulated(channels, chosen)
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
) -> tuple[SubjectFit, NDArray, ViewBias]:  # fmt: skip
    """Fit lengths, points, gear and cameras; returns the fit, its covariance, and the detectors' bias by view.

    The standard deviation of landmark offsets is estimated from the take (`place_spread`), starting from
    `_OFFSET_PRIOR_STDS`, separately for short segments (fingers). The bias by view is estimated in the first round, and
    removed in later ones. Detector bias would move cameras: the weight of their calibration is raised by the excess of
    the round before.
    """
    spread, excess_of, start, gear, bias = np.array(_OFFSET_PRIOR_STDS), 1.0, None, kinds.Gear(body), ViewBias()
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
) -> tuple[ViewBias, list[Sequence[KeypointMeasurement]]]:
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
    groups = limb_groups(body, channels)
    weight = channels.weight[list(states)]
    for row, (f, state) in zip(weight, states.items(), strict=True):
        sides = None if channels.sides_known is None else channels.sides_known[f]
        row[find_swaps(channels, groups, channels.uv[f], row, fitted_pixels(body, channels, state), sides)] = 0.0
    return weight
