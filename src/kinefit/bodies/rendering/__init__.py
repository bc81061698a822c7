"""Render triangles in a camera: depth and triangle of every pixel, by a z-buffer.

Depth is z along the optical axis, exact at the pixel's centre (1/z is linear in the image). Triangles are clipped at
the near plane; adjacent triangles leave no gap. Distortion is applied to corners only: an edge is rendered as the chord
of its distorted image, so large triangles should be subdivided (`subdivided`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import check_shape, shaped
from kinefit.bodies import Body, BodyState
from kinefit.bodies.rendering import _kernels as kernels
from kinefit.bodies.surfaces.mesh import BodyMesh
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera

MIN_Z = 0.05  # [m] nothing closer is rendered; nearer than any sensor measures, far enough for 1/z to stay small

_IDENTITY = np.eye(4)
_IDENTITY.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Raster:
    """A rendered image.

    Parameters
    ----------
    depth : (H, W) float32 [m]
        Along the optical axis; inf for the background.
    face : (H, W) int32
        Index of the visible triangle; -1 for the background.
    labels : (T,) int, optional
        Label of every triangle: for a body its segment.
    """

    depth: NDArray
    face: NDArray
    labels: NDArray | None = None

    @cached_property
    def segment(self) -> NDArray:
        """Label (H, W) int16 of the visible triangle, -1 for the background; raises ObservationError without labels."""
        if self.labels is None:
            raise ObservationError("the rendered triangles have no labels", remedy="Use render_body, or give labels.")
        return np.append(self.labels, -1).astype(np.int16)[self.face]

    @property
    def seen(self) -> NDArray:
        """Whether a pixel (H, W) shows a triangle; bool."""
        return self.face >= 0


class Canvas:
    """Renders images of one size into reused buffers.

    The next call overwrites the result of `draw`; copy it to keep it.

    Parameters
    ----------
    size : (width, height) [px]

    Raises
    ------
    ObservationError
        A size below 1 pixel.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        width, height = (int(n) for n in size)
        if width < 1 or height < 1:
            raise ObservationError(f"an image of {width} x {height} pixels", remedy="Give (width, height), 1 or more.")
        self.size = width, height
        self._depth, self._face = np.empty((height, width), np.float32), np.empty((height, width), np.int32)
        self._room = np.empty((6, 0))

    @property
    def face(self) -> NDArray:
        """Triangle (H, W) int32 of every pixel of the last image, -1 for the background."""
        return self._face

    def draw(
        self, vertices_camera: ArrayLike, faces: ArrayLike, lens: ArrayLike, *, near: float = MIN_Z, cull: bool = False
    ) -> Raster:
        """Render vertices (V, 3) [m] and faces (T, 3) into this canvas; see `rasterise`."""
        return self._draw(vertices_camera, _IDENTITY, faces, np.append(lens, near), cull, None)

    def draw_for(
        self, camera: Camera, vertices_world: ArrayLike, faces: ArrayLike, *, cull: bool = False,
        labels: NDArray | None = None,
    ) -> Raster:
        """Render vertices (V, 3) [m] of the world and faces (T, 3) in a camera of this canvas's size."""
        lens = np.append(lens_of(camera), MIN_Z)
        if _is_straight(camera):
            return self._draw(vertices_world, camera.T_camera_world, faces, lens, cull, labels)
        return self._draw(in_camera(camera, vertices_world), _IDENTITY, faces, lens, cull, labels)

    def _draw(
        self, vertices: ArrayLike, T_camera_frame: NDArray, faces: ArrayLike, lens: NDArray, cull: bool,
        labels: NDArray | None,
    ) -> Raster:
        if not np.isfinite(lens).all() or min(lens[0], lens[1], lens[4]) <= 0.0:
            raise ObservationError(f"a lens of {lens} (fx, fy, cx, cy, near)", remedy="fx, fy and near are positive.")
        x, f = shaped(vertices, ("V", 3), "vertices"), np.ascontiguousarray(faces)
        check_shape(f, ("T", 3), "faces")
        if self._room.shape[1] < len(x):
            self._room = np.empty((6, len(x)))
        inputs = [array.view() for array in (x, T_camera_frame, f.astype(np.int32, copy=False))]
        for array in inputs:  # one type for the compiler, read-only or not
            array.flags.writeable = False
        status = kernels.rasterise(*inputs, *lens, bool(cull), self._room, self._depth, self._face)
        if status == kernels.NOT_FINITE:
            problem = "vertices to render are not finite"
            raise ObservationError(problem, remedy="Remove states that are not finite.")
        if status == kernels.NO_VERTEX:
            raise ObservationError("faces with vertex numbers out of range", remedy="Count vertices from 0.")
        return Raster(self._depth, self._face, labels)


