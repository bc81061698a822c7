"""Segment people in a depth image: subtract the background and the floor, then cluster the remaining points."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images.depth import _image, to_points

# Visible area and extent of a person: head and shoulders alone are about 0.1 m² and 0.4 m tall, a standing adult 0.5 to
# 0.8 m² and up to 2.1 m, 2.6 m with an arm stretched upwards.
_AREA_RANGE = (0.06, 2.0)  # [m²]
_EXTENT_RANGE = (0.3, 2.6)  # [m]
_MIN_PIXELS = 150  # a person 10 m from a camera of 160 x 124 pixels (43 degrees wide) has 200
_MAX_CLUSTERS = 40  # more are noise, as of an image that is far away all over
_BORDER_SHARE = 0.01  # of the image's side, along its edges: there many sensors measure nothing
_MAX_GAP = 0.12  # [m] within a cluster: shadows separate limbs from the body by some centimetres
_MIN_FLOOR_SIGMA = 0.2  # [m] along its narrow side: a metre of floor has 0.3, a slice through a person 0.1
_FLOOR_SAMPLES = 20000  # of three points: a floor of 8 % of the points is missed by (1 - 0.08^3)^20000 = 0.004 %
_MAX_FLOOR_PLANES = 1000  # level planes that are compared


def background_model(images: Iterable[NDArray], *, share: float = 0.2, seen: float = 0.1) -> NDArray:
    """Estimate the depth of the empty scene, from images of it or from a take in which the person moves.

    The background of a pixel is its farthest stable depth.

    Parameters
    ----------
    images : of (H, W) [m], 0 where nothing was measured
    share : float in 0..1
        Share of a pixel's measurements that must lie at least as far away: 0.5 (the median) for an empty scene, less
        if the person occludes a pixel for most of the take.
    seen : float in 0..1
        Share of the images in which a pixel must be measured.

    Returns
    -------
    (H, W) float32 [m], 0 where the background is unknown

    Raises
    ------
    ObservationError
        No images, or images of different sizes.
    """
    stack = [_image(image) for image in images]
    if not stack or len({image.shape for image in stack}) > 1:
        raise ObservationError(
            f"a background from images of shapes {sorted({i.shape for i in stack})}", remedy="Give images of one size."
        )
    z = np.stack(stack)
    z[~((z > 0.0) & (z < np.inf))] = np.inf
    z.sort(axis=0)
    count = np.isfinite(z).sum(axis=0)
    place = np.clip(np.ceil(count * (1.0 - share)).astype(int) - 1, 0, None)
    far = np.take_along_axis(z, place[None], axis=0)[0]
    return np.where(count >= max(seen * len(z), 1.0), far, 0.0).astype(np.float32)


def foreground(depth: NDArray, background: NDArray, *, margin: float = 0.03, growth: float = 0.006) -> NDArray:
    """Subtract the background: (H, W) bool, pixels nearer than it by more than `margin` [m] + `growth` [1/m] · depth².

    The noise of stereo and structured light grows with the square of the depth: 1.4 mm/m² for the first Kinect
    (Khoshelham 2012). The default is four standard deviations of that. Where the background is unknown, every measured
    pixel is foreground.

    Raises
    ------
    ObservationError
        Image and background differ in size.
    """
    depth, background = _image(depth), _image(background)
    if depth.shape != background.shape:
        raise ObservationError(f"a background {background.shape} for a depth image {depth.shape}")
    return (depth > 0.0) & ((background <= 0.0) | (depth < background - margin - growth * background**2))


@dataclass(frozen=True)
class Floor:
    """A plane normal·x = height: normal (3,) upwards in the world, height [m], share 0..1 of the points on it."""

    normal: tuple[float, float, float]
    height: float
    share: float

    def above(self, x_world: NDArray) -> NDArray:
        """Heights (N,) [m] of points (N, 3) [m] above the floor."""
        return x_world @ np.array(self.normal) - self.height


def find_floor(
    x_world: NDArray, up: ArrayLike, *, tilt: float = math.radians(20), thickness: float = 0.03, least: float = 0.05,
    seed: int = 0,
) -> Floor | None:  # fmt: skip
    """Fit the floor to points by RANSAC: the nearly level plane with most points and almost none below it.

    Parameters
    ----------
    x_world : (N, 3) [m]
    up : (3,) approximately upwards in the world
    tilt : float [rad]
        Largest angle between normal and `up`: the uncertainty of the sensor's orientation.
    thickness : float [m]
        Points within this distance of the plane are inliers.
    least : float in 0..1
        Smallest share of all points that must be inliers.
    seed : int
        Of the random samples.

    Returns
    -------
    Floor, or None where no plane qualifies
    """
    x = np.asarray(x_world, float)
    direction = np.asarray(up, float) / np.linalg.norm(np.asarray(up, float))
    if len(x) < 100:
        return None
    rng = np.random.default_rng(seed)
    some = x[rng.choice(len(x), min(len(x), 2000), replace=False)]
    three = some[rng.integers(0, len(some), (_FLOOR_SAMPLES, 3))]
    normal = np.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    length = np.linalg.norm(normal, axis=1)
    ok = length > 1e-9
    normal, first = normal[ok] / length[ok, None], three[ok, 0]
    normal *= np.where(normal @ direction < 0.0, -1.0, 1.0)[:, None]
    level = normal @ direction > math.cos(tilt)
    normal, first = normal[level][:_MAX_FLOOR_PLANES], first[level][:_MAX_FLOOR_PLANES]
    if not len(normal):
        return None
    height = some @ normal.T - (normal * first).sum(axis=1)
    inside, below = (np.abs(height) < thickness).mean(axis=0), (height < -2.0 * thickness).mean(axis=0)
    inside[below > 0.2 * inside] = 0.0  # a table or a seat: there are points below it
    best = int(np.argmax(inside))
    if inside[best] < least:
        return None
    n, h = normal[best], float(normal[best] @ first[best])
    for _ in range(3):  # plane through all of its points
        near = x[np.abs(x @ n - h) < thickness]
        mean = near.mean(axis=0)
        axes, variances, _ = np.linalg.svd((near - mean).T @ (near - mean) / len(near))
        n = axes[:, 2] if axes[:, 2] @ direction > 0 else -axes[:, 2]
        h = float(n @ mean)
    if n @ direction < math.cos(tilt) or variances[1] < _MIN_FLOOR_SIGMA**2:
        return None
    return Floor((float(n[0]), float(n[1]), float(n[2])), h, float((np.abs(x @ n - h) < thickness).mean()))


def clusters(x: NDArray, gap: float = _MAX_GAP) -> NDArray:
    """Cluster points (N, 3) [m] by distance: labels (N,) from 0.

    Cubes of edge `gap` [m] that touch by a face, an edge or a corner belong to one cluster. So points closer than `gap`
    share a cluster, and points farther apart than 2√3·`gap` share one only through points between them.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(x):
        return np.zeros(0, int)
    cell = np.floor((x - x.min(axis=0)) / gap).astype(np.int64) + 1
    shape = cell.max(axis=0) + 2
    key = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
    cells, index = np.unique(key, return_inverse=True)
    offsets = np.array([(a * shape[1] + b) * shape[2] + c for a in (0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)])
    ends = []
    for offset in offsets[offsets > 0]:
        place = np.minimum(np.searchsorted(cells, cells + offset), len(cells) - 1)
        here = np.flatnonzero(cells[place] == cells + offset)
        ends.append(np.stack([here, place[here]]))
    a, b = np.concatenate(ends, axis=1)
    touching = coo_array((np.ones(len(a)), (a, b)), shape=(len(cells), len(cells)))
    return connected_components(touching, directed=False)[1][index]


