"""A free-form surface of a body file: points on a grid, as a Fourier series (P1 2.3)."""

from __future__ import annotations

from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces.fourier import FourierSurface
from kinefit.bodies.surfaces.mesh import MeshSurface
from kinefit.bodies.surfaces.obj import surface_of_file
from kinefit.errors import BodyError


def fourier_surface(
    path: str | PathLike[str],
    segment: int,
    *,
    grid: tuple[int, int],
    closed: tuple[bool, bool] = (True, True),
    orders: tuple[int, int] | None = None,
    nodes: tuple[int, int] | None = None,
    unit: str = "m",
    mirror: bool = False,
    place: str | None = None,
) -> MeshSurface:
    """Surface of a segment from a file of points x,y,z in the segment's frame, a row of the grid after the other.

    Parameters
    ----------
    grid : (M1, M2) points along the first and the second parameter; the second runs fastest.
    closed : whether each parameter runs around, or from end to end; see `FourierSurface`.
    orders : highest frequencies that are kept; default: all.
    nodes : (N1, N2) of the mesh that is made of the series; default: as many as there are points.
    unit : "m", "cm" or "mm", of the file.
    mirror : bool, its image on the other side of z = 0.
    place : str, named in messages.

    Raises
    ------
    BodyError
        A file that cannot be read or has another number of points; an unknown unit; a series or a mesh that cannot be.
    """

    def read() -> tuple[NDArray, NDArray]:
        try:
            points = np.loadtxt(path, delimiter=",", ndmin=2)
        except (OSError, ValueError) as error:
            raise BodyError(f"points that cannot be read: {error}", remedy="Write lines of x,y,z.") from error
        if points.shape != (grid[0] * grid[1], 3):
            problem = f"{points.shape[0]} lines of {points.shape[1]} numbers for a grid of {grid[0]} x {grid[1]}"
            raise BodyError(problem, remedy="Write x,y,z of every point, and the grid's two counts.")
        return FourierSurface.of(points.reshape(*grid, 3), closed=closed, orders=orders).triangles(nodes or grid)

    return surface_of_file(path, segment, read, unit=unit, mirror=mirror, place=place)