def rasterise(
    vertices_camera: ArrayLike, faces: ArrayLike, lens: ArrayLike, size: tuple[int, int], *, near: float = MIN_Z,
    cull: bool = False,
) -> Raster:  # fmt: skip
    """Render triangles in a pinhole camera: depth and triangle of every pixel.

    Parameters
    ----------
    vertices_camera : (V, 3) [m]
        In the camera's frame: x right, y down, z along the optical axis.
    faces : (T, 3) int
    lens : (4,) [px]
        Focal lengths fx, fy and principal point cx, cy; the centre of the first pixel is (0, 0).
    size : (width, height) [px]
    near : float [m]
        Nothing nearer is rendered.
    cull : bool
        Whether to skip triangles seen from behind (clockwise corners): half the work for closed surfaces.

    Raises
    ------
    ObservationError
        Vertices that are not finite, indices out of range, an invalid size or lens.
    """
    return Canvas(size).draw(vertices_camera, faces, lens, near=near, cull=cull)


def lens_of(camera: Camera) -> NDArray:
    """Focal lengths fx, fy and principal point cx, cy (4,) [px] of a camera."""
    return camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]


def render_body(
    body: Body, state: BodyState, camera: Camera, *, mesh: BodyMesh | None = None, scale: float = 1.0,
    canvas: Canvas | None = None,
) -> Raster:
    """Render a body in a camera: depth, triangle and segment of every pixel.

    Parameters
    ----------
    mesh : BodyMesh, optional
        Of the body, to reuse it; default: `body_mesh(body)`.
    scale : float
        Of the image: 0.25 renders it at a quarter of its width and height.
    canvas : Canvas, optional
        To reuse, of the scaled image's size; the next call with it overwrites the raster.

    Returns
    -------
    Raster
        `segment` is the segment of every pixel.

    Raises
    ------
    ObservationError
        A scale that leaves no pixel, or a canvas of another size.
    """
    mesh = body_mesh(body) if mesh is None else mesh
    camera = scaled(camera, scale)
    canvas = Canvas(camera.size) if canvas is None else canvas
    if canvas.size != camera.size:
        raise ObservationError(
            f"a canvas of {canvas.size} for an image of {camera.size} pixels", remedy="Make one of the image's size."
        )
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    return canvas.draw_for(camera, mesh.posed(frames), mesh.faces, cull=True, labels=mesh.face_segment)


@lru_cache(maxsize=32)
def scaled(camera: Camera, scale: float) -> Camera:
    """The camera with its image's width and height multiplied by a number `scale`, rounded to whole pixels.

    Cached, so that the scaled camera keeps its tables. Raises an ObservationError for a scale that is not positive.
    """
    if not 0.0 < scale < np.inf:
        raise ObservationError(f"an image scaled by {scale}", remedy="Give a positive number.")
    if scale == 1.0:
        return camera
    width, height = (max(1, round(scale * n)) for n in camera.size)
    return camera.scaled((width, height))


def in_camera(camera: Camera, x_world: ArrayLike) -> NDArray:
    """Transform points (N, 3) [m] of the world to where a pinhole with the camera's K has the same pixel and depth.

    Without distortion and skew these are the points in the camera's frame. Otherwise x and y are changed at the same z;
    points that do not project are not changed.
    """
    R, t = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
    x_world = np.asarray(x_world, float)
    x = x_world @ R.T + t
    K = camera.matrix
    if _is_straight(camera):
        return x
    uv = camera.project(x_world)
    ok = (x[:, 2] > 0.0) & np.isfinite(uv).all(axis=1)
    x[ok, 0] = (uv[ok, 0] - K[0, 2]) / K[0, 0] * x[ok, 2]
    x[ok, 1] = (uv[ok, 1] - K[1, 2]) / K[1, 1] * x[ok, 2]
    return x


def _is_straight(camera: Camera) -> bool:
    """Whether a camera is a pinhole without distortion and skew."""
    return camera.model == "radtan" and camera.matrix[0, 1] == 0.0 and not camera.distortion.any()


def subdivided(vertices: NDArray, faces: NDArray, longest: float) -> tuple[NDArray, NDArray]:
    """Subdivide triangles (V, 3) [m], (T, 3) by four until no edge is longer than `longest` [m]: (V', 3), (T', 3).

    All are divided equally, so that neighbours share whole edges.
    """
    while True:
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        if np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).max() <= longest:
            return vertices, faces
        pairs, place = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
        a, b, c = place.reshape(3, -1) + len(vertices)
        i, j, k = faces.T
        vertices = np.concatenate([vertices, 0.5 * (vertices[pairs[:, 0]] + vertices[pairs[:, 1]])])
        corners = [(i, a, c), (a, j, b), (c, b, k), (a, b, c)]
        faces = np.concatenate([np.stack(triple, axis=1) for triple in corners])
