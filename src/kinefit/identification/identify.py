"""Who is who in one frame of unlabelled markers: the model's labels, each with the point it is, or none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.identification._bids import bid, marginals
from kinefit.identification._kernels_evidence import place_joint
from kinefit.identification._search import Node, Search
from kinefit.identification._tables import SegmentTable, segment_tables
from kinefit.identification.model import MarkerModel

ATTEMPTS = 10
"""Searches of a frame that is not explained well; each takes 0.1 s or less."""

ROUNDS = 6
"""Of segments that tell each other which points they want."""

MOST_NODES = 6000
"""Nodes of all attempts at a frame, a second or so; one that needs more is left as it is. Sixty poses with 10 % missing
showed that less leaves whole bodies unexplained."""

SURE = 15.0
"""A lead that needs to be no longer."""

CLEAR = 12.0
"""Cost by which every choice leads the next, where nothing needs weighing."""

OUTLIERS, OUTLYING = 0.05, 4.0
"""Share of markers beyond the noise, and how far: a usual contamination of a Gaussian."""

ENOUGH = 0.65
"""Share of the labels that a noise level must explain to need no other tried; accidents explain up to half."""

TRUSTED = 0.72
"""Share of the points that an explanation must have a name for, if there are no more than labels; else it is chance. At
0.8 wrong names all but end where much is missing, and right ones with 10 % missing fall below 95 %."""

WHOLE = 0.95
"""Share of the largest segments' markers that a noise level explains when no coarser one need be looked at."""


@dataclass(frozen=True)
class IdentifySettings:
    """How `identify` searches; nothing of it is about one body or one recording.

    Parameters
    ----------
    finest, coarsest : noise levels between which is searched, as factors on the model's deviations
    certain : a label less probable than this is unknown. On seven real takes with a tenth of the markers gone, 0.8
        names up to 1.1 % more right than 0.9 and up to 0.15 % more wrong; in whole frames 0.7 begins to name wrong
    gate : deviations by which a distance may differ
    miss : expected share of missing markers, before the frame's count is known
    """

    finest: float = 0.02
    coarsest: float = 4.0
    certain: float = 0.8
    gate: float = 4.5
    miss: float = 0.05


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


def identify(
    model: MarkerModel,
    points: ArrayLike,
    *,
    previous: ArrayLike | None = None,
    settings: IdentifySettings | None = None,
) -> Identification:
    """Which point of a frame is which of the model's labels; needs no pose, nor how many are missing or too many.

    Parameters
    ----------
    points : (N, 3) [m], finite
    previous : (M, 3) [m] or None
        Where the labels were a moment ago, NaN where not known; not used for what the frame itself makes certain.

    Raises
    ------
    ObservationError
        Points of the wrong shape or not finite.
    """
    settings = settings or IdentifySettings()
    at = np.ascontiguousarray(points, float)
    if at.ndim != 2 or at.shape[1] != 3 or not np.isfinite(at).all():
        raise ObservationError(
            f"points of shape {at.shape}, or not finite",
            remedy="Give the (N, 3) [m] points that were seen, without gaps.",
        )
    count = len(model)
    if len(at) < 3:
        return Identification(np.full(count, -1), np.zeros(count), 0.0, False, guess=np.full(count, -1))
    gaps = np.linalg.norm(at[:, None] - at, axis=-1)
    box = float(np.prod(np.ptp(at, 0) + 0.3))
    miss = min(max(1 - len(at) / count, settings.miss), 0.5)
    clutter = max(len(at) - count * (1 - miss), 0.5) / box
    gain = float(np.log((1 - miss) / (miss * clutter)))
    best: Solution | None = None
    spent = 0
    for root, scale in _attempts(model, at, gaps, gain, box, settings):
        found = _solve(segment_tables(model, root), at, gaps, scale, gain, box, settings.gate)
        spent += len(found.search.memo)
        if best is None or (found.clashes, found.cost) < (best.clashes, best.cost):
            best = found
        enough = 0.9 * len(at) if len(at) <= count else ENOUGH * count
        if (found.matched >= enough and found.noise < 1.25 * scale) or spent > MOST_NODES:
            break
    assert best is not None
    contested = best.search.wanted | _shared(best.search, best.chosen)
    noisy = best.noise > 1.2 * best.search.scale
    if best.matched > 3 and (noisy or contested.any()):
        scale = 1.05 * best.noise if noisy else best.search.scale
        found = _solve(best.search.tables, at, gaps, scale, gain, box, settings.gate, contested)
        best = found if found.matched >= 0.8 * best.matched else best
    named = _decide(best, count, settings.certain)
    if best.matched < (TRUSTED * len(at) if len(at) <= count else ENOUGH * count):  # accidents
        return replace(named, assignment=np.full(count, -1), confidence=np.zeros(count), ambiguous=True)
    return named


