"""What all skeleton formats need: poses relative to the parent, Euler angles without jumps, names without blanks."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.geometry import se3
from kinefit.motion import Motion

_LOCKED = 1e-7  # cosine of the middle angle below which the outer two turn about one axis


def local_poses(motion: Motion) -> NDArray:
    """T_parent_segment (F, S, 4, 4) of every segment; of the root T_world_root."""
    Ts_world = motion.segment_poses()
    parents = motion.body.tree.parents
    out = se3.inverse(Ts_world[:, np.maximum(parents, 0)]) @ Ts_world
    out[:, parents < 0] = Ts_world[:, parents < 0]
    return out


def slides(body: Body) -> NDArray:
    """(S,) bool: segments whose joint can slide, so that their offset changes."""
    out = np.zeros(len(body.tree.segments), bool)
    out[body.tree.owners[body.tree.prismatic]] = True
    return out


def euler_zxy(rotations: NDArray) -> NDArray:
    """Angles (F, ..., 3) [rad] about body-fixed z, x, y of rotations (F, ..., 3, 3), R = Rz Rx Ry, continuous over F.

    Of the two triples that give the same rotation, and of all whole turns, the nearest to the frame before is taken.
    At gimbal lock the first angle stays as it was, so that the triple always gives the rotation.
    """
    R = np.asarray(rotations, float)
    out = np.empty((*R.shape[:-2], 3))
    before = np.zeros(R.shape[1:-2] + (3,))
    for frame in range(len(R)):
        out[frame] = before = _nearest_zxy(R[frame], before)
    return out


def _nearest_zxy(R: NDArray, before: NDArray) -> NDArray:
    locked = np.hypot(R[..., 0, 1], R[..., 1, 1]) < _LOCKED
    z = np.where(locked, before[..., 0], np.arctan2(-R[..., 0, 1], R[..., 1, 1]))
    one, other = _given_z(R, z, before), _given_z(R, z + np.pi, before)
    nearer = np.sum((one - before) ** 2, -1) <= np.sum((other - before) ** 2, -1)
    return np.where((nearer | locked)[..., None], one, other)


def _given_z(R: NDArray, z: NDArray, before: NDArray) -> NDArray:
    """The triple whose first angle is z, by whole turns nearest to the triple before."""
    c, s = np.cos(z), np.sin(z)
    x = np.arctan2(R[..., 2, 1], c * R[..., 1, 1] - s * R[..., 0, 1])
    y = np.arctan2(c * R[..., 0, 2] + s * R[..., 1, 2], c * R[..., 0, 0] + s * R[..., 1, 0])
    angles = np.stack([z, x, y], -1)
    return angles + 2.0 * np.pi * np.round((before - angles) / (2.0 * np.pi))


def continuous_quaternions(rotations: NDArray) -> NDArray:
    """Quaternions (F, 4) as (w, x, y, z) of rotations (F, 3, 3); of the two signs the nearer to the frame before."""
    q = se3.quaternion(rotations)
    flips = np.sum(q[1:] * q[:-1], axis=-1) < 0
    q[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return q


def plain_names(names: Iterable[str]) -> list[str]:
    """Names without blanks and slashes, each once: a repeated one gets a number."""
    out: list[str] = []
    for name in names:
        base = plain = re.sub(r"[\s/\\]+", "_", name) or "_"
        count = 1
        while plain in out:
            count += 1
            plain = f"{base}_{count}"
        out.append(plain)
    return out
