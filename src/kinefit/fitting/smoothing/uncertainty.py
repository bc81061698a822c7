"""Compute honest error bars: the fit's covariance, plus systematic errors and the uncertainty of the shape.

A fit assumes independent errors in every frame. A systematic error e displaces the pose by δ = P Jᵀ W e, with P the
covariance of one frame on its own, however many frames are smoothed jointly. The pose also responds to a change of the
shape θ (bone lengths, landmark offsets). So

    Cov = C + P (Jᵀ W Σ W J + Σ_c s_c s_cᵀ) P + D Σ_θ Dᵀ,        D = −P H_qθ

where C is the smoothed fit's covariance, Σ the variance of every channel's bias and drift, and s_c = Jᵀ W 1_c · shift
the shared bias of a camera or another sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.bodies import Body, BodyState, KinematicTree
from kinefit.bodies.lasting_errors import KEYS_AT_ONCE, LastingErrors, ParameterErrors, key_frames
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.smoothing.border import SAMPLED_FRAMES, ShapeErrors, parameter_errors
from kinefit.fitting.smoothing.process_noise import SmoothTake
from kinefit.fitting.smoothing.sensor_noise import OtherNoise, Pushes, covariance_alone, filled, leverages
from kinefit.fitting.smoothing.shared_errors import SharedErrors
from kinefit.fitting.smoothing.spool import stretches
from kinefit.fitting.subject.fit import closing_moves, point_moves
from kinefit.fitting.subject.point_moves import ClosureMoves, PointMoves
from kinefit.fitting.subject.subject import CameraExtrinsics, Subject, SubjectFit, same_cameras
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.keypoints import Layout
from kinefit.sensors.settings import CameraErrors
from kinefit.solving.bundle.border_frames import gram
from kinefit.solving.correspondences import _kernels, targets
from kinefit.solving.correspondences.closures import closed_at
from kinefit.solving.equations import block_diagonal, columns, joint_moves, product, square_root
from kinefit.solving.rows import Rows
from kinefit.solving.trajectory.variance_components import VarianceComponents, variance_components

Answers = Callable[[Sequence[int], Sequence[NDArray]], ShapeErrors]
"""(frames, covariance of each on its own) -> variances that the uncertainty of the shape adds to them."""

MOTION_CORRELATION_TIME = 0.1
"""[s] within which the motion correlates frames: an acceleration lasts about twice that."""

_BY_MEASUREMENTS = 0.8  # of a smoothed fit's variance, by errors of measurements, the rest by accelerations. 0.78 to
# 0.83 by the spectrum of a motion prior that averages 0.2 s, at 30 to 100 Hz, with accelerations of 0.05 to 0.3 s
_MAX_STORED = 6e4  # [m, rad] of what is kept, which 16 bits hold: of what nothing observes
_DIRECTIONS = 120  # of lasting errors that are kept. The sigma of differences on the balancing trial is within 0.3 %
# of that with all; with 60 within 6 %, with 20 within 43 %
_NOISE_STRETCHES = 6  # of a long take, from which the detectors' noise is estimated: 12,000 frames are enough
_SEPARATING_FRAMES = 800  # without detections between two stretches: more than the longest lag, at up to 400 Hz


@dataclass(frozen=True, eq=False)
class SystematicErrors:
    """Covariance from systematic errors and the shape, of one frame: smoothing does not reduce it.

    Parameters
    ----------
    dofs : (n, n) covariance of the degrees of freedom [m, rad]
    joints : (S, 3) [m²] variance of the joint centres along the world's axes
    alone : (n, n) covariance of the frame on its own, prior included
    constant, drift : (n, k) factors of what of `dofs` comes from constant errors and the shape, and from drift
    white_dofs, white_joints : (n,), (S, 3) share 0..1 of the fit's own variance that white errors cause
    """

    dofs: NDArray
    joints: NDArray
    alone: NDArray
    constant: NDArray
    drift: NDArray
    white_dofs: NDArray
    white_joints: NDArray


def with_systematic_errors(
    results: Sequence[FrameResult], subject: Subject, take: SmoothTake, weight: NDArray, others: OtherNoise,
    answers: Sequence[Answers] = (), *, cameras: CameraErrors | None = None, smoothed: bool = True,
) -> tuple[Iterator[FrameResult], VarianceComponents, LastingErrors]:  # fmt: skip
    """Add systematic errors and the uncertainty of the shape to standard deviations.

    Also returns the detectors' noise, and what lasts of the errors, complete once all frames are taken.

    Parameters
    ----------
    results : F consecutive frames, with the standard deviations of a fit that assumes independent errors
    subject : person whose shape was estimated from the take; without a fit it counts as exact
    take : keypoints and states of the fit
    weight : (F, N) [1/px²] of every channel in the fit, robust factor included
    others : noise of all other sensors
    answers : uncertainty of shapes that were fitted to several kinds of sensors
    cameras : standard deviations of the cameras' poses, if neither the subject nor the answers contain them; None for
        exact ones
    smoothed : whether the fit averages neighbouring frames
    """
    body, channels, shared, rate = subject.body, take.pixels.channels, take.pixels.errors, 1.0 / take.dt
    layout = Layout(channels.with_points(body), body)
    sampled = _sampled(len(results))
    absorbed, count = np.zeros((2, len(channels.column)))
    for f in sampled:
        rows, J, pushed = pixel_columns(layout, results[f].state, weight[f], shared)
        whole = gram(J, pushed) + others.pooled(f)
        used = rows.weight > 0.0
        leverage = leverages(J[used], pushed[used], covariance_alone(body, results[f].state, whole))
        absorbed += np.bincount(rows.group[used], leverage, len(absorbed))
        count += np.bincount(rows.group[used], minlength=len(count))
    absorbed = filled(absorbed, count)
    if channels.view_followed is not None:
        absorbed = 1.0 - (1.0 - absorbed) * (1.0 - channels.view_followed)
    values = _residuals(take)
    noise = variance_components(
        values, np.arange(len(values)) / rate, leverage=absorbed, window=2 * others.half + 1,
        pool=np.minimum(channels.column, channels.column[channels.partner]), group=channels.source,
    )  # fmt: skip
    del values
    priors = KeypointPriors.of(subject, channels, cameras)

    def errors_at(f: int) -> SystematicErrors:
        near = weight[others.near(f)]
        averaged = Averaged(2 * others.half + 1, 1.0 / np.maximum(near.max(axis=0), 1e-12)) if smoothed else None
        return systematic_errors(
            priors, layout, results[f].state, near.mean(axis=0), noise, shared, others.pushes(f), averaged
        )  # fmt: skip

    few = {f: errors_at(f) for f in sampled.tolist()}
    shapes = [answer(list(few), [errors.alone for errors in few.values()]) for answer in answers]
    parameters = [(len(priors.root), priors.parameters), *((s.factors.shape[2], s.parameters) for s in shapes)]
    drift_times = [noise.drift_time] if not others.lasting or np.any(noise.drift > 0.0) else []
    drift_times += others.drift_times
    kept = _KeyFrames.of(few, shapes, len(results), rate, min(drift_times, default=np.inf), parameters)

    def variances() -> Iterator[tuple[NDArray, ...]]:
        """Of every frame's degrees of freedom and joints, and white shares of the fit's own, between key frames."""
        keys = _computed(len(results), rate)
        before, now = tuple[NDArray, ...](), tuple[NDArray, ...]()
        for last, f in pairwise([-1, *keys.tolist()]):
            errors = few.pop(f, None) or errors_at(f)
            kept.add(f, errors, shapes)
            dofs = np.maximum(np.diag(errors.dofs), 0.0)
            before, now = now, (dofs, errors.joints, errors.white_dofs, errors.white_joints)
            for k in range(last + 1, f):
                share = (k - last) / (f - last)
                yield tuple((1.0 - share) * a + share * b for a, b in zip(before, now))
            yield now

    def inflated() -> Iterator[FrameResult]:
        for f, (result, (dofs, joints, white_dofs, white_joints)) in enumerate(zip(results, variances())):
            for shape in shapes:
                dofs, joints = (variance + added for variance, added in zip((dofs, joints), shape.at(f)))
            yield replace(
                result, dof_std=np.sqrt(white_dofs * np.square(result.dof_std) + dofs),
                joint_std=np.sqrt(white_joints * np.square(result.joint_std) + joints),
            )  # fmt: skip

    return inflated(), noise, kept.errors


def _computed(frames: int, rate: float) -> NDArray:
    """Frames in which errors are computed: key frames, all where these lie close."""
    keys = key_frames(frames, rate)
    return keys if np.diff(keys).min(initial=2) >= 2 else np.arange(frames)


def _sampled(frames: int) -> NDArray:
    return np.unique(np.linspace(0, frames - 1, min(SAMPLED_FRAMES, frames)).astype(int))


def asked_frames(frames: int, rate: float) -> NDArray:
    """(K,) int, increasing: of so many frames at a rate [Hz] those of which other sensors' errors are asked for."""
    return np.union1d(_computed(frames, rate), _sampled(frames))


