"""What measurements can observe of a joint at all: how far a seen point moves when the joint turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.sensors import _kernels_observability

# A detector's point stands about a centimetre away from where the body has it, the same way in every frame: a joint
# that moves no point by more than twice that for a radian only follows this error.
SHORTEST = 0.02  # [m/rad]


def levers(body: Body, points: PointSet, seen: NDArray, Ts_world_root: NDArray, angles: NDArray) -> NDArray:
    """(F, D) [m/rad] how far each coordinate moves the point that it moves furthest, of those seen; inf if it slides.

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
    """(F, D) bool: coordinates that move some point seen by more than detectors err; arguments as of `levers`."""
    shortest = SHORTEST * body.offset_shares[body.tree.owners]
    return np.asarray(levers(body, points, seen, Ts_world_root, angles) > shortest)


def near(told: NDArray, frames: int) -> NDArray:
    """(F, D) bool: coordinates that are observed, (F, D) bool, in this frame or at most so many frames away."""
    count = np.cumsum(np.concatenate([np.zeros((1, told.shape[1]), int), told]), axis=0)
    f = np.arange(len(told))
    return np.asarray(count[np.minimum(f + frames + 1, len(told))] > count[np.maximum(f - frames, 0)])
