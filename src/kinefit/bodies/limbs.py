"""Limbs of a body: chains of segments from a branch of the tree to a leaf."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body, PointSet

_MAX_BRANCHES = 4  # of a trunk segment; one with more, none of which branches again, is a hand

FACE = {
    "jaw": ("jaw", "CC_Base_JawRoot", "temporomandibular"),
    "eye_l": ("leftEye", "eye.L", "CC_Base_L_Eye", "l_eyeball_joint"),
    "eye_r": ("rightEye", "eye.R", "CC_Base_R_Eye", "r_eyeball_joint"),
}
"""Segments of the face of `humanoid_face` -> names in VRM, Rigify, iClone, H-Anim; a character may have none."""


def limbs(body: Body) -> tuple[tuple[int, ...], ...]:
    """Segments of each limb, from a branch of the tree to a leaf; fingers belong to their arm."""
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
    """Names of all finger segments {hand: segments}, of hands with fingers."""
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
    """Number (S,) of children of each segment."""
    return np.bincount(parents[parents >= 0], minlength=len(parents))


def _is_hand(parents: NDArray) -> NDArray:
    """Whether each segment (S,) is a hand; bool."""
    children = _children(parents)
    forks = children > 1
    below = np.zeros(len(parents), bool)  # whether a descendant branches; parents come first
    for s in range(len(parents) - 1, 0, -1):
        if parents[s] >= 0:
            below[parents[s]] |= forks[s] | below[s]
    return (children > _MAX_BRANCHES) & (parents >= 0) & ~below


KNUCKLE = "metacarpal_phalanx_3"
"""End of the name of the landmark at the middle finger's knuckle."""


def knuckles(body: Body) -> dict[int, NDArray]:
    """Knuckle of the middle finger {segment: (3,) [m] in its frame}, of hands without finger segments."""
    leaf = ~np.isin(np.arange(len(body.tree.parents)), body.tree.parents)
    points = body.landmarks
    return {
        int(s): x for name, s, x in zip(points.names, points.segments, points.points)
        if name.endswith(KNUCKLE) and leaf[s]
    }  # fmt: skip


def of_fingers(body: Body, segment: NDArray, x_rest: NDArray) -> NDArray:
    """Whether points of segments (N,) lie beyond the knuckles: (N,) bool, from x_rest (N, 3) [m] in the root's frame.

    A fist leaves these points empty. A measurement there supports the hand, a missing one does not contradict it.
    """
    out = np.zeros(len(segment), bool)
    for s, knuckle in knuckles(body).items():
        own = segment == s
        out[own] = (x_rest[own] - body.tree.rest[s]) @ knuckle > knuckle @ knuckle
    return out


def rigid_pairs(body: Body, points: PointSet) -> list[tuple[int, int, int, float]]:
    """Pairs of points on one segment, whose distance is constant: (point, point, scale group, distance at rest [m]).

    A point at a joint's centre belongs to both segments there.
    """
    tree = body.tree
    hosts: list[dict[int, NDArray]] = []
    for s, x in zip(points.segments, points.points, strict=True):
        here = {int(s): x}
        if np.linalg.norm(x) < 1e-9 and tree.parents[s] >= 0:
            here[int(tree.parents[s])] = tree.offsets[s]
        hosts.append(here)
    out = []
    for i in range(len(hosts)):
        for j in range(i + 1, len(hosts)):
            for s in hosts[i].keys() & hosts[j].keys():
                length = float(np.linalg.norm(hosts[i][s] - hosts[j][s]))
                if length > 0.05:
                    out.append((i, j, int(body.segment_scale[s]), length))
    return out
