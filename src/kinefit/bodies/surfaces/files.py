"""Read the surfaces of a body file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kinefit._files import regular
from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.bodies.surfaces.fourier import FourierCurve, FourierSurface, by_length
from kinefit.bodies.surfaces.mesh import MeshSurface, mesh_surface, surface_of_file
from kinefit.bodies.surfaces.metaballs import Metaballs
from kinefit.errors import BodyError, located
from kinefit.geometry.se3 import exp_so3

_CURVE_POINTS = 256  # along a contour: one every 4 mm for a sheet of A4
Vector = tuple[float, float, float]
Section = float | tuple[float, float]


class BallRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A metaball: an ellipsoid's centre and radii [m] in the segment's frame, its weight, its rotation [deg]."""

    at: Vector
    radii: Vector
    weight: float = 1.0
    turn: Vector = (0.0, 0.0, 0.0)


class SurfaceRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`surface` of a segment, one of five kinds.

    A tapered cylinder, with circles (one radius) or ellipses (two half axes) as sections. A mesh: the path of an OBJ
    file, relative to the body file's folder, with its unit. A Fourier series: the path of a file of points, their grid,
    closed parameters, orders, and nodes of the mesh. A closed curve, the contour of a thin plate: the path of a file of
    points, and the order. Metaballs, from one end of the limb to the other.
    """

    end: Vector | None = None
    radii: tuple[Section, Section] | None = None
    start: Vector = (0.0, 0.0, 0.0)
    side: Vector | None = None
    mesh: str | None = None
    contour: str | None = None
    order: int | None = None
    fourier: str | None = None
    grid: tuple[int, int] | None = None
    closed: tuple[bool, bool] = (True, True)
    orders: tuple[int, int] | None = None
    nodes: tuple[int, int] | None = None
    unit: str = "m"
    mirror: bool = False
    balls: tuple[BallRecord, ...] = ()


def surfaces_of(
    records: SurfaceRecord | Sequence[SurfaceRecord] | None, segment: int, source: str, place: str
) -> list[TaperedCylinder | MeshSurface]:
    """Surfaces of a segment, given by its index; `source` and `place` are named in messages.

    Raises
    ------
    BodyError
        An invalid surface: see `TaperedCylinder`, `mesh_surface`.
    """
    given = [records] if isinstance(records, SurfaceRecord) else records or ()
    return [_surface(record, segment, source, place) for record in given]


def _surface(record: SurfaceRecord, segment: int, source: str, place: str) -> TaperedCylinder | MeshSurface:
    cylinder = record.end is not None and record.radii is not None
    series = record.fourier is not None and record.grid is not None
    shapes = (cylinder, series, record.mesh is not None, record.contour is not None, bool(record.balls))
    with located(source, place):
        if sum(shapes) != 1:
            remedy = "Give `end` and `radii` of a cylinder, or `mesh`, the path of an OBJ file, "
            remedy += "or `fourier` and `grid`, or `contour`, or `balls`."
            raise BodyError("a surface needs exactly one shape", remedy=remedy)
        if record.balls:
            return _metaballs(record, segment)
        if record.end is not None and record.radii is not None:
            first, last = (r if isinstance(r, tuple) else (r, r) for r in record.radii)
            return TaperedCylinder(segment, record.start, record.end, (first, last), record.side)
    if record.mesh is not None:
        path = Path(source).parent / record.mesh
        return mesh_surface(path, segment, unit=record.unit, mirror=record.mirror, place=place)
    return _series(record, segment, source, place)


def _series(record: SurfaceRecord, segment: int, source: str, place: str) -> MeshSurface:
    """Fourier series (P1 2.2, 2.3) from a file of points x,y,z: of a closed curve, or of a grid row by row."""
    path, grid = Path(source).parent / str(record.contour or record.fourier), record.grid

    def read() -> tuple[FourierCurve | FourierSurface, Any]:
        try:
            points = np.loadtxt(regular(path), delimiter=",", ndmin=2)
        except (OSError, ValueError) as error:
            raise BodyError(f"points that cannot be read: {error}", remedy="Write lines of x,y,z.") from error
        if record.contour is not None:
            return FourierCurve.of(by_length(points, _CURVE_POINTS), record.order), _CURVE_POINTS
        assert grid is not None
        if points.shape != (grid[0] * grid[1], 3):
            problem = f"{points.shape[0]} lines of {points.shape[1]} numbers for a grid of {grid[0]} x {grid[1]}"
            raise BodyError(problem, remedy="Write x,y,z of every point, and the grid's two counts.")
        series = FourierSurface.of(points.reshape(*grid, 3), closed=record.closed, orders=record.orders)
        return series, record.nodes or grid

    return surface_of_file(path, segment, read, unit=record.unit, mirror=record.mirror, place=place)


def _metaballs(record: SurfaceRecord, segment: int) -> Metaballs:
    balls = record.balls
    axes = exp_so3(np.radians([b.turn for b in balls])).swapaxes(1, 2)
    out = Metaballs.of(segment, [b.at for b in balls], [b.radii for b in balls], [b.weight for b in balls], axes)
    return out.mirrored() if record.mirror else out