def _attempts(
    model: MarkerModel, at: NDArray, gaps: NDArray, gain: float, box: float, settings: IdentifySettings
) -> list[tuple[int, float]]:
    """Segments to begin with and noise levels, the likeliest first.

    The level is that at which the largest segments, each on its own, are explained best; the segment is that of which
    the next choice is furthest behind the best. After that other levels and other segments, the nearest first.
    """
    sizes = sorted((len(m) for m in model.segments), reverse=True)
    large = [s for s, m in enumerate(model.segments) if len(m) >= max(3, sizes[min(2, len(sizes) - 1)])][:6]
    large = large or [int(np.argmax([len(m) for m in model.segments]))]
    tables = segment_tables(model, large[0])
    best, share, scale, chosen = np.inf, 0.0, settings.finest, 0
    levels: list[tuple[float, list[int]]] = []
    while scale <= settings.coarsest:
        search = Search(tables, at, gaps, scale, gain, box, settings.gate)
        found = [search.alone(search.by_index[s]) for s in large]
        cost = sum(f[0] for f in found)
        order = sorted(range(len(large)), key=lambda k: (-min(found[k][2], SURE), found[k][0]))
        levels.append((scale, [large[k] for k in order]))
        if cost < best:
            best, chosen = cost, len(levels) - 1
            share = sum(f[1] for f in found) / sum(len(model.segments[s]) for s in large)
            if share > WHOLE:
                break
        elif share > ENOUGH + 0.05:
            break
        scale = max(1.6 * scale, 1.0)  # not between: a body is firm here and loose there
    ranked = [
        (abs(n - chosen) + rank, -n, root, scale)
        for n, (scale, roots) in enumerate(levels) if n or not chosen for rank, root in enumerate(roots[:3])
    ]  # fmt: skip
    return [(root, scale) for *_, root, scale in sorted(ranked)[:ATTEMPTS]]


@dataclass(frozen=True, eq=False)
class Solution:
    """The best explanation at one noise level: the nodes and choices, top down."""

    search: Search
    root: Node
    chosen: list[tuple[Node, int]]
    cost: float
    noise: float
    matched: int
    clashes: bool


def _solve(
    tables: tuple[SegmentTable, ...], at: NDArray, gaps: NDArray, scale: float, gain: float, box: float, gate: float,
    contested: NDArray | None = None,
) -> Solution:
    search = Search(tables, at, gaps, scale, gain, box, gate, contested)
    root = search.node(tables[0], None, -1)
    search.gather(root)
    chosen, cost, clashes = _without_conflicts(search, root, 1 + max(int(t.markers.max()) for t in tables))
    squares, freedom, matched = 0.0, 0, 0
    for node, c in chosen:
        n = int((node.index[c] >= 0).sum())
        if n >= 2:
            squares += float(node.squares[c])
            freedom += 1 if n == 2 else 3 * n - 6
        matched += int((node.index[c][node.table.shared < 0] >= 0).sum())
    matched -= int(np.bitwise_count(_shared(search, chosen)).sum())
    return Solution(search, root, chosen, cost, scale * float(np.sqrt(squares / max(freedom, 1))), matched, clashes)


def _without_conflicts(search: Search, root: Node, labels: int) -> tuple[list[tuple[Node, int]], float, bool]:
    """The best explanation, its cost, and whether two labels share a point in it: what clashes is bid for."""
    chosen = search.decode(root)
    clash = bool(_shared(search, chosen).any())
    found: list[tuple[float, list[tuple[Node, int]]]] = []

    def until() -> bool:
        now = search.decode(root)
        if not _shared(search, now).any():
            found.append((search.cost_of(now), now))
        return bool(found)

    if clash:
        bid(search, root, labels, ROUNDS, until)
        chosen, clash = (found[0][1], False) if found else (search.decode(root), True)
    return chosen, search.cost_of(chosen), clash


def _shared(search: Search, chosen: list[tuple[Node, int]]) -> NDArray:
    """(W,) bits of points that two segments take."""
    once = np.zeros_like(search.contested)
    twice = once.copy()
    for node, c in chosen:
        twice |= once & node.new[c]
        once |= node.new[c]
    return twice


def _decide(found: Solution, count: int, certain: float) -> Identification:
    """Labels that are probable enough, by the share of all explanations that agree on them."""
    guess = np.full(count, -1)
    for node, c in found.chosen:
        fresh = node.table.shared < 0
        guess[node.table.markers[fresh]] = node.index[c, fresh]
    if all(np.delete(node.best, c).min(initial=np.inf) - node.best[c] > CLEAR for node, c in found.chosen):
        confidence = np.full(count, 1 - float(np.exp(-CLEAR)))
    else:
        confidence = _shares(found, guess)
    for point in np.flatnonzero(np.bincount(guess[guess >= 0]) > 1):  # what nobody gave way in
        users = np.flatnonzero(guess == point)
        guess[users[users != users[np.argmax(confidence[users])]]] = -1
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


def _shares(found: Solution, guess: NDArray) -> NDArray:
    """(M,) share of the likelihood of all explanations that agree with a guess about each label.

    A point that other segments want costs.
    """
    bid(found.search, found.root, len(guess), ROUNDS, lambda: False)
    return marginals(found.search, found.root, len(guess))[np.arange(len(guess)), guess]


def _complete(found: Solution, guess: NDArray, confidence: NDArray) -> None:
    """Markers that left their place further than the noise allows, as skin does: the one free point near enough.

    A share OUTLIERS of the markers has OUTLYING times the deviation; the odds are those against a missing marker and a
    point that is none. Changes guess and confidence.
    """
    search = found.search
    points = search.points
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
            odds = search.gain + np.log(OUTLIERS) - 1.5 * np.log(2 * np.pi * wide)
            odds = odds - 0.5 * ((points[free] - at) ** 2).sum(1) / wide
            best = int(np.argmax(odds))
            share = float(np.exp(odds[best]) / (1 + np.exp(odds).sum()))
            sure = share * float(confidence[t.markers[here]].min(initial=1.0))
            if sure > 0.5:
                guess[t.markers[i]], confidence[t.markers[i]] = free[best], sure
                free = np.delete(free, best)
                if not len(free):
                    return
