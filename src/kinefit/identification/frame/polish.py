"""An explanation of a frame made better piece by piece, and what comes near it: branches of the tree searched anew.

The search over the tree lets two limbs take the same point, as long as neither hangs on the other. Here every
explanation that counts is one in which each point is taken once.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.frame.search import WIDE, LabelSearch, Node

Explanation = list[tuple[Node, int]]
"""Nodes and what is chosen in each, parents first."""

NODES = 20
"""For each segment of a branch that is searched anew; what is chosen elsewhere leaves it few points."""

SWEEPS = 3
"""Over all branches, or fewer if one changes nothing."""

GIVE_WAY = 3
"""Segments of which one gives way, where several want a point."""

MOST = 6
"""Other choices of one segment that are looked at."""

NEAR = 6.0
"""Rivals dearer by more than this are 0.25 % as likely, and not looked at."""

RESTARTS = 4
"""A rival that is cheaper becomes the explanation, so many times at most."""


def cost_of(search: LabelSearch, chosen: Explanation) -> float:
    """-log likelihood of an explanation; a point that two segments take counts for both."""
    at = {node.table.index: (node, c) for node, c in chosen}
    total = 0.0
    for node, c in chosen:
        total += float(node.cost[c])
        if node.table.parent in at:
            total += float(search.between(*at[node.table.parent], node)[c])
    return total


def labels_of(chosen: Explanation, count: int) -> NDArray:
    """(M,) int, point of each label, -1 for none."""
    labels = np.full(count, -1)
    for node, c in chosen:
        fresh = node.table.shared < 0
        labels[node.table.markers[fresh]] = node.index[c, fresh]
    return labels


def shared(search: LabelSearch, chosen: Explanation) -> NDArray:
    """(W,) bits of points that two segments take."""
    twice, once = search.bits[-1].copy(), search.bits[-1].copy()
    for node, c in chosen:
        twice |= once & node.new[c]
        once |= node.new[c]
    return twice


def apart(search: LabelSearch, chosen: Explanation) -> Explanation:
    """The explanation with every point taken once."""
    found = disentangle(search, chosen, branches(search), {chosen[0][0].table.index})
    assert found is not None  # segments below the root can always choose none
    return found


def polish(search: LabelSearch, found: Explanation) -> Explanation:
    """The explanation, no dearer by the change of any one branch."""
    below = branches(search)
    cost = cost_of(search, found)
    largest = 0.6 * len(found)  # nearly all of a body, searched anew, is the search that it came from
    small = [node.table.index for node, _ in found[1:] if len(below[node.table.index]) < largest][::-1]
    for _ in range(SWEEPS):
        before = cost
        for s in () if search.idle else small:
            trial = anew(search, found, below[s])
            now = cost_of(search, trial)
            if now < cost - 1e-6 and not shared(search, trial).any():
                found, cost = trial, now
        if cost == before:
            break
    return found


def carried(search: LabelSearch, chosen: Explanation) -> Explanation:
    """An explanation as another search has it, at another noise level; points that it thinks too far off are left."""
    every = np.bitwise_or.reduce(search.bits, 0)
    at: dict[int, tuple[Node, int]] = {}
    for node, c in chosen:
        own = search.beside(every & ~node.all[c], WIDE)
        here = own.seat(node.table, *at.get(node.table.parent, (None, -1)))
        same = np.flatnonzero((here.index == node.index[c]).all(1))
        at[node.table.index] = (here, int(same[0]) if len(same) else int(np.argmin(here.cost)))
    return list(at.values())


def disentangle(
    search: LabelSearch, chosen: Explanation, below: dict[int, list[int]], fixed: set[int], limit: float = np.inf
) -> Explanation | None:
    """The explanation with every point taken once; of two segments that want one the cheaper gives way.

    None where both are `fixed`, or where that would cost more than `limit`.
    """
    tries = 0
    while (twice := shared(search, chosen)).any():
        tries += 1
        users = {node.table.index for node, c in chosen if (node.new[c] & twice).any()} - fixed
        if not users or cost_of(search, chosen) > limit:  # room for others only costs
            return None
        least = sorted(users, key=lambda s: (len(below[s]), s))
        # branches that take points twice themselves: from the last segments on, it ends
        trials = [anew(search, chosen, below[s]) for s in least[: 1 if tries > len(chosen) else GIVE_WAY]]
        left = [int(np.unpackbits(shared(search, trial).view(np.uint8)).sum()) for trial in trials]
        chosen = trials[min(range(len(trials)), key=lambda k: (left[k], cost_of(search, trials[k])))]
    return chosen


def branches(search: LabelSearch) -> dict[int, list[int]]:
    """For each segment itself and all below it."""
    found: dict[int, list[int]] = {}
    for t in reversed(search.tables):
        found[t.index] = [t.index] + [s for child in t.children for s in found[child]]
    return found


def anew(search: LabelSearch, chosen: Explanation, branch: list[int]) -> Explanation:
    """The explanation with a branch (a segment and all below it) searched again, without others' points."""
    kept = [(node, c) for node, c in chosen if node.table.index not in branch]
    table = search.by_index[branch[0]]
    above = next((node, c) for node, c in kept if node.table.index == table.parent)
    outside = search.bits[-1].copy()
    for node, c in kept:
        outside |= node.new[c]
    local = search.beside(outside)
    local.grant(NODES * len(branch))
    return kept + local.decode(local.node(table, *above), above)


def rivals(search: LabelSearch, chosen: Explanation) -> tuple[Explanation, list[tuple[float, Explanation]], set[int]]:
    """The cheapest explanation near one, by how much others are dearer, up to NEAR, and segments that were looked at.

    These are all, unless the frame's work was used up before.
    """
    search.allow(1.0)
    for _ in range(RESTARTS):
        cost, found = cost_of(search, chosen), []
        seen: set[int] = set()
        for trial in _others(search, chosen, seen):
            found.append((cost_of(search, trial), trial))
            if found[-1][0] < cost - 1e-6:
                break
        else:
            break
        found[-1] = (cost, chosen)
        cost, chosen = cost_of(search, trial), trial
    return chosen, [(now - cost, rival) for now, rival in found if now < cost + NEAR], seen


def _others(search: LabelSearch, chosen: Explanation, seen: set[int]) -> Iterator[Explanation]:
    """Explanations in which one segment chooses otherwise, and others make room for that; adds to `seen`."""
    below, free = branches(search), search.beside(search.bits[-1], WIDE)
    at = {node.table.index: (node, c) for node, c in chosen}
    limit = cost_of(search, chosen) + NEAR
    for node, c in chosen:
        if search.frame.idle:
            return
        table, branch = node.table, below[node.table.index]
        above = at.get(table.parent)
        kept = [pair for pair in chosen if pair[0].table.index not in branch]
        free.grant(NODES * len(branch))
        here = free.node(table, *above) if above else node
        cost = free.beneath(here, above)
        now = cost_of(search, [pair for pair in chosen if pair[0].table.index in branch])
        if above is not None:
            now += float(search.between(*above, node)[c])
        fixed = {s for s in below if table.index in below[s]}
        order = np.argsort(cost)
        likely = cost[order] <= now + NEAR
        differs = (here.index[order] != node.index[c]).any(1)
        for k in order[likely & differs][:MOST]:
            trial = disentangle(search, kept + free.follow(here, int(k)), below, fixed, limit)
            if trial is not None:
                yield trial
        if not search.frame.idle:
            seen.add(table.index)
