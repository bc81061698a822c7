"""Explain a whole frame by searches from several segments and noise levels, until one solution is certain.

The searches also end when the frame's work is used up.

Improve an explanation of a frame branch by branch, and list the rivals whose cost is close to it.

The search over the tree lets limbs in different branches use the same point. Here every explanation uses each point
once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.markers.frame.search import MAX_BRANCH_EXCESS_COST, LabelSearch, Node, UnlabelledFrame
from kinefit.markers.frame.tables import segment_tables
from kinefit.markers.model.model import MarkerModel

Explanation = list[tuple[Node, int]]
"""Nodes and the index of the choice in each, parents first."""

NODES_PER_SEGMENT = 20
"""Node budget per segment when a branch is searched again; the rest of the body leaves it few points."""

MAX_SWEEPS = 3
"""Sweeps over all branches; fewer if one changes nothing."""

MAX_TRIALS = 3
"""Segments tried for another choice if several use the same point."""

MAX_ALTERNATIVES = 6
"""Alternative choices tried per segment."""

MAX_RIVAL_COST = 6.0
"""Cost above the best beyond which rivals are ignored: 0.25 % of the likelihood."""

MAX_RESTARTS = 4
"""Times that a cheaper rival may replace the explanation."""


def cost_of(search: LabelSearch, chosen: Explanation) -> float:
    """-log likelihood of an explanation, a number; a point used by two segments counts twice."""
    at = {node.table.index: (node, c) for node, c in chosen}
    total = 0.0
    for node, c in chosen:
        total += float(node.cost[c])
        if node.table.parent in at:
            total += float(search.range_costs(*at[node.table.parent], node)[c])
    return total


def labels_of(chosen: Explanation, count: int) -> NDArray:
    """(M,) int, point of each of `count` labels, -1 for none."""
    labels = np.full(count, -1)
    for node, c in chosen:
        fresh = node.table.shared < 0
        labels[node.table.markers[fresh]] = node.index[c, fresh]
    return labels


def shared_points(search: LabelSearch, chosen: Explanation) -> NDArray:
    """(W,) uint64 bits of the points that two segments use."""
    used_twice, used = search.bits[-1].copy(), search.bits[-1].copy()
    for node, c in chosen:
        used_twice |= used & node.new[c]
        used |= node.new[c]
    return used_twice


def resolve_conflicts(search: LabelSearch, chosen: Explanation) -> Explanation:
    """Change an explanation so that every point is used once."""
    found = remove_conflicts(search, chosen, branches(search), {chosen[0][0].table.index})
    assert found is not None  # segments below the root can always choose none
    return found


def polish(search: LabelSearch, found: Explanation) -> Explanation:
    """Improve an explanation until no change of a single branch lowers its cost."""
    below = branches(search)
    cost = cost_of(search, found)
    largest = 0.6 * len(found)  # a branch of nearly the whole body would repeat the first search
    small = [node.table.index for node, _ in found[1:] if len(below[node.table.index]) < largest][::-1]
    for _ in range(MAX_SWEEPS):
        before = cost
        for s in () if search.is_exhausted else small:
            trial = search_branch(search, found, below[s])
            trial_cost = cost_of(search, trial)
            if trial_cost < cost - 1e-6 and not shared_points(search, trial).any():
                found, cost = trial, trial_cost
        if cost == before:
            break
    return found


def transfer(search: LabelSearch, chosen: Explanation) -> Explanation:
    """Transfer an explanation to a search at another noise level; points outside its gate are dropped."""
    every = np.bitwise_or.reduce(search.bits, 0)
    at: dict[int, tuple[Node, int]] = {}
    for node, c in chosen:
        local = search.without_points(every & ~node.all[c], MAX_BRANCH_EXCESS_COST)
        new_node = local.make_node(node.table, *at.get(node.table.parent, (None, -1)))
        matches = np.flatnonzero((new_node.index == node.index[c]).all(1))
        at[node.table.index] = (new_node, int(matches[0]) if len(matches) else int(np.argmin(new_node.cost)))
    return list(at.values())


def remove_conflicts(
    search: LabelSearch, chosen: Explanation, below: dict[int, list[int]], fixed: set[int], limit: float = np.inf
) -> Explanation | None:
    """Change an explanation so that every point is used once: of two segments one chooses again, whichever costs less.

    None if both are `fixed`, or if the cost (a number) exceeds `limit`.
    """
    tries = 0
    while (conflicts := shared_points(search, chosen)).any():
        tries += 1
        users = {node.table.index for node, c in chosen if (node.new[c] & conflicts).any()} - fixed
        if not users or cost_of(search, chosen) > limit:  # further changes only add cost
            return None
        order = sorted(users, key=lambda s: (len(below[s]), s))
        # with conflicts inside a branch: one at a time from the last segments on, so that it ends
        trials = [search_branch(search, chosen, below[s]) for s in order[: 1 if tries > len(chosen) else MAX_TRIALS]]
        conflict_counts = [int(np.unpackbits(shared_points(search, trial).view(np.uint8)).sum()) for trial in trials]
        chosen = trials[min(range(len(trials)), key=lambda k: (conflict_counts[k], cost_of(search, trials[k])))]
    return chosen


def branches(search: LabelSearch) -> dict[int, list[int]]:
    """For each segment the indices of itself and its descendants."""
    found: dict[int, list[int]] = {}
    for t in reversed(search.tables):
        found[t.index] = [t.index] + [s for child in t.children for s in found[child]]
    return found


def search_branch(search: LabelSearch, chosen: Explanation, branch: list[int]) -> Explanation:
    """Search a branch (a segment and its descendants) of an explanation again, without the points of the rest."""
    kept = [(node, c) for node, c in chosen if node.table.index not in branch]
    table = search.by_index[branch[0]]
    above = next((node, c) for node, c in kept if node.table.index == table.parent)
    outside = search.bits[-1].copy()
    for node, c in kept:
        outside |= node.new[c]
    local = search.without_points(outside)
    local.set_node_budget(NODES_PER_SEGMENT * len(branch))
    return kept + local.decode(local.node(table, *above), above)


def rivals(search: LabelSearch, chosen: Explanation) -> tuple[Explanation, list[tuple[float, Explanation]], set[int]]:
    """The cheapest explanation near one, its rivals with their excess cost, and the indices of segments examined.

    All segments are examined unless the frame's work is used up. The excess cost is at most MAX_RIVAL_COST.
    """
    search.set_work_share(1.0)
    for _ in range(MAX_RESTARTS):
        cost, found = cost_of(search, chosen), []
        examined: set[int] = set()
        for trial in _alternatives(search, chosen, examined):
            found.append((cost_of(search, trial), trial))
            if found[-1][0] < cost - 1e-6:
                break
        else:
            break
        found[-1] = (cost, chosen)
        cost, chosen = cost_of(search, trial), trial
    return chosen, [(total - cost, rival) for total, rival in found if total < cost + MAX_RIVAL_COST], examined


def _alternatives(search: LabelSearch, chosen: Explanation, examined: set[int]) -> Iterator[Explanation]:
    """Explanations in which one segment chooses differently and others adapt; adds its index to `examined`."""
    below, free = branches(search), search.without_points(search.bits[-1], MAX_BRANCH_EXCESS_COST)
    at = {node.table.index: (node, c) for node, c in chosen}
    limit = cost_of(search, chosen) + MAX_RIVAL_COST
    for node, c in chosen:
        if search.frame.is_exhausted:
            return
        table, branch = node.table, below[node.table.index]
        parent_choice = at.get(table.parent)
        kept = [pair for pair in chosen if pair[0].table.index not in branch]
        free.set_node_budget(NODES_PER_SEGMENT * len(branch))
        alternatives = free.node(table, *parent_choice) if parent_choice else node
        cost = free.branch_costs(alternatives, parent_choice)
        current_cost = cost_of(search, [pair for pair in chosen if pair[0].table.index in branch])
        if parent_choice is not None:
            current_cost += float(search.range_costs(*parent_choice, node)[c])
        fixed = {s for s in below if table.index in below[s]}
        order = np.argsort(cost)
        likely = cost[order] <= current_cost + MAX_RIVAL_COST
        differs = (alternatives.index[order] != node.index[c]).any(1)
        for k in order[likely & differs][:MAX_ALTERNATIVES]:
            trial = remove_conflicts(search, kept + free.follow(alternatives, int(k)), below, fixed, limit)
            if trial is not None:
                yield trial
        if not search.frame.is_exhausted:
            examined.add(table.index)


SEARCH_BUDGETS = ((0, 80, 40, 0.1), (3, 300, 100, 0.2), (2, 750, 250, 0.4))
"""Rounds of (number of starts, 0: all; nodes per search; nodes per choice of the root; share of the remaining work).
Every start gets a small budget and the best ones more: a good start needs few nodes, and only a search shows it."""

MAX_LEVEL_SEGMENTS = 6
"""Most segments from which the noise level is estimated."""

STARTS_PER_LEVEL = 5
"""Starting segments per noise level."""

FIRST_STARTS = 2
"""Starts at a noise level before the next level is examined."""

MIN_LEVEL_GAIN = 30.0
"""Decrease of the total cost of separately searched segments at which the next noise level is tried before the other
starts of this one. In 30 poses of the paper's body: -28 to 28 at 4 % distortion, 25 to 70 at 10 %."""

