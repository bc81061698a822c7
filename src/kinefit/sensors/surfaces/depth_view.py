"""Depth images as seen: rendered bodies beside what was measured, and the background that a sensor learns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.sensors.surfaces import _kernels_depth_view as kernels

_CLOUD_FOCAL_PX = 300.0  # of the virtual camera that renders a cloud
_MAX_NEIGHBOUR_DISTANCE = 0.10  # [m] of adjacent pixels of one surface: less than from an arm to the trunk behind it
UNMEASURED_TRUST = 0.5  # that a pixel without a measurement is empty: background out of range, or a hole


class DepthSeen(NamedTuple):
    """A depth image for occlusion tests of other sensors: (H, W) [m], its camera, its standard deviation [m]."""

    depth: NDArray
    camera: Camera
    sigma: float


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth image cut to one person and downsampled.

    Parameters
    ----------
    T_view_world : (4, 4) [m]
    lens : (4,) [px] fx, fy, cx, cy of the small image, without distortion.
    observed : (h, w) float32 [m] depth of the person, 0 elsewhere.
    behind : (h, w) float32 [m] depth of other objects, inf where nothing was measured.
    trust : (h, w) float32 in 0..1, confidence that the person is not at a pixel where it was not observed: 1 where
        another object was measured, 0 outside the sensor's image.
    points : (h, w, 3) [m] in the world, 0 where the person was not observed.
    """

    T_view_world: NDArray
    lens: NDArray
    observed: NDArray
    behind: NDArray
    trust: NDArray
    points: NDArray

    @property
    def seen(self) -> NDArray:
        """(h, w) bool: pixels at which the person was observed."""
        return self.observed > 0

    @property
    def cloud(self) -> NDArray:
        """(N, 3) [m] the person's points in the world."""
        return self.points[self.seen]

    @property
    def viewpoint(self) -> NDArray:
        """(3,) [m] the sensor in the world."""
        return -self.T_view_world[:3, :3].T @ self.T_view_world[:3, 3]

    @property
    def thickness(self) -> NDArray:
        """(h, w) [m] distance of every pixel of the person to the contour."""
        inside = cv2.distanceTransform(self.seen.astype(np.uint8), cv2.DIST_L2, 3)
        return inside * self.observed / self.lens[0]


def view_of(
    depth: NDArray, person: NDArray, camera: Camera, *, pixels: int = 72, width: float = 0.022, margin: float = 0.3
) -> DepthView:
    """The part of a depth image around a person, downsampled.

    Parameters
    ----------
    depth : (H, W) [m], 0 where nothing was measured
    person : (H, W) bool
    camera : Camera of the depth image
    pixels : int, longer side of the view without its margin, at most
    width : float [m] of a pixel, at least: a wrist is two wide
    margin : float
        Added on every side, as a share of the longer side: room to search for an occluded limb.
    """
    rays = camera.ray_table[:, person & (depth > 0)]
    low, high = np.nanmin(rays, axis=1), np.nanmax(rays, axis=1)
    longer = max(float((high - low).max()), 1e-3)
    low, high = low - margin * longer, high + margin * longer
    focal = min(pixels / longer, float(np.median(depth[person & (depth > 0)])) / width)
    w, h = (np.ceil(focal * (high - low)).astype(int) + 1).tolist()
    lens = np.array([focal, focal, -focal * low[0], -focal * low[1]])
    i, j = np.mgrid[0:h, 0:w]
    x_view = np.stack([(j - lens[2]) / focal, (i - lens[3]) / focal, np.ones((h, w))], axis=-1)
    uv = camera.project(x_view @ camera.T_world_camera[:3, :3].T + camera.centre_world)
    inside = np.isfinite(uv).all(axis=-1)
    column, row = (np.rint(np.where(inside, uv[..., k], -1.0)).astype(int) for k in (0, 1))
    inside &= (column >= 0) & (column < camera.size[0]) & (row >= 0) & (row < camera.size[1])
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    measured = np.where(inside, depth[row, column], 0.0)
    own = person[row, column] & (measured > 0)
    observed = np.where(own, measured, 0.0)
    behind = np.where(~own & (measured > 0), measured, np.inf)
    trust = np.where(inside, np.where(measured > 0, 1.0, UNMEASURED_TRUST), 0.0)
    x = x_view * observed[..., None]
    points = np.where(own[..., None], x @ camera.T_world_camera[:3, :3].T + camera.centre_world, 0.0)
    observed, behind, trust = (np.ascontiguousarray(a, np.float32) for a in (observed, behind, trust))
    return DepthView(np.array(camera.T_camera_world), lens, observed, behind, trust, np.ascontiguousarray(points))


