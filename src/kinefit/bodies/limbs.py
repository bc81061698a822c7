"""Limbs of a body: chains of segments from where the tree branches to its leaves."""

from __future__ import annotations

import numpy as np

from kinefit.bodies.body import Body

_MAX_BRANCHES = 4  # of a trunk; what forks into more is a hand


def limbs(body: Body) -> tuple[tuple[int, ...], ...]:
    """Segments from each leaf up to where the tree branches, the nearest to the trunk first; fingers with their arm."""
    parents = body.tree.parents
    children = np.bincount(parents[parents >= 0], minlength=len(parents))
    hand = (children > _MAX_BRANCHES) & (parents >= 0)
    out: dict[int, list[int]] = {}
    for end in np.flatnonzero((children == 0) | hand):
        limb = [int(end)]
        while parents[limb[-1]] > 0 and children[parents[limb[-1]]] == 1:
            limb.append(int(parents[limb[-1]]))
        if end > 0:
            above = int(parents[limb[-1]])
            out[above if hand[above] else int(end)] = [*(out[above] if hand[above] else []), *limb[::-1]]
    return tuple(tuple(limb) for limb in out.values())


def finger_groups(body: Body) -> dict[str, tuple[str, ...]]:
    """Name of a hand -> names of all segments below it, of hands that fork into fingers."""
    tree = body.tree
    children = np.bincount(tree.parents[tree.parents >= 0], minlength=len(tree.parents))
    of = np.where((children > _MAX_BRANCHES) & (tree.parents >= 0), np.arange(len(children)), -1)
    for s, parent in enumerate(tree.parents):  # parents come first
        if parent >= 0 and of[parent] >= 0:
            of[s] = of[parent]
    return {
        tree.segments[hand]: tuple(tree.segments[s] for s in np.flatnonzero(of == hand) if s != hand)
        for hand in np.unique(of[of >= 0])
    }
