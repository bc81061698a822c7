"""One tracked frame with its standard deviations and quality.

Which degrees of freedom a frame's measurements observe, and which segments they contradict.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.tree import KinematicTree
from kinefit.sensors.base import Leftover, Matched, Measurement, leftovers_at
from kinefit.sensors.evidence import Evidence, near
from kinefit.sensors.points.keypoints import pixels_of
from kinefit.sensors.scene import Scene
from kinefit.solving.equations import joint_moves, variances
from kinefit.solving.rows import AnyRows, PairRows, ParameterRows, Rows

UNOBSERVED_STD_RATIO = 0.95
"""Posterior over prior standard deviation above which a coordinate counts as unobserved: the data explain less than a
tenth of the prior's variance."""
ROOT_PRIOR_STD = 1.0
"""[m, rad] prior standard deviation of an unobserved root."""
_MIN_JOINT_SHIFT = 1e-3  # [m] by which unobserved coordinates must move a joint centre to leave it unknown
_MAX_UNOBSERVED_SHARE = 0.5  # of a joint's variance that may come from unobserved coordinates


@dataclass(frozen=True, eq=False)
class FrameResult:
    """One tracked frame.

    Parameters
    ----------
    time : float [s]
    state : BodyState
    dof_std : (6 + D,) [m, rad]
        Posterior standard deviation; inf where the measurements do not observe a degree of freedom.
    joint_std : (S, 3) [m]
        Standard deviation of every joint centre along the world's axes; inf where it is unobserved.
    segment_quality : (S,) in 0..1
        Share of a segment's evidence that agrees; 0 where no sensor observes the segment, nor its neighbours on both
        sides.
    lost : (S,) bool
        Segments that the measurements contradict.
    hidden : (S,) bool
        Segments that no sensor observes; prediction and prior alone constrain them.
    support : float in 0..1
        Share of all evidence that agrees.
    iterations : int
    matched : every measurement with the correspondences of the fit
    measurements : the measurements of this frame
    leftovers : residuals of every sensor after the fit, in a frame that is kept
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
    leftovers: tuple[Leftover, ...] = ()

    @property
    def quality(self) -> float:
        """Mean quality of all segments, a share of 0 to 1."""
        return float(np.mean(self.segment_quality))

    def kept(self, scene: Scene) -> FrameResult:
        """What a take keeps of this frame: matches of keypoints, measurements of others, residuals; no whole images.

        Parameters
        ----------
        scene : at the state, with the measurements and the velocity
        """
        pixels = tuple(pixels_of(self.matched))
        packed = {m.sensor for m in pixels}
        return replace(
            self, matched=pixels, measurements=tuple(m.compact() for m in self.measurements if m.sensor not in packed),
            leftovers=tuple(rest for m in self.matched for rest in leftovers_at(m, scene)),
        )  # fmt: skip

    def joined(self, later: FrameResult) -> FrameResult:
        """The frame with what other sensors saw before the next one is due; both are kept frames."""
        names = ("matched", "measurements", "leftovers")
        both = {name: getattr(self, name) + getattr(later, name) for name in names}
        return replace(later, time=self.time, **both)


def deviations(
    body: Body, moves: NDArray, covariances: NDArray, observed: NDArray
) -> tuple[NDArray, NDArray]:
    """Standard deviations of the degrees of freedom (F, n) [m, rad] and of the joint centres (F, S, 3) [m].

    They are infinite where the data explain less than a tenth of the prior's variance. A joint centre's is infinite
    where unobserved coordinates make up most of its variance, and it reaches what they give it by the prior alone.

    Parameters
    ----------
    moves : (F, S, 3, n) derivatives of the joint centres
    covariances : (F, n, n) posterior, the prior included once
    observed : (F, D) bool
        Coordinates that the data observe; others count as unknown whatever their variance.
    """
    tree = body.tree
    prior = np.concatenate([np.full(6, ROOT_PRIOR_STD), tree.posture_std])
    std = np.sqrt(np.maximum(np.einsum("fii->fi", covariances), 0.0))
    blind = std > UNOBSERVED_STD_RATIO * prior
    blind[:, 6:] |= ~observed
    blind[:, :6] &= tree.root_free
    never = ~observed & np.isfinite(tree.spread)
    joints = np.empty(moves.shape[:3])
    patterns = np.concatenate([blind, never], axis=1)
    _, first, group = np.unique(patterns, axis=0, return_index=True, return_inverse=True)
    for g, one in enumerate(first):
        frames = np.flatnonzero(group.ravel() == g)
        joints[frames] = _joint_deviations(
            moves[frames], covariances[frames], blind[one], 6 + np.flatnonzero(never[one]), prior
        )
    return np.where(blind, np.inf, std), joints


def _joint_deviations(
    moves: NDArray, covariance: NDArray, blind: NDArray, never: NDArray, prior: NDArray
) -> NDArray:
    """(F, S, 3) [m] of frames (F, ...) with the same coordinates blind (n,) bool and never observed (k,) int."""
    covariance = _with_variances(covariance, never, prior[never] ** 2)
    F, S, _, n = moves.shape
    lines = moves.reshape(F, 3 * S, n)
    of_joints = lines @ covariance
    variances = np.maximum(np.einsum("fri,fri->fr", of_joints, lines), 0.0)
    joints = np.sqrt(variances)
    if blind.any():
        unknown = np.square(lines) @ np.square(np.where(blind, np.minimum(prior, 1e3), 0.0))
        own, directly, along = covariance[:, blind][:, :, blind], lines[..., blind], of_joints[..., blind]
        share = np.einsum("fri,fri->fr", along @ _inverse(own), along)
        share = np.minimum(share, np.einsum("fri,fri->fr", directly @ own, directly))
        most = (unknown > _MIN_JOINT_SHIFT**2) & (share > _MAX_UNOBSERVED_SHARE * variances)
        joints = np.where(most & (variances > UNOBSERVED_STD_RATIO**2 * unknown), np.inf, joints)
    return joints.reshape(F, S, 3)


def _with_variances(covariance: NDArray, some: NDArray, variances: NDArray) -> NDArray:
    """Covariances (F, n, n) in which some coordinates (k,) have at least these variances (k,).

    All others keep their distribution given those: what data know of a sum of angles stays known.
    """
    if not len(some):
        return covariance
    own = covariance[:, some][:, :, some]
    along = covariance[:, :, some] @ _inverse(own)
    along[:, some] = np.eye(len(some))
    more = np.maximum(variances - np.einsum("fii->fi", own), 0.0)
    return np.asarray(covariance + (along * more[:, None]) @ along.transpose(0, 2, 1))


def _inverse(covariance: NDArray) -> NDArray:
    """Of coordinates (F, k, k) that closures may tie to each other: their covariance is then singular."""
    return np.linalg.pinv(covariance, rcond=1e-9, hermitian=True)


def evidence_of(scene: Scene, matched: Sequence[Matched]) -> list[Evidence]:
    """Evidence of each match for and against every segment at a scene's state."""
    return [m.evidence(scene.at_time(m.time)) for m in matched]


