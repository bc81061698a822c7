"""Improve an explanation of a frame branch by branch, and list the rivals whose cost is close to it.

The search over the tree lets limbs in different branches use the same point. Here every explanation uses each point
once.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from kinefit.markers.frame.search import MAX_BRANCH_EXCESS_COST, LabelSearch, Node

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
