"""Read triangle meshes from Wavefront OBJ files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_text
from kinefit.bodies.surfaces.mesh import MeshSurface
from kinefit.errors import BodyError, check_choice, located

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
MAX_LENGTH = 10.0  # [m] of a segment's mesh; a longer one is in another unit


def read_obj(path: str | PathLike[str]) -> tuple[NDArray, NDArray]:
    """Read vertices (V, 3) in the file's unit and triangles (T, 3) of an OBJ file; polygons are split into fans.

    Uses the first three numbers of `v` lines and the vertices of `f` lines (`1`, `1/2`, `1//3`, `1/2/3`, or negative
    numbers from the end). All other lines are ignored.

    Raises
    ------
    BodyError
        A file that cannot be read, an invalid line, or a file without faces.
    """
    remedy = "Give the path of an OBJ file."
    lines = read_text(path, "the mesh", remedy=remedy, error=BodyError, errors="replace").splitlines()
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(lines, 1):
        word, *rest = line.split("#")[0].split() or [""]
        if word not in ("v", "f"):
            continue
        try:
            if word == "v":
                x, y, z = (float(text) for text in rest[:3])
                vertices.append([x, y, z])
                continue
            corners = [int(text.split("/")[0]) for text in rest]
        except ValueError as error:
            problem = f"not a line of an OBJ file: '{line[:60]}'"
            remedy = "A `v` has three numbers, an `f` whole numbers such as 1, 1/2 or 1/2/3."
            raise BodyError(problem, file=path, place=f"line {number}", remedy=remedy) from error
        corners = [c - 1 if c > 0 else len(vertices) + c for c in corners]
        if len(corners) < 3 or min(corners) < 0 or max(corners) >= len(vertices):
            problem = f"a face of {len(corners)} vertices, or with vertices that are not yet defined: '{line[:60]}'"
            remedy = "A face lists three vertices or more, counted from 1."
            raise BodyError(problem, file=path, place=f"line {number}", remedy=remedy)
        faces += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
    if not faces:
        raise BodyError("the mesh has no faces", file=path, remedy="Export it as OBJ with its faces.")
    return np.array(vertices), np.array(faces, np.int64)


def mesh_surface(
    path: str | PathLike[str], segment: int, *, unit: str = "m", mirror: bool = False, place: str | None = None
) -> MeshSurface:
    """Surface of a segment from an OBJ file in the segment's frame.

    Parameters
    ----------
    path : of the file.
    segment : int
    unit : "m", "cm" or "mm", of the file.
    mirror : bool, whether it is mirrored at z = 0.
    place : str, named in messages.

    Raises
    ------
    BodyError
        See `read_obj` and `MeshSurface`; an unknown unit; a mesh longer than 10 m, which is probably in another unit.
    """
    return surface_of_file(path, segment, lambda: read_obj(path), unit=unit, mirror=mirror, place=place)


def surface_of_file(
    path: str | PathLike[str], segment: int, read: Callable[[], tuple[Any, Any]], *, unit: str, mirror: bool,
    place: str | None,
) -> MeshSurface:  # fmt: skip
    """Surface of a segment from vertices and triangles of a file; arguments as of `mesh_surface`.

    Parameters
    ----------
    read : returns vertices (V, 3) in the file's unit, and triangles (T, 3); or a Fourier series, and its nodes.

    Raises
    ------
    BodyError
        As `mesh_surface`.
    """
    check_choice("unit", unit, UNITS, BodyError, file=path, place=place, remedy="Give one of these.")
    with located(path, place):
        shape, nodes = read()
        series = None
        if isinstance(shape, np.ndarray):
            vertices, faces = UNITS[unit] * shape, nodes
        else:
            series = replace(shape, coefficients=UNITS[unit] * shape.coefficients)
            vertices, faces = series.triangles(nodes)
        length = float(np.ptp(vertices, axis=0).max())
        if length > MAX_LENGTH:
            remedy = 'State the unit of its file, such as unit = "mm".'
            raise BodyError(f"the mesh is {length:.4g} m long", remedy=remedy)
        surface = MeshSurface(segment, vertices, faces, series=series, nodes=series and nodes)
    return surface.mirrored() if mirror else surface
