"""Which degrees of freedom a frame's measurements observe, and which segments they contradict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.bodies.tree import KinematicTree
from kinefit.fitting.frame.results import ROOT_PRIOR_STD, UNOBSERVED_STD_RATIO
from kinefit.sensors.base import Matched
from kinefit.sensors.evidence import Evidence, near
from kinefit.solving.equations import variances
from kinefit.solving.rows import AnyRows, PairRows, ParameterRows, Rows

_MAX_START_SIGMAS = 4.0  # of the prediction: a start farther off discards the prediction
_MAX_PRIOR_STD = 1e3  # [m, rad] standard deviation of a coordinate that is reset and has no prior


def observed(tree: KinematicTree, information: NDArray) -> NDArray:
    """(n,) bool: degrees of freedom that an information (n, n), prior included, observes; see `UNOBSERVED_STD_RATIO`.

    Couplings of the prior are removed first: they would let one observed coordinate make another count as observed.
    """
    prior, alone = np.concatenate([np.full(6, ROOT_PRIOR_STD), tree.spread]), np.array(information)
    alone[6:, 6:] -= tree.couplings.T @ tree.couplings
    return np.asarray(np.sqrt(np.maximum(variances(alone), 0.0)) <= UNOBSERVED_STD_RATIO * prior)


def dofs_moving(tree: KinematicTree, segments: NDArray) -> NDArray:
    """(n,) bool: degrees of freedom that move any of some segments (S,) bool."""
    out = np.zeros(tree.n_dofs, bool)
    for s in np.flatnonzero(segments):
        last = int(tree.last_dof[s])
        out[tree.chain[last, : tree.depth[last] + 1]] = True
    out[:6] &= tree.root_free
    return out


def unknown_joints(tree: KinematicTree, lost: NDArray, hidden: NDArray, half: int) -> NDArray:
    """(F, S) bool: joints whose angles are unknown in a frame, whatever the fit's covariance.

    A joint, named by its child segment, is unknown if both segments that it connects are lost or hidden, and one of
    them is lost within `half` frames: it moved away unobserved, and a motion prior cannot follow it.

    Parameters
    ----------
    lost, hidden : (F, S) bool, as in `Evidence`
    half : int, frames to either side
    """
    parents = np.where(tree.parents >= 0, tree.parents, np.arange(len(tree.parents)))
    unknown, contradicted = lost | hidden, lost | lost[:, parents]
    return np.asarray(unknown & unknown[:, parents] & near(contradicted, half))


def segments_not_shown(matched: Matched, evidence: Evidence) -> NDArray | None:
    """(S,) bool: segments that a surface sensor does not show, or contradicts; None for points.

    Surface points matched to such a segment belong to another one, or to none. They may pull the segment, but they are
    no measurement of its place. The same holds for rows against collisions.
    """
    return np.asarray(evidence.hidden | evidence.lost) if matched.shows_surface else None


def dofs_of_joints(tree: KinematicTree, segments: NDArray) -> NDArray:
    """(n,) bool: coordinates of the joints of some segments (S,) bool, and of their parents' joints."""
    near_segments = np.array(segments)
    parents = tree.parents[segments]
    near_segments[parents[parents >= 0]] = True
    return np.concatenate([np.zeros(6, bool), near_segments[tree.owners]])


def reset_to_prior(tree: KinematicTree, covariance: NDArray, gone: NDArray) -> NDArray:
    """Covariance (n, n) with the degrees of freedom `gone` (n,) bool reset to the prior, uncorrelated."""
    prior = np.concatenate([np.full(6, ROOT_PRIOR_STD), np.minimum(tree.posture_std, _MAX_PRIOR_STD)])
    out = np.where(gone[:, None] | gone[None, :], 0.0, covariance)
    out[gone, gone] = prior[gone] ** 2
    return out


def angles_off_prediction(predicted: BodyState, information: NDArray, state: BodyState) -> NDArray | None:
    """(n,) bool: angles of a start that are more than `_MAX_START_SIGMAS` off the prediction; None for none.

    Parameters
    ----------
    information : (n, n) of the prediction
    """
    off, std = predicted.difference(state), np.sqrt(variances(information))
    out = np.abs(off) > _MAX_START_SIGMAS * std
    out[:6] = False
    return out if out.any() else None


def without_segments(rows: AnyRows, segments: NDArray) -> AnyRows:
    """The same rows, with weight 0 for those on some segments (S,) bool."""
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
