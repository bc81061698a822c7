"""Anchors: points of a body's surfaces in the surfaces' own coordinates, which transfer to bodies of other sizes.

On a tapered cylinder they are (ξ, η, t): shares of the two half axes and of the length, so that the point is
(a(t) ξ, b(t) η, t L). On a mesh they are a face, two barycentric coordinates and a height along the face's normal, in
units of the square root of twice the face's area. Both also describe points near the surface. Normals are transferred
by the inverse transpose of the map between the two surfaces.

Surfaces of a body packed for kernels, and their nearest points to measured points.

All surfaces of a body as one mesh, and points sampled evenly on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.bodies.body import Body
from kinefit.bodies.surfaces.closest._kernels_cylinder import nearest_on_cylinders, nearest_on_cylinders_exact
from kinefit.bodies.surfaces.closest._kernels_grid import nearest_faces, nearest_on_grids
from kinefit.bodies.surfaces.closest._kernels_metaballs import nearest_on_metaballs
from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.bodies.surfaces.mesh import BodyMesh, MeshSurface, triangles
from kinefit.bodies.tree import BodyState
from kinefit.errors import BodyError, ObservationError


class _SurfacePlaces(NamedTuple):
    """Surface (N,), face (N,) (0 for cylinders), coordinates (N, 3) and normals (N, 3), as covectors, of N anchors."""

    surface: NDArray
    face: NDArray
    at: NDArray
    normal: NDArray


@dataclass(frozen=True, eq=False)
class SurfaceAnchors:
    """N points on the surfaces of a body.

    Parameters
    ----------
    body : Body on which they are defined.
    segment : (N,) int
    points : (N, 3) [m] on or near a surface of that segment, in the root frame at rest.
    normals : (N, 3) outward there.

    Raises
    ------
    BodyError
        A segment without a surface; raised at the first use on another body.
    """

    body: Body
    segment: NDArray
    points: NDArray
    normals: NDArray

    def __len__(self) -> int:
        return len(self.segment)

    def on(self, body: Body) -> tuple[NDArray, NDArray]:
        """Points and normals (N, 3) [m] of the anchors on a body with the same surfaces, in its root frame at rest.

        Raises
        ------
        BodyError
            Surfaces that do not correspond: another number, kind or segment, or a mesh with other faces.
        """
        if body is self.body:
            return self.points, self.normals
        if self._latest and self._latest[0][0] is body:
            return self._latest[0][1]
        _check_correspondence(self.body, body)
        places = self._places
        points, J = _mapped(body, places.surface, places.face, places.at)
        points += body.tree.rest[self.segment]
        normals = np.linalg.solve(np.swapaxes(J, 1, 2), places.normal[..., None])[..., 0]
        size = np.linalg.norm(self.normals, axis=1) / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)
        placed = points, normals * size[:, None]
        self._latest[:] = [(body, placed)]
        return placed

    @cached_property
    def _latest(self) -> list[tuple[Body, tuple[NDArray, NDArray]]]:
        """Cache of the last other body, with its points and normals."""
        return []

    @cached_property
    def _places(self) -> _SurfacePlaces:
        """Each anchor on the nearest surface of its segment."""
        body, count = self.body, len(self)
        out = _SurfacePlaces(np.full(count, -1), np.zeros(count, np.int64), np.zeros((count, 3)), np.zeros((count, 3)))
        best = np.full(count, np.inf)
        for k, surface in enumerate(body.surfaces):
            own = np.flatnonzero(self.segment == surface.segment)
            x = self.points[own] - body.tree.rest[surface.segment]
            away, face, at = _placed(surface, x)
            nearer = away < best[own]
            own, face, at = own[nearer], face[nearer], at[nearer]
            best[own], out.surface[own], out.face[own], out.at[own] = away[nearer], k, face, at
        if count and out.surface.min() < 0:
            name = body.tree.segments[int(self.segment[np.argmin(out.surface)])]
            raise BodyError(f"segment '{name}' has no surface for anchors", remedy="Give it a surface.")
        _, J = _mapped(body, out.surface, out.face, out.at)
        out.normal[:] = np.einsum("nji,nj->ni", J, self.normals)
        return out


class _Cylinders(NamedTuple):
    """A body's M surfaces as arrays; rows of other surfaces than tapered cylinders are zero."""

    is_cylinder: NDArray
    start: NDArray
    axes: NDArray
    length: NDArray
    first: NDArray
    growth: NDArray

    def mapped(self, surface: NDArray, at: NDArray) -> tuple[NDArray, NDArray]:
        """Points (N, 3) and derivatives (N, 3, 3) as of `_mapped`, for anchors on surfaces (N,)."""
        first, growth, axes, length = (v[surface] for v in (self.first, self.growth, self.axes, self.length))
        half, J = first + at[:, 2:] * growth, np.zeros((len(at), 3, 3))
        local = np.concatenate([half * at[:, :2], length[:, None] * at[:, 2:]], axis=1)
        J[:, 0, 0], J[:, 1, 1], J[:, 2, 2] = half[:, 0], half[:, 1], length
        J[:, :2, 2] = growth * at[:, :2]
        turned = np.swapaxes(axes, 1, 2)
        return (turned @ local[..., None])[..., 0] + self.start[surface], turned @ J


