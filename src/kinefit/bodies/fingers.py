"""Fingers: what of a hand may be folded away, though bodies without finger joints are always drawn with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body

KNUCKLE = "metacarpal_phalanx_3"
"""How the name of the landmark ends at which the middle finger begins."""


def knuckles(body: Body) -> dict[int, NDArray]:
    """Segment -> (3,) [m] its middle finger's knuckle in its frame, of hands that no segment goes on from."""
    leaf = ~np.isin(np.arange(len(body.tree.parents)), body.tree.parents)
    points = body.landmarks
    return {
        int(s): x for name, s, x in zip(points.names, points.segments, points.points)
        if name.endswith(KNUCKLE) and leaf[s]
    }  # fmt: skip


def of_fingers(body: Body, segment: NDArray, x_rest: NDArray) -> NDArray:
    """(N,) bool: points (N, 3) [m] at rest, in the root's frame, of segments (N,) that lie beyond the knuckles.

    Where a fist is made there is nothing. What is measured there is the hand's; that nothing is speaks against nobody.
    """
    out = np.zeros(len(segment), bool)
    for s, knuckle in knuckles(body).items():
        own = segment == s
        out[own] = (x_rest[own] - body.tree.rest[s]) @ knuckle > knuckle @ knuckle
    return out
