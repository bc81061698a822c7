"""One tracked frame, and how sure it is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.sensors.base import Matched, Measurement
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.scene import Scene
from kinefit.solvers.equations import joint_moves

BLIND = 0.95  # of a prior's standard deviation: the data explain less than a tenth of the variance
ANYWHERE = 1.0  # [m, rad] prior standard deviation of a root that nothing holds
_LEAST = 1e-3  # [m] by which an unobserved coordinate must move a joint centre to leave it unknown


@dataclass(frozen=True, eq=False)
class FrameResult:
    """One tracked frame.

    Parameters
    ----------
    time : float [s]
    state : BodyState
    dof_std : (6 + D,) [m, rad]
        Posterior standard deviation; inf where only the prior speaks.
    joint_std : (S, 3) [m]
        Of every joint centre along the world's axes; inf likewise.
    segment_quality : (S,) in 0..1
        Share of what the sensors can see of a segment that agrees with them; 0 where they see nothing of it, nor of its
        neighbours on both sides.
    lost : (S,) bool
        Segments that what was measured speaks against.
    hidden : (S,) bool
        Segments that no sensor sees: held by the prediction and the prior alone.
    support : float in 0..1
        Share of all evidence that agrees.
    iterations : int
    matched : of every measurement, with the correspondences of the fit
    measurements : the measurements themselves
    """

    time: float
    state: BodyState
    dof_std: NDArray
    joint_std: NDArray
    segment_quality: NDArray
    lost: NDArray
    hidden: NDArray
    support: float
    iterations: int
    matched: tuple[Matched, ...] = ()
    measurements: tuple[Measurement, ...] = ()

    @property
    def quality(self) -> float:
        """Mean quality of all segments, in 0..1."""
        return float(np.mean(self.segment_quality))


def deviations(
    body: Body, state: BodyState, covariance: NDArray, observed: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """Standard deviations of the degrees of freedom (n,) [m, rad] and of the joint centres (S, 3) [m].

    Infinite where the data explain less than a tenth of the prior's variance: for a joint centre, where its variance is
    as much as the coordinates that are so would give it by the prior alone.

    Parameters
    ----------
    covariance : (n, n) posterior, the prior counted once
    observed : (D,) bool, optional
        Coordinates that the data observe at all; others are unknown however small their variance is.
    """
    tree = body.tree
    prior = np.concatenate([np.full(6, ANYWHERE), tree.posture_std])
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    blind = std > BLIND * prior
    if observed is not None:
        blind[6:] |= ~observed
        covariance = np.array(covariance)
        never = 6 + np.flatnonzero(~observed & np.isfinite(tree.spread))
        covariance[never, never] = np.maximum(covariance[never, never], prior[never] ** 2)
    blind[:6] &= tree.root_free
    moves = joint_moves(body, state)
    joints = np.sqrt(np.maximum(np.einsum("...i,...i->...", moves @ covariance, moves), 0.0))
    if blind.any():
        alone = np.square(np.where(blind, np.minimum(prior, 1e3), 0.0))
        unknown = np.sqrt(np.square(moves) @ alone)
        joints = np.where((unknown > _LEAST) & (joints > BLIND * unknown), np.inf, joints)
    return np.where(blind, np.inf, std), joints


def evidence_of(scene: Scene, matched: Sequence[Matched]) -> list[Evidence]:
    """What each match says of each segment at a scene's state."""
    return [m.evidence(scene.at_time(m.time)) for m in matched]


def together(scene: Scene, told: Iterable[Evidence]) -> Evidence:
    """What several say, all in all."""
    return sum(told, Evidence.none(len(scene.body.tree.segments)))


def judged(
    scene: Scene, covariance: NDArray, matched: Sequence[Matched], iterations: int, *, observed: NDArray | None = None,
    told: Evidence | None = None,
) -> FrameResult:  # fmt: skip
    """A fitted frame with its deviations and its quality.

    Parameters
    ----------
    scene : at the fitted state
    covariance, observed : see `deviations`
    told : what the matches say at the fitted state, where that is known already
    """
    told = together(scene, evidence_of(scene, matched)) if told is None else told
    total = float(told.agreeing.sum() + told.contrary.sum())
    support = float(told.agreeing.sum()) / total if total > 0.0 else 0.0
    std = deviations(scene.body, scene.state, covariance, observed)
    return FrameResult(
        scene.time, scene.state, *std, told.segment_quality(scene.body.tree), told.lost, told.hidden, support,
        iterations, tuple(matched), scene.measurements,
    )  # fmt: skip
