"""Limbs of a body: chains of segments from where the tree branches to its leaves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body

_MAX_BRANCHES = 4  # of a trunk; what forks into more, none of which forks again, is a hand

FACE = {
    "jaw": ("jaw", "CC_Base_JawRoot", "temporomandibular"),
    "eye_l": ("leftEye", "eye.L", "CC_Base_L_Eye", "l_eyeball_joint"),
    "eye_r": ("rightEye", "eye.R", "CC_Base_R_Eye", "r_eyeball_joint"),
}
"""Segments of the face of `humanoid_face` -> names in VRM, Rigify, iClone, H-Anim; a character may lack any."""


def limbs(body: Body) -> tuple[tuple[int, ...], ...]:
    """Segments from each leaf up to where the tree branches, the nearest to the trunk first; fingers with their arm."""
    parents = body.tree.parents
    children, hand = _children(parents), _is_hand(parents)
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
    of = np.where(_is_hand(tree.parents), np.arange(len(tree.parents)), -1)
    for s, parent in enumerate(tree.parents):  # parents come first
        if parent >= 0 and of[parent] >= 0:
            of[s] = of[parent]
    return {
        tree.segments[hand]: tuple(tree.segments[s] for s in np.flatnonzero(of == hand) if s != hand)
        for hand in np.unique(of[of >= 0])
    }


def _children(parents: NDArray) -> NDArray:
    """(S,) how many segments hang on each."""
    return np.bincount(parents[parents >= 0], minlength=len(parents))


def _is_hand(parents: NDArray) -> NDArray:
    """(S,) bool."""
    children = _children(parents)
    forks = children > 1
    below = np.zeros(len(parents), bool)  # whether anything below forks; parents come first
    for s in range(len(parents) - 1, 0, -1):
        if parents[s] >= 0:
            below[parents[s]] |= forks[s] | below[s]
    return (children > _MAX_BRANCHES) & (parents >= 0) & ~below
