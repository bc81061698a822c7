"""Tracked points of a surface: each sticks to the place of the body where it was first seen (P4-5, P4-11).

A point that was not seen before is drawn to the nearest surface, as one of a cloud. Once the step is accepted it is
anchored where it lies on its segment; from then on it says in all three directions where that place is, so that turns
about a limb's own axis are seen. Anchors are what the sensor learnt, not parameters: skin slides on the bone by
`slide`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.surfaces import SurfaceAnchors
from kinefit.correspondences import surface_rows
from kinefit.errors import ObservationError
from kinefit.rows import AnyRows, Rows
from kinefit.sensors.base import Leftover, Matched, Measurement, Sensor, by_segments
from kinefit.sensors.scene import Scene
from kinefit.sensors.surface_match import SurfacePairs

_AGREES = 3.0  # standard deviations from the surface within which a new point is anchored
Anchor = tuple[int, NDArray]


@dataclass(frozen=True, eq=False)
class SurfacePointFrame:
    """Points of a surface at one time, as `photogrammetry.surface_tracking.SurfaceTracker.update` gives them.

    Parameters
    ----------
    sensor, time : name of the sensor, and [s]
    ids : (N,) int, the same for the same point at all times
    x_world : (N, 3) [m]; NaN where not seen
    covariance : (N, 3, 3) [m²]

    Raises
    ------
    ObservationError
        Shapes that do not fit, or a point twice.
    """

    sensor: str
    time: float
    ids: NDArray
    x_world: NDArray
    covariance: NDArray

    def __post_init__(self) -> None:
        ids, x, c = np.asarray(self.ids), np.asarray(self.x_world, float), np.asarray(self.covariance, float)
        if ids.ndim != 1 or x.shape != (len(ids), 3) or c.shape != (len(ids), 3, 3) or ids.dtype.kind not in "iu":
            problem = f"{ids.dtype} ids {ids.shape}, points {x.shape}, covariances {c.shape} of {self.sensor}"
            raise ObservationError(problem, remedy="Give whole numbers (N,), (N, 3) and (N, 3, 3).")
        if len(np.unique(ids)) < len(ids):
            raise ObservationError(f"a point of {self.sensor} twice", remedy="Give every point its own number.")
        seen = np.isfinite(x).all(axis=1) & np.isfinite(c).all(axis=(1, 2))
        for name, value in (("ids", ids[seen]), ("x_world", x[seen]), ("covariance", c[seen])):
            object.__setattr__(self, name, value)


class SurfacePointSensor(Sensor):
    """A surface that is tracked: skin, a sleeve. Give it to `Tracker(..., sensors=[...])` or to a `Recording`.

    Parameters
    ----------
    name : as its frames are named
    slide : float [m] standard deviation by which the surface slides on the bone, and the body's surface is off
    most : int, points that are used at a time, spread evenly
    """

    def __init__(self, name: str, *, slide: float = 0.01, most: int = 400) -> None:
        if not (0 < slide < np.inf) or most < 1:
            raise ObservationError(f"a slide of {slide} m, {most} points", remedy="Give positive numbers.")
        self.name, self.slide, self.most = name, float(slide), int(most)
        self.anchors: Mapping[int, Anchor] = {}

    def prepare(self, frame: SurfacePointFrame, scene: Scene) -> SurfacePointMeasurement:
        """Points with an anchor first, then new ones, no more than `most`."""
        if not isinstance(frame, SurfacePointFrame):
            problem = f"a {type(frame).__name__} for the sensor '{self.name}'"
            raise ObservationError(problem, remedy="Give a SurfacePointFrame.")
        known = np.array([int(i) in self.anchors for i in frame.ids], bool)
        order = np.concatenate([np.flatnonzero(known), np.flatnonzero(~known)])
        if len(order) > self.most:
            order = order[np.linspace(0, len(order) - 1, self.most).astype(int)]
        mean = np.trace(frame.covariance[order], axis1=1, axis2=2) / 3.0
        return SurfacePointMeasurement(
            frame.sensor, frame.time, frame.ids[order], frame.x_world[order], mean + self.slide**2, self.slide,
            self.anchors,
        )  # fmt: skip

    def learn(self, measurement: Measurement, scene: Scene, sure: bool) -> None:
        """Anchor the new points that lie on the surface."""
        if not sure or not isinstance(measurement, SurfacePointMeasurement):
            return
        new = measurement.new
        near = measurement.near(scene, new, _AGREES * self.slide)
        f = scene.frames[near.segment]
        gap = measurement.x_world[new][near.group] - f[:, 9:]
        rest = np.einsum("nji,nj->ni", f[:, :9].reshape(-1, 3, 3), gap)
        ids = measurement.ids[new][near.group]
        added = {int(i): (int(s), x) for i, s, x in zip(ids, near.segment, rest)}
        self.anchors = {**self.anchors, **added}


@dataclass(frozen=True, eq=False)
class SurfacePointMeasurement(Measurement):
    """Points of one time.

    Parameters
    ----------
    sensor, time, ids, x_world : as of the frame
    variance : (N,) [m²] with the slide
    slide : float [m]
    anchors : {id: (segment, place in its frame (3,) [m])}, as known then
    """

    sensor: str
    time: float
    ids: NDArray
    x_world: NDArray
    variance: NDArray
    slide: float
    anchors: Mapping[int, Anchor]
    settled = False

    @property
    def new(self) -> NDArray[np.int64]:
        """(M,) indices of points without an anchor."""
        return np.flatnonzero([int(i) not in self.anchors for i in self.ids])

    def near(self, scene: Scene, index: ArrayLike, reach: float) -> Rows:
        """Rows of some points to the nearest surface, within a distance [m]; groups count among `index`."""
        chosen = np.asarray(index, int)
        return surface_rows(
            scene.body, scene.state, np.ascontiguousarray(self.x_world[chosen]), max_distance=reach,
            sigma=float(np.sqrt(self.variance[chosen].mean())) if len(chosen) else 1.0, frames=scene.frames,
        )  # fmt: skip

    def match(self, scene: Scene, reach: float) -> SurfacePointMatched:
        """Anchors where there are; nearest points of the surface for the others."""
        new = self.new
        old = np.setdiff1d(np.arange(len(self.ids)), new)
        pairs, scale = [], max(reach, _AGREES * self.slide)
        if len(old):
            told = [self.anchors[int(i)] for i in self.ids[old]]
            segment, rest = np.array([s for s, _ in told]), np.array([x for _, x in told])
            for axis in np.eye(3):
                anchors = SurfaceAnchors(scene.body, segment, rest, np.tile(axis, (len(old), 1)))
                x = np.ascontiguousarray(self.x_world[old])
                pairs.append(SurfacePairs(anchors, x, 1.0 / self.variance[old], scale, False))
        if len(new):
            x = np.ascontiguousarray(self.x_world[new])
            pairs.append(SurfacePairs.nearest(self.near(scene, new, scale), x, scene, scale))
        lasts = float(self.slide**2 / self.variance.mean()) if len(self.ids) else 0.0
        return SurfacePointMatched(tuple(pairs), lasts, self.sensor)


@dataclass(frozen=True, eq=False)
class SurfacePointMatched(Matched):
    """Points with their places on the body.

    Parameters
    ----------
    pairs : of anchored points along three axes, and of new ones along the surface's normal
    lasts : share of the variance that lasts: the slide
    sensor : of the measurement
    """

    pairs: tuple[SurfacePairs, ...]
    lasts: float = 0.0
    sensor: str = ""
    of_points = False
    shows_surface = True

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a pair."""
        return [pairs.rows(scene) for pairs in self.pairs]

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [m] along the axes and normals, by segments."""
        told = [pairs.on_segments(scene) for pairs in self.pairs]
        residual = np.concatenate([np.zeros(0), *(rows.residual for rows in told)])
        segment = np.concatenate([np.zeros(0, np.int64), *(rows.segment for rows in told)])
        return [by_segments(self.sensor, scene.body, residual, segment, "m")]
