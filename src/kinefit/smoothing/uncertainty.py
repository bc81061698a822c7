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

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import room
from kinefit.bodies import BodyState, KinematicTree
from kinefit.correspondences import _kernels, targets
from kinefit.correspondences.closures import closed_at
from kinefit.frame.results import FrameResult
from kinefit.lasting_errors import LastingErrors, key_frames
from kinefit.rows import Rows
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.keypoints import Layout
from kinefit.sensors.settings import CameraErrors
from kinefit.smoothing.process_noise import SmoothTake
from kinefit.smoothing.sensor_noise import OtherNoise, Pushes, covariance_alone, filled, leverages
from kinefit.smoothing.shape_errors import SAMPLED_FRAMES, ShapeErrors
from kinefit.smoothing.shared_errors import SharedErrors
from kinefit.smoothing.spool import stretches
from kinefit.solvers.bundle.border_frames import gram
from kinefit.solvers.equations import block_diagonal, columns, joint_moves, product, square_root
from kinefit.solvers.trajectory.variance_components import VarianceComponents, variance_components
from kinefit.subject.matched_frames import closing_moves, point_moves
from kinefit.subject.point_moves import ClosureMoves, PointMoves
from kinefit.subject.sensor_parameters import CameraExtrinsics, same_cameras
from kinefit.subject.subject import Subject

Answers = Callable[[Sequence[int], Sequence[NDArray]], ShapeErrors]
"""(frames, covariance of each on its own) -> variances that the uncertainty of the shape adds to them."""

MOTION_CORRELATION_TIME = 0.1
"""[s] within which the motion correlates frames: an acceleration lasts about twice that."""

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
    """

    dofs: NDArray
    joints: NDArray
    alone: NDArray
    constant: NDArray
    drift: NDArray


def with_systematic_errors(
    results: Sequence[FrameResult], subject: Subject, take: SmoothTake, weight: NDArray, others: OtherNoise,
    answers: Sequence[Answers] = (), *, cameras: CameraErrors | None = None,
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
        near = weight[others.near(f)].mean(axis=0)
        of_others = others.pooled(f), others.pushes(f)
        return systematic_errors(priors, layout, results[f].state, near, noise, shared, *of_others)

    few = {f: errors_at(f) for f in sampled.tolist()}
    shapes = [answer(list(few), [errors.alone for errors in few.values()]) for answer in answers]
    drift_times = [noise.drift_time] if not others.lasting or np.any(noise.drift > 0.0) else []
    drift_times += others.drift_times
    kept = _KeyFrames.of(few, shapes, len(results), rate, min(drift_times, default=np.inf))

    def variances() -> Iterator[tuple[NDArray, NDArray]]:
        """Of every frame's degrees of freedom and joints: interpolated between key frames two or more frames apart."""
        keys = _computed(len(results), rate)
        before, now = (np.zeros(0), np.zeros(0)), (np.zeros(0), np.zeros(0))
        for last, f in pairwise([-1, *keys.tolist()]):
            errors = few.pop(f, None) or errors_at(f)
            kept.add(f, errors, shapes)
            before, now = now, (np.maximum(np.diag(errors.dofs), 0.0), errors.joints)
            for k in range(last + 1, f):
                share = (k - last) / (f - last)
                yield (1.0 - share) * before[0] + share * now[0], (1.0 - share) * before[1] + share * now[1]
            yield now

    def inflated() -> Iterator[FrameResult]:
        for f, (result, (dofs, joints)) in enumerate(zip(results, variances())):
            for shape in shapes:
                dofs, joints = (variance + added for variance, added in zip((dofs, joints), shape.at(f)))
            yield replace(
                result, dof_std=np.sqrt(np.square(result.dof_std) + dofs),
                joint_std=np.sqrt(np.square(result.joint_std) + joints),
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
        drift_time: float,
    ) -> _KeyFrames:  # fmt: skip
        """For so many frames, with directions from the errors of a few."""
        all_constant = np.stack([_with_shapes(errors, shapes, f) for f, errors in few.items()])
        all_drift = np.stack([errors.drift for errors in few.values()])
        constant, drift = _directions(all_constant), _directions(all_drift)
        keys = key_frames(frames, rate)
        s, d = (room((len(keys), all_drift.shape[1], v.shape[1]), np.float16) for v in (constant, drift))
        return cls(LastingErrors(keys, s, d, drift_time), constant, drift)

    def add(self, frame: int, errors: SystematicErrors, shapes: Sequence[ShapeErrors]) -> None:
        """Keep those of a frame, if it is a key frame."""
        k = int(np.searchsorted(self.errors.frames, frame))
        if k < len(self.errors.frames) and self.errors.frames[k] == frame:
            self.errors.constant[k] = _with_shapes(errors, shapes, frame) @ self.constant
            self.errors.drift[k] = errors.drift @ self.drift


def _with_shapes(errors: SystematicErrors, shapes: Sequence[ShapeErrors], frame: int) -> NDArray:
    """(n, k) factors of all constant errors of a frame."""
    return np.concatenate([errors.constant, *(shape.factor_at(frame) for shape in shapes)], axis=1)


def _directions(factors: NDArray) -> NDArray:
    """(k, K) orthonormal directions that hold most of factors (F, n, k), every coordinate alike; all where few."""
    std = np.sqrt(np.square(factors).sum(axis=2).mean(axis=0))
    rows = (factors / np.maximum(std, 1e-12)[:, None]).reshape(std.size * len(factors), -1)
    return np.asarray(np.linalg.eigh(gram(rows, rows))[1][:, ::-1][:, :_DIRECTIONS])


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
    """

    moves: PointMoves | None
    cameras: CameraExtrinsics | None
    covariance: NDArray
    closing: ClosureMoves | None = None

    @cached_property
    def root(self) -> NDArray:
        """(p, p) of which the product with its own transpose is the covariance."""
        return square_root(self.covariance)

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
                return cls(moves, cameras, covariance + np.outer(shift, shift), closing)
            if cameras is not None:  # cameras of another take
                covariance = covariance[: -len(cameras.names), : -len(cameras.names)]
        else:
            moves, covariance, closing = None, np.zeros((0, 0)), None
        if errors is None or not len(channels.camera):
            return cls(moves, None, covariance, closing)
        used = tuple(channels.rig.names[c] for c in np.unique(channels.camera))
        cameras = CameraExtrinsics.of(errors, channels.rig, used)
        whole = block_diagonal(covariance, np.linalg.inv(cameras.information))
        return cls(moves, cameras, whole, closing)

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


def systematic_errors(
    priors: KeypointPriors, layout: Layout, state: BodyState, weight: NDArray,
    noise: VarianceComponents, shared: SharedErrors, other_information: NDArray, others: Pushes,
) -> SystematicErrors:  # fmt: skip
    """Covariance of one frame's pose from bias, drift, shared biases of sensors and shape.

    Parameters
    ----------
    priors : shape and cameras with their covariance
    weight : (N,) [1/px²] of every channel in the fit, robust factor included; 0 where undetected
    noise : of the detectors
    shared : share of a channel's errors, of jitter and drift alike, that its group shares
    other_information : (n, n) of all sensors but the keypoints
    others : of these
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
    alone = covariance_alone(body, state, gram(J, pushed) + other_information)
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
    return SystematicErrors(
        dofs + shape, np.maximum(joints, 0.0), alone, np.concatenate([constant, by_shape], axis=1), drift
    )
