"""Error bars that are true: jitter as the fit's own covariance has it, errors that do not average out, and the shape.

A fit takes every error for new in every frame. An error e that lasts goes through to the pose whole, by δ = P Jᵀ W e
with P the covariance of one frame on its own, however many frames are smoothed together. With δ also the answer to a
change of the shape θ (bone lengths, places of points), the pose being fitted anew,

    Cov = C + P (Jᵀ W Σ W J + Σ_c s_c s_cᵀ) P + D Σ_θ Dᵀ,        D = −P H_qθ

where C is the smoothed fit's covariance, Σ the variance of every channel's drift and s_c = Jᵀ W 1_c · shift that of a
camera, or of another sensor, as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState, KinematicTree
from kinefit.correspondences import _kernels, targets
from kinefit.correspondences.closures import closed_at
from kinefit.frame.results import ANYWHERE, FrameResult
from kinefit.multiview.detector_noise import DetectorNoise, estimate_noise
from kinefit.rows import Rows
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.keypoints import Layout
from kinefit.smoothing.process_noise import SmoothTake
from kinefit.smoothing.sensor_noise import OtherNoise
from kinefit.smoothing.shape_errors import SAMPLED, ShapeErrors
from kinefit.smoothing.shared_errors import SharedErrors
from kinefit.smoothing.spool import stretches
from kinefit.solvers.bundle.border_frames import gram
from kinefit.solvers.bundle.whitened import PoseScrews, columns
from kinefit.solvers.equations import block_diagonal, inverse, joint_moves, product
from kinefit.subject.closure_moves import ClosureMoves
from kinefit.subject.matched_frames import closing_moves, point_moves
from kinefit.subject.point_moves import PointMoves
from kinefit.subject.sensor_parameters import CameraExtrinsics, alike
from kinefit.subject.subject import Subject

Answers = Callable[[Sequence[int], Sequence[NDArray]], ShapeErrors]
"""(frames, covariance of each on its own) -> what an uncertain shape adds to them."""

_MOST_HIDDEN = 0.75  # share of its errors that a fit may be thought to follow
_STRETCHES = 6  # of a long take, from which the detectors' noise is estimated: 12,000 frames tell it
_APART = 200  # frames: more than residuals are followed over, at up to 400 Hz
_TIED = 0.1  # [s] within which motion ties a frame to another: an acceleration lasts about twice that


@dataclass(frozen=True, eq=False)
class Lasting:
    """What no smoothing takes away, of one frame.

    Parameters
    ----------
    dofs : (n, n) [m, rad] covariance of the degrees of freedom.
    joints : (S, 3) [m²] variance of the joint centres along the world's axes.
    alone : (n, n) covariance of the frame on its own, prior included.
    """

    dofs: NDArray
    joints: NDArray
    alone: NDArray


def with_lasting_errors(
    results: Sequence[FrameResult], subject: Subject, take: SmoothTake, weight: NDArray, rate: float,
    others: OtherNoise | None = None, answers: Sequence[Answers] = (), *,
    cameras: tuple[float, float] | None = None, shared: SharedErrors | None = None,
) -> tuple[Iterator[FrameResult], DetectorNoise]:  # fmt: skip
    """The same results, one by one, with the deviations that lasting errors and the shape add; the detectors' noise.

    Parameters
    ----------
    results : F neighbouring frames, with the standard deviations of a fit that takes errors for new each time.
    subject : with the shape that was estimated from the take; without one it is taken for exact.
    take : the pixels as they were used, and the states
    weight : (F, N) [1/px²] with which every channel took part, robust factor included
    others : noise of all other sensors
    answers : what shapes add that were found from several kinds of sensors together
    cameras : (2,) standard deviations [m], [rad] of the cameras' poses, where neither the subject nor the answers know
    shared : what points of one segment err by together, as the fit took it; None: each for itself
    """
    body, channels = subject.body, take.channels
    shared = shared or SharedErrors.none(len(channels.column))
    values, factor = _left_over(take)
    seen = float(np.mean(np.sum(factor > 0, axis=1))) if factor.size else 0.0
    hidden = np.full(factor.shape[1], min(body.tree.n_dofs / max(2.0 * seen, 1.0), _MOST_HIDDEN))
    if channels.view_followed is not None:
        hidden = 1.0 - (1.0 - hidden) * (1.0 - channels.view_followed)
    noise = estimate_noise(channels, values, factor, rate, leverage=hidden)
    del values, factor
    known = Known.of(subject, channels, cameras)
    layout = Layout(channels.with_points(body), body)
    half, n = round(_TIED * rate), body.tree.n_dofs
    nothing = np.zeros((n, n)), np.zeros((n, n))
    sampled = np.unique(np.linspace(0, len(results) - 1, min(SAMPLED, len(results))).astype(int))

    def lasts(f: int) -> Lasting:
        more = nothing if others is None else others.pooled(f, half)
        near = weight[max(f - half, 0) : f + half + 1]
        return lasting(known, layout, results[f].state, near.mean(axis=0), noise, shared, *more)

    shapes = []
    if answers:
        alone = [lasts(int(f)).alone for f in sampled]
        shapes = [one([int(f) for f in sampled], alone) for one in answers]

    def surer_no_more() -> Iterator[FrameResult]:
        for f, result in enumerate(results):
            one = lasts(f)
            dofs, joints = np.maximum(np.diag(one.dofs), 0.0), one.joints
            for shape in shapes:
                dofs, joints = (mine + of_shape for mine, of_shape in zip((dofs, joints), shape.at(f)))
            yield replace(
                result, dof_std=np.sqrt(np.square(result.dof_std) + dofs),
                joint_std=np.sqrt(np.square(result.joint_std) + joints),
            )  # fmt: skip

    return surer_no_more(), noise


def _left_over(take: SmoothTake) -> tuple[NDArray, NDArray]:
    """Residuals (F, N, 2) [px] and robust factors (F, N); of long takes in stretches, with unseen frames between."""
    channels, parts = take.channels, stretches(len(take.roots))
    chosen = [parts[i] for i in np.unique(np.linspace(0, len(parts) - 1, _STRETCHES).astype(int))]
    values, factors = [], []
    for some in chosen:
        part = take.part(some)
        fitted = part.fitted(part.roots, part.angles)
        values.append(part.uv - fitted)
        factors.append(part.factors(channels.sigma, fitted))
        if len(parts) > _STRETCHES:  # as many frames as residuals are followed over
            values.append(np.full((_APART, *values[0].shape[1:]), np.nan))
            factors.append(np.zeros((_APART, factors[0].shape[1])))
    return np.concatenate(values), np.concatenate(factors)


@dataclass(frozen=True, eq=False)
class Known:
    """What keypoints rest on, and how sure it is.

    Parameters
    ----------
    moves : how points move with the shape; None for one that is exact.
    cameras : parameters of cameras' poses, which come last; None for exact ones.
    covariance : (p, p) of both
    closing : how the body's closures move with the first of them; their own deviations last.
    """

    moves: PointMoves | None
    cameras: CameraExtrinsics | None
    covariance: NDArray
    closing: ClosureMoves | None = None

    @classmethod
    def of(cls, subject: Subject, channels: Channels, std: tuple[float, float] | None) -> Known:
        """Of a subject; cameras that its fit did not seek are as sure as `std`, their calibration; None for exact."""
        if subject.fit is not None and subject.covariance is not None:
            cameras = subject.fit.cameras
            moves, covariance = point_moves(subject.fit), subject.covariance
            closing = closing_moves(subject.fit, subject.body)
            if cameras is not None and alike(cameras.rig, channels.rig):
                stay = np.zeros(len(covariance))  # where they were found, and the motion was not
                stay[-len(cameras.names) :] = subject.fit.mean[-len(cameras.names) :]
                return cls(moves, cameras, covariance + np.outer(stay, stay), closing)
            if cameras is not None:  # those of another take tell nothing of these
                covariance = covariance[: -len(cameras.names), : -len(cameras.names)]
        else:
            moves, covariance, closing = None, np.zeros((0, 0)), None
        if std is None or not len(channels.camera):
            return cls(moves, None, covariance, closing)
        used = tuple(channels.rig.names[c] for c in np.unique(channels.camera))
        cameras = CameraExtrinsics(channels.rig, None, std, used)
        whole = block_diagonal(covariance, np.linalg.inv(cameras.information))
        return cls(moves, cameras, whole, closing)

    def columns(self, layout: Layout, rows: Rows, tree: KinematicTree, frames: NDArray) -> tuple[NDArray, NDArray]:
        """(N, p) how far points of rows move along their directions, whitened, and (S, 3, p) how joints do."""
        by, joints = np.zeros((len(rows), len(self.covariance))), np.zeros((len(frames), 3, len(self.covariance)))
        if self.moves is not None:
            moved, told = self.moves.joints(tree, frames), self.moves.columns(layout.places, rows, tree, frames)
            joints[:, :, : moved.shape[2]] = moved
            if told is not None:
                by[:, : told.shape[1]] = told
        if self.cameras is not None:
            channels = layout.channels
            seen = self.cameras.columns(rows, channels.rig, channels.camera[rows.group])
            by[:, by.shape[1] - seen.shape[1] :] = seen
        return by, joints


def lasting(
    known: Known, layout: Layout, state: BodyState, weight: NDArray,
    noise: DetectorNoise, shared: SharedErrors, other_information: NDArray, other_lasting: NDArray,
) -> Lasting:  # fmt: skip
    """Covariance of one frame's pose from drift, shifts of sensors and shape.

    Parameters
    ----------
    known : what the keypoints rest on
    weight : (N,) [1/px²] with which each channel took part, robust factor included; 0 where unseen.
    shared : part of a channel's errors, of jitter and of drift alike, that is the same in all of its group
    other_information, other_lasting : (n, n) of all sensors but the keypoints, see `OtherNoise`
    """
    body, channels, tree = layout.body, layout.channels, layout.body.tree
    n = tree.n_dofs
    weight = weight / (1.0 - shared.share)  # of what is its own
    rows = targets.fill(
        _kernels.pixel_rows, 2, body, state, layout.points, channels.rig.packed, channels.camera,
        np.zeros((len(weight), 2)), np.ascontiguousarray(weight),
    )  # fmt: skip
    frames, _ = tree.forward(state.T_world_root, state.angles)
    by_pose, Sigma = columns(rows, PoseScrews.of(body, state)), known.covariance
    by_shape, stretch = known.columns(layout, rows, tree, frames)
    by_pose, by_shape = (shared.whitened(one, weight, rows.group) for one in (by_pose, by_shape))
    if body.closures:
        closed = closed_at(body, state)
        w = closed.rows().weight
        other_information = other_information + closed.jacobian.T @ (w[:, None] * closed.jacobian)
        soft = (w * ~closed.hard)[:, None] * closed.jacobian
        other_lasting = other_lasting + soft.T @ closed.jacobian
    prior = block_diagonal(np.eye(6) / ANYWHERE**2, tree.posture_precision)
    free = slice(0 if tree.root_free else 6, n)  # a root that is fixed answers to nothing
    alone = np.zeros((n, n))
    seen = gram(by_pose, by_pose)
    alone[free, free] = inverse((seen + other_information + prior)[free, free])
    pushed = np.sqrt(weight[rows.group])[:, None] * shared.whitened(by_pose, weight, rows.group)
    source, axis = channels.source[rows.group], np.arange(len(rows)) % 2
    sums = [[pushed[(source == q) & (axis == a)].sum(axis=0) for a in (0, 1)] for q in range(len(noise.shift))]
    push = np.concatenate([np.empty((0, n)), *(np.array(p) * s[:, None] for p, s in zip(sums, noise.shift))])
    last, share = (v[rows.group][:, None] * pushed for v in (noise.drift * np.sqrt(1.0 - shared.share),
                                                            noise.drift * np.sqrt(shared.share)))
    together = shared.sums(share, rows.group)
    drift = gram(last, last) + gram(together, together)
    meat = drift + product(push.T, push) + other_lasting
    pushed_by_shape = gram(by_pose, by_shape)
    if known.closing is not None:
        moved_by = known.closing.at(state)
        pushed_by_shape[:, : moved_by.shape[1]] += closed.jacobian.T @ (w[:, None] * moved_by)
    answer = -product(alone, pushed_by_shape)
    dofs = product(product(alone, meat), alone)
    moved = joint_moves(body, state)
    whole = product(moved, answer) + stretch
    joints = np.sum(product(moved, dofs) * moved, axis=-1) + np.sum(product(whole, Sigma) * whole, axis=-1)
    shape = product(product(answer, Sigma), answer.T)
    return Lasting(dofs + shape, np.maximum(joints, 0.0), alone)
