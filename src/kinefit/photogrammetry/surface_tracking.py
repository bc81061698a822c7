"""Points of a surface followed through videos: temporal matching in each view, spatial matching as the check.

N. D'Apuzzo, R. Plänkers, P. Fua, A. Gruen and D. Thalmann, Modeling human bodies from video sequences (1999), section
2.4: linear prediction, a search box scanned by cross-correlation, least-squares matching to the next image in every
view, and between the views where the points ended up; a point is kept if both agree. Lost points are regenerated, and
new ones made as they become visible, from the neighbours that are there. Where a body's motion is known, lost points
are found again, with their names, as it brings them back into view (`returning`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError, TrackingError
from kinefit.geometry.camera import Rig
from kinefit.motion import Motion
from kinefit.photogrammetry.intersection import intersect
from kinefit.photogrammetry.least_squares_matching import WINDOW, match
from kinefit.photogrammetry.matching.correlation import search_box
from kinefit.photogrammetry.region_growing import LEAST_CORRELATION, Grid, Seeds
from kinefit.photogrammetry.returning import PointReturn, Vanished
from kinefit.photogrammetry.spline_image import SplineImage
from kinefit.photogrammetry.surface import check_images, largest_parallax, measure
from kinefit.photogrammetry.trajectories import Trajectories

_BEYOND = 3.0  # standard deviations by which temporal and spatial matches may differ beyond the stated agreement
_BESIDE = 3.0  # steps of the grid from a point that was lost to one that was found, for it to be sought again
_EXPECTED = 0.5  # of the box, within which a point that comes back is taken for itself
_ROUNDS = 20  # of seeking again, in which a motion spreads from point to point


@dataclass(frozen=True)
class SurfaceTracking:
    """How a surface is followed.

    Parameters
    ----------
    window : odd side [px] of the windows
    step : [px] of the grid on which points are made and made again
    reach : [px] from where a point is predicted to the sides of its search box
    least : correlation of a match
    agreement : [px] by which spatial and temporal match may differ
    regenerate : whether places of the grid that lost their point get a new one
    """

    window: int = WINDOW
    step: int = 8
    reach: int = 8
    least: float = LEAST_CORRELATION
    agreement: float = 0.5
    regenerate: bool = True


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a surface at one time.

    Parameters
    ----------
    ids : (M,) int; the same for the same point of the surface at all times
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
        """Some of them, by index or mask."""
        return SurfacePoints(*(value[keep] for value in vars(self).values()))


@dataclass(eq=False)
class SurfaceTracker:
    """Follows a surface through images of synchronised cameras; `update` once a frame, `trajectories` at the end.

    Parameters
    ----------
    rig : two cameras or more; points are chosen in the first one's image
    rate : [Hz]
    settings : SurfaceTracking
    mask : (H, W) bool, where in the first camera's first image the surface is; regenerated points need live neighbours,
        and so stay with it
    seeds : as of `measure`, for the first frame
    motion : of a body whose surface it is, frame by frame; it says where points that were lost come back
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

    def __post_init__(self) -> None:
        if self.motion is not None:
            self._vanished = Vanished(self.rig, self.motion, self.settings.window)

    def update(self, images: Sequence[SplineImage]) -> SurfacePoints:
        """Follow the surface into the next images, one of each camera.

        Raises
        ------
        ObservationError, CalibrationError
            As `measure`, of the first images; images of other sizes.
        TrackingError
            No point is left.
        """
        check_images(self.rig, images)
        if not self._frames:
            now, velocity = self._started(images), None
        else:
            now, velocity = self._followed(images)
        if len(now) == 0:
            problem = f"no point of the surface is left in frame {len(self._frames)}"
            raise TrackingError(problem, remedy="A larger reach or window, more light, or a shorter exposure may help.")
        self._velocity = np.zeros_like(now.uv) if velocity is None else velocity
        if velocity is not None and self._vanished is not None:
            now = self._with(now, self._returned(images, now))
        if velocity is not None and self.settings.regenerate:
            now = self._with(now, self._regenerated(images, now))
        self._images = images
        self._frames.append(now)
        return now

    def _with(self, now: SurfacePoints, more: SurfacePoints) -> SurfacePoints:
        """Points and others, which move as their neighbours."""
        shift = _of_nearest(now.uv[:, 0], self._velocity, more.uv[:, 0])
        self._velocity = np.concatenate([self._velocity, shift])
        return SurfacePoints(*(np.concatenate([a, b]) for a, b in zip(vars(now).values(), vars(more).values())))

    def trajectories(self) -> Trajectories:
        """All points over all frames so far."""
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
        """When points that vanished are expected and were found again; none without the motion."""
        return [] if self._vanished is None else list(self._vanished.returns)

    def _started(self, images: Sequence[SplineImage]) -> SurfacePoints:
        settings = self.settings
        grid = Grid.of(images[0].size, settings.step, margin=settings.window // 2 + 2, mask=self.mask)
        surface = measure(
            self.rig, images, grid, seeds=self.seeds, window=settings.window, least=settings.least, constrained=False
        )
        index = np.flatnonzero(surface.measured)
        kept = (surface.x_world, surface.covariance, surface.uv, surface.deformation)
        return SurfacePoints(self._new(len(index)), *(value[index] for value in kept))

    def _new(self, count: int) -> NDArray[np.int64]:
        """Names of new points."""
        self._next += count
        return np.arange(self._next - count, self._next)

    def _followed(self, images: Sequence[SplineImage]) -> tuple[SurfacePoints, NDArray]:
        """Points of the last frame that are found in this one, and their motion in the images (M, C, 2) [px].

        Points that are not found where they are predicted are sought again where their neighbours went.
        """
        last, settings = self._frames[-1], self.settings
        predicted = self._velocity.copy()
        uv, own, velocity, maps, good = self._moved(images, last, predicted)
        for _ in range(_ROUNDS):
            lost, there = np.flatnonzero(~good), np.flatnonzero(good)
            if not (len(lost) and len(there)):
                break
            beside = there[_nearest(last.uv[there, 0], last.uv[lost, 0])]
            near = np.linalg.norm(last.uv[beside, 0] - last.uv[lost, 0], axis=1) <= _BESIDE * settings.step
            other = np.linalg.norm(velocity[beside] - predicted[lost], axis=2).max(axis=1) > settings.reach / 2
            again = near & other
            if not again.any():
                break
            lost, shift = lost[again], velocity[beside[again]]
            predicted[lost] = shift
            told = self._moved(images, last.only(lost), shift)
            for values, found in zip((uv, own, velocity, maps, good), told):
                values[lost] = found
        kept, uv, own, velocity, maps = last.only(good), uv[good], own[good], velocity[good], maps[good]
        meet = intersect(self.rig, uv, own)
        agree = meet.parallax <= largest_parallax(meet.parallax)
        return SurfacePoints(kept.ids, meet.x_world, meet.covariance, uv, maps).only(agree), velocity[agree]

    def _moved(
        self, images: Sequence[SplineImage], last: SurfacePoints, predicted: NDArray
    ) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray[np.bool_]]:
        """Where points of the last frame are in this one, predicted to have moved by (M, C, 2) [px].

        Returns
        -------
        uv : (M, C, 2) [px]
        covariance : (M, C, 2, 2) [px²]
        velocity : (M, C, 2) [px] by temporal matching alone
        deformation : (M, C - 1, 2, 2)
        good : (M,) bool, found in every view, where spatial matching agrees
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
        velocity, maps, index = uv - last.uv, last.deformation.copy(), np.flatnonzero(good)
        for c in range(1, len(images)):
            good[index] &= self._agreeing(images, c, index, uv, covariance, maps)
        return uv, covariance, velocity, maps, good

    def _returned(self, images: Sequence[SplineImage], now: SurfacePoints) -> SurfacePoints:
        """Points that were lost before, where the body's motion says that they are in view again.

        Each is matched in every view to what it looked like last, and between the views as the check.
        """
        assert self._vanished is not None
        settings, frame, last = self.settings, len(self._frames), self._frames[-1]
        lost = np.flatnonzero(~np.isin(last.ids, now.ids))
        self._vanished.remember(frame - 1, last.ids[lost], last.x_world[lost], last.uv[lost], list(self._images))
        expected = self._vanished.expected(frame)
        if expected is None:
            return now.only(np.zeros(0, int))
        window, good = settings.window, np.ones(len(expected.ids), bool)
        uv, covariance = expected.uv.copy(), np.empty((*expected.uv.shape, 2))
        for c, image in enumerate(images):
            mosaic, at = expected.mosaics[c], expected.at[:, c]
            box = search_box(mosaic, image, at, expected.uv[:, c], reach=settings.reach, window=window)
            start = np.where(np.isfinite(box.uv), box.uv, expected.uv[:, c])
            told = match(mosaic, image, at, start, deformation=expected.maps[:, c], window=window)
            good &= told.found & (told.correlation >= settings.least)
            good &= np.linalg.norm(told.uv - expected.uv[:, c], axis=1) <= _EXPECTED * settings.reach
            uv[:, c], covariance[:, c] = told.uv, told.covariance
        maps, index = expected.between.copy(), np.flatnonzero(good)
        for c in range(1, len(images)):
            good[index] &= self._agreeing(images, c, index, uv, covariance, maps)
        index = np.flatnonzero(good)
        meet = intersect(self.rig, uv[index], covariance[index])
        agree = meet.parallax <= largest_parallax(meet.parallax)
        self._vanished.found(frame, expected.index[index[agree]])
        kept = (expected.ids[index], meet.x_world, meet.covariance, uv[index], maps[index])
        return SurfacePoints(*(value[agree] for value in kept))

    def _agreeing(
        self, images: Sequence[SplineImage], c: int, index: NDArray, uv: NDArray, covariance: NDArray, maps: NDArray
    ) -> NDArray[np.bool_]:
        """(K,) whether matching from the first image to camera c's finds points where they are, some of all.

        Their places, covariances and maps are made those of that match.
        """
        settings = self.settings
        told = match(
            images[0], images[c], uv[index, 0], uv[index, c], deformation=maps[index, c - 1], window=settings.window
        )
        gap = np.linalg.norm(told.uv - uv[index, c], axis=1)
        spread = np.sqrt(np.trace(told.covariance + covariance[index, c], axis1=1, axis2=2))
        near = gap <= settings.agreement + _BEYOND * spread
        uv[index, c], covariance[index, c] = told.uv, told.covariance
        maps[index, c - 1] = told.deformation
        return np.asarray(told.found & (told.correlation >= settings.least) & near)

    def _regenerated(self, images: Sequence[SplineImage], now: SurfacePoints) -> SurfacePoints:
        """New points where the grid has none, next to those that are there."""
        grid = Grid.of(images[0].size, self.settings.step, margin=self.settings.window // 2 + 2)
        cell = np.rint((now.uv[:, 0] - grid.points[0]) / grid.step).astype(int)
        rows = len(grid.points) // grid.columns
        taken = np.zeros((rows + 2, grid.columns + 2), bool)
        taken[np.clip(cell[:, 1], -1, rows) + 1, np.clip(cell[:, 0], -1, grid.columns) + 1] = True
        near = taken.copy()  # at most one cell from a live point: a surface grows by its step a frame
        for axis in (0, 1):
            near |= np.roll(near, 1, axis) | np.roll(near, -1, axis)
        free = (near & ~taken)[1:-1, 1:-1].ravel()
        if not free.any():
            return now.only(np.zeros(0, int))
        return self._beside(images, now, grid.points[free])

    def _beside(self, images: Sequence[SplineImage], now: SurfacePoints, at: NDArray) -> SurfacePoints:
        """Points at places (K, 2) [px] of the first image, started from the maps of the nearest live ones."""
        settings, near = self.settings, _nearest(now.uv[:, 0], at)
        uv = np.repeat(at[:, None], len(images), axis=1)
        covariance = np.tile(1e-6 * np.eye(2), (len(at), len(images), 1, 1))
        maps, good = now.deformation[near].copy(), np.ones(len(at), bool)
        for c in range(1, len(images)):
            start = now.uv[near, c] + np.einsum("nij,nj->ni", maps[:, c - 1], at - now.uv[near, 0])
            told = match(images[0], images[c], at, start, deformation=maps[:, c - 1], window=settings.window)
            close = np.linalg.norm(told.uv - start, axis=1) <= settings.step / 2
            good &= told.found & (told.correlation >= settings.least) & close
            uv[:, c], covariance[:, c], maps[:, c - 1] = told.uv, told.covariance, told.deformation
        meet = intersect(self.rig, uv, covariance)
        good &= meet.parallax <= largest_parallax(meet.parallax[good])
        index = np.flatnonzero(good)
        kept = (meet.x_world, meet.covariance, uv, maps)
        return SurfacePoints(self._new(len(index)), *(value[index] for value in kept))


def _nearest(points: NDArray, at: NDArray) -> NDArray[np.int64]:
    """(K,) index of the nearest of points (M, 2) to each place (K, 2)."""
    return np.array([np.argmin(((points - place) ** 2).sum(axis=1)) for place in at], np.int64)


def _of_nearest(points: NDArray, values: NDArray, at: NDArray) -> NDArray:
    """Values of the nearest points (M, 2) to places (K, 2)."""
    return values[_nearest(points, at)] if len(at) else values[:0]
