"""Triangulate surfaces for rendering, and sample points evenly on them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.bodies.surfaces.mesh import MeshSurface, tube_faces
from kinefit.errors import BodyError

if TYPE_CHECKING:
    from kinefit.bodies.body import Body


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
