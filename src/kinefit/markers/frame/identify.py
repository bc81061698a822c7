"""Label the markers of one frame: assign a point to each label of a model, or none.

The search compares a segment with its parent only. Here whole explanations of similar cost are compared by the learnt
distribution of joint rotations. A rotation that a segment's points do not determine is predicted from its parent.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked, shaped
from kinefit.markers.frame import explain
from kinefit.markers.frame._kernels_evidence import place_joint
from kinefit.markers.frame._kernels_posture import turn_costs
from kinefit.markers.frame.explain import MAX_RIVAL_COST, Solution, gain_of, labels_of, rivals
from kinefit.markers.frame.search import LabelSearch, UnlabelledFrame
from kinefit.markers.frame.tables import Beliefs, Identification, segment_tables
from kinefit.markers.model.model import MarkerModel

OUTLIER_SHARE = 0.05
"""Share of markers with larger noise: a common contamination of a Gaussian."""

OUTLIER_SIGMAS = 4.0
"""Their standard deviation, as a factor on that of the others."""

SEARCH_WORK_SHARE = 0.7
"""Share of a frame's work for the search; the rest is for the comparison with rivals."""

TYPICAL_STEP = 0.1
"""[m] motion of a marker between frames: a hand at 5 m/s moves 8 cm at 60 Hz."""

STAY_GAIN = 2.0
"""Gain of a label that stays in place and cost of one that jumps; used between rivals only."""


@dataclass(frozen=True)
class IdentifySettings:
    """Settings of `identify`, independent of body and recording.

    Parameters
    ----------
    finest, coarsest : noise levels between which to search, as factors on the model's deviations
    certain : least probability of a known label. On seven real takes with 10 % of the markers removed, 0.8
        gives up to 0.8 % more correct and 0.1 % more wrong labels than 0.9; in complete frames errors begin at 0.6
    gate : standard deviations by which a distance may differ from the model's
    miss : expected share of missing markers, before the frame's points are counted
    searches : most searches per frame, from several segments and noise levels; one or two mostly suffice
    work : most distance tests per frame: 0.6 to 0.95 s on one core of 3 GHz
        Labels not found by then stay unknown. Tests are counted instead of time, so that results are reproducible.
    """

    finest: float = 0.02
    coarsest: float = 4.0
    certain: float = 0.8
    gate: float = 4.5
    miss: float = 0.05
    searches: int = 60
    work: float = 1.3e8


@checked
def identify(
    model: MarkerModel,
    points: ArrayLike,
    *,
    previous: ArrayLike | None = None,
    beliefs: Beliefs | None = None,
    settings: IdentifySettings | None = None,
) -> Identification:
    """Assign the points of a frame to the labels of a model; no initial pose or number of missing points is needed.

    Parameters
    ----------
    points : (N, 3) [m], finite
    previous : (M, 3) [m] or None
        Positions of the labels in the frame before, NaN if unknown; they only decide between rivals. Default: unknown.
    beliefs : presence and noise estimated from other frames of the same take, see `learn_beliefs`; default: priors

    Raises
    ------
    ObservationError
        Points have the wrong shape or are not finite.
    """
    settings = settings or IdentifySettings()
    at = shaped(points, ("N", 3), "points", finite=True)
    count = len(model)
    if len(at) < 3:
        return Identification(np.full(count, -1), np.zeros(count), 0.0, False, guess=np.full(count, -1))
    gaps = np.linalg.norm(at[:, None] - at, axis=-1)
    box = float(np.prod(np.ptp(at, 0) + 0.3))
    expected_count = count * (1 - min(max(1 - len(at) / count, settings.miss), 0.5))
    work = np.full(1, SEARCH_WORK_SHARE * settings.work)
    frame = UnlabelledFrame(at, gaps, box, gain_of(expected_count, count, len(at), box), settings.gate, work, beliefs)
    best = explain.explain(model, frame, settings.finest, settings.coarsest, settings.searches)
    work += (1 - SEARCH_WORK_SHARE) * settings.work
    best = explain.refine(model, best)
    before = shaped(np.full((count, 3), np.nan) if previous is None else previous, (count, 3), "previous positions")
    return _select_labels(model, best, before, settings.certain)


def _select_labels(model: MarkerModel, found: Solution, before: NDArray, certain: float) -> Identification:
    """Labels that are probable enough against all rivals; in an uncertain solution only those that two starts found."""
    count = len(found.labels)
    segments = {node.table.index for node, _ in found.chosen}
    chosen, near, examined = (found.chosen, [], segments) if found.clear else rivals(found.search, found.chosen)
    pool = {labels_of(e, count).tobytes(): (excess, e) for excess, e in [*near, (0.0, chosen)]}
    labels = np.array([labels_of(e, count) for _, e in pool.values()])
    cost = np.array([excess for excess, _ in pool.values()]) + _motion_costs(labels, found.search.frame.points, before)
    if len(labels) > 1:
        cost += posture_costs(model, found.search, labels)
    best = int(np.argmin(cost))
    chosen, guess = list(pool.values())[best][1], labels[best].copy()
    odds = (np.exp(cost[best] - cost)[:, None] * (labels != guess)).sum(0) + np.exp(-MAX_RIVAL_COST)
    confidence = 1 / (1 + odds)
    if not found.settled:
        confidence *= np.any([other.labels == guess for other in found.others], axis=0)
    for node, _ in chosen:
        if node.table.index not in examined:  # no work was left to search for rivals
            confidence[node.table.markers] = np.minimum(confidence[node.table.markers], 0.5)
    found = explain.solution(found.search, chosen, count)
    _add_outliers(found, guess, confidence)
    known = (confidence >= certain) & (guess >= 0)
    assignment = np.where(known, guess, -1)
    return Identification(
        assignment,
        np.where(guess >= 0, confidence, 0.0),
        found.cost,
        bool(((guess >= 0) & ~known).any()),
        found.noise,
        guess,
    )


