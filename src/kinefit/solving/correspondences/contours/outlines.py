"""Contour to contour: rim points of the body towards the contour of its silhouette (P1 2.3).

Occluding contour of a body in a camera: rim points of its mesh, tested in a rendered image (P1 2.3).

A rim point lies on an edge between a triangle that faces the camera and one that does not. A rendered image with depth
and triangle of every pixel shows whether the point is visible, and whether another part of the body is behind it.

Rows of a body's skin points, which are blended between segments and moved by morphs (P1 2.4, 3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.bodies import Body, BodyState
from kinefit.bodies.morphs.morphing import MorphedPose
from kinefit.bodies.rendering import Canvas, Raster, lens_of
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.geometry.lines import line_along
from kinefit.solving.correspondences import _kernels
from kinefit.solving.correspondences.contours import _kernels_outlines as kernels
from kinefit.solving.rows import DofRows, Rows

_MAX_RIM_POINTS = 20000  # of one image
_MAX_DEPTH_STEP = 0.05  # [m] from a rim to the limb's surface one pixel inside of it, which may be nearer
_MIN_OCCLUSION_DEPTH = 0.03  # [m] behind the rim of a part that occludes another; less is a crease
_OTHER_BODY = -2  # in an image of triangles
_MARGIN_PX = 4.0  # of a window around the body
_WINDOW_STEP_PX = 32  # of window sizes, so that few canvases serve all windows


class Window(NamedTuple):
    """A part of a camera's image, rendered at another scale: its pixel i is at (i + 0.5) / scale - 0.5 + left.

    Parameters
    ----------
    left, top : float [px] of the camera's image
    size : (width, height) [px] of the window
    scale : float, window pixels for one pixel of the camera
    """

    left: float
    top: float
    size: tuple[int, int]
    scale: float

    @classmethod
    def about(cls, uv: NDArray, camera: Camera, longest: int) -> Window:
        """Window around points (N, 2) [px] of a camera's image, at most `longest` [px] wide plus a margin."""
        (left, top, right, bottom), (width, height) = kernels.bounds(uv), camera.size
        left, right = min(max(left, 0.0), width - 1.0), min(max(right, 0.0), width - 1.0)
        top, bottom = min(max(top, 0.0), height - 1.0), min(max(bottom, 0.0), height - 1.0)
        scale = min(longest / max(right - left, bottom - top, 1.0), 1.0)
        margin = math.ceil(_MARGIN_PX / scale)
        wide, high = ((n + 2 * margin + 1) * scale for n in (right - left, bottom - top))
        size = math.ceil(wide / _WINDOW_STEP_PX) * _WINDOW_STEP_PX, math.ceil(high / _WINDOW_STEP_PX) * _WINDOW_STEP_PX
        return cls(float(math.floor(left - margin)), float(math.floor(top - margin)), size, scale)

    def lens(self, camera: Camera) -> NDArray:
        """Focal lengths and principal point (4,) [px] of the window."""
        fx, fy, cx, cy = lens_of(camera)
        offset = cx - self.left + 0.5, cy - self.top + 0.5
        return np.array([fx, fy, *offset]) * self.scale - (0.0, 0.0, 0.5, 0.5)


class Triangles(Protocol):
    """A mesh whose faces have segments."""

    @property
    def faces(self) -> NDArray:
        """Faces (T, 3) int."""
        ...

    @property
    def face_segment(self) -> NDArray:
        """Segment of each face (T,) int."""
        ...


@dataclass(frozen=True, eq=False)
class Rim:
    """Occluding contour of a body in one camera, N points.

    Parameters
    ----------
    outline : (4, N) u, v [px] and the unit normal (a, b), pointing away from the body.
    vertices : (N, 2) int, ends of the mesh's edge that each point lies on.
    share : (N,) 0..1, weight of the second end.
    segment : (N,) int
    inner : (N,) bool, whether another part of the body is behind it, so that a silhouette does not show it.
    """

    outline: NDArray
    vertices: NDArray
    share: NDArray
    segment: NDArray
    inner: NDArray

    def __len__(self) -> int:
        return len(self.share)

    def on(self, vertices: NDArray) -> NDArray:
        """Rim points (N, 3) [m] on vertices (V, 3) [m] of the mesh, in the frame of these: the world, or at rest."""
        s = self.share[:, None]
        return np.asarray((1.0 - s) * vertices[self.vertices[:, 0]] + s * vertices[self.vertices[:, 1]])

    def chosen(self, which: NDArray) -> Rim:
        """The points selected by a mask or indices (k,)."""
        return Rim(
            np.ascontiguousarray(self.outline[:, which]), self.vertices[which], self.share[which], self.segment[which],
            self.inner[which],
        )  # fmt: skip