MAX_MARGIN = 15.0
"""Cost margins to the second choice above this count as equal."""

MAX_NOISE_RATIO = 1.25
"""The noise level of a search was too low if the residuals exceed it by this factor."""

MAX_DIFFERENT_SHARE = 0.05
"""Share of the labels in which two solutions may differ and still count as the same."""

MIN_AGREEING_STARTS = 3
"""Number of starts with the same solution that makes it certain even if all their searches were cut."""

MIN_REPEATED_SHARE = 0.93
"""Share of the points, or of the labels if fewer, that must be labelled in a solution that two starts found."""

MIN_COMPLETE_SHARE = 0.65
"""The same if its search was not cut, or more starts agree. Accidental matches reach up to half."""

MIN_CLEAR_MARGIN = 12.0
"""Cost margin of every choice at which rivals need no comparison."""

MAX_REFINEMENTS = 2
"""Times that noise and shares of missing points are estimated again."""

MIN_GOOD_SHARE = 0.7
"""Share of the points, and of the best solution's cost, below which a solution is not polished."""


@dataclass(frozen=True, eq=False)
class Solution:
    """The explanation found by one search.

    Parameters
    ----------
    chosen : nodes and choices, parents first, every point used once
    labels : (M,) int, point of each label, -1 for none
    cost : -log likelihood ratio to no point being a marker; comparable between noise levels
    noise : estimated from the residuals, as a factor on the model's deviations
    clear : whether no segment has another choice of similar cost
    settled : whether it is certainly not accidental
    others : solutions of searches from other segments
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
        """Number of labels with a point."""
        return int((self.labels >= 0).sum())

    def same(self, other: Solution) -> bool:
        """Whether another solution differs in at most MAX_DIFFERENT_SHARE of the labels."""
        return int((self.labels != other.labels).sum()) <= MAX_DIFFERENT_SHARE * len(self.labels)


def explain(model: MarkerModel, frame: UnlabelledFrame, finest: float, coarsest: float, searches: int = 60) -> Solution:
    """Find the most likely explanation of a frame.

    Parameters
    ----------
    finest, coarsest : noise levels between which to search, as factors on the model's deviations, without unit
    searches : most searches, each from one segment at one noise level
    """
    race = Race(model, frame)
    for many, budget, quota, share in SEARCH_BUDGETS:
        race.set_budget((budget, quota, share))
        ranked = sorted(race.solutions, key=lambda start: race.solutions[start].cost)[:many]
        for root, scale in ranked or _starts(model, frame, finest, coarsest):
            before: Solution | None = None
            while scale <= coarsest and (root, scale) not in race.done:
                before = race.run(root, scale, before)
                best = race.best()
                searches -= 1
                if best.settled or searches < 1 or frame.is_exhausted:
                    return best
                if before.noise < MAX_NOISE_RATIO * scale or before.matched < MIN_COMPLETE_SHARE * race.max_matches:
                    break
                scale = _next_level(scale)  # a good start with more noise than assumed
    return race.best()


class Race:
    """Searches of one frame from several segments, at several noise levels.

    Parameters
    ----------
    solutions : of each start (root segment, noise level)
    done : starts that need no more nodes in this round
    polished : solutions after polishing, by noise level and labels before it
    """

    def __init__(self, model: MarkerModel, frame: UnlabelledFrame):
        self.model, self.frame = model, frame
        self.max_matches = min(len(frame.points), len(model))
        self.solutions: dict[tuple[int, float], Solution] = {}
        self.done: set[tuple[int, float]] = set()
        self.polished: dict[tuple[float, bytes], Solution] = {}
        self.budget = (0, 0, 1.0)

    def set_budget(self, budget: tuple[int, int, float]) -> None:
        """Set nodes per search, nodes per choice of the root, and share (0 to 1) of the remaining work."""
        self.budget = budget
        self.done = {start for start, found in self.solutions.items() if not found.search.cut}

    def run(self, root: int, scale: float, before: Solution | None) -> Solution:
        """Search from segment `root` at noise level `scale` (without unit), starting also from solution `before`."""
        tables = segment_tables(self.model, root)
        search = LabelSearch(tables, self.frame, scale, *self.budget)
        chosen = search.decode(search.node(tables[0], None, -1))
        if search.cut or shared_points(search, chosen).any():
            found = self.polish_if_promising(solution(search, resolve_conflicts(search, chosen), len(self.model)))
        else:
            leads = (np.delete(node.best, c).min(initial=np.inf) - node.best[c] for node, c in chosen)
            found = replace(solution(search, chosen, len(self.model)), clear=min(leads) > MIN_CLEAR_MARGIN)
        if before is not None:
            found = min(found, at_level(before, self.frame, scale), key=_cost)
        self.done.add((root, scale))
        self.solutions[root, scale] = found
        return found

    def polish_if_promising(self, first: Solution) -> Solution:
        """Polish a solution if it is promising; otherwise return it as it is."""
        key = (first.search.scale, first.labels.tobytes())
        if key in self.polished:  # polished before
            return self.polished[key]
        best = min((found.cost for found in self.solutions.values()), default=0.0)
        is_good = first.matched >= MIN_GOOD_SHARE * self.max_matches and first.cost <= MIN_GOOD_SHARE * best
        if self.frame.is_exhausted or not is_good:
            return first
        first.search.set_work_share(self.budget[-1])
        chosen = polish(first.search, first.chosen)
        self.polished[key] = solution(first.search, chosen, len(self.model))
        return self.polished[key]

    def best(self) -> Solution:
        """The solution of least cost, with whether it is settled."""
        best = min(self.solutions.values(), key=_cost)
        root = best.search.tables[0].index
        others = tuple(s for (r, _), s in self.solutions.items() if r != root)
        roots = {r for (r, _), s in self.solutions.items() if s.same(best)}
        share = best.matched / self.max_matches
        complete = not best.search.cut or len(roots) >= MIN_AGREEING_STARTS
        is_certain = share > MIN_COMPLETE_SHARE and (complete or (len(roots) > 1 and share > MIN_REPEATED_SHARE))
        fits = any(s.noise < MAX_NOISE_RATIO * scale and s.same(best) for (_, scale), s in self.solutions.items())
        return replace(best, others=others, settled=is_certain and fits)


def solution(search: LabelSearch, chosen: Explanation, count: int) -> Solution:
    """Make a solution of an explanation: its cost, noise and labels."""
    squares, freedom = 0.0, 0
    for node, c in chosen:
        n = int((node.index[c] >= 0).sum())
        if n >= 2:
            squares += float(node.squares[c])
            freedom += 1 if n == 2 else 3 * n - 6
    noise = search.scale * float(np.sqrt(squares / max(freedom, 1)))
    return Solution(search, chosen, labels_of(chosen, count), cost_of(search, chosen), noise)


def at_level(found: Solution, frame: UnlabelledFrame, scale: float) -> Solution:
    """Transfer a solution to another noise level `scale` (without unit) or prior on missing points, and polish it."""
    search = LabelSearch(found.search.tables, frame, scale)
    search.cut = True  # only this explanation and its neighbours are examined
    chosen = polish(search, resolve_conflicts(search, transfer(search, found.chosen)))
    return solution(search, chosen, len(found.labels))


def refine(model: MarkerModel, found: Solution) -> Solution:
    """Repeat a solution with the noise and the shares of missing and unrelated points estimated from it."""
    for _ in range(MAX_REFINEMENTS):
        frame, scale = found.search.frame, found.search.scale
        gain = gain_of(found.matched, len(model), len(frame.points), frame.volume)
        noise = max(1.05 * found.noise, 1.0) if scale >= 1.0 else scale
        if found.clear or found.matched <= 3 or (abs(noise / scale - 1) < 0.1 and abs(gain - frame.gain) < 0.5):
            break
        refined = at_level(found, replace(frame, gain=gain), noise)
        found = replace(refined, settled=found.settled, others=found.others)
    return found


def gain_of(matched: float, labels: int, points: int, volume: float) -> float:
    """Gain of a match over a miss, log(1/m³), given the numbers of matches, labels and points; volume in [m³]."""
    miss = min(max(1 - matched / labels, 0.02), 0.5)
    return float(np.log((1 - miss) * volume / (miss * max(points - matched, 0.5))))


def _cost(found: Solution) -> float:
    return found.cost


def _starts(model: MarkerModel, frame: UnlabelledFrame, finest: float, coarsest: float) -> Iterator[tuple[int, float]]:
    """Pairs of starting segment and noise level, finest level first.

    The finest level is the first that explains almost all markers of the largest segments searched separately, or else
    the model's own. Segments with the largest margin between their choices come first. After FIRST_STARTS starts the
    rest of a level is postponed if the next one explains the segments much better.
    """
    sizes = sorted((len(m) for m in model.segments), reverse=True)
    least = max(3, sizes[min(2, len(sizes) - 1)])
    large = [s for s, m in enumerate(model.segments) if len(m) >= least][:MAX_LEVEL_SEGMENTS]
    large = large or [int(np.argmax([len(m) for m in model.segments]))]
    tables, scale, last, started = segment_tables(model, large[0]), finest, np.inf, False
    candidates = sorted({*large, *(s for s, m in enumerate(model.segments) if len(m) > 3)})
    waiting: list[tuple[int, float]] = []
    postponed: list[tuple[int, float]] = []
    while scale <= coarsest:
        search = LabelSearch(tables, frame, scale)
        if not started:  # one of these mostly suffices
            order, _, share = _rank_segments(search, large)
            started = scale >= 1.0 or share > MIN_REPEATED_SHARE or _next_level(scale) > coarsest
            yield from ((s, scale) for s in order[: FIRST_STARTS * started])
        if started:
            order, cost, _ = _rank_segments(search, candidates)
            if cost < last - MIN_LEVEL_GAIN:
                postponed += waiting
            else:
                yield from waiting
            yield from ((s, scale) for s in order[:FIRST_STARTS])
            waiting, last = [(s, scale) for s in order[FIRST_STARTS:STARTS_PER_LEVEL]], cost
        scale = _next_level(scale)
    yield from waiting
    yield from postponed


def _rank_segments(search: LabelSearch, segments: list[int]) -> tuple[list[int], float, float]:
    """Segments searched separately, the largest margin first; their total cost; the share of markers explained."""
    found = {s: search.search_alone(search.by_index[s]) for s in segments}
    order = sorted(segments, key=lambda s: (-min(found[s][2], MAX_MARGIN), found[s][0]))
    markers = sum(len(search.by_index[s].markers) for s in segments)
    return order, sum(f[0] for f in found.values()), sum(f[1] for f in found.values()) / markers


def _next_level(scale: float) -> float:
    """The next noise level; never between the finest and the model's own, as segments differ in rigidity."""
    return max(1.6 * scale, 1.0)
