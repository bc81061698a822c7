"""Triangulate surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.bodies.surfaces.mesh import MeshSurface, tube_faces
from kinefit.errors import BodyError


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