class RimFinder:
    """Finds the rims of one mesh repeatedly, with reused buffers and tables.

    Parameters
    ----------
    mesh : its faces (T, 3), outward counter-clockwise, with their segments (T,); vertices are given at every call.
    like : RimFinder of the same mesh, whose tables are shared; finders in parallel need buffers of their own.
    """

    def __init__(self, mesh: Triangles, like: RimFinder | None = None) -> None:
        if like is not None:
            self.__dict__["_edges"] = like._edges
        self.faces = np.ascontiguousarray(mesh.faces, np.int32)
        self.face_segment = np.ascontiguousarray(mesh.face_segment, np.int64)
        self._front = np.empty(len(self.faces), np.int8)
        self._out, self._place = np.empty((4, _MAX_RIM_POINTS)), np.empty((_MAX_RIM_POINTS, 2))
        self._kind = np.empty(_MAX_RIM_POINTS, np.int8)
        self._canvases: dict[tuple[int, int], Canvas] = {}
        self._last: tuple[Camera, NDArray, Raster, Window] | None = None
        #: the part of the image that was rendered last, shifted with the body since then
        self.window = Window(0.0, 0.0, (0, 0), 1.0)

    @cached_property
    def _edges(self) -> tuple[NDArray, NDArray]:
        """Edges (E, 2) and the faces (E, 2) on both sides, -1 for none."""
        ends = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=2).reshape(-1, 2)
        owner = np.repeat(np.arange(len(self.faces)), 3)
        order = np.lexsort((owner, ends.max(axis=1), ends.min(axis=1)))
        pairs, owner = np.sort(ends, axis=1)[order], owner[order]
        first = np.flatnonzero(np.any(np.diff(pairs, axis=0, prepend=-1), axis=1))
        second = np.append(first[1:], len(pairs)) - 1  # a third face on an edge is ignored
        other = np.where(second > first, owner[second], -1)
        return np.ascontiguousarray(pairs[first]), np.stack([owner[first], other], axis=1)

    def drawn(self, camera: Camera) -> NDArray:
        """Triangle (H, W) int32 of every pixel, -1 for none, as last rendered for a camera of this size."""
        return self._canvases[camera.size].face

    @property
    def face(self) -> NDArray:
        """Triangle (H, W) int32 of every pixel of the last rendered window, -1 for none."""
        assert self._last is not None
        return self._last[2].face

    @property
    def depth(self) -> NDArray:
        """Depth (H, W) float32 [m] along the optical axis, of the last rendered window, inf for none."""
        assert self._last is not None
        return self._last[2].depth

    def find(
        self, vertices_world: NDArray, camera: Camera, *, spacing: float = 3.0, inner: bool = True, stale: float = 0.0,
        close: int | None = None, others: Sequence[tuple[NDArray, NDArray]] = (),
    ) -> Rim:  # fmt: skip
        """Find rim points about `spacing` [px] apart, of the mesh's vertices (V, 3) [m] in the world.

        Parameters
        ----------
        vertices_world : (V, 3) [m]
        camera : Camera
        spacing : float [px]
        inner : bool, whether to include rims in front of other parts of the body, which silhouettes do not show.
        stale : float [px]
            The last rendered image of this camera is reused if no vertex has moved farther since; with `close`,
            relative to their common motion.
        close : int [px], optional
            Renders only the part of the image that contains the body, at most this wide; see `window`.
        others : vertices (W, 3) [m] in the world and faces (U, 3) of other bodies
            They occlude the body, it has no rim in front of them, and the rendered image has -2 for them.
        """
        x, uv = np.empty((len(vertices_world), 3)), np.empty((len(vertices_world), 2))
        kernels.seen(camera.packed, np.ascontiguousarray(vertices_world), x, uv)
        last, moved = self._last, np.inf
        if last is not None and last[0] is camera and stale > 0.0:
            du, dv, moved = kernels.shift(uv, last[1], close is not None)
        if last is not None and moved <= stale:
            drawn, w = last[2], last[3]._replace(left=last[3].left + du, top=last[3].top + dv)
            self.window = w
        else:
            w = Window(0.0, 0.0, camera.size, 1.0) if close is None else Window.about(uv, camera, close)
            if w.size not in self._canvases:
                self._canvases[w.size] = Canvas(w.size)
            canvas = self._canvases[w.size]
            lens = w.lens(camera)
            drawn = canvas.draw(x, self.faces, lens, cull=True)
            for vertices, faces in others:
                there = np.empty((len(vertices), 3))
                kernels.seen(camera.packed, np.ascontiguousarray(vertices), there, np.empty((len(vertices), 2)))
                other = Canvas(w.size).draw(there, np.ascontiguousarray(faces, np.int32), lens, cull=True)
                drawn.face[(other.face >= 0) & (other.depth < drawn.depth)] = _OTHER_BODY
            self._last = camera, uv, drawn, w
            self.window = w
        if close is not None:
            uv = (uv + (0.5 - w.left, 0.5 - w.top)) * w.scale - 0.5
        edges, sides = self._edges
        n = kernels.rims(
            x, uv, self.faces, self.face_segment, edges, sides, drawn.depth, drawn.face, spacing, _MAX_DEPTH_STEP,
            _MIN_OCCLUSION_DEPTH, inner, self._front, self._out, self._place, self._kind,
        )  # fmt: skip
        number = self._place[:n, 0].astype(np.int64)
        own = np.where(self._front[sides[number, 0]] == 1, sides[number, 0], sides[number, 1])
        outline = self._out[:, :n].copy()
        if close is not None:
            outline[:2] = (outline[:2] + 0.5) / w.scale - 0.5 + np.array([[w.left], [w.top]])
        return Rim(
            outline, edges[number].astype(np.int64), self._place[:n, 1].copy(), self.face_segment[own],
            self._kind[:n] == kernels.INNER,
        )  # fmt: skip