@lru_cache(maxsize=256)
def _cylinders(body: Body) -> _Cylinders:
    count = len(body.surfaces)
    out = _Cylinders(
        np.zeros(count, bool), np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count), np.zeros((count, 2)),
        np.zeros((count, 2)),
    )  # fmt: skip
    for k, s in enumerate(body.surfaces):
        if isinstance(s, TaperedCylinder):
            (a, b), (c, d) = s.radii
            out.is_cylinder[k], out.start[k], out.axes[k], out.length[k] = True, s.start, s.axes, s.length
            out.first[k], out.growth[k] = (a, b), (c - a, d - b)
    return out


def _mapped(body: Body, surface: NDArray, face: NDArray, at: NDArray) -> tuple[NDArray, NDArray]:
    """Points (N, 3) [m] in their segments' frames from coordinates (N, 3), and derivatives (N, 3, 3) by them."""
    points, J, table = np.empty((len(at), 3)), np.empty((len(at), 3, 3)), _cylinders(body)
    own = table.is_cylinder[surface]
    points[own], J[own] = table.mapped(surface[own], at[own])
    for k in np.unique(surface[~own]):
        own = surface == k
        corner, J[own] = _face_axes(body.surfaces[k], face[own])
        points[own] = corner + np.einsum("nij,nj->ni", J[own], at[own])
    return points, J


def _placed(surface: TaperedCylinder | MeshSurface, x: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Approximate distance (N,) [m] to a surface, face (N,) and coordinates (N, 3) of points (N, 3) [m]."""
    if isinstance(surface, MeshSurface):
        corners = surface.vertices[surface.faces]
        twice = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        some = np.flatnonzero(twice > 1e-6 * twice.max())  # a face without area has no coordinates
        place, square = np.empty(len(x), np.int64), np.empty(len(x))
        nearest_faces(np.ascontiguousarray(corners[some]), np.ascontiguousarray(x), place, square)
        face = some[place]
        corner, J = _face_axes(surface, face)
        return np.sqrt(square), face, np.linalg.solve(J, (x - corner)[..., None])[..., 0]
    first, last = np.array(surface.radii)
    local = (x - surface.start) @ surface.axes.T
    t = local[:, 2:] / surface.length
    half = np.maximum(first + t * (last - first), 1e-6)
    at = np.concatenate([local[:, :2] / half, t], axis=1)
    from_side = (np.linalg.norm(at[:, :2], axis=1) - 1.0) * np.sqrt(half.prod(axis=1))
    from_ends = (np.abs(t[:, 0] - 0.5) - 0.5) * surface.length
    return np.abs(np.maximum(from_side, from_ends)), np.zeros(len(x), np.int64), at


def _face_axes(surface: MeshSurface, face: NDArray) -> tuple[NDArray, NDArray]:
    """First corners (N, 3) of faces, and columns (N, 3, 3): two sides, and a normal of about a side's length."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces[face]], 1, 0)
    normal = np.cross(b - a, c - a)
    size = np.sqrt(np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30))
    return a, np.stack([b - a, c - a, normal / size], axis=2)


