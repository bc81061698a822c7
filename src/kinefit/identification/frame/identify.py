"""Who is who in one frame of unlabelled markers: the model's labels, each with the point it is, or none.

What the turns of a body's joints say for and against explanations of a frame: learnt axes and limits.

The search looks at a segment beside its parent alone; here whole explanations that come near each other are compared.
A turn that a segment's own points do not tell comes from its parent's, so that toes are held by the knee's axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked, shaped
from kinefit.identification.frame._kernels_evidence import place_joint
from kinefit.identification.frame._kernels_posture import turn_costs
from kinefit.identification.frame.beliefs import Beliefs
from kinefit.identification.frame.explain import Solution, explain, gain_of, refine, solution
from kinefit.identification.frame.polish import NEAR, labels_of, rivals
from kinefit.identification.frame.search import LabelSearch, UnlabelledFrame
from kinefit.identification.frame.tables import segment_tables
from kinefit.identification.model.model import MarkerModel

OUTLIERS, OUTLYING = 0.05, 4.0
"""Share of markers beyond the noise, and how far: a usual contamination of a Gaussian."""

SEARCHING = 0.7
"""Share of a frame's work that the search may take; the rest is for what else comes near what it found."""

STEP, STAYS = 0.1, 2.0
"""[m] usual way of a marker since the last frame (a hand at 5 m/s goes 8 cm at 60 Hz); what a label earns that stays
where it was, and what it costs if it jumps. It decides between rivals alone."""


@dataclass(frozen=True)
class IdentifySettings:
    """How `identify` searches; nothing of it is about one body or one recording.

    Parameters
    ----------
    finest, coarsest : noise levels between which is searched, as factors on the model's deviations
    certain : a label less probable than this is unknown. On seven real takes with a tenth of the markers gone, 0.8
        names up to 0.8 % more right than 0.9 and up to 0.1 % more wrong; in whole frames 0.6 begins to name wrong
    gate : deviations by which a distance may differ
    miss : expected share of missing markers, before the frame's count is known
    searches : of one frame, from several segments and noise levels; most need one or two
    work : tries of a point for a marker that a frame may take: 0.6 to 0.95 s on one core of 3 GHz
        What was not found by then stays unknown. It is counted, so that the same frame has the same names anywhere.
    """

    finest: float = 0.02
    coarsest: float = 4.0
    certain: float = 0.8
    gate: float = 4.5
    miss: float = 0.05
    searches: int = 60
    work: float = 1.3e8


@dataclass(frozen=True, eq=False)
class Identification:
    """Names of one frame's points.

    Parameters
    ----------
    assignment : (M,) int, the point of each of the model's labels; -1 where it is missing or not known
    confidence : (M,)
        Probability that the assignment is right; where it is -1, that of the best guess, which was too little.
    cost : float, -log likelihood of the whole body's best explanation against that nothing is a marker
    ambiguous : whether a label has a guess, but none that is probable enough
    scale : noise found, as a factor on the model's deviations
    guess : (M,) int, the most probable of all, however probable
    """

    assignment: NDArray
    confidence: NDArray
    cost: float
    ambiguous: bool
    scale: float = 1.0
    guess: NDArray | None = None


@checked
def identify(
    model: MarkerModel,
    points: ArrayLike,
    *,
    previous: ArrayLike | None = None,
    beliefs: Beliefs | None = None,
    settings: IdentifySettings | None = None,
) -> Identification:
    """Which point of a frame is which of the model's labels; needs no pose, nor how many are missing or too many.

    Parameters
    ----------
    points : (N, 3) [m], finite
    previous : (M, 3) [m] or None
        Where the labels were a moment ago, NaN where not known; not used for what the frame itself makes certain.
    beliefs : of this model, what other frames of the same take have shown: see `learn_beliefs`; default: nothing

    Raises
    ------
    ObservationError
        Points of the wrong shape or not finite.
    """
    settings = settings or IdentifySettings()
    at = shaped(points, ("N", 3), "points", finite=True)
    count = len(model)
    if len(at) < 3:
        return Identification(np.full(count, -1), np.zeros(count), 0.0, False, guess=np.full(count, -1))
    gaps = np.linalg.norm(at[:, None] - at, axis=-1)
    box = float(np.prod(np.ptp(at, 0) + 0.3))
    usual = count * (1 - min(max(1 - len(at) / count, settings.miss), 0.5))
    work = np.full(1, SEARCHING * settings.work)
    frame = UnlabelledFrame(at, gaps, box, gain_of(usual, count, len(at), box), settings.gate, work, beliefs)
    best = explain(model, frame, settings.finest, settings.coarsest, settings.searches)
    work += (1 - SEARCHING) * settings.work
    best = refine(model, best)
    before = shaped(np.full((count, 3), np.nan) if previous is None else previous, (count, 3), "previous positions")
    return _decide(model, best, before, settings.certain)


