"""A triangle mesh as the surface of a segment.

Triangulate surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._files import metres_of, read_text
from kinefit.bodies.surfaces.closest.grid import DistanceGrid, cell_size, distance_grid, parts
from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.bodies.surfaces.fourier import FourierCurve, FourierSurface, levels
from kinefit.errors import BodyError, located

WELD = 1e-6  # [m] distance below which corners are merged: the rounding of six decimals in a file


@dataclass(frozen=True, eq=False)
class MeshSurface:
    """Closed triangle mesh of a segment; it may consist of several closed parts that intersect.

    Parameters
    ----------
    segment : int
    vertices : (V, 3) [m] in the segment's frame.
    faces : (T, 3) int, counter-clockwise as seen from outside.
    series : FourierCurve or FourierSurface [m] from which the mesh was made, or None.
    nodes : argument of the series' `triangles` that gives the vertices of the mesh.

    Raises
    ------
    BodyError
        Vertices that are not finite, indices out of range, faces with opposite orientations, a part that is inside out,
        a hole that is wider than a cell of the distance grid.
    """

    segment: int
    vertices: NDArray
    faces: NDArray
    series: FourierCurve | FourierSurface | None = field(default=None, kw_only=True)
    nodes: Any = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        vertices, faces = np.array(self.vertices, float), np.array(self.faces)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,):
            problem = f"a mesh has vertices of shape {vertices.shape} and faces of shape {faces.shape}"
            raise BodyError(problem, remedy="Give (V, 3) and (T, 3).")
        if not np.isfinite(vertices).all():
            line = int(np.flatnonzero(~np.isfinite(vertices).all(1))[0])
            raise BodyError(f"vertex {line} of a mesh is not finite", remedy="Remove it and its faces.")
        if faces.size and faces.dtype.kind not in "iu":
            raise BodyError(f"a mesh has faces of {faces.dtype} numbers", remedy="Give the indices of vertices.")
        faces = faces.astype(np.int64)
        if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
            problem = f"a mesh of {len(vertices)} vertices has faces with vertex numbers out of range, or no faces"
            raise BodyError(problem, remedy="Count vertices from 0.")
        vertices.flags.writeable = faces.flags.writeable = False
        object.__setattr__(self, "segment", int(self.segment))
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        _check(vertices, self._welded, self._open_edges)

    def box(self) -> tuple[NDArray, NDArray, NDArray]:
        """Mean of the vertices (3,), their principal directions (3, 3) in rows, the longest first, and extents (3,)."""
        middle = self.vertices.mean(axis=0)
        axes = np.linalg.svd(self.vertices - middle, full_matrices=False)[2]
        return middle, axes, np.ptp((self.vertices - middle) @ axes.T, axis=0)

    @cached_property
    def grid(self) -> DistanceGrid:
        """Grid of signed distances around the mesh, computed at first use."""
        return distance_grid(self.vertices, self._welded)

    @property
    def open_edges(self) -> int:
        """Number of edges with a face on one side only: 0 for a watertight mesh."""
        return len(self._open_edges)

    def scaled(self, factor: float) -> MeshSurface:
        """The mesh scaled about the origin of its segment by a factor, a number > 0."""
        return self._with_vertices(self.segment, factor * self.vertices, factor)

    def on(self, segment: int) -> MeshSurface:
        """The mesh on another segment; both share one distance grid."""
        return self._with_vertices(segment, self.vertices, 1.0)

    def mirrored(self) -> MeshSurface:
        """The mesh mirrored at the plane z = 0: a left limb from a right one."""
        flip = (1.0, 1.0, -1.0)
        series = self._scaled_series(flip)
        return MeshSurface(
            self.segment, self.vertices * flip, self.faces[:, ::-1], series=series, nodes=self.nodes
        )

    def low_pass_shifts(self, count: int) -> list[NDArray]:
        """Shifts (V, 3) [m] of the vertices to low-pass approximations of the series, coarse to fine (P1 2.4)."""
        assert self.series is not None
        vertices = [shape.triangles(self.nodes)[0] for shape in levels(self.series, count)]
        return [v - vertices[-1] for v in vertices]

    def _scaled_series(self, factor: ArrayLike) -> FourierCurve | FourierSurface | None:
        """The series with its three signals multiplied by a factor or by factors (3,)."""
        if self.series is None:
            return None
        p = self.series.coefficients
        return replace(self.series, coefficients=p * np.broadcast_to(factor, 3).reshape(3, *[1] * (p.ndim - 1)))

    def _with_vertices(self, segment: int, vertices: NDArray, factor: float) -> MeshSurface:
        out = MeshSurface(segment, vertices, self.faces, series=self._scaled_series(factor), nodes=self.nodes)
        if "grid" in self.__dict__:
            out.__dict__["grid"] = self.grid if factor == 1.0 else self.grid.scaled(factor)
        return out

    @cached_property
    def _welded(self) -> NDArray:
        """Faces (T', 3) with merged corners, without degenerate ones."""
        _, first, same = np.unique(np.round(self.vertices / WELD), axis=0, return_index=True, return_inverse=True)
        faces = first[same.ravel()][self.faces]
        flat = np.any(faces == np.roll(faces, 1, axis=1), axis=1)
        return np.ascontiguousarray(faces[~flat])

    @cached_property
    def _open_edges(self) -> NDArray:
        """Edges (E, 2) of an odd number of faces."""
        edges, count, _ = _edges(self._welded)
        return edges[count % 2 == 1]


def _edges(faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Edges (E, 2), the number of faces of each, and the balance of faces in both directions (0 if consistent)."""
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    edges, which, count = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    balance = np.bincount(which.ravel(), np.sign(ends[:, 1] - ends[:, 0]), len(edges))
    return edges, count, balance


def check_triangles(vertices: NDArray, faces: NDArray) -> None:
    """Raise BodyError for vertices (V, 3) [m] and faces (T, 3) that enclose no volume, see `MeshSurface`."""
    edges, count, _ = _edges(np.asarray(faces, np.int64))
    _check(vertices, np.asarray(faces, np.int64), edges[count % 2 == 1])


def _check(vertices: NDArray, faces: NDArray, open_edges: NDArray) -> None:
    if not len(faces):
        raise BodyError("all faces of a mesh have no area", remedy="Check that it is in metres.")
    edges, count, balance = _edges(faces)
    flipped = edges[(count % 2 == 0) & (balance != 0)]
    if len(flipped):
        at = np.round(vertices[flipped[0]].mean(0), 4).tolist()
        problem = f"neighbouring faces of a mesh face opposite ways, at {len(flipped)} edges, the first near {at}"
        raise BodyError(problem, remedy="Make them all face outwards (in Blender: Mesh, Normals, Recalculate Outside).")
    cell = cell_size(vertices[faces])
    for hole in parts(open_edges) if len(open_edges) else []:
        border = vertices[open_edges[hole]].reshape(-1, 3)
        width = float(np.linalg.norm(np.ptp(border, axis=0)))
        if width > cell:  # beyond that, inside and outside are ambiguous
            at = np.round(border.mean(0), 4).tolist()
            problem = f"a mesh has a hole of {width:.3f} m near {at} ({len(open_edges)} open edges in all)"
            raise BodyError(problem, remedy="Fill it (in Blender: Mesh, Clean Up, Fill Holes).")
    for part in parts(faces):
        a, b, c = np.moveaxis(vertices[faces[part]] - vertices[faces[part[0], 0]], 1, 0)
        volume = float(np.einsum("ti,ti->", a, np.cross(b, c))) / 6.0
        if volume <= 0.0:
            problem = f"a mesh's part of {len(part)} faces is inside out or flat (volume {volume:.3g} m³)"
            raise BodyError(problem, remedy="Reverse the order of corners of its faces; remove inner walls.")


@cache
def tube_faces(along: int, around: int) -> NDArray:
    """Faces (T, 3) of `along` rings of `around` quads, with a fan at each end, whose centres are the last vertices."""
    j = np.arange(around)
    following, bottom, top = (j + 1) % around, (along + 1) * around, (along + 1) * around + 1
    rows = np.arange(along)[:, None] * around
    one, two, three, four = rows + j, rows + following, rows + around + following, rows + around + j
    sides = np.stack([np.stack([one, two, three], -1), np.stack([one, three, four], -1)], 2).reshape(-1, 3)
    low = np.stack([np.full(around, bottom), following, j], -1)
    high = np.stack([np.full(around, top), along * around + j, along * around + following], -1)
    return np.concatenate([sides, low, high])


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
    with located(path, place):
        metres = metres_of(unit, BodyError, remedy="Give one of these.")
        shape, nodes = read()
        series = None
        if isinstance(shape, np.ndarray):
            vertices, faces = metres * shape, nodes
        else:
            series = replace(shape, coefficients=metres * shape.coefficients)
            vertices, faces = series.triangles(nodes)
        length = float(np.ptp(vertices, axis=0).max())
        if length > MAX_LENGTH:
            remedy = 'State the unit of its file, such as unit = "mm".'
            raise BodyError(f"the mesh is {length:.4g} m long", remedy=remedy)
        surface = MeshSurface(segment, vertices, faces, series=series, nodes=series and nodes)
    return surface.mirrored() if mirror else surface


class GridTable(NamedTuple):
    """All meshes of a body, for `nearest_on_grids`; limbs of equal shape share their nodes.

    Parameters
    ----------
    values : (M, 4) float32, nodes of all grids.
    layout : (G, 5) int64, of each mesh: segment, first node, nodes along x, y, z.
    boxes : (G, 10) [m], in the root frame at rest
        First node (3), cell, centre of the surface's box (3), half its size (3).
    """

    values: NDArray
    layout: NDArray
    boxes: NDArray


def pack_grids(surfaces: Sequence[MeshSurface], rest: NDArray) -> GridTable:
    """Pack a body's meshes into a table; rest (S, 3) [m]: joint centres in the root frame at rest."""
    starts: dict[tuple[bytes, bytes], int] = {}
    grids: dict[tuple[bytes, bytes], DistanceGrid] = {}
    values, layout, boxes, total = [], [], [], 0
    for surface in surfaces:
        shape = surface.vertices.tobytes(), surface.faces.tobytes()
        if shape not in grids:
            grids[shape], starts[shape] = surface.grid, total
            values.append(surface.grid.values.reshape(-1, 4))
            total += len(values[-1])
        grid = grids[shape]
        layout.append([surface.segment, starts[shape], *grid.values.shape[:3]])
        at = rest[surface.segment]
        centre = 0.5 * (grid.lower + grid.upper) + at
        boxes.append([*(grid.origin + at), grid.cell, *centre, *(0.5 * (grid.upper - grid.lower))])
    return GridTable(
        np.concatenate(values) if values else np.zeros((0, 4), np.float32),
        np.array(layout, np.int64).reshape(-1, 5),
        np.array(boxes, float).reshape(-1, 10),
    )


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """All surfaces of a body as triangles, in the root frame at rest.

    Parameters
    ----------
    vertices : (V, 3) [m]
    faces : (T, 3) int32, outward counter-clockwise.
    segment : (V,) int32, segment of each vertex.
    face_segment : (T,) int32, segment of each face.
    """

    vertices: NDArray
    faces: NDArray
    segment: NDArray
    face_segment: NDArray

    def posed(self, frames: NDArray) -> NDArray:
        """Vertices (V, 3) [m] in the world, for frames (S, 12) of `KinematicTree.forward`."""
        out = np.empty_like(self.vertices)
        starts = np.flatnonzero(np.diff(self.segment, prepend=-1))  # one product for each run of a segment's vertices
        for start, end in zip(starts, [*starts[1:], len(out)]):
            f = frames[self.segment[start]]
            np.matmul(self.vertices[start:end], f[:9].reshape(3, 3).T, out=out[start:end])
            out[start:end] += f[9:]
        return out


def segment_middles(vertices: NDArray, segment: NDArray, count: int) -> NDArray:
    """Mean vertex (S, 3) [m] of each of S = count segments, from vertices (V, 3) [m] and segment (V,); 0 for none."""
    number = np.maximum(np.bincount(segment, minlength=count), 1)
    return np.stack([np.bincount(segment, x, count) / number for x in vertices.T], axis=1)


def triangles(surface: TaperedCylinder | MeshSurface, around: int = 20, along: int = 6) -> tuple[NDArray, NDArray]:
    """Triangulate a surface: vertices (V, 3) [m] in the segment's frame and faces (T, 3), outward counter-clockwise.

    A cylinder has `along` rings of `around` quads and a fan on each cap. Its sections are polygons with the ellipses'
    areas, so that corners lie slightly outside (0.8 % of the radius with 20). A mesh is returned as it is.

    Raises
    ------
    BodyError
        Fewer than 3 corners or 1 ring.
    """
    if isinstance(surface, MeshSurface):
        return surface.vertices, surface.faces
    if around < 3 or along < 1:
        raise BodyError(f"a cylinder cannot have {around} corners and {along} rings", remedy="Give at least 3 and 1.")
    a, b, axis = surface.axes
    turn = 2.0 * math.pi / around
    angle, t = turn * np.arange(around), np.linspace(0.0, 1.0, along + 1)[:, None]
    first, last = np.array(surface.radii) * math.sqrt(turn / math.sin(turn))
    at = (1.0 - t) * first + t * last  # (along + 1, 2) half axes of the rings
    centres = surface.start + surface.length * t * axis
    rings = centres[:, None] + (at[:, :1] * np.cos(angle))[..., None] * a + (at[:, 1:] * np.sin(angle))[..., None] * b
    vertices = np.concatenate([rings.reshape(-1, 3), centres[[0, -1]]])
    return vertices, tube_faces(along, around).copy()
