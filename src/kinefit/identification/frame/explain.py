"""The explanation of a whole frame: searches from several segments, at several noise levels, until one is sure.

They end, too, where the frame's work is used up.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.frame.polish import Explanation, apart, carried, cost_of, labels_of, polish, shared
from kinefit.identification.frame.search import LabelSearch, UnlabelledFrame
from kinefit.identification.frame.tables import segment_tables
from kinefit.identification.model.model import MarkerModel

RUNGS = ((0, 80, 40, 0.1), (3, 300, 100, 0.2), (2, 750, 250, 0.4))
"""How many starts (first: all) get how many nodes for their search, and for each choice of its root, and what share of
the work that is left. Every start gets a few, the best of them more: a good one needs few, and whether it is good shows
only by searching."""

LARGEST = 6
"""Segments by which the noise level is judged."""

STARTS = 5
"""Segments to begin with, at each noise level."""

FIRST = 2
"""Starts at a noise level before the next is looked at."""

BETTER = 30.0
"""Cost of all segments, each on its own, by which the next level must be better to be tried before the rest of one. In
30 poses each of the paper's body: -28 to 28 at 4 % distortion, 25 to 70 at 10 %."""

SURE = 15.0
"""A lead that needs to be no longer."""

FITTING = 1.25
"""Noise of an explanation, as a factor on that which it was searched with, above which that was too little."""

FEW = 0.05
"""Share of the labels in which two explanations may differ and count as the same, found twice."""

OFTEN = 3
"""Starts that lead to the same explanation, after which it is not doubted even where all their searches were cut."""

WHOLE, ENOUGH = 0.93, 0.65
"""Shares of the points, or of the labels if they are fewer, that an explanation names: so many leave no doubt of an
explanation found twice; so many must be in one whose search was cut nowhere. Accidents explain up to half."""

CLEAR = 12.0
"""Cost by which every choice leads the next, where nothing needs weighing."""

REFINED = 2
"""Times that noise and shares are found anew."""

HOPEFUL = 0.7
"""Share of points, and of the cost of the best, below which an explanation is not worked on."""


@dataclass(frozen=True, eq=False)
class Solution:
    """An explanation that one search led to.

    Parameters
    ----------
    chosen : nodes and choices, parents first, every point taken once
    labels : (M,) int, point of each label, -1 for none
    cost : -log likelihood against that nothing is a marker; comparable between noise levels
    noise : found, as a factor on the model's deviations
    clear : whether no other choice of any segment comes near
    settled : whether there is no doubt that it is no accident
    others : what searches from other segments led to
    """

    search: LabelSearch
    chosen: Explanation
    labels: NDArray
    cost: float
    noise: float
    clear: bool = False
    settled: bool = False
    others: tuple[Solution, ...] = ()

    @property
    def matched(self) -> int:
        """Labels that have a point."""
        return int((self.labels >= 0).sum())

    def same(self, other: Solution) -> bool:
        """Whether another solution is the same but for a few labels."""
        return int((self.labels != other.labels).sum()) <= FEW * len(self.labels)


def explain(model: MarkerModel, frame: UnlabelledFrame, finest: float, coarsest: float, searches: int = 60) -> Solution:
    """The cheapest explanation of a frame, found by so many searches from several segments and noise levels."""
    race = Race(model, frame)
    for many, budget, quota, share in RUNGS:
        race.rung((budget, quota, share))
        ranked = sorted(race.reached, key=lambda start: race.reached[start].cost)[:many]
        for root, scale in ranked or _starts(model, frame, finest, coarsest):
            before: Solution | None = None
            while scale <= coarsest and (root, scale) not in race.done:
                before = race.run(root, scale, before)
                best = race.best()
                searches -= 1
                if best.settled or searches < 1 or frame.idle:
                    return best
                if before.noise < FITTING * scale or before.matched < ENOUGH * race.most:
                    break
                scale = _coarser(scale)  # well begun, and noisier than thought
    return race.best()


class Race:
    """Searches of one frame from several segments, at several noise levels.

    Parameters
    ----------
    reached : what each start led to; done : starts that need no more nodes on this rung
    begun : what was made of explanations before, by noise level and labels
    """

    def __init__(self, model: MarkerModel, frame: UnlabelledFrame):
        self.model, self.frame = model, frame
        self.most = min(len(frame.points), len(model))
        self.reached: dict[tuple[int, float], Solution] = {}
        self.done: set[tuple[int, float]] = set()
        self.begun: dict[tuple[float, bytes], Solution] = {}
        self.means = (0, 0, 1.0)

    def rung(self, means: tuple[int, int, float]) -> None:
        """Nodes, in all and for each choice of the root, and share of the work left, for each search from now on."""
        self.means = means
        self.done = {start for start, found in self.reached.items() if not found.search.cut}

    def run(self, root: int, scale: float, before: Solution | None) -> Solution:
        """One search and what it led to, or what it makes of what was found at the noise level `before`."""
        tables = segment_tables(self.model, root)
        search = LabelSearch(tables, self.frame, scale, *self.means)
        chosen = search.decode(search.node(tables[0], None, -1))
        if search.cut or shared(search, chosen).any():
            found = self.improved(solution(search, apart(search, chosen), len(self.model)))
        else:
            leads = (np.delete(node.best, c).min(initial=np.inf) - node.best[c] for node, c in chosen)
            found = replace(solution(search, chosen, len(self.model)), clear=min(leads) > CLEAR)
        if before is not None:
            found = min(found, at_level(before, self.frame, scale), key=_cost)
        self.done.add((root, scale))
        self.reached[root, scale] = found
        return found

    def improved(self, first: Solution) -> Solution:
        """A solution polished, if that is worth it."""
        key = (first.search.scale, first.labels.tobytes())
        if key in self.begun:  # what that led to needs no second time
            return self.begun[key]
        best = min((found.cost for found in self.reached.values()), default=0.0)
        if self.frame.idle or first.matched < HOPEFUL * self.most or first.cost > HOPEFUL * best:
            return first
        first.search.allow(self.means[-1])
        chosen = polish(first.search, first.chosen)
        self.begun[key] = solution(first.search, chosen, len(self.model))
        return self.begun[key]

    def best(self) -> Solution:
        """The cheapest solution so far."""
        best = min(self.reached.values(), key=_cost)
        root = best.search.tables[0].index
        others = tuple(found for (r, _), found in self.reached.items() if r != root)
        roots = {r for (r, _), found in self.reached.items() if found.same(best)}
        share = best.matched / self.most
        whole = not best.search.cut or len(roots) >= OFTEN
        sure = share > ENOUGH and (whole or (len(roots) > 1 and share > WHOLE))
        fits = any(found.noise < FITTING * scale and found.same(best) for (_, scale), found in self.reached.items())
        return replace(best, others=others, settled=sure and fits)


