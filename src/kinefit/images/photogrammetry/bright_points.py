"""Track bright points, such as retroreflective spheres on skin, by their centroids in the images of a rig.

A bright point rises above its surroundings, in rooms that are lit as well as in dark ones: a white top-hat removes all
that is wider. D'Apuzzo et al. (1999) track targets on the body by their centroids in all views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.lines import triangulate
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface_tracking import SurfacePoints, SurfaceTracker

_MIN_CONTRAST = 30.0  # grey values of a new point above its surroundings: less is noise and JPEG blocks
_MIN_TRACKED_CONTRAST = 15.0  # of a point that is already tracked
_LEVEL = 0.5  # of the peak: pixels below it do not join spots
_MIN_PIXELS = 3  # of a spot, for a centroid
_MAX_ASPECT = 2.0  # length over width of a spot
_CENTROID_VARIANCE = 0.1**2  # [px²]
_MAX_RAY_GAP_PX = 2.0  # between views: distance of the intersection of rays from each spot
_MAX_FRAMES_MISSED = 5  # in which a point is predicted; it keeps its id if it is found again
_MAX_CONTRAST_RATIO = 2.0  # of a point's contrast in one frame to the next
_MAX_AMBIGUITY = 0.5  # distance of the nearest spot to that of the next


def find_spots(grey: NDArray, diameter: int) -> tuple[NDArray, NDArray]:
    """Bright compact spots of an image (H, W) of grey values, at most `diameter` [px] wide; corners of areas, too.

    Returns
    -------
    uv : (K, 2) [px] centroids, weighted by the grey values above the surroundings
    contrast : (K,) grey values of the peaks above the surroundings
    """
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * diameter + 1,) * 2)
    risen = cv2.morphologyEx(grey.astype(np.float32), cv2.MORPH_TOPHAT, kernel)
    peak = cv2.dilate(risen, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * (diameter // 2) + 1,) * 2))
    inside = (risen > _MIN_TRACKED_CONTRAST) & (risen >= _LEVEL * peak)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8), connectivity=8)
    uv, contrast = [], []
    for k in range(1, count):
        left, top, width, height, area = boxes[k]
        if area < _MIN_PIXELS or max(width, height) > min(diameter, _MAX_ASPECT * min(width, height)):
            continue
        rows, columns = (slice(max(a - 1, 0), a + n + 1) for a, n in ((top, height), (left, width)))
        own = labels[rows, columns] == k
        weight = risen[rows, columns] * cv2.dilate(own.astype(np.uint8), np.ones((3, 3), np.uint8))
        moments = cv2.moments(weight)
        uv.append(np.array([moments["m10"], moments["m01"]]) / moments["m00"] + (columns.start, rows.start))
        contrast.append(float(risen[rows, columns][own].max()))
    return np.array(uv).reshape(-1, 2), np.array(contrast)


@dataclass(eq=False)
class BrightPointTracker(SurfaceTracker):
    """Tracks bright points through images of synchronised cameras: `update` once per frame, `trajectories` at the end.

    A point is predicted linearly in every image and found at the spot that is nearest to its prediction, if no other
    point and no other spot is about as near. It may be missed in five frames. The rays of all views must meet. Spots
    that belong to no point are associated between the views by their rays, if only one combination fits, and become new
    points.

    Parameters
    ----------
    rig, rate, settings, motion : as of `SurfaceTracker`; of `settings` only `reach` counts
    mask : (H, W) bool, where points may lie in the first camera's first image. With a mask no points are made later
    diameter : [px] of the widest spot
    """

    diameter: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        views = len(self.rig)  # of each point that ever was: its last place, motion per frame, contrast and frame
        self._uv, self._moves = np.zeros((0, views, 2)), np.zeros((0, views, 2))
        self._contrast, self._seen = np.zeros((0, views)), np.zeros(0, int)

    def _measure_first(self, images: Sequence[SplineImage]) -> SurfacePoints:
        spots = self._find(images)
        if self.mask is not None:
            if self.mask.shape != images[0].size[::-1]:
                has, wanted = ("x".join(map(str, size)) for size in (self.mask.shape[::-1], images[0].size))
                remedy = "Give a mask of the first camera's images."
                raise ObservationError(f"a mask of {has} px for images of {wanted} px", remedy=remedy)
            u, v = np.rint(spots[0]).astype(int).T
            spots[0] = spots[0][self.mask[v, u]]
        return self._associated(spots)

    def _track(self, images: Sequence[SplineImage]) -> tuple[SurfacePoints, NDArray]:
        frame = len(self._frames)
        ids = np.flatnonzero(frame - self._seen <= 1 + _MAX_FRAMES_MISSED)
        elapsed = (frame - self._seen[ids])[:, None, None]
        expected = self._uv[ids] + elapsed * self._moves[ids]
        uv, contrast, good = expected.copy(), self._contrast[ids], np.ones(len(ids), bool)
        for c, image in enumerate(images):
            spots, levels = find_spots(image.grey, self.diameter)
            gaps = _distances(expected[:, c], spots)
            change = np.abs(np.log(levels) - np.log(contrast[:, c])[:, None])
            gaps[change > np.log(_MAX_CONTRAST_RATIO)] = np.inf
            index = nearest_spots(gaps, self.settings.reach)
            good &= index >= 0
            if len(spots):
                uv[:, c], contrast[:, c] = spots[index], levels[index]
        found = self._locate(uv, np.tile(_CENTROID_VARIANCE * np.eye(2), (*uv.shape[:2], 1, 1)))
        good &= found.parallax <= _MAX_RAY_GAP_PX
        ids, uv, elapsed = ids[good], uv[good], elapsed[good]
        moves = (uv - self._uv[ids]) / elapsed
        self._uv[ids], self._moves[ids], self._contrast[ids], self._seen[ids] = uv, moves, contrast[good], frame
        points = SurfacePoints(ids, found.x_world[good], found.covariance[good], uv, self._identities(len(ids)))
        return points, moves

    def _regenerate(self, images: Sequence[SplineImage], points: SurfacePoints) -> SurfacePoints:
        if self.mask is not None:
            return points.only(np.zeros(0, int))
        spots = self._find(images)
        free = [at[_distances(at, points.uv[:, c]).min(axis=1, initial=np.inf) > 0] for c, at in enumerate(spots)]
        return self._associated(free)

    def _find(self, images: Sequence[SplineImage]) -> list[NDArray]:
        """Spots (K, 2) [px] of each image that rise far enough to become points."""
        found = [find_spots(image.grey, self.diameter) for image in images]
        return [uv[contrast >= _MIN_CONTRAST] for uv, contrast in found]

    def _associated(self, spots: Sequence[NDArray]) -> SurfacePoints:
        """New points whose spots (K, 2) [px] in all views belong together without doubt."""
        combined = self._combined(spots)
        found = self._locate(combined, np.tile(_CENTROID_VARIANCE * np.eye(2), (*combined.shape[:2], 1, 1)))
        good = found.parallax <= _MAX_RAY_GAP_PX
        for c in range(len(self.rig)):
            _, spot, count = np.unique(combined[good, c], axis=0, return_inverse=True, return_counts=True)
            good[good] = count[spot.ravel()] == 1
        uv, ids = combined[good], self._new_ids(int(good.sum()))
        known = (uv, np.zeros_like(uv), np.full(uv.shape[:2], np.nan), np.full(len(uv), len(self._frames)))
        for name, values in zip(("_uv", "_moves", "_contrast", "_seen"), known):
            setattr(self, name, np.concatenate([getattr(self, name), values]))
        return SurfacePoints(ids, found.x_world[good], found.covariance[good], uv, self._identities(len(uv)))

    def _identities(self, count: int) -> NDArray:
        """Maps between views (count, C - 1, 2, 2), of which centroids tell nothing."""
        return np.tile(np.eye(2), (count, len(self.rig) - 1, 1, 1))

    def _combined(self, spots: Sequence[NDArray]) -> NDArray:
        """(N, C, 2) [px] every spot of the first view with every one of the second, and those nearest in the others."""
        if len(self.rig) == 1:
            return spots[0][:, None]
        i, j = (index.ravel() for index in np.indices((len(spots[0]), len(spots[1]))))
        uv = np.full((len(i), len(self.rig), 2), np.nan)
        uv[:, 0], uv[:, 1] = spots[0][i], spots[1][j]
        x = triangulate(self.rig, uv)
        for c, camera in enumerate(self.rig.cameras[2:], 2):
            if len(spots[c]):
                uv[:, c] = spots[c][_distances(camera.project(x), spots[c]).argmin(axis=1)]
        return uv[np.isfinite(uv).all(axis=(1, 2))]


def nearest_spots(gaps: NDArray, reach: float) -> NDArray[np.int64]:
    """Index (N,) of the spot nearest to each point, by distances (N, K) [px]; -1 where in doubt, or beyond `reach`.

    A spot is in doubt if the next spot, or the next point that expects it, is less than twice as far.
    """
    gaps = np.pad(gaps, ((0, 1), (0, 2)), constant_values=np.inf)
    best = gaps.argmin(axis=1)[:-1]
    least = gaps[np.arange(len(best)), best]
    next_spot = np.partition(gaps[:-1], 1, axis=1)[:, 1]
    others = gaps[:, best]
    others[np.arange(len(best)), np.arange(len(best))] = np.inf
    is_clear = least <= _MAX_AMBIGUITY * np.minimum(next_spot, others.min(axis=0))
    return np.where((least <= reach) & is_clear, best, -1)


def _distances(one: NDArray, other: NDArray) -> NDArray:
    """(N, K) [px] between points (N, 2) and (K, 2)."""
    return np.linalg.norm(one[:, None] - other[None], axis=2)