def sum_evidence(scene: Scene, parts: Iterable[Evidence]) -> Evidence:
    """Sum of the evidence of several measurements."""
    return sum(parts, Evidence.none(len(scene.body.tree.segments)))


def frame_result(
    scene: Scene, covariance: NDArray, matched: Sequence[Matched], iterations: int, *, observed: NDArray | None = None,
    evidence: Evidence | None = None,
) -> FrameResult:  # fmt: skip
    """A fitted frame with its standard deviations and quality.

    Parameters
    ----------
    scene : at the fitted state
    covariance : (n, n) posterior, the prior included once
    observed : (D,) bool, optional, see `deviations`
    evidence : sum over all matches at the fitted state; default: computed here
    """
    evidence = sum_evidence(scene, evidence_of(scene, matched)) if evidence is None else evidence
    of_one = replace(evidence, **{name: known[None] for name, known in vars(evidence).items() if known is not None})
    observed = np.ones(len(scene.state.angles), bool) if observed is None else observed
    (result,) = frame_results(
        scene.body, [scene.state], [scene.time], np.asarray(covariance)[None], of_one, observed=observed[None],
        iterations=[iterations],
    )  # fmt: skip
    return replace(result, matched=tuple(matched), measurements=scene.measurements)


def frame_results(
    body: Body, states: Sequence[BodyState], times: Sequence[float] | NDArray, covariances: NDArray,
    evidence: Evidence, *, observed: NDArray, iterations: Sequence[int],
) -> list[FrameResult]:  # fmt: skip
    """Several fitted frames at once, without their matches; see `frame_result`.

    Parameters
    ----------
    states : F states
    times : (F,) [s]
    covariances : (F, n, n) posterior, the prior included once
    evidence : of F frames
    observed : (F, D) bool
    iterations : F numbers
    """
    moves = np.stack([joint_moves(body, state) for state in states])
    std, joints = deviations(body, moves, covariances, observed)
    agreeing, contrary = evidence.agreeing.sum(axis=1), evidence.contrary.sum(axis=1)
    support = agreeing / np.maximum(agreeing + contrary, 1e-12)
    quality, lost, hidden = evidence.segment_quality(body.tree), evidence.lost, evidence.hidden
    return [
        FrameResult(
            float(times[f]), state, std[f], joints[f], quality[f], lost[f], hidden[f], float(support[f]), iterations[f]
        )
        for f, state in enumerate(states)
    ]  # fmt: skip


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