@dataclass(frozen=True, eq=False)
class _KeyFrames:
    """Lasting errors of key frames as they are computed, in the directions that hold most of them.

    Parameters
    ----------
    errors : zeros, to be filled
    constant, drift : (k, K) directions
    """

    errors: LastingErrors
    constant: NDArray
    drift: NDArray

    @classmethod
    def of(
        cls, few: Mapping[int, SystematicErrors], shapes: Sequence[ShapeErrors], frames: int, rate: float,
        drift_time: float, parameters: Sequence[tuple[int, ParameterErrors | None]],
    ) -> _KeyFrames:  # fmt: skip
        """For so many frames, with directions from the errors of a few; (count, parameters) of the last columns."""
        all_constant = np.stack([_with_shapes(errors, shapes, f) for f, errors in few.items()])
        all_drift = np.stack([errors.drift for errors in few.values()])
        constant, drift = _directions(all_constant), _directions(all_drift)
        keys = key_frames(frames, rate)
        s, d = (room((len(keys), all_drift.shape[1], v.shape[1]), np.float16) for v in (constant, drift))
        first, known = len(constant) - sum(count for count, _ in parameters), None
        for count, errors in parameters:
            if errors is not None:
                known = replace(errors, directions=constant[first : first + count].T @ errors.directions)
            first += count
        return cls(LastingErrors(keys, s, d, drift_time, known), constant, drift)

    def add(self, frame: int, errors: SystematicErrors, shapes: Sequence[ShapeErrors]) -> None:
        """Keep those of a frame, if it is a key frame."""
        k = int(np.searchsorted(self.errors.frames, frame))
        if k < len(self.errors.frames) and self.errors.frames[k] == frame:
            constant, drift = _with_shapes(errors, shapes, frame), errors.drift
            self.errors.constant[k] = np.clip(product(constant, self.constant), -_MAX_STORED, _MAX_STORED)
            self.errors.drift[k] = np.clip(product(drift, self.drift), -_MAX_STORED, _MAX_STORED)
            if (k + 1) % KEYS_AT_ONCE == 0:
                release(self.errors.constant, self.errors.drift)


