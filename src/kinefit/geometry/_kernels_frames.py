"""Points and directions at rest, moved by a frame (12,): its rotation row by row, then its translation [m]."""

from __future__ import annotations

from kinefit._jit import jit


@jit
def turned(f, x, y, z):
    """The direction (x, y, z) at rest, rotated."""
    return f[0] * x + f[1] * y + f[2] * z, f[3] * x + f[4] * y + f[5] * z, f[6] * x + f[7] * y + f[8] * z


@jit
def moved(f, x, y, z):
    """The point (x, y, z) [m] at rest, moved."""
    u, v, w = turned(f, x, y, z)
    return u + f[9], v + f[10], w + f[11]
