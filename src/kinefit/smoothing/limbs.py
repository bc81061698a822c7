"""Groups of degrees of freedom: of one limb, and of left and right."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body


def limbs(body: Body) -> NDArray:
    """(n,) int: number of the limb of each degree of freedom: trunk, head, each arm, each leg (between two forks)."""
    tree = body.tree
    children = np.bincount(np.maximum(tree.parents, 0), minlength=len(tree.segments))
    children[0] -= 1  # the root is no child of its own
    out = np.zeros(len(tree.segments), int)
    for s in range(1, len(out)):
        parent = tree.parents[s]
        out[s] = out[parent] if children[parent] == 1 else s
    return np.concatenate([np.zeros(6, int), out[tree.owners]])


def noise_groups(body: Body) -> NDArray:
    """(n,) int: number of the group that shares a process noise: the root's shift, its turn, left and right joints."""
    groups: dict[str, int] = {}
    names = ["shift"] * 3 + ["turn"] * 3
    names += [c[:-2] if c.endswith(("_l", "_r")) else c for c in body.tree.coordinates]
    return np.array([groups.setdefault(name, len(groups)) for name in names])