def _with_shapes(errors: SystematicErrors, shapes: Sequence[ShapeErrors], frame: int) -> NDArray:
    """(n, k) factors of all constant errors of a frame."""
    return np.concatenate([errors.constant, *(shape.factor_at(frame) for shape in shapes)], axis=1)


def _directions(factors: NDArray) -> NDArray:
    """(k, K) orthonormal directions that hold most of factors (F, n, k), every coordinate alike; all where few."""
    std = np.sqrt(np.square(factors).sum(axis=2).mean(axis=0))
    rows = (factors / np.maximum(std, 1e-12)[:, None]).reshape(std.size * len(factors), -1)
    return np.ascontiguousarray(np.linalg.eigh(gram(rows, rows))[1][:, ::-1][:, :_DIRECTIONS])


def _residuals(take: SmoothTake) -> NDArray:
    """Residuals (F, N, 2) [px], NaN where undetected; of a long take some stretches, separated by NaN frames."""
    parts = stretches(len(take.roots))
    chosen = [parts[i] for i in np.unique(np.linspace(0, len(parts) - 1, _NOISE_STRETCHES).astype(int))]
    values = []
    for some in chosen:
        part = take.part(some)
        values.append(part.pixels.gaps(part.body, part.roots, part.angles))
        if len(parts) > _NOISE_STRETCHES:
            values.append(np.full((_SEPARATING_FRAMES, *values[0].shape[1:]), np.nan))
    return np.concatenate(values)


