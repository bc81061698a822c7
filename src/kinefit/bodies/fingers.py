"""Fingers of bodies without finger joints: parts of a hand's surface that a person may fold away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body

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