def splat(points: NDArray, camera: Camera) -> tuple[NDArray, Camera]:
    """A depth image (h, w) [m] of a cloud (N, 3) [m] in the world, coarse enough to have no holes.

    Returns it with its downsampled camera.
    """
    x = points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    uv = camera.project(points)
    ok = np.isfinite(uv).all(axis=1) & (x[:, 2] > 0)
    extent = np.ptp(uv[ok], axis=0) if ok.any() else np.ones(2)
    # two to three points a pixel of the box that the cloud fills by a third or so
    factor = min(1.0, float(np.sqrt(max(ok.sum(), 1) / max(extent.prod(), 1.0))))
    size = max(int(camera.size[0] * factor), 8), max(int(camera.size[1] * factor), 8)
    small = camera.scaled(size)
    uv = np.rint(small.project(points[ok])).astype(int)
    inside = (uv >= 0).all(axis=1) & (uv < size).all(axis=1)
    depth = np.full((size[1], size[0]), np.inf)
    np.minimum.at(depth, (uv[inside, 1], uv[inside, 0]), x[ok][inside, 2])
    return np.where(np.isfinite(depth), depth, 0.0), small


def geodesic_ends(view: DepthView, centre: NDArray, *, count: int = 7, least: float = 0.15) -> NDArray:
    """(E, 3) [m] ends of the limbs: the points farthest from `centre` (3,) along the surface, one after the other.

    Accumulative geodesic extrema (Plagemann et al., ICRA 2010): every end found becomes a source itself. Parts that
    holes cut off are joined over the narrowest gap. An end needs a geodesic distance of `least` [m] to the others.
    """
    seen, points = view.seen, view.points
    if not seen.any():
        return np.empty((0, 3))
    distance = np.full(seen.shape, np.inf)
    away = np.where(seen, np.linalg.norm(points - centre, axis=-1), np.inf)
    distance[np.unravel_index(np.argmin(away), seen.shape)] = 0.0
    kernels.spread(points, seen, _MAX_NEIGHBOUR_DISTANCE, distance)
    _bridge(points, seen, distance)
    ends: list[NDArray] = []
    while len(ends) < count:
        far = np.where(seen & np.isfinite(distance), distance, -1.0)
        at = np.unravel_index(np.argmax(far), seen.shape)
        if far[at] < least:
            break
        ends.append(points[at])
        distance[at] = 0.0
        kernels.spread(points, seen, _MAX_NEIGHBOUR_DISTANCE, distance)
    return np.array(ends).reshape(-1, 3)


