"""Track the points of a surface through videos: temporal matching in each view, spatial matching as a check.

N. D'Apuzzo, R. Plänkers, P. Fua, A. Gruen and D. Thalmann, Modeling human bodies from video sequences (1999), section
2.4: linear prediction, cross-correlation in a search box, least-squares matching to the next image in every view, and
then between the views; a point is kept if both agree. Lost points are regenerated, and new ones created as they become
visible, from their neighbours. If a body's motion is known, lost points are re-identified when it brings them back into
view (`returning`).

One camera has no match between views as a check. There a point is matched back to the image before, and no other place
of the search box may look alike. Then it is matched from its first image, so that errors do not add up. Its place in
space is on the plane z = 0, or on the body whose motion is given (`one_camera`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion
from kinefit.errors import ObservationError, TrackingError
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry import intersection
from kinefit.images.photogrammetry import least_squares_matching as matching
from kinefit.images.photogrammetry.intersection import Intersections, Ranges, body_ranges, intersect, plane_ranges
from kinefit.images.photogrammetry.least_squares_matching import MIN_CORRELATION, WINDOW, Grid, Matches, Seeds, match
from kinefit.images.photogrammetry.matching.multi_image import Correlations, search_box
from kinefit.images.photogrammetry.returning import PointReturn, Vanished
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface import check_images, max_parallax, measure
from kinefit.images.photogrammetry.trajectories import Trajectories

_MAX_DISAGREEMENT_SIGMAS = 3.0  # by which temporal and spatial matches may differ beyond `agreement`
_MAX_STEPS_APART = 3.0  # of the grid from a lost point to the tracked one whose motion it tries
_MAX_RETURN_SHARE = 0.5  # of `reach`: distance of a re-identified point from its prediction
_MAX_SEARCH_ROUNDS = 20  # in which a motion spreads from point to point
_EXACT_VARIANCE = 1e-6  # [px²] of the points in the first image, which are exact by definition
_MAX_BACKWARD_PX = 0.2  # of one camera: distance of a point that is matched back from where it came
_MAX_ANCHOR_GAP_PX = 2.0  # of one camera: distance of a point from where its window of the first image matches
_MAX_RUNNER_UP_RATIO = 0.95  # of one camera: second-best correlation in a search box to the best


@dataclass(frozen=True)
class SurfaceTracking:
    """Settings of `SurfaceTracker`.

    Parameters
    ----------
    window : odd side [px] of the windows
    step : [px] of the grid on which points are created
    reach : [px] half side of the search box around a predicted point
    least : least correlation, 0 to 1, of a match
    agreement : [px] by which spatial and temporal match may differ
    regenerate : whether free grid points get new surface points
    """

    window: int = WINDOW
    step: int = 8
    reach: int = 8
    least: float = MIN_CORRELATION
    agreement: float = 0.5
    regenerate: bool = True


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a surface at one time.

    Parameters
    ----------
    ids : (M,) int; a surface point keeps its id over time
    x_world : (M, 3) [m]
    covariance : (M, 3, 3) [m²]
    uv : (M, C, 2) [px]
    deformation : (M, C - 1, 2, 2) from the first image to each other one
    """

    ids: NDArray[np.int64]
    x_world: NDArray
    covariance: NDArray
    uv: NDArray
    deformation: NDArray

    def __len__(self) -> int:
        return len(self.ids)

    def only(self, keep: NDArray) -> SurfacePoints:
        """Select points by index or mask."""
        return SurfacePoints(*(value[keep] for value in vars(self).values()))