def _decide(model: MarkerModel, found: Solution, before: NDArray, certain: float) -> Identification:
    """Labels that are probable enough against all rivals; where it may all be accident, only what two starts say."""
    count = len(found.labels)
    every = {node.table.index for node, _ in found.chosen}
    chosen, near, seen = (found.chosen, [], every) if found.clear else rivals(found.search, found.chosen)
    pool = {labels_of(e, count).tobytes(): (dearer, e) for dearer, e in [*near, (0.0, chosen)]}
    labels = np.array([labels_of(e, count) for _, e in pool.values()])
    cost = np.array([dearer for dearer, _ in pool.values()]) + _moved(labels, found.search.frame.points, before)
    if len(labels) > 1:
        cost += unusual(model, found.search, labels)
    best = int(np.argmin(cost))
    chosen, guess = list(pool.values())[best][1], labels[best].copy()
    odds = (np.exp(cost[best] - cost)[:, None] * (labels != guess)).sum(0) + np.exp(-NEAR)
    confidence = 1 / (1 + odds)
    if not found.settled:
        confidence *= np.any([other.labels == guess for other in found.others], axis=0)
    for node, _ in chosen:
        if node.table.index not in seen:  # there was no work left to look for what comes near
            confidence[node.table.markers] = np.minimum(confidence[node.table.markers], 0.5)
    found = solution(found.search, chosen, count)
    _complete(found, guess, confidence)
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


def _moved(labels: NDArray, points: NDArray, before: NDArray) -> NDArray:
    """(E,) -log likelihood of the ways from `before` (M, 3) [m] to the points of (E, M) labels; 0 where not known."""
    square = ((points[labels] - before) ** 2).sum(-1) / STEP**2
    return np.where((labels >= 0) & np.isfinite(square), np.minimum(0.5 * square, 2 * STAYS) - STAYS, 0.0).sum(1)


def _complete(found: Solution, guess: NDArray, confidence: NDArray) -> None:
    """Markers that left their place further than the noise allows, as skin does: the one free point near enough.

    A share OUTLIERS of the markers has OUTLYING times the deviation; the odds are those against a missing marker and a
    point that is none. Changes guess and confidence.
    """
    search = found.search
    points = search.frame.points
    free = np.setdiff1d(np.arange(len(points)), guess[guess >= 0])
    for node, c in found.chosen if len(free) else ():
        t, here = node.table, node.index[c] >= 0
        lost = [i for i in np.flatnonzero(~here) if t.shared[i] < 0 and guess[t.markers[i]] < 0]
        x, y, sigma = search.fitted(node, c)
        if len(x) < 3 or not lost:
            continue
        for i in lost:
            at = np.empty(3)
            variance = place_joint(len(x), x, y, sigma, t.x[i], at)
            wide = OUTLYING**2 * search.sigma[t.index][i] ** 2 + variance
            odds = search.gain[t.index][i] + np.log(OUTLIERS) - 1.5 * np.log(2 * np.pi * wide)
            odds = odds - 0.5 * ((points[free] - at) ** 2).sum(1) / wide
            best = int(np.argmax(odds))
            share = float(np.exp(odds[best]) / (1 + np.exp(odds).sum()))
            sure = share * float(confidence[t.markers[here]].min(initial=1.0))
            if sure > 0.5:
                guess[t.markers[i]], confidence[t.markers[i]] = free[best], sure
                free = np.delete(free, best)
                if not len(free):
                    return


MOST = 6.0
"""That the turn of one joint costs at most: people do move as no training shows."""


@dataclass(frozen=True, eq=False)
class PostureModel:
    """A model's segments, parents first, in this `order`, as the kernel wants them: see `turn_costs`."""

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
    """The tables of a model; None where no motion taught it any joint's turns."""
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


def unusual(model: MarkerModel, search: LabelSearch, labels: NDArray) -> NDArray:
    """(E,) what the posture costs under explanations (E, M), -log likelihood; 0 where no motion taught the model."""
    known, out = posture_of(model), np.zeros(len(labels))
    if known is not None:
        sigma = np.concatenate([search.sigma[s] for s in known.order.tolist()])
        turn_costs(
            np.ascontiguousarray(labels), search.frame.points, known.starts, known.markers, known.x, sigma,
            known.parent, known.here, known.there, known.spread, known.middle, known.give, MOST, out,
        )  # fmt: skip
    return out