def _bridge(points: NDArray, seen: NDArray, distance: NDArray) -> None:
    """Extend geodesic distances (h, w) to disconnected parts, in a straight line over the narrowest gap."""
    for _ in range(8):
        inside, outside = np.nonzero(seen & np.isfinite(distance)), np.nonzero(seen & ~np.isfinite(distance))
        if not len(outside[0]):
            return
        a, b = points[inside], points[outside]
        a_some = a[:: max(len(a) // 400, 1)]
        gaps = np.linalg.norm(b[:, None] - a_some[None], axis=-1)
        k, m = np.unravel_index(np.argmin(gaps), gaps.shape)
        start = distance[inside][:: max(len(a) // 400, 1)][m]
        distance[outside[0][k], outside[1][k]] = start + gaps[k, m]
        kernels.spread(points, seen, _MAX_NEIGHBOUR_DISTANCE, distance)


def outside(view: DepthView, x_world: NDArray) -> tuple[NDArray, NDArray]:
    """Distance of points (N, 3) [m] from the person's contour, (N,) [m] across the line of sight; negative inside it.

    And its confidence, (N,) in 0..1: 0 outside the sensor's image, behind other objects, and inside where the person is
    measured at another depth. The edge of the image and other objects in front of the person are no contour.
    """
    x = x_world @ view.T_view_world[:3, :3].T + view.T_view_world[:3, 3]
    z = np.maximum(x[:, 2], 1e-3)
    column, row = (np.rint(view.lens[k] * x[:, k] / z + view.lens[2 + k]).astype(int) for k in (0, 1))
    h, w = view.observed.shape
    inside = (x[:, 2] > 1e-3) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    empty = ~view.seen & (view.trust > 0.0) & (view.behind > np.median(view.observed[view.seen]))
    gap, depth = (cv2.distanceTransform(a.astype(np.uint8), cv2.DIST_L2, 3)[row, column] for a in (~view.seen, ~empty))
    trust = np.where(inside & (x[:, 2] < view.behind[row, column]), view.trust[row, column], 0.0)
    within = view.seen[row, column]
    agrees = inside & (np.abs(view.observed[row, column] - x[:, 2]) < _MAX_NEIGHBOUR_DISTANCE)
    # the contour runs half a pixel before the first pixel without the person
    distance = np.where(within, 0.5 - depth, np.maximum(gap - 0.5, 0.0)) * z / view.lens[0]
    return distance, np.where(within, agrees, trust)


def camera_at(x_world: NDArray, viewpoint: NDArray | None) -> Camera:
    """A virtual camera at a viewpoint (3,) [m], looking at points (N, 3) [m]; without one 3 m off along -z."""
    middle = np.median(x_world, axis=0)
    eye = middle - np.array((0.0, 0.0, 3.0)) if viewpoint is None else np.asarray(viewpoint, float)
    z = (middle - eye) / max(float(np.linalg.norm(middle - eye)), 1e-9)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    K = np.array([[_CLOUD_FOCAL_PX, 0, 319.5], [0, _CLOUD_FOCAL_PX, 319.5], [0, 0, 1.0]])
    return Camera("cloud", (640, 640), K, T_camera_world=se3.transform(R, -R @ eye))


_CELL_COLUMNS = 320  # finer cells cost more, and a wrist at 3 m is four wide
_OUTLIER_SIGMAS = 3.0  # beyond which a depth is a new object's
_BODY_MARGIN_PX = 2  # of the rendered body (at most 160 columns) by which it may be off the measured one
_ROW_INTERLEAVE = 4  # each image teaches every fourth row of cells


class Background:
    """The background of one static depth camera.

    In the first image everything but the body is background. Later a new object away from the body is background at
    once; near it (a table that the person walks up to, an object put down) after `wait` images in which no part of the
    body is there. A depth behind the known background shows that an object has gone.

    Parameters
    ----------
    camera : Camera of the depth images
    sigma : float [m] standard deviation of a depth at the body; it grows with the depth squared.
    wait : int, images
    """

    state_attributes = ("_mean", "_spread", "_count", "_waiting", "_bound", "_variance", "_empty", "_turn")

    def __init__(self, camera: Camera, sigma: float, wait: int) -> None:
        self.camera, self.wait, self._sigma = camera, wait, sigma
        width, height = camera.size
        self._cell = max(width // _CELL_COLUMNS, 1)
        shape = -(-height // self._cell), -(-width // self._cell)
        self._mean, self._spread, self._count, self._waiting = np.zeros((4, *shape))
        self._bound = np.full(shape, np.inf)
        self._variance: NDArray | None = None
        self._empty, self._turn = True, 0

    def learn(self, depth: NDArray, shown: NDArray, box: tuple[NDArray, NDArray], sure: bool) -> None:
        """Learn from an image (H, W) [m] after the body has been fitted to it.

        Parameters
        ----------
        shown : (h, w) [m] the body's rendered depth, inf outside.
        box : (3,), (3,) [m] corners of the box that the body may be in.
        sure : bool
            Whether no segment is lost: only then objects near the body are learnt.
        """
        seen = np.isfinite(shown)
        if self._variance is None:
            self._variance = self._prior_variance(float(np.median(shown[seen])) if seen.any() else 2.0)
        if self._empty and not sure:
            return
        about = cv2.dilate(seen.astype(np.uint8), np.ones((2 * _BODY_MARGIN_PX + 1,) * 2, np.uint8))
        kernels.learn(
            depth, self.camera.ray_table, self.camera.packed, *box, about, self._cell,
            *((0, 1) if self._empty else (self._turn, _ROW_INTERLEAVE)), self._variance, _OUTLIER_SIGMAS**2,
            1 if self._empty else max(self.wait // _ROW_INTERLEAVE, 1), sure,
            self._mean, self._spread, self._count, self._waiting, self._bound,
        )  # fmt: skip
        self._empty, self._turn = False, (self._turn + 1) % _ROW_INTERLEAVE

    def know(self, depth: NDArray) -> None:
        """Set the background from an image (H, W) [m] of the empty scene; 0 where it is unknown."""
        z = np.asarray(depth, float)[:: self._cell, :: self._cell]
        known = z > 0.0
        if self._variance is None:
            self._variance = self._prior_variance(float(np.median(z[known])) if known.any() else 2.0)
        self._mean[known], self._count[known] = z[known], 4.0  # as much weight as four images
        self._spread[:] = self._variance[0] + self._variance[1] * z**4
        self._bound[known] = (z - _OUTLIER_SIGMAS * np.sqrt(self._spread))[known]
        self._empty = False

    def _prior_variance(self, at: float) -> NDArray:
        """(2,) a, b of the variance a + b z⁴ that is sigma² at a depth [m]."""
        return np.array((0.25, 0.75 / at**4)) * self._sigma**2

    def marked(self, depth: NDArray, first: tuple[int, int], last: tuple[int, int]) -> NDArray:
        """A copy of an image (H, W) [m], negative at background pixels within first..last (row, column)."""
        out = np.array(depth, np.float32)
        if not self._empty:
            low, high = ((a // self._cell, b // self._cell) for a, b in (first, (last[0] - 1, last[1] - 1)))
            end = high[0] + 1, high[1] + 1
            kernels.mark(out, self._bound, self._cell, low, end)
        return out
