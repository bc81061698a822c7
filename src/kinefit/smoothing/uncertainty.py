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
from kinefit.frame.results import FrameResult
from kinefit.rows import Rows
from kinefit.sensors.channels import Channels
from kinefit.sensors.layout import Layout
from kinefit.sensors.settings import CameraErrors
from kinefit.smoothing.process_noise import SmoothTake
from kinefit.smoothing.sensor_noise import OtherNoise, covariance_alone, leverages
from kinefit.smoothing.shape_errors import SAMPLED, ShapeErrors
from kinefit.smoothing.shared_errors import SharedErrors
from kinefit.smoothing.spool import stretches
from kinefit.solvers.bundle.border_frames import gram
from kinefit.solvers.bundle.whitened import PoseScrews, columns
from kinefit.solvers.equations import block_diagonal, joint_moves, product
from kinefit.solvers.trajectory.variance_components import VarianceComponents, variance_components
from kinefit.subject.closure_moves import ClosureMoves
from kinefit.subject.matched_frames import closing_moves, point_moves
from kinefit.subject.point_moves import PointMoves
from kinefit.subject.sensor_parameters import CameraExtrinsics, alike
from kinefit.subject.subject import Subject

Answers = Callable[[Sequence[int], Sequence[NDArray]], ShapeErrors]
"""(frames, covariance of each on its own) -> what an uncertain shape adds to them."""

TIED = 0.1
"""[s] within which motion ties a frame to another: an acceleration lasts about twice that."""

_STRETCHES = 6  # of a long take, from which the detectors' noise is estimated: 12,000 frames tell it
_APART = 800  # frames: more than residuals are followed over, at up to 400 Hz


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
    results: Sequence[FrameResult], subject: Subject, take: SmoothTake, weight: NDArray,
    others: OtherNoise | None = None, answers: Sequence[Answers] = (), *,
    cameras: CameraErrors | None = None, shared: SharedErrors | None = None,
) -> tuple[Iterator[FrameResult], VarianceComponents]:  # fmt: skip
    """The same results, one by one, with the deviations that lasting errors and the shape add; the detectors' noise.

    Parameters
    ----------
    results : F neighbouring frames, with the standard deviations of a fit that takes errors for new each time.
    subject : with the shape that was estimated from the take; without one it is taken for exact.
    take : the pixels as they were used, and the states
    weight : (F, N) [1/px²] with which every channel took part, robust factor included
    others : noise of all other sensors
    answers : what shapes add that were found from several kinds of sensors together
    cameras : errors of the cameras' poses, where neither the subject nor the answers know; None for exact ones
    shared : what points of one segment err by together, as the fit took it; None: each for itself
    """
    body, channels, rate = subject.body, take.channels, 1.0 / take.dt
    shared = shared or SharedErrors.none(len(channels.column))
    layout = Layout(channels.with_points(body), body)
    half, n = round(TIED * rate), body.tree.n_dofs
    sampled = np.unique(np.linspace(0, len(results) - 1, min(SAMPLED, len(results))).astype(int))
    hidden, seen = np.zeros((2, len(channels.column)))
    for f in sampled:
        rows, J, pushed = pixel_columns(layout, results[f].state, weight[f], shared)
        whole = gram(J, pushed) + (0.0 if others is None else others.pooled(f, half)[0])
        felt = rows.weight > 0.0
        followed = leverages(J[felt], pushed[felt], covariance_alone(body, results[f].state, whole))
        hidden += np.bincount(rows.group[felt], followed, len(hidden))
        seen += np.bincount(rows.group[felt], minlength=len(seen))
    hidden = np.where(seen > 0, hidden / np.maximum(seen, 1), hidden.sum() / max(seen.sum(), 1))
    if channels.view_followed is not None:
        hidden = 1.0 - (1.0 - hidden) * (1.0 - channels.view_followed)
    values = _left_over(take)
    noise = variance_components(
        values, np.arange(len(values)) / rate, leverage=hidden, jitter_leverage=hidden / (2 * half + 1),
        pool=np.minimum(channels.column, channels.column[channels.partner]), group=channels.source,
    )  # fmt: skip
    del values
    known = Known.of(subject, channels, cameras)
    nothing = np.zeros((n, n)), np.zeros((n, n))

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