def _motion_costs(labels: NDArray, points: NDArray, before: NDArray) -> NDArray:
    """(E,) -log likelihood of the motion from `before` (M, 3) [m] to the points of (E, M) labels; 0 if unknown."""
    steps = ((points[labels] - before) ** 2).sum(-1) / TYPICAL_STEP**2
    costs = np.minimum(0.5 * steps, 2 * STAY_GAIN) - STAY_GAIN
    return np.where((labels >= 0) & np.isfinite(steps), costs, 0.0).sum(1)


def _add_outliers(found: Solution, guess: NDArray, confidence: NDArray) -> None:
    """Assign free points to missing markers that moved beyond the noise, as on sliding skin.

    A share OUTLIER_SHARE of the markers has OUTLIER_SIGMAS times the deviation; the alternative is a missing marker
    and an unrelated point, by the shares of both in this solution. Changes guess and confidence.
    """
    search = found.search
    points = search.frame.points
    gain = gain_of(found.matched, len(guess), len(points), search.frame.volume) - search.frame.gain
    free = np.setdiff1d(np.arange(len(points)), guess[guess >= 0])
    for node, c in found.chosen if len(free) else ():
        t, matched = node.table, node.index[c] >= 0
        missing = [i for i in np.flatnonzero(~matched) if t.shared[i] < 0 and guess[t.markers[i]] < 0]
        x, y, sigma = search.fit_points(node, c)
        if len(x) < 3 or not missing:
            continue
        for i in missing:
            at = np.empty(3)
            variance = place_joint(len(x), x, y, sigma, t.x[i], at)
            variance_sum = OUTLIER_SIGMAS**2 * search.sigma[t.index][i] ** 2 + variance
            odds = search.gain[t.index][i] + gain + np.log(OUTLIER_SHARE) - 1.5 * np.log(2 * np.pi * variance_sum)
            odds = odds - 0.5 * ((points[free] - at) ** 2).sum(1) / variance_sum
            best = int(np.argmax(odds))
            share = float(np.exp(odds[best]) / (1 + np.exp(odds).sum()))
            probability = share * float(confidence[t.markers[matched]].min(initial=1.0))
            if probability > 0.5:
                guess[t.markers[i]], confidence[t.markers[i]] = free[best], probability
                free = np.delete(free, best)
                if not len(free):
                    return


MAX_TURN_COST = 6.0
"""Largest cost of one joint's rotation: people also move in ways that training does not show."""


@dataclass(frozen=True, eq=False)
class PostureModel:
    """A model's segments as arrays for `turn_costs`, parents first in this `order`."""

    order: NDArray
    starts: NDArray
    markers: NDArray
    x: NDArray
    parent: NDArray
    here: NDArray
    there: NDArray
    spread: NDArray
    middle: NDArray
    give: NDArray


@lru_cache(maxsize=64)
def posture_of(model: MarkerModel) -> PostureModel | None:
    """Arrays of a model for `turn_costs`; None if it was learnt without motion."""
    joints = {j.child: j for j in model.joints}
    if all(j.turn is None for j in model.joints):
        return None
    tables = segment_tables(model, 0)
    order = np.array([t.index for t in tables])
    place = {s: i for i, s in enumerate(order.tolist())}
    count = len(tables)
    middle, give = np.tile(np.eye(3), (count, 1, 1)), np.full((count, 3, 3), -1.0)
    for i, t in enumerate(tables):
        joint = joints.get(t.index)
        if joint is not None and joint.turn is not None and joint.give is not None:
            middle[i], give[i] = joint.turn, joint.give
    zero = np.zeros(3)
    return PostureModel(
        order, np.concatenate([[0], np.cumsum([len(t.markers) for t in tables])]),
        np.concatenate([t.markers for t in tables]), np.concatenate([t.x for t in tables]),
        np.array([place.get(t.parent, -1) for t in tables]),
        np.array([zero if t.joint_here is None else t.joint_here for t in tables]),
        np.array([zero if t.joint_there is None else t.joint_there for t in tables]),
        np.array([t.spread for t in tables]), middle, give,
    )  # fmt: skip


def posture_costs(model: MarkerModel, search: LabelSearch, labels: NDArray) -> NDArray:
    """(E,) cost of the posture, -log likelihood, under labels (E, M); 0 if the model was learnt without motion."""
    p, out = posture_of(model), np.zeros(len(labels))
    if p is not None:
        sigma = np.concatenate([search.sigma[s] for s in p.order.tolist()])
        turn_costs(
            np.ascontiguousarray(labels), search.frame.points, p.starts, p.markers, p.x, sigma,
            p.parent, p.here, p.there, p.spread, p.middle, p.give, MAX_TURN_COST, out,
        )  # fmt: skip
    return out
