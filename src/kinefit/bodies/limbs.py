"""Limbs of a body: chains of segments from where the tree branches to its leaves."""

from __future__ import annotations

import numpy as np

from kinefit.bodies.body import Body


def limbs(body: Body) -> tuple[tuple[int, ...], ...]:
    """Segments from each leaf up to where the tree branches, the nearest to the trunk first."""
    parents = body.tree.parents
    children = np.bincount(parents[parents >= 0], minlength=len(parents))
    out = []
    for leaf in np.flatnonzero(children == 0):
        limb = [int(leaf)]
        while parents[limb[-1]] > 0 and children[parents[limb[-1]]] == 1:
            limb.append(int(parents[limb[-1]]))
        if leaf > 0:
            out.append(tuple(limb[::-1]))
    return tuple(out)
