"""Observability of joints: how far an observed point moves when a joint turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.sensors import _kernels_observability

# A detector's point is about a centimetre off the body's, the same way in every frame: a joint that moves no point by
# more than twice that for a radian only follows this error.
MIN_LEVER = 0.02  # [m/rad]


def levers(body: Body, points: PointSet, seen: NDArray, Ts_world_root: NDArray, angles: NDArray) -> NDArray:
    """(F, D) [m/rad] longest lever of each coordinate on the points seen in a frame; inf for prismatic joints.

    Parameters
    ----------
    points : PointSet of K points; seen : (F, K) bool.
    Ts_world_root, angles : (F, 4, 4), (F, D)
    """
    tree, rest, out = body.tree, body.points_rest(points), np.empty(angles.shape)
    for f in range(len(angles)):
        frames, screws = tree.forward(Ts_world_root[f], angles[f])
        _kernels_observability.longest_levers(
            frames, screws, points.segments, rest, seen[f], Ts_world_root[f], tree.last_dof, tree.dof_parent, out[f]
        )
    return np.where(tree.prismatic, np.inf, out)


def moves_points(body: Body, points: PointSet, seen: NDArray, Ts_world_root: NDArray, angles: NDArray) -> NDArray:
    """(F, D) bool: coordinates that move a visible point by more than detectors err; arguments as of `levers`."""
    shortest = MIN_LEVER * body.offset_shares[body.tree.owners]
    return np.asarray(levers(body, points, seen, Ts_world_root, angles) > shortest)


def near(observed: NDArray, frames: int) -> NDArray:
    """(F, D) bool: coordinates observed in this frame or within a number of frames; observed (F, D) bool."""
    count = np.cumsum(np.concatenate([np.zeros((1, observed.shape[1]), int), observed]), axis=0)
    f = np.arange(len(observed))
    return np.asarray(count[np.minimum(f + frames + 1, len(observed))] > count[np.maximum(f - frames, 0)])
