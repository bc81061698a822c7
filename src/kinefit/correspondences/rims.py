"""The outline of a body as a camera would see it: rim points of its mesh, by a virtual image (P1 4.1).

A rim point lies on an edge between a triangle that looks at the camera and one that does not. The virtual image, depth
and triangle of every pixel, tells whether it is seen, and what is behind it: nothing, or another part of the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.correspondences import _kernels_outlines as kernels
from kinefit.geometry.camera import Camera
from kinefit.rendering import Canvas, Raster

_ROOM = 20000  # rim points of one image, at most
_NEAR = 0.05  # [m] depth by which a limb's surface one pixel inside of its rim may be nearer than the rim
_APART = 0.03  # [m] depth behind a rim from which it is the outline of one part before another, and no crease


class Triangles(Protocol):
    """A mesh whose faces have segments."""

    @property
    def faces(self) -> NDArray:
        """(T, 3) int."""
        ...

    @property
    def face_segment(self) -> NDArray:
        """(T,) int."""
        ...


@dataclass(frozen=True, eq=False)
class Rim:
    """Outline of a body in one camera, N points.

    Parameters
    ----------
    outline : (4, N) u, v [px] and the unit normal (a, b), away from the body.
    vertices : (N, 2) int, ends of the mesh's edge that each point lies on.
    share : (N,) of the second end.
    segment : (N,) int
    inner : (N,) bool, outline of one part of the body before another: a silhouette does not show it.
    """

    outline: NDArray
    vertices: NDArray
    share: NDArray
    segment: NDArray
    inner: NDArray

    def __len__(self) -> int:
        return len(self.share)

    def on(self, vertices: NDArray) -> NDArray:
        """(N, 3) [m] the points on vertices (V, 3) of the mesh, wherever these are: in the world, or at rest."""
        s = self.share[:, None]
        return np.asarray((1.0 - s) * vertices[self.vertices[:, 0]] + s * vertices[self.vertices[:, 1]])

    def chosen(self, which: NDArray) -> Rim:
        """Some of the points."""
        return Rim(
            np.ascontiguousarray(self.outline[:, which]), self.vertices[which], self.share[which], self.segment[which],
            self.inner[which],
        )  # fmt: skip


class RimFinder:
    """Room and tables to find the rims of one mesh again and again.

    Parameters
    ----------
    mesh : its faces (T, 3), outward counter-clockwise, with their segments (T,); the vertices come with every call.
    like : RimFinder of the same mesh, whose tables are shared: finders that work side by side need room each.
    """

    def __init__(self, mesh: Triangles, like: RimFinder | None = None) -> None:
        if like is not None:
            self.__dict__["_edges"] = like._edges
        self.faces = np.ascontiguousarray(mesh.faces, np.int32)
        self.face_segment = np.ascontiguousarray(mesh.face_segment, np.int64)
        self._front = np.empty(len(self.faces), np.int8)
        self._out, self._place = np.empty((4, _ROOM)), np.empty((_ROOM, 2))
        self._kind = np.empty(_ROOM, np.int8)
        self._canvases: dict[tuple[int, int], Canvas] = {}
        self._last: tuple[Camera, NDArray, Raster] | None = None

    @cached_property
    def _edges(self) -> tuple[NDArray, NDArray]:
        """Edges (E, 2) and the faces on their sides (E, 2), -1 for none."""
        ends = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=2).reshape(-1, 2)
        owner = np.repeat(np.arange(len(self.faces)), 3)
        order = np.lexsort((owner, ends.max(axis=1), ends.min(axis=1)))
        pairs, owner = np.sort(ends, axis=1)[order], owner[order]
        first = np.flatnonzero(np.any(np.diff(pairs, axis=0, prepend=-1), axis=1))
        second = np.append(first[1:], len(pairs)) - 1  # a third face on one edge is beyond what a surface has
        other = np.where(second > first, owner[second], -1)
        return np.ascontiguousarray(pairs[first]), np.stack([owner[first], other], axis=1)

    def drawn(self, camera: Camera) -> NDArray:
        """(H, W) int32 triangle of every pixel of a camera of this size, -1 for none, as it was drawn last."""
        return self._canvases[camera.size].face

    def find(
        self, vertices_world: NDArray, camera: Camera, *, spacing: float = 3.0, inner: bool = True, stale: float = 0.0
    ) -> Rim:
        """Rim points about `spacing` [px] apart of the mesh's vertices (V, 3) [m] in the world.

        Parameters
        ----------
        inner : whether outlines of one part before another are wanted, which silhouettes do not show.
        stale : float [px]
            The last virtual image of this camera serves again where no vertex has moved farther since it was drawn.
        """
        x, uv, K = np.empty((len(vertices_world), 3)), np.empty((len(vertices_world), 2)), camera.matrix
        kernels.seen(camera.packed, np.ascontiguousarray(vertices_world), x, uv)
        last = self._last
        if last is not None and last[0] is camera and stale > 0.0 and kernels.shift(uv, last[1], stale) <= stale:
            drawn = last[2]
        else:
            canvas = self._canvases.setdefault(camera.size, Canvas(camera.size))
            drawn = canvas.draw(x, self.faces, K[0, 0], K[1, 1], K[0, 2], K[1, 2], cull=True)
            self._last = camera, uv, drawn
        edges, sides = self._edges
        n = kernels.rims(
            x, uv, self.faces, self.face_segment, edges, sides, drawn.depth, drawn.face, spacing, _NEAR, _APART,
            inner, self._front, self._out, self._place, self._kind,
        )  # fmt: skip
        number = self._place[:n, 0].astype(np.int64)
        own = np.where(self._front[sides[number, 0]] == 1, sides[number, 0], sides[number, 1])
        return Rim(
            self._out[:, :n].copy(), edges[number].astype(np.int64), self._place[:n, 1].copy(), self.face_segment[own],
            self._kind[:n] == kernels.INNER,
        )  # fmt: skip
