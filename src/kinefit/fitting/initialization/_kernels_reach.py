"""Inverse kinematics of one limb, from many starts: numba."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.bodies._kernels import forward

_MAX_STEP_RAD = 0.6  # per iteration: linear steps of a bent limb overshoot


@jit
def reach_for(parents, dof_start, prismatic, axes, rest, root, angles, dofs, segment, tips, targets, mean, std, lower,
          upper, sigma, iterations):  # fmt: skip
    """Move points of a segment to targets by some coordinates with a Gaussian prior (iterated Kalman update).

    angles (B, D) [rad or m] are changed in place; dofs (d,) int: coordinates that move; tips (B, 3) [m] in the rest
    pose, root frame; targets (B, 3) [m] in the world, with sigma `sigma` [m]; mean, std, lower, upper (D,).
    """
    frames, screws = np.empty((parents.size, 12)), np.empty((axes.shape[0], 6))
    J, S, y = np.empty((3, dofs.size)), np.empty((3, 3)), np.empty(3)
    for b in range(len(angles)):
        q = angles[b]
        for _ in range(iterations):
            forward(parents, dof_start, prismatic, axes, rest, root, q, frames, screws)
            f = frames[segment]
            for i in range(3):
                x = f[3 * i] * tips[b, 0] + f[3 * i + 1] * tips[b, 1] + f[3 * i + 2] * tips[b, 2] + f[9 + i]
                S[i, 0] = x - root[i, 3]  # from the origin of the screws
                y[i] = targets[b, i] - x
            px, py, pz = S[0, 0], S[1, 0], S[2, 0]
            S[:] = 0.0
            for k in range(dofs.size):
                d = dofs[k]
                wx, wy, wz = screws[d, 3], screws[d, 4], screws[d, 5]
                J[0, k] = screws[d, 0] + wy * pz - wz * py
                J[1, k] = screws[d, 1] + wz * px - wx * pz
                J[2, k] = screws[d, 2] + wx * py - wy * px
                for i in range(3):
                    y[i] += J[i, k] * (q[d] - mean[d])
                    for j in range(3):
                        S[i, j] += J[i, k] * J[j, k] * std[d] * std[d]
            for i in range(3):
                S[i, i] += sigma * sigma
            c00, c01, c02 = (
                S[1, 1] * S[2, 2] - S[1, 2] * S[2, 1],
                S[0, 2] * S[2, 1] - S[0, 1] * S[2, 2],
                S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1],
            )
            c11, c12, c22 = (
                S[0, 0] * S[2, 2] - S[0, 2] * S[2, 0],
                S[0, 2] * S[1, 0] - S[0, 0] * S[1, 2],
                S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0],
            )
            det = S[0, 0] * c00 + S[0, 1] * c01 + S[0, 2] * c02
            u = (c00 * y[0] + c01 * y[1] + c02 * y[2]) / det
            v = (c01 * y[0] + c11 * y[1] + c12 * y[2]) / det
            w = (c02 * y[0] + c12 * y[1] + c22 * y[2]) / det
            largest = 0.0
            for k in range(dofs.size):
                d = dofs[k]
                new = mean[d] + std[d] * std[d] * (J[0, k] * u + J[1, k] * v + J[2, k] * w)
                step = min(max(new - q[d], -_MAX_STEP_RAD), _MAX_STEP_RAD)
                new = min(max(q[d] + step, lower[d]), upper[d])
                largest = max(largest, abs(new - q[d]))
                q[d] = new
            if largest < 0.01 or not largest < math.inf:
                break