@dataclass(frozen=True, eq=False)
class DepthBlob:
    """A cluster of about a person's size in a depth image.

    Parameters
    ----------
    mask : (H, W) bool
    centre : (3,) [m] median point in the world
    area : float [m²] visible to the sensor
    extent : float [m] longest edge of its bounding box along the world's axes
    cut : bool
        Whether the border of the image cuts it off.
    """

    mask: NDArray
    centre: NDArray
    area: float
    extent: float
    cut: bool


def people(
    depth: NDArray, camera: Camera, *, mask: NDArray | None = None, floor: Floor | None = None, gap: float = _MAX_GAP,
    clearance: float = 0.05,
) -> tuple[DepthBlob, ...]:  # fmt: skip
    """Find the clusters of about a person's size in a depth image, in order of decreasing area.

    Clusters of fewer than 150 pixels are discarded: they do not determine a pose. At most the 40 largest are examined.

    Parameters
    ----------
    depth : (H, W) [m], cleaned
    camera : Camera
    mask : (H, W) bool, optional
        The foreground (see `foreground`); default all pixels.
    floor : Floor, optional
        Points lower than `clearance` [m] above it are removed, soles included: feet would connect all clusters.
    gap : float [m]
        Of the clustering, see `clusters`.
    """
    depth = _image(depth, camera)
    measured = (depth > 0.0) if mask is None else (depth > 0.0) & mask
    measured &= np.isfinite(camera.ray_table).all(axis=0)
    x = to_points(depth, camera, mask=measured)
    keep = np.ones(len(x), bool) if floor is None else floor.above(x) > clearance
    pixel, x = np.flatnonzero(measured)[keep], x[keep]
    label = clusters(x, gap)
    z = depth.ravel()[pixel].astype(float)
    area = np.bincount(label, z * z / (camera.matrix[0, 0] * camera.matrix[1, 1]))
    found, border = [], [max(round(_BORDER_SHARE * n), 1) for n in depth.shape]
    likely = np.flatnonzero((area > _AREA_RANGE[0]) & (area < _AREA_RANGE[1]) & (np.bincount(label) >= _MIN_PIXELS))
    for number in likely[np.argsort(-area[likely], kind="stable")[:_MAX_CLUSTERS]]:
        in_cluster = label == number
        low, high = np.percentile(x[in_cluster], (0.5, 99.5), axis=0)
        extent = float((high - low).max())
        if _EXTENT_RANGE[0] < extent < _EXTENT_RANGE[1]:
            visible = np.zeros(depth.shape, bool)
            visible.reshape(-1)[pixel[in_cluster]] = True
            inner = visible[border[0] : -border[0], border[1] : -border[1]]
            cut = bool(np.count_nonzero(inner) < np.count_nonzero(visible))
            found.append(DepthBlob(visible, np.median(x[in_cluster], axis=0), float(area[number]), extent, cut))
    return tuple(sorted(found, key=lambda blob: -blob.area))
