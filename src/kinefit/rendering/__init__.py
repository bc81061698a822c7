"""What a camera would see of triangles: depth and which triangle, for every pixel.

A z-buffer: every triangle is drawn row by row, the nearer one stays. Depth is z along the optical axis, exact at the
pixel's centre (1/z is linear in the image). Triangles that cross the near plane are cut there; neighbouring triangles
leave no gap. Lenses bend corners, not edges: with distortion an edge is the chord of its bent image, so large triangles
should be divided (`subdivided`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import check_shape, shaped
from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces.triangles import BodyMesh, body_mesh
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.rendering import _kernels as kernels

NEAR = 0.05  # [m] nothing closer is drawn; nearer than any sensor measures, far enough for 1/z to stay small

_IDENTITY = np.eye(4)
_IDENTITY.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Raster:
    """What a camera sees.

    Parameters
    ----------
    depth : (H, W) float32 [m]
        Along the optical axis; inf where nothing is.
    face : (H, W) int32
        Index of the triangle seen; -1 where nothing is.
    labels : (T,) int, optional
        A label of every triangle: for a body its segment.
    """

    depth: NDArray
    face: NDArray
    labels: NDArray | None = None

    @cached_property
    def segment(self) -> NDArray:
        """(H, W) int16 label of the triangle seen; -1 where nothing is."""
        if self.labels is None:
            raise ObservationError("the triangles drawn have no labels", remedy="Use render_body, or give labels.")
        return np.append(self.labels, -1).astype(np.int16)[self.face]

    @property
    def seen(self) -> NDArray:
        """(H, W) bool, something is there."""
        return self.face >= 0


class Canvas:
    """Room for drawing one image after another of the same size without making new arrays.

    What `draw` returns is overwritten by the next call; copy what must last.

    Parameters
    ----------
    size : (width, height) [px]
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
        """(H, W) int32, the triangles drawn last."""
        return self._face

    def draw(
        self, vertices_camera: ArrayLike, faces: ArrayLike, lens: ArrayLike, *, near: float = NEAR, cull: bool = False
    ) -> Raster:
        """As `rasterise`, into this canvas."""
        return self._draw(vertices_camera, _IDENTITY, faces, np.append(lens, near), cull, None)

    def draw_for(
        self, camera: Camera, vertices_world: ArrayLike, faces: ArrayLike, *, cull: bool = False,
        labels: NDArray | None = None,
    ) -> Raster:
        """Draw triangles of the world (V, 3) [m] as `camera`, of this canvas' size, sees them."""
        lens = np.append(lens_of(camera), NEAR)
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
        given = [array.view() for array in (x, T_camera_frame, f.astype(np.int32, copy=False))]
        for array in given:  # read-only or not, they are of one type to the compiler
            array.flags.writeable = False
        told = kernels.rasterise(*given, *lens, bool(cull), self._room, self._depth, self._face)
        if told == kernels.NOT_FINITE:
            problem = "vertices to be drawn are not finite"
            raise ObservationError(problem, remedy="Leave out states that are not finite.")
        if told == kernels.NO_VERTEX:
            raise ObservationError("faces of vertices that are not there", remedy="Count vertices from 0.")
        return Raster(self._depth, self._face, labels)


def rasterise(
    vertices_camera: ArrayLike, faces: ArrayLike, lens: ArrayLike, size: tuple[int, int], *, near: float = NEAR,
    cull: bool = False,
) -> Raster:  # fmt: skip
    """Depth and triangle seen by a pinhole camera.

    Parameters
    ----------
    vertices_camera : (V, 3) [m]
        In the camera's frame: x right, y down, z along the optical axis.
    faces : (T, 3) int
    lens : (4,) [px]
        Focal lengths fx, fy and principal point cx, cy; the centre of the first pixel is (0, 0).
    size : (width, height) [px]
    near : float [m]
        Nothing nearer than this is drawn.
    cull : bool
        Leave out triangles seen from behind (their corners clockwise): half the work for closed surfaces.

    Raises
    ------
    ObservationError
        Vertices that are not finite, faces of vertices that are not there, a size or lens that cannot be.
    """
    return Canvas(size).draw(vertices_camera, faces, lens, near=near, cull=cull)


def lens_of(camera: Camera) -> NDArray:
    """(4,) [px] focal lengths fx, fy and principal point cx, cy of a camera."""
    return camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]


def render_body(
    body: Body, state: BodyState, camera: Camera, *, mesh: BodyMesh | None = None, scale: float = 1.0,
    canvas: Canvas | None = None,
) -> Raster:
    """Depth, triangle and segment of a body as a camera sees it.

    Parameters
    ----------
    mesh : BodyMesh, optional
        Of the body, made once; default: `body_mesh(body)`.
    scale : float
        Of the image: 0.25 draws it at a quarter of its width and height.
    canvas : Canvas, optional
        Reused, of the scaled image's size; the raster is then overwritten by the next call with it.

    Returns
    -------
    Raster
        `segment` tells the segment of every pixel.

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
    """The same camera with an image `scale` times as wide and high, rounded to whole pixels.

    Asked again for the same camera it gives the same one, which keeps its tables.
    """
    if not 0.0 < scale < np.inf:
        raise ObservationError(f"an image scaled by {scale}", remedy="Give a positive number.")
    if scale == 1.0:
        return camera
    width, height = (max(1, round(scale * n)) for n in camera.size)
    return camera.scaled((width, height))


def in_camera(camera: Camera, x_world: ArrayLike) -> NDArray:
    """Points (N, 3) [m] of the world where a pinhole with the camera's K would see them in the same pixel and depth.

    Without distortion and skew these are the points in the camera's frame. With them x and y are moved at the same z;
    points that no ray reaches, or behind the camera, stay where they are.
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
    """A pinhole, without distortion and skew."""
    return camera.model == "radtan" and camera.matrix[0, 1] == 0.0 and not camera.distortion.any()


def subdivided(vertices: NDArray, faces: NDArray, longest: float) -> tuple[NDArray, NDArray]:
    """Triangles cut in four until no edge is longer than `longest` [m]: vertices (V', 3), faces (T', 3).

    All are cut alike, so that neighbours keep meeting in whole edges.
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