def _check_correspondence(body: Body, other: Body) -> None:
    """Raise BodyError if the surfaces of two bodies do not correspond."""
    a, b = body.surfaces, other.surfaces
    alike = len(a) == len(b) and all(
        type(s) is type(t) and s.segment == t.segment
        and (not isinstance(s, MeshSurface) or np.array_equal(s.faces, t.faces))  # type: ignore[union-attr]
        for s, t in zip(a, b)
    )  # fmt: skip
    if not alike:
        problem = f"surfaces of body '{other.name}' do not correspond to those of '{body.name}'"
        raise BodyError(problem, remedy="Use a body with the same surfaces, of other lengths and widths.")


class Nearest(NamedTuple):
    """Nearest points of a body's surface.

    Parameters
    ----------
    distance : (N,) [m] positive outside, negative inside; `max_distance` if no surface is as near.
    point : (N, 3) [m] in the world, on the surface; x itself if no surface is as near.
    normal : (N, 3) unit, outward at that point, in the world; zero if no surface is as near.
    segment : (N,) int, -1 if no surface is as near.
    """

    distance: NDArray
    point: NDArray
    normal: NDArray
    segment: NDArray


def nearest(
    body: Body,
    state: BodyState,
    x_world: ArrayLike,
    *,
    max_distance: float,
    only: ArrayLike | None = None,
    exact: bool = False,
) -> Nearest:
    """Find the nearest points of all surfaces of a body (P2 2.3).

    Parameters
    ----------
    body : Body
    state : BodyState
    x_world : (N, 3) [m]
    max_distance : float [m], radius of the search.
    only : (N,) int, or one for all, optional
        Segment that each point may belong to, -1 for any.
    exact : bool
        Whether closest points of cylinders are found to 1e-4 mm instead of a fraction of a millimetre, in three times
        the time.

    Raises
    ------
    ObservationError
        Points of the wrong shape or not finite, a radius that is not positive, a segment out of range.
    """
    x = shaped(x_world, ("N", 3), "points")
    lines = np.ascontiguousarray(x.T)
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    distance, normal, segment = nearest_lines(body, frames, lines, max_distance, only, exact=exact)
    point = lines - np.where(segment >= 0, distance, 0.0) * normal
    return Nearest(distance, point.T, normal.T, segment)


def nearest_lines(
    body: Body, frames: NDArray, x: NDArray, max_distance: float, only: ArrayLike | None = None, *, exact: bool = False
) -> tuple[NDArray, NDArray, NDArray]:
    """Distance (N,) [m], normal (3, N) and segment (N,) for points x (3, N) [m] and frames (S, 12); see `nearest`.

    Raises
    ------
    ObservationError
        As `nearest`.
    """
    count = x.shape[1]
    if not abs(float(x.sum())) < np.inf:
        raise ObservationError("points are not finite", remedy="Remove points without a measurement.")
    if not 0.0 < max_distance < np.inf:
        raise ObservationError(f"the largest distance is {max_distance} m", remedy="Give a positive distance.")
    wanted = np.full(count, -1) if only is None else np.asarray(only)
    if wanted.shape not in ((), (count,)) or wanted.dtype.kind not in "iu":
        raise ObservationError(f"segments have shape {wanted.shape}", remedy=f"Give ({count},) integers, or one.")
    if wanted.size and not -1 <= wanted.min() <= wanted.max() < len(body.tree.segments):
        problem = f"a segment lies outside 0 to {len(body.tree.segments) - 1}"
        raise ObservationError(problem, remedy="Give -1 for any.")
    wanted = np.array(np.broadcast_to(wanted, count), np.int64)
    distance, normal, segment = np.full(count, float(max_distance)), np.zeros((3, count)), np.full(count, -1)
    tables = body.surface_tables
    if len(tables.cylinders):
        search = nearest_on_cylinders_exact if exact else nearest_on_cylinders
        search(x, frames, tables.cylinders, wanted, distance, normal, segment)
    if tables.grids is not None:
        nearest_on_grids(x, frames, *tables.grids, wanted, distance, normal, segment)
    if tables.balls is not None:
        nearest_on_metaballs(np.ascontiguousarray(x), frames, *tables.balls, wanted, distance, normal, segment)
    return distance, normal, segment