@dataclass(eq=False)
class SurfaceTracker:
    """Tracks a surface through images of synchronised cameras: `update` once per frame, `trajectories` at the end.

    Parameters
    ----------
    rig : cameras; points are chosen in the first one's image. Of a single camera no new points are made
    rate : [Hz]
    settings : SurfaceTracking
    mask : (H, W) bool, region of the surface in the first camera's first image. Later points need tracked neighbours
        and so stay on the surface. Default: the whole image
    seeds : for the first frame, as in `measure`
    motion : of the body that has this surface, frame by frame; it predicts where lost points return. With a single
        camera it also places the points in space, to 2 cm along the ray. Default: none
    """

    rig: Rig
    rate: float
    settings: SurfaceTracking = SurfaceTracking()
    mask: NDArray | None = None
    seeds: Sequence[Seeds] | None = None
    motion: Motion | None = None
    _frames: list[SurfacePoints] = field(default_factory=list)
    _images: Sequence[SplineImage] = ()
    _velocity: NDArray = field(default_factory=lambda: np.zeros((0, 0, 2)))
    _next: int = 0
    _vanished: Vanished | None = None
    _ranges: Ranges | None = None
    _first: Sequence[SplineImage] = ()
    _maps: NDArray = field(default_factory=lambda: np.zeros((0, 2, 2)))

    def __post_init__(self) -> None:
        if len(self.rig) == 1:
            camera = self.rig.cameras[0]
            self._ranges = plane_ranges(camera) if self.motion is None else body_ranges(self.motion, camera)
        if self.motion is not None:
            self._vanished = Vanished(self.rig, self.motion, self.settings.window)

    def update(self, images: Sequence[SplineImage]) -> SurfacePoints:
        """Track the surface into the next images, one of each camera.

        Raises
        ------
        ObservationError, CalibrationError
            As `measure` for the first images, or images of other sizes.
        TrackingError
            No point is left.
        """
        check_images(self.rig, images, fewest=1)
        if not self._frames:
            points, velocity = self._measure_first(images), None
        else:
            points, velocity = self._track(images)
        if len(points) == 0:
            problem = f"no point of the surface is left in frame {len(self._frames)}"
            raise TrackingError(problem, remedy="Try a larger reach or window, more light, or a shorter exposure.")
        self._velocity = np.zeros_like(points.uv) if velocity is None else velocity
        if velocity is not None and self._vanished is not None:
            points = self._append(points, self._reidentify(images, points))
        if velocity is not None and self.settings.regenerate and self._ranges is None:
            points = self._append(points, self._regenerate(images, points))
        self._images = images
        self._frames.append(points)
        return points

    def _append(self, points: SurfacePoints, added: SurfacePoints) -> SurfacePoints:
        """Append points, with the velocity of their nearest neighbours."""
        shift = self._velocity[matching.nearest(added.uv[:, 0], points.uv[:, 0])]
        self._velocity = np.concatenate([self._velocity, shift])
        return SurfacePoints(*(np.concatenate([a, b]) for a, b in zip(vars(points).values(), vars(added).values())))

    def trajectories(self) -> Trajectories:
        """Trajectories of all points over all frames so far.

        Raises
        ------
        ObservationError
            There is no frame yet.
        """
        if not self._frames:
            raise ObservationError("no frame was given", remedy="Call `update` first.")
        shape = (len(self._frames), self._next)
        x, std = np.full((*shape, 3), np.nan), np.full((*shape, 3), np.nan)
        uv = np.full((*shape, len(self.rig), 2), np.nan)
        for k, points in enumerate(self._frames):
            x[k, points.ids], uv[k, points.ids] = points.x_world, points.uv
            std[k, points.ids] = np.sqrt(np.diagonal(points.covariance, axis1=1, axis2=2))
        return Trajectories(np.arange(len(self._frames)) / self.rate, x, std, uv)

    def returns(self) -> list[PointReturn]:
        """Frames in which lost points are expected and found again; empty without a motion."""
        return [] if self._vanished is None else list(self._vanished.returns)

    def _measure_first(self, images: Sequence[SplineImage]) -> SurfacePoints:
        settings = self.settings
        grid = Grid.of(images[0].size, settings.step, margin=settings.window // 2 + 2, mask=self.mask)
        if self._ranges is not None:
            self._first = images
            return self._placed(grid.points[grid.inside])
        surface = measure(
            self.rig, images, grid, seeds=self.seeds, window=settings.window, least=settings.least, constrained=False
        )
        index = np.flatnonzero(surface.measured)
        kept = (surface.x_world, surface.covariance, surface.uv, surface.deformation)
        return SurfacePoints(self._new_ids(len(index)), *(value[index] for value in kept))

    def _placed(self, uv: NDArray) -> SurfacePoints:
        """New points of a single camera at image points (N, 2) [px]."""
        covariance = np.tile(_EXACT_VARIANCE * np.eye(2), (len(uv), 1, 1, 1))
        found = self._locate(uv[:, None], covariance)
        index = np.flatnonzero(np.isfinite(found.parallax))
        maps, ids = np.zeros((len(index), 0, 2, 2)), self._new_ids(len(index))
        self._maps = np.tile(np.eye(2), (len(index), 1, 1))
        return SurfacePoints(ids, found.x_world[index], found.covariance[index], uv[index, None], maps)

    def _locate(self, uv: NDArray, covariance: NDArray) -> Intersections:
        """Places in space of image points (N, C, 2) [px] of the next frame, with covariances (N, C, 2, 2) [px²]."""
        if self._ranges is None:
            return intersect(self.rig, uv, covariance)
        sigma = 0.0 if self.motion is None else intersection.BODY_SIGMA
        ranges = self._ranges(len(self._frames), uv[:, 0])
        return intersection.at_range(self.rig.cameras[0], uv[:, 0], covariance[:, 0], ranges, sigma)

    def _new_ids(self, count: int) -> NDArray[np.int64]:
        """(count,) ids of new points."""
        self._next += count
        return np.arange(self._next - count, self._next)

    def _track(self, images: Sequence[SplineImage]) -> tuple[SurfacePoints, NDArray]:
        """Points of the last frame that are found in this one, and their motion in the images (M, C, 2) [px].

        Points not found at their prediction are searched again with the motion of their neighbours.
        """
        last, settings = self._frames[-1], self.settings
        predicted = self._velocity.copy()
        uv, own, velocity, maps, good = self._match_temporally(images, last, predicted)
        for _ in range(_MAX_SEARCH_ROUNDS):
            lost, tracked = np.flatnonzero(~good), np.flatnonzero(good)
            if not (len(lost) and len(tracked)):
                break
            other = tracked[matching.nearest(last.uv[lost, 0], last.uv[tracked, 0])]
            near = np.linalg.norm(last.uv[other, 0] - last.uv[lost, 0], axis=1) <= _MAX_STEPS_APART * settings.step
            differs = np.linalg.norm(velocity[other] - predicted[lost], axis=2).max(axis=1) > settings.reach / 2
            retried = near & differs
            if not retried.any():
                break
            lost, shift = lost[retried], velocity[other[retried]]
            predicted[lost] = shift
            matches = self._match_temporally(images, last.only(lost), shift)
            for values, found in zip((uv, own, velocity, maps, good), matches):
                values[lost] = found
        if self._ranges is not None:
            good[good] = self._anchor(images[0], last.ids[good], uv, own, good)
        points, uv, own, velocity, maps = last.only(good), uv[good], own[good], velocity[good], maps[good]
        meet = self._locate(uv, own)
        agree = meet.parallax <= max_parallax(meet.parallax)
        return SurfacePoints(points.ids, meet.x_world, meet.covariance, uv, maps).only(agree), velocity[agree]

    def _match_temporally(
        self, images: Sequence[SplineImage], last: SurfacePoints, predicted: NDArray
    ) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray[np.bool_]]:
        """Match points of the last frame in this one, starting from a predicted motion (M, C, 2) [px].

        Returns
        -------
        uv : (M, C, 2) [px]
        covariance : (M, C, 2, 2) [px²]
        velocity : (M, C, 2) [px] by temporal matching alone
        deformation : (M, C - 1, 2, 2)
        good : (M,) bool, found in every view, and spatial matching agrees; of one camera, matching back
        """
        settings = self.settings
        uv, covariance = np.empty_like(last.uv), np.empty((*last.uv.shape, 2))
        good = np.ones(len(last), bool)
        for c, (old, new) in enumerate(zip(self._images, images)):
            expected = last.uv[:, c] + predicted[:, c]
            box = search_box(old, new, last.uv[:, c], expected, reach=settings.reach, window=settings.window)
            start = np.where(np.isfinite(box.uv), box.uv, expected)
            found = match(old, new, last.uv[:, c], start, window=settings.window)
            uv[:, c], covariance[:, c] = found.uv, found.covariance
            good &= found.found & (found.correlation >= settings.least)
            good &= self._is_confirmed(old, new, box, found)
        velocity, maps, index = uv - last.uv, last.deformation.copy(), np.flatnonzero(good)
        for c in range(1, len(images)):
            good[index] &= self._match_spatially(images, c, index, uv, covariance, maps)
        return uv, covariance, velocity, maps, good

    def _anchor(
        self, image: SplineImage, ids: NDArray, uv: NDArray, covariance: NDArray, good: NDArray
    ) -> NDArray[np.bool_]:
        """(K,) which points `ids` (K,) of a single camera still look as in its first image.

        Replaces the image points (M, C, 2) [px] of `good` (M,) by those of their windows in the first image, so that
        errors of the steps do not add up; points that are further off than `agreement` stay as they are.
        """
        settings, begin, at = self.settings, self._frames[0].uv[ids, 0], np.flatnonzero(good)
        found = match(self._first[0], image, begin, uv[at, 0], deformation=self._maps[ids], window=settings.window)
        gap = np.linalg.norm(found.uv - uv[at, 0], axis=1)
        alike = found.found & (found.correlation >= settings.least) & (gap <= _MAX_ANCHOR_GAP_PX)
        near = alike & (gap <= settings.agreement)
        uv[at[near], 0], covariance[at[near], 0] = found.uv[near], found.covariance[near]
        self._maps[ids[near]] = found.deformation[near]
        return np.asarray(alike)

    def _is_confirmed(self, old: SplineImage, new: SplineImage, box: Correlations, found: Matches) -> NDArray[np.bool_]:
        """(N,) which matches of a single camera are unique in their box and lead back to where they came from."""
        if self._ranges is None:
            return np.ones(len(found.uv), bool)
        inverse = np.linalg.pinv(np.nan_to_num(found.deformation))
        back = match(new, old, found.uv, found.points, deformation=inverse, window=self.settings.window)
        unique = ~(box.runner_up > _MAX_RUNNER_UP_RATIO * box.best)
        return np.asarray(unique & (np.linalg.norm(back.uv - found.points, axis=1) <= _MAX_BACKWARD_PX))

    def _reidentify(self, images: Sequence[SplineImage], points: SurfacePoints) -> SurfacePoints:
        """Re-identify lost points that the body's motion brings back into view.

        Each is matched in every view with its last appearance, and then between the views as a check.
        """
        assert self._vanished is not None
        settings, frame, last = self.settings, len(self._frames), self._frames[-1]
        lost = np.flatnonzero(~np.isin(last.ids, points.ids))
        self._vanished.remember(frame - 1, last.ids[lost], last.x_world[lost], last.uv[lost], list(self._images))
        expected = self._vanished.expected(frame)
        if expected is None:
            return points.only(np.zeros(0, int))
        window, good = settings.window, np.ones(len(expected.ids), bool)
        uv, covariance = expected.uv.copy(), np.empty((*expected.uv.shape, 2))
        for c, image in enumerate(images):
            mosaic, at = expected.mosaics[c], expected.at[:, c]
            box = search_box(mosaic, image, at, expected.uv[:, c], reach=settings.reach, window=window)
            start = np.where(np.isfinite(box.uv), box.uv, expected.uv[:, c])
            found = match(mosaic, image, at, start, deformation=expected.maps[:, c], window=window)
            good &= found.found & (found.correlation >= settings.least)
            good &= self._is_confirmed(mosaic, image, box, found)
            good &= np.linalg.norm(found.uv - expected.uv[:, c], axis=1) <= _MAX_RETURN_SHARE * settings.reach
            uv[:, c], covariance[:, c] = found.uv, found.covariance
        maps, index = expected.between.copy(), np.flatnonzero(good)
        for c in range(1, len(images)):
            good[index] &= self._match_spatially(images, c, index, uv, covariance, maps)
        index = np.flatnonzero(good)
        intersections = self._locate(uv[index], covariance[index])
        consistent = intersections.parallax <= max_parallax(intersections.parallax)
        self._vanished.mark_found(frame, expected.index[index[consistent]])
        kept = (expected.ids[index], intersections.x_world, intersections.covariance, uv[index], maps[index])
        return SurfacePoints(*(value[consistent] for value in kept))

    def _match_spatially(
        self, images: Sequence[SplineImage], c: int, index: NDArray, uv: NDArray, covariance: NDArray, maps: NDArray
    ) -> NDArray[np.bool_]:
        """(K,) whether matching the first image with that of camera c confirms the points `index` (K,).

        Replaces their image points, covariances and maps by those of this match.
        """
        settings = self.settings
        found = match(
            images[0], images[c], uv[index, 0], uv[index, c], deformation=maps[index, c - 1], window=settings.window
        )
        gap = np.linalg.norm(found.uv - uv[index, c], axis=1)
        spread = np.sqrt(np.trace(found.covariance + covariance[index, c], axis1=1, axis2=2))
        near = gap <= settings.agreement + _MAX_DISAGREEMENT_SIGMAS * spread
        uv[index, c], covariance[index, c] = found.uv, found.covariance
        maps[index, c - 1] = found.deformation
        return np.asarray(found.found & (found.correlation >= settings.least) & near)

    def _regenerate(self, images: Sequence[SplineImage], points: SurfacePoints) -> SurfacePoints:
        """New points at free grid points next to tracked ones."""
        grid = Grid.of(images[0].size, self.settings.step, margin=self.settings.window // 2 + 2)
        cell = np.rint((points.uv[:, 0] - grid.points[0]) / grid.step).astype(int)
        rows = len(grid.points) // grid.columns
        taken = np.zeros((rows + 2, grid.columns + 2), bool)
        taken[np.clip(cell[:, 1], -1, rows) + 1, np.clip(cell[:, 0], -1, grid.columns) + 1] = True
        near = taken.copy()  # at most one cell from a tracked point: a surface grows by one step per frame
        for axis in (0, 1):
            near |= np.roll(near, 1, axis) | np.roll(near, -1, axis)
        free = (near & ~taken)[1:-1, 1:-1].ravel()
        if not free.any():
            return points.only(np.zeros(0, int))
        return self._match_new(images, points, grid.points[free])

    def _match_new(self, images: Sequence[SplineImage], points: SurfacePoints, at: NDArray) -> SurfacePoints:
        """Match new points (K, 2) [px] of the first image, starting from the maps of the nearest tracked ones."""
        settings, near = self.settings, matching.nearest(at, points.uv[:, 0])
        uv = np.repeat(at[:, None], len(images), axis=1)
        covariance = np.tile(1e-6 * np.eye(2), (len(at), len(images), 1, 1))
        maps, good = points.deformation[near].copy(), np.ones(len(at), bool)
        for c in range(1, len(images)):
            start = points.uv[near, c] + np.einsum("nij,nj->ni", maps[:, c - 1], at - points.uv[near, 0])
            found = match(images[0], images[c], at, start, deformation=maps[:, c - 1], window=settings.window)
            close = np.linalg.norm(found.uv - start, axis=1) <= settings.step / 2
            good &= found.found & (found.correlation >= settings.least) & close
            uv[:, c], covariance[:, c], maps[:, c - 1] = found.uv, found.covariance, found.deformation
        intersections = intersect(self.rig, uv, covariance)
        good &= intersections.parallax <= max_parallax(intersections.parallax[good])
        index = np.flatnonzero(good)
        kept = (intersections.x_world, intersections.covariance, uv, maps)
        return SurfacePoints(self._new_ids(len(index)), *(value[index] for value in kept))
