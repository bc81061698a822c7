"""Surfaces of a body packed by kind, as kernels take them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.bodies.surfaces.mesh import GridTable, MeshSurface, pack_grids
from kinefit.bodies.surfaces.metaballs import BallTable, Metaballs, pack_balls


class SurfaceTables(NamedTuple):
    """Surfaces of a body by kind.

    Parameters
    ----------
    cylinders : (C, 18)
        segment, start (3) [m] in the root frame at rest, directions of a, b and the axis (9), length [m],
        a0, b0 and their growth along the axis (4).
    grids : GridTable of its meshes, None without meshes.
    balls : BallTable of its metaballs, None without metaballs.
    """

    cylinders: NDArray
    grids: GridTable | None
    balls: BallTable | None = None


def tables(surfaces: Sequence[TaperedCylinder | MeshSurface], rest: NDArray) -> SurfaceTables:
    """Pack surfaces into tables; rest (S, 3) [m]: joint centres in the root frame at rest."""
    cylinders = [s for s in surfaces if isinstance(s, TaperedCylinder)]
    melted = [s for s in surfaces if isinstance(s, Metaballs)]
    meshes = [s for s in surfaces if isinstance(s, MeshSurface) and not isinstance(s, Metaballs)]
    out = np.empty((len(cylinders), 18))
    for line, c in zip(out, cylinders):
        (a0, b0), (a1, b1) = c.radii
        growth = [a0, b0, (a1 - a0) / c.length, (b1 - b0) / c.length]
        line[:] = [c.segment, *np.add(c.start, rest[c.segment]), *c.axes.ravel(), c.length, *growth]
    out.flags.writeable = False
    grids, balls = pack_grids(meshes, rest) if meshes else None, pack_balls(melted, rest) if melted else None
    return SurfaceTables(out, grids, balls)