@dataclass(frozen=True, eq=False)
class KeypointPriors:
    """Shape and cameras with their covariance, on which the poses from keypoints depend.

    Parameters
    ----------
    moves : derivatives of points by the shape; None for an exact shape
    cameras : parameters of cameras' poses, the last ones; None for exact cameras
    covariance : (p, p) of shape and cameras
    closing : derivatives of the body's closures by the shape; errors of closures themselves are systematic
    fit : of the shape; None for an exact one
    """

    moves: PointMoves | None
    cameras: CameraExtrinsics | None
    covariance: NDArray
    closing: ClosureMoves | None = None
    fit: SubjectFit | None = None

    @cached_property
    def root(self) -> NDArray:
        """(p, p) of which the product with its own transpose is the covariance."""
        return square_root(self.covariance)

    @property
    def parameters(self) -> ParameterErrors | None:
        """What the fit of the shape knows, and of the cameras that it contained; None for an exact shape."""
        if self.fit is None:
            return None
        known = np.arange(min(len(self.covariance), len(self.fit.names)))
        return parameter_errors(self.fit, self.root[: len(known)], known)

    @classmethod
    def of(cls, subject: Subject, channels: Channels, errors: CameraErrors | None) -> KeypointPriors:
        """Priors of a subject; cameras that its fit did not contain have the calibration's `errors`, None for exact."""
        if subject.fit is not None and subject.covariance is not None:
            cameras = subject.fit.cameras
            moves, covariance = point_moves(subject.fit), subject.covariance
            closing = closing_moves(subject.fit, subject.body)
            if cameras is not None and same_cameras(cameras.rig, channels.rig):
                shift = np.zeros(len(covariance))  # the subject's fit moved the cameras, the motion's fit did not
                shift[-len(cameras.names) :] = subject.fit.mean[-len(cameras.names) :]
                return cls(moves, cameras, covariance + np.outer(shift, shift), closing, subject.fit)
            if cameras is not None:  # cameras of another take
                covariance = covariance[: -len(cameras.names), : -len(cameras.names)]
        else:
            moves, covariance, closing = None, np.zeros((0, 0)), None
        if errors is None or not len(channels.camera):
            return cls(moves, None, covariance, closing, subject.fit)
        used = tuple(channels.rig.names[c] for c in np.unique(channels.camera))
        cameras = CameraExtrinsics.of(errors, channels.rig, used)
        whole = block_diagonal(covariance, np.linalg.inv(cameras.information))
        return cls(moves, cameras, whole, closing, subject.fit)

    def columns(self, layout: Layout, rows: Rows, tree: KinematicTree, frames: NDArray) -> tuple[NDArray, NDArray]:
        """(N, p) whitened derivatives of rows, and (S, 3, p) of joint centres; frames (S, 12) of the segments."""
        by, joints = np.zeros((len(rows), len(self.covariance))), np.zeros((len(frames), 3, len(self.covariance)))
        if self.moves is not None:
            of_joints, of_rows = self.moves.joints(tree, frames), self.moves.columns(layout.places, rows, tree, frames)
            joints[:, :, : of_joints.shape[2]] = of_joints
            if of_rows is not None:
                by[:, : of_rows.shape[1]] = of_rows
        if self.cameras is not None:
            channels = layout.channels
            by_cameras = self.cameras.columns(rows, channels.rig, channels.camera[rows.group])
            by[:, by.shape[1] - by_cameras.shape[1] :] = by_cameras
        return by, joints


def pixel_columns(
    layout: Layout, state: BodyState, weight: NDArray, shared: SharedErrors
) -> tuple[Rows, NDArray, NDArray]:
    """Rows of the keypoints of one frame with weights (N,) [1/px²], two each, and their derivatives.

    Returns
    -------
    rows, J (2 N, n) [px] derivatives by the pose, and W J (2 N, n) [1/px] gradient of the pose by an error of each row
    """
    own = weight / (1.0 - shared.share)
    rows = targets.fill(
        _kernels.pixel_rows, 2, layout.body, state, layout.points, layout.channels.rig.packed, layout.channels.camera,
        np.zeros((len(weight), 2)), np.ascontiguousarray(own),
    )  # fmt: skip
    root = np.sqrt(own[rows.group])[:, None]
    whitened = columns(rows, layout.body, state)
    twice = shared.whitened(shared.whitened(whitened, own, rows.group), own, rows.group)
    return rows, whitened / np.where(root > 0.0, root, 1.0), root * twice


class Averaged(NamedTuple):
    """Number of frames that a smoothed fit averages; variances (N,) [px²] of channels that it counts as white."""

    frames: int
    assumed: NDArray


