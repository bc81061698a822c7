"""Who is in a depth image: the empty scene and the floor taken away, what is left parted into bodies."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images.depth import _image, to_points

# What a person shows to a sensor: head and shoulders alone are about 0.1 m² and 0.4 m tall, a standing adult 0.5 to
# 0.8 m² and up to 2.1 m, 2.6 m with an arm stretched upwards.
_AREA, _EXTENT = (0.06, 2.0), (0.3, 2.6)  # [m²], [m]
_PIXELS = 150  # of a thing; a person 10 m from a camera of 160 x 124 pixels (43 degrees wide) has 200
_CROWD = 40  # things: more are noise, as of an image that is far away all over
_RIM = 0.01  # of the image, along its edges: there many sensors measure nothing
_GAP = 0.12  # [m] parts farther apart than twice this are two things; shadows tear limbs off by some centimetres
_FLOOR_BREADTH = 0.2  # [m] deviation along its narrow side: a metre of floor has 0.3, a slice through a person 0.1
_FLOOR_ROUNDS = 20000  # samples of three: a floor of 8 % of the points is missed by (1 - 0.08^3)^20000 = 0.004 %
_FLOOR_PLANES = 1000  # of the planes that are level, this many are compared


def background_model(images: Iterable[NDArray], *, share: float = 0.2, seen: float = 0.1) -> NDArray:
    """Empty scene from images of it, or from a take in which the person moves: the farthest stable depth of a pixel.

    Parameters
    ----------
    images : of (H, W) [m], 0 where nothing was measured
    share : float
        At least this share of a pixel's measurements must lie as far away: 0.5 (the median) for an empty scene, less
        where the person stands before a pixel for most of the take.
    seen : float
        Share of the images in which a pixel must be measured at all.

    Returns
    -------
    (H, W) float32 [m], 0 where the scene is unknown
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
    """(H, W) bool: measured, and nearer than the empty scene by more than `margin` [m] + `growth` [1/m] · depth².

    The noise of stereo and structured light grows with the square of the depth: 1.4 mm/m² of a first Kinect
    (Khoshelham 2012), of which four deviations are the default. Where the scene is unknown, all that is
    measured is new.
    """
    depth, background = _image(depth), _image(background)
    if depth.shape != background.shape:
        raise ObservationError(f"a background {background.shape} for a depth image {depth.shape}")
    return (depth > 0.0) & ((background <= 0.0) | (depth < background - margin - growth * background**2))


@dataclass(frozen=True)
class Floor:
    """A plane: normal·x = height, the normal (3,) upwards in the world, height [m]; `share` of the points lie in it."""

    normal: tuple[float, float, float]
    height: float
    share: float

    def above(self, x_world: NDArray) -> NDArray:
        """(N,) [m] heights of points over the floor."""
        return x_world @ np.array(self.normal) - self.height


def find_floor(
    x_world: NDArray, up: ArrayLike, *, tilt: float = math.radians(20), thickness: float = 0.03, least: float = 0.05,
    seed: int = 0,
) -> Floor | None:  # fmt: skip
    """Floor among points, by RANSAC: the plane with most points, about level, and with next to nothing below it.

    Parameters
    ----------
    x_world : (N, 3) [m]
    up : (3,) about upwards in the world
    tilt : float [rad]
        How far its normal may lean from `up`: how well one knows how a sensor was held.
    thickness : float [m]
        Points within this of the plane are the floor's.
    least : float
        Share of all points that it must hold, to be one.
    """
    x = np.asarray(x_world, float)
    direction = np.asarray(up, float) / np.linalg.norm(np.asarray(up, float))
    if len(x) < 100:
        return None
    rng = np.random.default_rng(seed)
    some = x[rng.choice(len(x), min(len(x), 2000), replace=False)]
    three = some[rng.integers(0, len(some), (_FLOOR_ROUNDS, 3))]
    normal = np.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    length = np.linalg.norm(normal, axis=1)
    ok = length > 1e-9
    normal, first = normal[ok] / length[ok, None], three[ok, 0]
    normal *= np.where(normal @ direction < 0.0, -1.0, 1.0)[:, None]
    level = normal @ direction > math.cos(tilt)
    normal, first = normal[level][:_FLOOR_PLANES], first[level][:_FLOOR_PLANES]
    if not len(normal):
        return None
    height = some @ normal.T - (normal * first).sum(axis=1)
    inside, below = (np.abs(height) < thickness).mean(axis=0), (height < -2.0 * thickness).mean(axis=0)
    inside[below > 0.2 * inside] = 0.0  # a table, a seat: the floor goes on below it
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
    if n @ direction < math.cos(tilt) or variances[1] < _FLOOR_BREADTH**2:
        return None
    return Floor((float(n[0]), float(n[1]), float(n[2])), h, float((np.abs(x @ n - h) < thickness).mean()))


def clusters(x: NDArray, gap: float = _GAP) -> NDArray:
    """(N,) labels 0.. of the points (N, 3) [m]: those closer than `gap` share one, those beyond 2√3·`gap` need not.

    Cubes of edge `gap` that touch, by face, edge or corner, belong together.
    """
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
    label = np.arange(len(cells))
    while True:  # every cell takes the least label of its neighbours, and of what those took
        before = label.copy()
        np.minimum.at(label, a, label[b])
        np.minimum.at(label, b, label[a])
        label = label[label]
        if np.array_equal(label, before):
            break
    return np.unique(label, return_inverse=True)[1][index]


@dataclass(frozen=True, eq=False)
class DepthBlob:
    """One thing of about a person's size in a depth image.

    Parameters
    ----------
    mask : (H, W) bool
    centre : (3,) [m] median point in the world
    area : float [m²] that it shows to the sensor
    extent : float [m] longest edge of its box along the axes of the world
    cut : bool
        Whether it is cut off by the edge of the image.
    """

    mask: NDArray
    centre: NDArray
    area: float
    extent: float
    cut: bool


def people(
    depth: NDArray, camera: Camera, *, mask: NDArray | None = None, floor: Floor | None = None, gap: float = _GAP,
    clearance: float = 0.05,
) -> tuple[DepthBlob, ...]:  # fmt: skip
    """Everything of about a person's size that is left in a depth image, the largest first: two of them are two people.

    Parameters
    ----------
    depth : (H, W) [m], cleaned
    camera : Camera
    mask : (H, W) bool, optional
        What is not the empty scene (`foreground`).
    floor : Floor, optional
        Taken away with all that lies lower than `clearance` [m] above it, soles included: feet connect everything.
    gap : float [m]
        Parts closer than this are one thing, those beyond 2√3 times it are two.

    What shows fewer pixels than tell one posture from another is left out, and so is all but the largest of a crowd.
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
    found, rim = [], [max(round(_RIM * n), 1) for n in depth.shape]
    likely = np.flatnonzero((area > _AREA[0]) & (area < _AREA[1]) & (np.bincount(label) >= _PIXELS))
    for number in likely[np.argsort(-area[likely], kind="stable")[:_CROWD]]:
        mine = label == number
        low, high = np.percentile(x[mine], (0.5, 99.5), axis=0)
        extent = float((high - low).max())
        if _EXTENT[0] < extent < _EXTENT[1]:
            shown = np.zeros(depth.shape, bool)
            shown.reshape(-1)[pixel[mine]] = True
            inner = shown[rim[0] : -rim[0], rim[1] : -rim[1]]
            cut = bool(np.count_nonzero(inner) < np.count_nonzero(shown))
            found.append(DepthBlob(shown, np.median(x[mine], axis=0), float(area[number]), extent, cut))
    return tuple(sorted(found, key=lambda blob: -blob.area))