def outline_pairs(
    rim: NDArray, image: NDArray, *, reach: float, angle: float = 1.0, both: bool = True
) -> tuple[NDArray, NDArray]:
    """Match two contours (4, N) and (4, M): indices (K,) of the points in the first and in the second.

    Each point of the body's rim is matched to the nearest point of the image's contour with a similar normal. With
    `both`, each point of the image's contour is matched to the rim too, which pulls the body to unexplained parts of
    the silhouette.

    Parameters
    ----------
    rim : (4, N) u, v [px] and unit normal of the body's contour.
    image : (4, M) the same of the silhouette's contour.
    reach : float [px], largest distance of a pair.
    angle : float [rad], largest angle between two normals.
    both : bool
    """
    to_image = np.empty(rim.shape[1], np.int64)
    to_model = np.empty((2, image.shape[1]))
    kernels.match(rim, image, reach, np.cos(angle), to_image, to_model)
    first = np.flatnonzero(to_image >= 0)
    pairs = [(first, to_image[first])]
    if both:
        second = np.flatnonzero(to_model[0] >= 0)
        pairs.append((to_model[0, second].astype(np.int64), second))
    i, k = (np.concatenate(side) for side in zip(*pairs))
    return i, k


def outline_rows(
    body: Body,
    state: BodyState,
    rim: Rim,
    vertices_world: NDArray,
    camera: Camera,
    image: NDArray,
    *,
    sigma: float = 2.0,
    by: str = "pixels",
) -> Rows:
    """Rows that pull the rim of a body onto the contour of its silhouette.

    By "pixels", one row for each pair: the rim point's pixel should lie on the tangent of the contour, along which it
    may slide. By "rays", two rows for each pair: the rim point should lie on the ray of the contour's point (P1's
    constraint). The `group` of a row is the index of its pair. `outline_pairs` finds pairs.

    Parameters
    ----------
    rim : Rim of the body at this state in this camera, N points.
    vertices_world : (V, 3) [m] of the mesh at this state.
    camera : Camera, of the image's size.
    image : (4, N) the matched point of the silhouette's contour for each: u, v [px], normal.
    sigma : float [px] standard deviation of a pair.
    by : "pixels" or "rays"

    Raises
    ------
    ObservationError
        Another `by`, or a sigma that is not positive.
    """
    if by not in ("pixels", "rays"):
        raise ObservationError(f"rows by '{by}'", remedy='Write by="pixels" or by="rays".')
    if not sigma > 0:
        raise ObservationError(f"a standard deviation of {sigma} px", remedy="Give a positive number of pixels.")
    count = len(rim)
    data, segment, group = _kernels.buffers(2 * count)
    if by == "pixels":
        used = kernels.tangent_rows(
            camera.packed, np.ascontiguousarray(vertices_world), rim.vertices, rim.share, rim.segment,
            np.ascontiguousarray(image), 1.0 / sigma**2, data, segment, group,
        )  # fmt: skip
        return Rows(np.ascontiguousarray(data[:, :used]), segment[:used], group[:used])
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    f, points = frames[rim.segment], rim.on(vertices_world)
    rest = np.ascontiguousarray(np.einsum("nij,ni->nj", f[:, :9].reshape(-1, 3, 3), points - f[:, 9:]))
    rays = line_along(camera.centre_world, camera.ray(image[:2].T))
    focal = np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
    depth = points @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    weight = np.where(depth > 0.0, (focal / (depth * sigma)) ** 2, 0.0)
    used = _kernels.ray_rows(frames, rim.segment, rest, rays, weight, data, segment, group, 0)
    return Rows(np.ascontiguousarray(data[:, :used]), segment[:used], group[:used])


