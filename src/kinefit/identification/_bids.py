"""What segments tell each other of points that several of them want, and how probable each label then is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from kinefit.identification._search import Node, Search

DEAREST = 8.0
"""Most that one segment's wish for a point costs another."""


def bid(search: Search, root: Node, labels: int, rounds: int, until: Callable[[], bool]) -> None:
    """Weigh all nodes by what each point costs a segment as others want it: loopy belief propagation.

    A parent and its children never share a point; of all other segments one at most may have it. They tell each
    other `rounds` times, or `until` it is enough.
    """
    owner = np.full(labels, -1)
    for t in search.tables:
        owner[t.markers[t.shared < 0]] = t.index
    segments = sorted(search.by_index)
    apart = np.ones((len(segments), len(segments)), bool)
    for t in search.tables:
        apart[t.index, [t.index, *t.children]] = False
        apart[[*t.children], t.index] = False
    price = np.array([search.bids[s] for s in segments])
    for _ in range(rounds):
        use = np.zeros(price.shape)
        np.add.at(use, owner, marginals(search, root, labels)[:, :-1])
        use = np.clip(use, 0.0, 1 - np.exp(-DEAREST))
        wish = np.exp(np.minimum(np.log(np.maximum(use, 1e-9)) - np.log1p(-use) + price, DEAREST))
        fresh = np.log1p(apart @ wish)
        price = 0.5 * (price + fresh) if price.any() else fresh
        search.bids = dict(zip(segments, price))
        search.reweigh()
        if until():
            break


def marginals(search: Search, root: Node, labels: int) -> NDArray:
    """(M, N + 1) probability of each point to be each label, the last for none."""
    share: dict[int, NDArray] = {id(n): np.zeros(len(n.cost)) for n in search.nodes}
    weight = np.exp(root.total.min() - root.total)
    share[id(root)] += weight / weight.sum()
    table = np.zeros((labels, len(search.points) + 1))
    for node in reversed(search.nodes):  # parents before children
        p = share[id(node)]
        if not p.any():
            continue
        fresh = node.table.shared < 0
        for c in np.flatnonzero(p > 1e-6).tolist():
            table[node.table.markers[fresh], node.index[c, fresh]] += p[c]
            for child in node.below[c] or ():
                fits = ~(child.new & node.all[c]).any(1)
                cost = np.where(fits, child.total + search.between(node, c, child), np.inf)
                weight = np.exp(cost.min() - cost)
                share[id(child)] += p[c] * weight / weight.sum()
    return table
