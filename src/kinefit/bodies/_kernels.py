"""Forward kinematics of a tree by screws in the rest pose."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_frames import moved, turned


@jit
def forward(parents, dof_start, prismatic, axes, rest, root, angles, frames, screws):
    """Segment frames and joint screws of one pose (product of exponentials; P1 3.1, P3 eq. 6).

    Parameters: parents (S,), dof_start (S+1,), prismatic (D,) bool, axes (D, 3), rest (S, 3): joint centres in the root
    frame at rest; root (4, 4), angles (D,). Out: frames (S, 12) = rotation row-major and t, so that a point given in
    the root frame at rest moves to R x + t; screws (D, 6) = (v, ω) in the world about the root's origin.
    """
    cx, cy, cz = root[0, 3], root[1, 3], root[2, 3]
    for s in range(parents.size):
        p = parents[s]
        if p < 0:
            for i in range(3):
                for j in range(3):
                    frames[s, 3 * i + j] = root[i, j]
                frames[s, 9 + i] = root[i, 3]
        else:
            for i in range(12):
                frames[s, i] = frames[p, i]
        f = frames[s]
        for d in range(dof_start[s], dof_start[s + 1]):
            ax, ay, az = axes[d, 0], axes[d, 1], axes[d, 2]
            wx, wy, wz = turned(f, ax, ay, az)
            q = angles[d]
            if prismatic[d]:
                screws[d, 0], screws[d, 1], screws[d, 2] = wx, wy, wz
                screws[d, 3], screws[d, 4], screws[d, 5] = 0.0, 0.0, 0.0
                f[9] += q * wx
                f[10] += q * wy
                f[11] += q * wz
                continue
            px, py, pz = rest[s, 0], rest[s, 1], rest[s, 2]
            ox, oy, oz = moved(f, px, py, pz)
            dx, dy, dz = ox - cx, oy - cy, oz - cz
            screws[d, 0] = dy * wz - dz * wy
            screws[d, 1] = dz * wx - dx * wz
            screws[d, 2] = dx * wy - dy * wx
            screws[d, 3], screws[d, 4], screws[d, 5] = wx, wy, wz
            sine = np.sin(q)
            half = np.sin(0.5 * q)
            versine = 2.0 * half * half
            for i in range(0, 9, 3):  # rows of R exp(q â), a at rest: rounding errors of w would grow along a chain
                r0, r1, r2 = f[i], f[i + 1], f[i + 2]
                dot = r0 * ax + r1 * ay + r2 * az
                f[i] = r0 + sine * (r1 * az - r2 * ay) + versine * (ax * dot - r0)
                f[i + 1] = r1 + sine * (r2 * ax - r0 * az) + versine * (ay * dot - r1)
                f[i + 2] = r2 + sine * (r0 * ay - r1 * ax) + versine * (az * dot - r2)
            px, py, pz = turned(f, px, py, pz)
            f[9], f[10], f[11] = ox - px, oy - py, oz - pz


@jit
def forward_many(parents, dof_start, prismatic, axes, rest, roots, angles, frames):
    """Segment frames of many poses: roots (F, 4, 4), angles (F, D) -> frames (F, S, 12)."""
    screws = np.empty((axes.shape[0], 6))
    for i in range(roots.shape[0]):
        forward(parents, dof_start, prismatic, axes, rest, roots[i], angles[i], frames[i], screws)


@jit
def difference(root, other, angles, other_angles, out):
    """Write δ (6 + D,) from one state to another to `out`: the root's shift, its rotation vector, then the angles."""
    for i in range(3):
        out[i] = other[i, 3] - root[i, 3]
    m = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            m[i, j] = other[i, 0] * root[j, 0] + other[i, 1] * root[j, 1] + other[i, 2] * root[j, 2]
    # the largest component of the quaternion first (Shepperd): exact for every angle up to π
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    q = np.empty(4)
    best, value = 0, trace
    for i in range(3):
        if m[i, i] > value:
            best, value = i + 1, m[i, i]
    if best == 0:
        q[0] = 1.0 + trace
        q[1], q[2], q[3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        i = best - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = m[k, j] - m[j, k]
        q[1 + i] = 1.0 + m[i, i] - m[j, j] - m[k, k]
        q[1 + j], q[1 + k] = m[i, j] + m[j, i], m[i, k] + m[k, i]
    sine = np.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    norm = np.sqrt(q[0] * q[0] + sine * sine)
    sign = -1.0 if q[0] < 0.0 else 1.0
    factor = 2.0 / norm if sine < 1e-9 * norm else 2.0 * np.arctan2(sine, sign * q[0]) / sine
    for i in range(3):
        out[3 + i] = sign * factor * q[1 + i]
    for d in range(angles.size):
        out[6 + d] = other_angles[d] - angles[d]


@jit
def retract(root, angles, delta, lower, upper, new_root, new_angles):
    """Move a state by δ (6 + D,): the root's twist in the world about its origin; angles are clipped to the limits."""
    wx, wy, wz = delta[3], delta[4], delta[5]
    t2 = wx * wx + wy * wy + wz * wz
    if t2 < 1e-8:
        a, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        t = math.sqrt(t2)
        half = math.sin(0.5 * t)
        a, b = math.sin(t) / t, 2.0 * half * half / t2
    for j in range(3):
        x, y, z = root[0, j], root[1, j], root[2, j]
        cx, cy, cz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        new_root[0, j] = x + a * cx + b * (wy * cz - wz * cy)
        new_root[1, j] = y + a * cy + b * (wz * cx - wx * cz)
        new_root[2, j] = z + a * cz + b * (wx * cy - wy * cx)
    for i in range(3):
        new_root[i, 3] = root[i, 3] + delta[i]
        new_root[3, i] = 0.0
    new_root[3, 3] = 1.0
    for d in range(angles.size):
        q = angles[d] + delta[6 + d]
        q = lower[d] if q < lower[d] else q
        new_angles[d] = upper[d] if q > upper[d] else q


@jit
def place(frames, segments, rest, out):
    """Write points (K, 3) in the world to `out`: those given in the root frame at rest, moved with their segments."""
    for k in range(segments.size):
        f, p = frames[segments[k]], rest[k]
        for r in range(3):
            out[k, r] = f[3 * r] * p[0] + f[3 * r + 1] * p[1] + f[3 * r + 2] * p[2] + f[9 + r]