def morphed_rows(
    pose: MorphedPose,
    index: ArrayLike,
    direction: ArrayLike,
    residual: ArrayLike,
    *,
    share: ArrayLike | None = None,
    sigma: ArrayLike = 0.01,
) -> Rows | DofRows:
    """One row for each skin point, r ≈ n·∂x/∂δ δ, with the derivative of morphs.

    Returns plain `Rows`, which are faster, if every node has one owner and nothing morphs.

    Parameters
    ----------
    pose : MorphedPose, of `Morphing(body).pose(state)`.
    index : (K,) int, nodes of the mesh; or (K, C), the nodes that each point lies between, such as a face's corners.
    direction : (K, 3) unit, in the world.
    residual : (K,) [m] how much further along it each point should lie; NaN for none.
    share : (K, C) barycentric coordinates.
    sigma : scalar or (K,) [m]

    Raises
    ------
    ObservationError
        Arrays of other shapes, or a sigma that is not positive.
    """
    chosen = np.asarray(index, np.int64)
    chosen = chosen[:, None] if chosen.ndim == 1 else chosen
    n, r = shaped(direction, (len(chosen), 3), "directions"), shaped(residual, (len(chosen),), "residuals")
    deviation = np.broadcast_to(np.asarray(sigma, float), r.shape)
    if not np.all(deviation > 0):
        raise ObservationError("a standard deviation that is not positive", remedy="Give metres above 0.")
    part = np.ones(chosen.shape) if share is None else np.asarray(share, float)
    known = np.isfinite(r) & np.isfinite(n).all(1)
    ids, weight = np.flatnonzero(known), 1.0 / deviation[known] ** 2
    if len(ids) < len(r):
        chosen, n, r, part = chosen[ids], n[ids], r[ids], part[ids]
    skin = pose.morphing.skin
    if pose.morphing.is_rigid and (skin.owners[chosen, 0] == skin.owners[chosen[:, :1], 0]).all():
        x = np.einsum("kc,kci->ki", part, pose.vertices[chosen])
        return Rows.of(skin.owners[chosen[:, 0], 0], x, n, r, weight, ids)
    owner = skin.owners[chosen].astype(np.int64)  # (K, C, owners of a node)
    segment = owner[:, 0, 0] if (owner == owner[:, :1, :1]).all() else None
    return DofRows(cache(lambda: pose.along(chosen, n, part)), r, weight, ids, segment=segment)


def on_moved_joints(pose: MorphedPose, rows: Rows) -> DofRows:
    """Convert rows of points on segments, made with `pose.frames`, to rows with the derivative of moving joints."""
    arm = rows.point - pose.state.T_world_root[:3, 3]
    a = np.concatenate([rows.direction, np.cross(arm, rows.direction)], axis=1)
    J = np.empty((len(rows), pose.morphing.body.tree.n_dofs))
    for s in np.unique(rows.segment):
        of = rows.segment == s
        J[of] = a[of] @ pose.segment_jacobian(int(s))
    return DofRows(J, rows.residual, rows.weight, rows.group, rows.loss, rows.segment)


def morphed_outline_rows(
    pose: MorphedPose,
    rim: Rim,
    camera: Camera,
    image: NDArray,
    *,
    sigma: float = 2.0,
) -> Rows | DofRows:
    """Rows as of `outline_rows` by pixels, for a skin that is blended or morphs.

    Parameters
    ----------
    pose : MorphedPose
    rim : Rim of `pose.vertices` in this camera, N points.
    camera : Camera
    image : (4, N) the matched point of the silhouette's contour for each: u, v [px], normal.
    sigma : float [px] standard deviation of a pair.

    Raises
    ------
    ObservationError
        A sigma that is not positive.
    """
    if not sigma > 0:
        raise ObservationError(f"a standard deviation of {sigma} px", remedy="Give a positive number of pixels.")
    n, away, size = toward_tangents(rim.on(pose.vertices), camera, image)
    share = np.stack([1.0 - rim.share, rim.share], axis=1)
    return morphed_rows(pose, rim.vertices, n, away, share=share, sigma=sigma / size)


def toward_tangents(x_world: NDArray, camera: Camera, image: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Displacement of points (N, 3) [m] that moves their pixels to the tangents of a contour (4, N).

    Returns
    -------
    direction : (N, 3) unit, in the world, along which the pixel moves fastest across the tangent.
    residual : (N,) [m] distance along it; size : (N,) [px/m] speed of the pixel.
    """
    u, v, a, b = image
    pixel, J = camera.project_with_jacobian(x_world)
    slope = a[:, None] * J[:, 0] + b[:, None] * J[:, 1]
    size = np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
    return slope / size[:, None], (a * (u - pixel[:, 0]) + b * (v - pixel[:, 1])) / size, size