def _left_over(take: SmoothTake) -> NDArray:
    """Residuals (F, N, 2) [px], NaN where unseen; of long takes in stretches, with unseen frames between."""
    parts = stretches(len(take.roots))
    chosen = [parts[i] for i in np.unique(np.linspace(0, len(parts) - 1, _STRETCHES).astype(int))]
    values = []
    for some in chosen:
        part = take.part(some)
        seen = part.confidence > 0
        values.append(np.where(seen[..., None], part.uv - part.fitted(part.roots, part.angles), np.nan))
        if len(parts) > _STRETCHES:  # as many frames as residuals are followed over
            values.append(np.full((_APART, *values[0].shape[1:]), np.nan))
    return np.concatenate(values)


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
    def of(cls, subject: Subject, channels: Channels, errors: CameraErrors | None) -> Known:
        """Of a subject; cameras that its fit did not seek err as their calibration; None for exact."""
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
        if errors is None or not len(channels.camera):
            return cls(moves, None, covariance, closing)
        used = tuple(channels.rig.names[c] for c in np.unique(channels.camera))
        cameras = CameraExtrinsics.of(errors, channels.rig, used)
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


def pixel_columns(
    layout: Layout, state: BodyState, weight: NDArray, shared: SharedErrors
) -> tuple[Rows, NDArray, NDArray]:
    """Keypoints of one frame with weights (N,) [1/px²], two rows each.

    Returns
    -------
    rows, J (2 N, n) [px] how they move with the pose, and W J (2 N, n) [1/px] how an error of each pushes the pose
    """
    own = weight / (1.0 - shared.share)
    rows = targets.fill(
        _kernels.pixel_rows, 2, layout.body, state, layout.points, layout.channels.rig.packed, layout.channels.camera,
        np.zeros((len(weight), 2)), np.ascontiguousarray(own),
    )  # fmt: skip
    root = np.sqrt(own[rows.group])[:, None]
    whitened = columns(rows, PoseScrews.of(layout.body, state))
    twice = shared.whitened(shared.whitened(whitened, own, rows.group), own, rows.group)
    return rows, whitened / np.where(root > 0.0, root, 1.0), root * twice


def pixel_information(take: SmoothTake, weight: NDArray, shared: SharedErrors | None) -> Callable[[int], NDArray]:
    """Function of a frame: the information (n, n) of its keypoints with weights (F, N) [1/px²]."""
    layout = Layout(take.channels.with_points(take.body), take.body)
    shared = shared or SharedErrors.none(weight.shape[1])

    def information(f: int) -> NDArray:
        _, J, pushed = pixel_columns(layout, BodyState(take.roots[f], take.angles[f]), weight[f], shared)
        return gram(J, pushed)

    return information


def lasting(
    known: Known, layout: Layout, state: BodyState, weight: NDArray,
    noise: VarianceComponents, shared: SharedErrors, other_information: NDArray, other_lasting: NDArray,
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
    rows, J, pushed = pixel_columns(layout, state, weight, shared)
    frames, _ = tree.forward(state.T_world_root, state.angles)
    by_shape, stretch = known.columns(layout, rows, tree, frames)
    Sigma = known.covariance
    if body.closures:
        closed = closed_at(body, state)
        w = closed.rows().weight
        soft = (w * ~closed.hard)[:, None] * closed.jacobian
        other_lasting = other_lasting + soft.T @ closed.jacobian
    alone = covariance_alone(body, state, gram(J, pushed) + other_information)
    of_axis = 2 * channels.source[rows.group] + np.arange(len(rows)) % 2
    push = np.ravel(noise.shared)[:, None] * gram(np.eye(2 * len(noise.shared))[of_axis], pushed)
    last, share = (v[rows.group][:, None] * pushed for v in (noise.lasting * np.sqrt(1.0 - shared.share),
                                                            noise.lasting * np.sqrt(shared.share)))
    together = shared.sums(share, rows.group)
    drift = gram(last, last) + gram(together, together)
    meat = drift + product(push.T, push) + other_lasting
    own = (weight / (1.0 - shared.share))[rows.group]
    pushed_by_shape = gram(pushed, by_shape / np.sqrt(np.where(own > 0.0, own, 1.0))[:, None])
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
