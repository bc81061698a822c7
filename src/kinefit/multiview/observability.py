"""What measurements can observe of a joint at all: how far a seen point moves when the joint turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet

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
    tree = body.tree
    x = body.trajectories(Ts_world_root, angles, points) - Ts_world_root[:, None, :3, 3]
    moved = np.zeros((len(points), len(tree.coordinates)), bool)
    for k, s in enumerate(points.segments):
        d = tree.last_dof[s]
        while d >= 6:
            moved[k, d - 6] = True
            d = tree.dof_parent[d]
    out = np.zeros(angles.shape)
    for f in range(len(angles)):
        _, screws = tree.forward(Ts_world_root[f], angles[f])
        arm = np.linalg.norm(screws[:, :3] + np.cross(screws[:, 3:], x[f][:, None]), axis=2)
        out[f] = np.max(arm * (moved & seen[f][:, None]), axis=0, initial=0.0)
    return np.where(tree.prismatic, np.inf, out)


def near(told: NDArray, frames: int) -> NDArray:
    """(F, D) bool: coordinates that are observed, (F, D) bool, in this frame or at most so many frames away."""
    count = np.cumsum(np.concatenate([np.zeros((1, told.shape[1]), int), told]), axis=0)
    f = np.arange(len(told))
    return np.asarray(count[np.minimum(f + frames + 1, len(told))] > count[np.maximum(f - frames, 0)])