def systematic_errors(
    priors: KeypointPriors, layout: Layout, state: BodyState, weight: NDArray, noise: VarianceComponents,
    shared: SharedErrors, others: Pushes, averaged: Averaged | None = None,
) -> SystematicErrors:  # fmt: skip
    """Covariance of one frame's pose from bias, drift, shared biases of sensors and shape.

    Parameters
    ----------
    priors : shape and cameras with their covariance
    weight : (N,) [1/px²] of every channel in the fit, robust factor included; 0 where undetected
    noise : of the detectors
    shared : share of a channel's errors, of jitter and drift alike, that its group shares
    others : of all sensors but the keypoints
    averaged : None for a fit of each frame, whose variance is left as it is
    """
    body, channels, tree = layout.body, layout.channels, layout.body.tree
    rows, J, pushed = pixel_columns(layout, state, weight, shared)
    frames, _ = tree.forward(state.T_world_root, state.angles)
    by_shape, stretch = priors.columns(layout, rows, tree, frames)
    Sigma, rest = priors.covariance, others.rest
    if body.closures:
        closed = closed_at(body, state)
        w = closed.rows().weight
        soft = (w * ~closed.hard)[:, None] * closed.jacobian
        rest = rest + soft.T @ closed.jacobian
    alone = covariance_alone(body, state, gram(J, pushed) + others.information)
    of_axis = 2 * channels.source[rows.group] + np.arange(len(rows)) % 2
    push = np.ravel(noise.shared)[:, None] * gram(np.eye(2 * len(noise.shared))[of_axis], pushed)

    def pushed_by(sigma: NDArray) -> NDArray:
        """(2 N + 2 G, n) gradient by errors of sigma (N,) [px] of each channel and each group."""
        own_error = np.zeros((2 * len(sigma), J.shape[1]))
        own, common = ((sigma * np.sqrt(share))[rows.group] for share in (1.0 - shared.share, shared.share))
        own_error[2 * rows.group + np.arange(len(rows)) % 2] = own[:, None] * pushed
        return np.concatenate([own_error, shared.sums(common[:, None] * pushed, rows.group)])

    own = (weight / (1.0 - shared.share))[rows.group]
    pushed_by_shape = gram(pushed, by_shape / np.sqrt(np.where(own > 0.0, own, 1.0))[:, None])
    if priors.closing is not None:
        moved_by = priors.closing.at(state)
        pushed_by_shape[:, : moved_by.shape[1]] += closed.jacobian.T @ (w[:, None] * moved_by)
    response = -product(alone, pushed_by_shape)
    biases = pushed_by(np.hypot(noise.bias, noise.bias_error))
    constant = product(alone, np.concatenate([push, biases, others.constant]).T)
    drift = product(alone, np.concatenate([pushed_by(noise.smoothed_drift), others.drift]).T)
    dofs = sum(product(v, v.T) for v in (constant, drift)) + product(product(alone, rest), alone)
    moved = joint_moves(body, state)
    whole = product(moved, response) + stretch
    joints = np.sum(product(moved, dofs) * moved, axis=-1) + np.sum(product(whole, Sigma) * whole, axis=-1)
    by_shape = product(response, priors.root)
    shape = product(by_shape, by_shape.T)
    white = np.ones(len(dofs)), np.ones(joints.shape)
    if averaged is not None:
        surplus = pushed_by(np.sqrt(np.maximum(averaged.assumed - np.square(noise.white), 0.0)))
        surplus, information = gram(surplus, surplus) + others.surplus, gram(J, pushed) + others.information
        white = _white_shares(body, state, averaged.frames * information, averaged.frames * surplus, moved)
    return SystematicErrors(
        dofs + shape, np.maximum(joints, 0.0), alone, np.concatenate([constant, by_shape], axis=1), drift, *white
    )


def _white_shares(
    body: Body, state: BodyState, information: NDArray, surplus: NDArray, moved: NDArray
) -> tuple[NDArray, NDArray]:
    """(n,), (S, 3) shares of the variances of degrees of freedom and joints that white errors cause.

    Parameters
    ----------
    information, surplus : (n, n) of the frames that the fit averages together; and what of it are no white errors
    moved : (S, 3, n) [m, m/rad] derivatives of the joints
    """
    whole = covariance_alone(body, state, information)
    less = _BY_MEASUREMENTS * product(product(whole, surplus), whole)
    dofs = np.diag(less) / np.maximum(np.diag(whole), 1e-30)
    joints = np.sum(product(moved, less) * moved, axis=-1)
    joints /= np.maximum(np.sum(product(moved, whole) * moved, axis=-1), 1e-30)
    return 1.0 - np.clip(dofs, 0.0, 1.0), 1.0 - np.clip(joints, 0.0, 1.0)
