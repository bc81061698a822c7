"""What a time's measurements observe, and what they only contradict."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.bodies.tree import KinematicTree
from kinefit.frame.results import ANYWHERE, BLIND
from kinefit.rows import AnyRows, PairRows, ParameterRows, Rows
from kinefit.sensors.base import Matched
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, Evidence
from kinefit.sensors.observability import moves_points, near
from kinefit.sensors.points.keypoints import KeypointMatched
from kinefit.sensors.scene import Scene
from kinefit.solvers.equations import variances

_LEAP = 4.0  # deviations of a prediction, beyond which a start is not held by it
_MOST = 1e3  # [m, rad] standard deviation of a coordinate that is forgotten and has no prior


def observed(tree: KinematicTree, information: NDArray) -> NDArray:
    """(n,) bool: degrees of freedom that an information (n, n), with the prior, tells of; see `BLIND`.

    By itself, not through what the prior couples with them.
    """
    prior, alone = np.concatenate([np.full(6, ANYWHERE), tree.spread]), np.array(information)
    alone[6:, 6:] -= tree.couplings.T @ tree.couplings
    return np.asarray(np.sqrt(np.maximum(variances(alone), 0.0)) <= BLIND * prior)


def levered(scene: Scene, pixels: Iterable[KeypointMatched]) -> NDArray:
    """(D,) bool: coordinates that move a keypoint that is seen where it should be."""
    out, state = np.zeros(len(scene.body.tree.coordinates), bool), scene.state
    for m in pixels:
        inside = (m.weight > 0) & (m.squares(scene.at_time(m.time)) < AGREEMENT_SIGMAS**2)
        points = m.measurement.layout.points_of(scene.body)
        out |= moves_points(scene.body, points, inside[None], state.T_world_root[None], state.angles[None])[0]
    return out


def moving(tree: KinematicTree, segments: NDArray) -> NDArray:
    """(n,) bool: degrees of freedom that move some segment of (S,) bool."""
    out = np.zeros(tree.n_dofs, bool)
    for s in np.flatnonzero(segments):
        last = int(tree.last_dof[s])
        out[tree.chain[last, : tree.depth[last] + 1]] = True
    out[:6] &= tree.root_free
    return out


def adrift(tree: KinematicTree, lost: NDArray, hidden: NDArray, half: int) -> NDArray:
    """(F, S) bool: joints of which frames in a row know nothing, whatever their fit says of them.

    Neither of the two segments that a joint (each named by the segment that hangs on it) connects is where it is
    thought to be, or seen at all, and within so many frames one of them is where it cannot be: what is unseen went
    somewhere else, and no motion prior tells where.

    Parameters
    ----------
    lost, hidden : (F, S) bool, as evidence has them
    half : int, frames to either side
    """
    parents = np.where(tree.parents >= 0, tree.parents, np.arange(len(tree.parents)))
    unknown, contradicted = lost | hidden, lost | lost[:, parents]
    return np.asarray(unknown & unknown[:, parents] & near(contradicted, half))


def unseen(matched: Matched, told: Evidence) -> NDArray | None:
    """(S,) bool: segments that a surface, as its evidence says, does not show, or speaks against; None for points.

    What it has near one of these is another segment's, or no segment's: it may pull that one along, and tells nothing
    of where it is. No more does it that parts of the body keep apart.
    """
    return np.asarray(told.hidden | told.lost) if matched.shows_surface else None


def holding(tree: KinematicTree, segments: NDArray) -> NDArray:
    """(n,) bool: coordinates of the joints of some segments (S,) bool, and of those that they hang on."""
    away = np.array(segments)
    parents = tree.parents[segments]
    away[parents[parents >= 0]] = True
    return np.concatenate([np.zeros(6, bool), away[tree.owners]])


def forgotten(tree: KinematicTree, covariance: NDArray, gone: NDArray) -> NDArray:
    """A covariance (n, n) that knows of some degrees of freedom (n,) bool no more than the prior does."""
    prior = np.concatenate([np.full(6, ANYWHERE), np.minimum(tree.posture_std, _MOST)])
    out = np.where(gone[:, None] | gone[None, :], 0.0, covariance)
    out[gone, gone] = prior[gone] ** 2
    return out


def leapt(predicted: BodyState, information: NDArray, state: BodyState) -> NDArray | None:
    """(n,) bool: angles that a start has changed by more than the prediction allows; None where there are none."""
    off, std = predicted.difference(state), np.sqrt(variances(information))
    out = np.abs(off) > _LEAP * std
    out[:6] = False
    return out if out.any() else None


def left_out(rows: AnyRows, segments: NDArray) -> AnyRows:
    """The same rows; those on some segments (S,) bool weigh nothing."""
    if isinstance(rows, ParameterRows):
        return rows
    of = rows.segments if isinstance(rows, PairRows) else rows.segment
    if of is None:
        return rows
    off = segments[of] if of.ndim == 1 else segments[of].any(axis=1)
    weight = np.where(off, 0.0, rows.weight)
    if isinstance(rows, Rows):
        return Rows(np.concatenate([rows.data[:7], weight[None]]), rows.segment, rows.group, rows.loss)
    return replace(rows, weight=weight)
