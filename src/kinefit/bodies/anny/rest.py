"""Rotations from Anny's own pose to the humanoid's rest pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body


def swapped(joints: NDArray, base: Body) -> NDArray:
    """Joints (S, 3) with right and left swapped."""
    tree = base.tree
    twin = lambda n: n[:-2] + {"_r": "_l", "_l": "_r"}[n[-2:]] if n[-2:] in ("_r", "_l") else n
    return joints[[tree.segment(twin(n)) for n in tree.segments]]


def frame(along: NDArray, hinge: NDArray) -> NDArray:
    """Rotation (3, 3) that points a limb's direction (3,) down and its hinge axis (3,) to the right (z)."""
    y = -along / np.linalg.norm(along)
    z = hinge - (hinge @ y) * y
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z])