def solution(search: LabelSearch, chosen: Explanation, count: int) -> Solution:
    """An explanation with its cost, noise and labels."""
    squares, freedom = 0.0, 0
    for node, c in chosen:
        n = int((node.index[c] >= 0).sum())
        if n >= 2:
            squares += float(node.squares[c])
            freedom += 1 if n == 2 else 3 * n - 6
    noise = search.scale * float(np.sqrt(squares / max(freedom, 1)))
    return Solution(search, chosen, labels_of(chosen, count), cost_of(search, chosen), noise)


def at_level(found: Solution, frame: UnlabelledFrame, scale: float) -> Solution:
    """A solution at another noise level, or with other thoughts of what is missing."""
    search = LabelSearch(found.search.tables, frame, scale)
    search.cut = True  # nothing but this explanation and its neighbours is looked at
    chosen = polish(search, apart(search, carried(search, found.chosen)))
    return solution(search, chosen, len(found.labels))


def refine(model: MarkerModel, found: Solution) -> Solution:
    """The same with the noise, and the shares of missing and strange points, that it has shown."""
    for _ in range(REFINED):
        frame, scale = found.search.frame, found.search.scale
        gain = gain_of(found.matched, len(model), len(frame.points), frame.volume)
        shown = max(1.05 * found.noise, 1.0) if scale >= 1.0 else scale
        if found.clear or found.matched <= 3 or (abs(shown / scale - 1) < 0.1 and abs(gain - frame.gain) < 0.5):
            break
        better = at_level(found, replace(frame, gain=gain), shown)
        found = replace(better, settled=found.settled, others=found.others)
    return found


def gain_of(matched: float, labels: int, points: int, volume: float) -> float:
    """What a match earns against a miss, log(1/m³), where so many of the labels have one of the points."""
    miss = min(max(1 - matched / labels, 0.02), 0.5)
    return float(np.log((1 - miss) * volume / (miss * max(points - matched, 0.5))))


def _cost(found: Solution) -> float:
    return found.cost


def _starts(model: MarkerModel, frame: UnlabelledFrame, finest: float, coarsest: float) -> Iterator[tuple[int, float]]:
    """Segments to begin with and noise levels, finest level first.

    The finest is that at which the largest segments, each on its own, are explained almost whole; else the model's
    own. A segment is the better a start the further its next choice is behind the best. After FIRST starts, a level
    is left for later if the next one explains the segments much better.
    """
    sizes = sorted((len(m) for m in model.segments), reverse=True)
    least = max(3, sizes[min(2, len(sizes) - 1)])
    large = [s for s, m in enumerate(model.segments) if len(m) >= least][:LARGEST]
    large = large or [int(np.argmax([len(m) for m in model.segments]))]
    tables, scale, last, tried = segment_tables(model, large[0]), finest, np.inf, False
    every = sorted({*large, *(s for s, m in enumerate(model.segments) if len(m) > 3)})
    held: list[tuple[int, float]] = []
    later: list[tuple[int, float]] = []
    while scale <= coarsest:
        search = LabelSearch(tables, frame, scale)
        if not tried:  # mostly one of these is enough
            order, _, share = _ranked(search, large)
            tried = scale >= 1.0 or share > WHOLE or _coarser(scale) > coarsest
            yield from ((s, scale) for s in order[: FIRST * tried])
        if tried:
            order, cost, _ = _ranked(search, every)
            if cost < last - BETTER:
                later += held
            else:
                yield from held
            yield from ((s, scale) for s in order[:FIRST])
            held, last = [(s, scale) for s in order[FIRST:STARTS]], cost
        scale = _coarser(scale)
    yield from held
    yield from later


def _ranked(search: LabelSearch, segments: list[int]) -> tuple[list[int], float, float]:
    """Segments each on its own, the surest first; their cost, and the share of their markers that they explain."""
    found = {s: search.alone(search.by_index[s]) for s in segments}
    order = sorted(segments, key=lambda s: (-min(found[s][2], SURE), found[s][0]))
    markers = sum(len(search.by_index[s].markers) for s in segments)
    return order, sum(f[0] for f in found.values()), sum(f[1] for f in found.values()) / markers


def _coarser(scale: float) -> float:
    """The next noise level; none between the finest and the model's own: a body is firm here and loose there."""
    return max(1.6 * scale, 1.0)
