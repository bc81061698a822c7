"""Pairs of a body's points with a constant distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body, PointSet


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