def body_mesh(body: Body, *, around: int = 20, along: int = 6) -> BodyMesh:
    """All surfaces of a body as one mesh; see `triangles` for `around` and `along`.

    Raises
    ------
    BodyError
        A body without surfaces.
    """
    if not body.surfaces:
        raise BodyError(f"body '{body.name}' has no surfaces", remedy="Give its segments a `surface`.")
    vertices, faces, segments, owners, total = [], [], [], [], 0
    for surface in body.surfaces:
        v, f = triangles(surface, around, along)
        vertices.append(v + body.tree.rest[surface.segment])
        faces.append(f + total)
        segments.append(np.full(len(v), surface.segment))
        owners.append(np.full(len(f), surface.segment))
        total += len(v)
    return BodyMesh(
        np.concatenate(vertices),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(segments).astype(np.int32),
        np.concatenate(owners).astype(np.int32),
    )


def sample(body: Body, count: int, *, seed: int = 0) -> tuple[NDArray, NDArray, NDArray]:
    """Sample points on all surfaces of a body, uniformly by area, including those inside of other surfaces.

    Parameters
    ----------
    body : Body
    count : int, number of points
    seed : int, of the random numbers

    Returns
    -------
    points : (count, 3) [m] on the surfaces, in the root frame at rest.
    normals : (count, 3) unit, outward.
    segment : (count,) int32
    """
    rng = np.random.default_rng(seed)
    mesh = body_mesh(body, around=48, along=12)
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(cross, axis=1)
    shares = np.cumsum(doubled) / doubled.sum()
    chosen = np.searchsorted(shares, (np.arange(count) + rng.random(count)) / max(count, 1))
    chosen = np.minimum(chosen, len(shares) - 1)
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    c = corners[chosen]
    points = c[:, 0] + u[:, None] * (c[:, 1] - c[:, 0]) + v[:, None] * (c[:, 2] - c[:, 0])
    normals = cross[chosen] / np.maximum(doubled[chosen], 1e-30)[:, None]
    first = 0
    for surface in body.surfaces:
        last = first + len(triangles(surface, 48, 12)[1])
        own = (chosen >= first) & (chosen < last)
        if isinstance(surface, TaperedCylinder) and own.any():
            rest = body.tree.rest[surface.segment]
            sides = own & (chosen < last - 2 * 48)  # the caps come last
            on, normals[sides] = _onto_side(surface, points[sides] - rest)
            points[sides] = on + rest
        first = last
    return points, normals, mesh.face_segment[chosen]


def _onto_side(cylinder: TaperedCylinder, points: NDArray) -> tuple[NDArray, NDArray]:
    """Project points (N, 3) [m] onto a cylinder's side at the same height and eccentric angle; points and normals."""
    p, q, h = ((points - cylinder.start) @ cylinder.axes.T).T
    first, last = np.array(cylinder.radii)
    growth = (last - first) / cylinder.length
    a, b = first[:, None] + growth[:, None] * h
    angle = np.arctan2(q / b, p / a)
    cos, sin = np.cos(angle), np.sin(angle)
    on = np.stack([a * cos, b * sin, h], 1) @ cylinder.axes + cylinder.start
    normal = np.stack([cos / a, sin / b, -(cos**2 * growth[0] / a + sin**2 * growth[1] / b)], 1)
    return on, normal / np.linalg.norm(normal, axis=1, keepdims=True) @ cylinder.axes
