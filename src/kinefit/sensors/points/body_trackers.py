"""Trackers fixed on the body, such as magnetic ones: each shows the pose of a segment, or the place of a point on it.

P2 2.3 takes them for "3D point to point" at feature points of the H-Anim specification. Those are landmarks of the
catalogue's bodies. A place makes three rows, as a marker does. An orientation makes three more: with the rotation of
the tracker R, of its segment R_s and of its mount M, the residual is the rotation vector φ = log(R (R_s M)ᵀ). A turn
of the segment by δω changes it by −J(−φ)⁻¹ δω, with the left Jacobian J of SO(3).

Turns are weighed as distances at the lever `sigma / rotation_sigma`, so that all residuals are in metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import check_shape
from kinefit.bodies import Body, PointSet
from kinefit.errors import BodyError, ObservationError, check_choice, choices
from kinefit.geometry import se3
from kinefit.geometry.losses import Loss
from kinefit.observations import BodyTrackerFrame
from kinefit.sensors.base import Hints, Leftover, Matched, Measurement, Sensor, Unknown, of_kind
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import MARKER_LOSS, TrackSettings
from kinefit.solving.correspondences import _kernels
from kinefit.solving.rows import AnyRows, DofRows

_REFERENCE_DISTANCE_M = TrackSettings.near  # [m] correspondence distance at which the loss holds as it is
_LEVER = 0.1  # [m] of the points that show an orientation to a start


Place = str | tuple[str, ...]
"""A landmark of the body, a segment, whose origin it then is, or landmarks of one segment, in whose middle it is."""


@lru_cache(maxsize=256)
def places_on(body: Body, what: str, names: tuple[str, ...], places: tuple[Place, ...]) -> PointSet:
    """(K,) points of a body at places; BodyError for a place that it does not have, of `what`, such as a "tracker"."""
    segments, x = list[int](), list[NDArray]()
    for name, place in zip(names, places):
        own = (place,) if isinstance(place, str) else place
        if all(one in body.landmarks.names for one in own):
            at = body.landmarks.select(own)
            segments, x = [*segments, int(at.segments[0])], [*x, at.points.mean(axis=0)]
        elif len(own) == 1 and own[0] in body.tree.segments:
            segments, x = [*segments, body.tree.segment(own[0])], [*x, np.zeros(3)]
        else:
            problem = choices("landmark or segment", ", ".join(own), [*body.landmarks.names, *body.tree.segments])
            raise BodyError(f"{what} '{name}': {problem}", remedy="Give a landmark or segment of the body.")
    return PointSet(names, np.array(segments, np.int64), np.reshape(x, (-1, 3)))


class BodyTrackerSensor(Sensor):
    """Trackers on the body. Give it to `Tracker(..., sensors=[...])` or to a `Recording`.

    Parameters
    ----------
    name : as its frames are named
    points : {tracker: landmark of the body, or segment, whose origin it then is}
    sigma : float [m] standard deviation of a place along each axis, with what a tracker moves on the skin
    rotation_sigma : float [rad] standard deviation of an orientation about each axis
    mounts : {tracker: (3,) [rad]} rotation vector from the tracker's axes to its segment's; default: they are the same
    mount_sigma : float [rad] standard deviation of the mounts, which `track` then estimates; default: they are exact

    Raises
    ------
    ObservationError
        Standard deviations that are not positive, a mount of no tracker, no tracker.
    """

    places_points = True

    def __init__(
        self, name: str, points: Mapping[str, str], *, sigma: float = 0.005, rotation_sigma: float = 0.035,
        mounts: Mapping[str, ArrayLike] | None = None, mount_sigma: float = 0.0,
    ) -> None:  # fmt: skip
        if not (0 < sigma < np.inf and 0 < rotation_sigma < np.inf and 0 <= mount_sigma < np.inf and points):
            problem = f"sigma {sigma} m, rotation_sigma {rotation_sigma} rad, mount_sigma {mount_sigma} rad, "
            problem += f"{len(points)} points: not all are positive"
            raise ObservationError(problem, remedy="Give positive numbers, and points with the place of each tracker.")
        for tracker, mount in (mounts or {}).items():
            check_choice("tracker", tracker, points, ObservationError, remedy="Add it to points.")
            check_shape(np.asarray(mount, float), (3,), f"the mount of tracker '{tracker}'", finite=True)
        self.name, self.points, self.sigma, self.lever = name, dict(points), float(sigma), sigma / rotation_sigma
        self.mounts = {k: np.asarray(v, float) for k, v in (mounts or {}).items()}
        if mount_sigma:
            self.unknowns = {f"{k} r{axis}": Unknown(0.0, float(mount_sigma)) for k in points for axis in "xyz"}

    def prepare(self, frame: BodyTrackerFrame, scene: Scene) -> BodyTrackerMeasurement:
        """Those trackers that are on the body and were measured.

        Raises
        ------
        BodyError
            A point that the body does not have.
        """
        of_kind(frame, BodyTrackerFrame, f"a frame of the sensor '{self.name}'", "Give its data in such a record.")
        here = [k for k, n in enumerate(frame.names) if n in self.points and np.isfinite(frame.x_world[k]).all()]
        names = tuple(frame.names[k] for k in here)
        self.places(scene.body, names)
        assert frame.Rs_world_tracker is not None
        x, R = np.ascontiguousarray(frame.x_world[here]), frame.Rs_world_tracker[here]
        return BodyTrackerMeasurement(self, frame.time, names, x, R)

    def places(self, body: Body, names: Sequence[str]) -> PointSet:
        """(K,) where trackers are on a body: its landmarks, else origins of its segments; else BodyError."""
        return places_on(body, "tracker", tuple(names), tuple(self.points[name] for name in names))

    def mounted(self, names: Sequence[str], scene: Scene) -> NDArray:
        """(K, 3, 3) rotations from the axes of trackers to those of their segments, as the scene has them."""
        known = np.array([self.mounts.get(name, (0.0, 0.0, 0.0)) for name in names], float)
        more = np.array([[scene.value(self.name, f"{name} r{axis}", 0.0) for axis in "xyz"] for name in names])
        return se3.exp_so3(known.reshape(-1, 3)) @ se3.exp_so3(more.reshape(-1, 3))


@dataclass(frozen=True, eq=False)
class BodyTrackerMeasurement(Measurement):
    """Trackers of one time.

    Parameters
    ----------
    of : BodyTrackerSensor
    time : float [s]
    names : (K,); x_world : (K, 3) [m]; Rs_world_tracker : (K, 3, 3), NaN where not measured
    """

    of: BodyTrackerSensor
    time: float
    names: tuple[str, ...]
    x_world: NDArray
    Rs_world_tracker: NDArray

    @property
    def sensor(self) -> str:  # type: ignore[override]
        """Name of the system."""
        return self.of.name

    def match(self, scene: Scene, reach: float) -> BodyTrackerMatched:
        """Match trackers by their names."""
        scale = MARKER_LOSS.scale * max(reach / _REFERENCE_DISTANCE_M, 1.0)
        return BodyTrackerMatched(self, replace(MARKER_LOSS, scale=scale))

    def hints(self, scene: Scene) -> Hints:
        """Places of the trackers, and points along their axes where orientations are known."""
        points = self.of.places(scene.body, self.names)
        axes = _LEVER * self.of.mounted(self.names, scene).swapaxes(1, 2)
        x = self.x_world[:, None] + _LEVER * self.Rs_world_tracker.swapaxes(1, 2)
        names = [*self.names, *(f"{name} {axis}" for name in self.names for axis in "xyz")]
        at = np.concatenate([points.points, (points.points[:, None] + axes).reshape(-1, 3)])
        segments = np.concatenate([points.segments, np.repeat(points.segments, 3)])
        return Hints(PointSet(tuple(names), segments, at), np.concatenate([self.x_world, x.reshape(-1, 3)]))


@dataclass(frozen=True, eq=False)
class BodyTrackerMatched(Matched):
    """Trackers with their places on the body; measurement and the Loss of a place, or of an orientation."""

    measurement: BodyTrackerMeasurement
    loss: Loss
    lasts = 1.0  # as of markers: skin, and where and how they were put on, are more than the noise of the system
    independent = True

    @property
    def turned(self) -> NDArray[np.int64]:
        """(T,) indices of trackers whose orientation was measured."""
        return np.flatnonzero(np.isfinite(self.measurement.Rs_world_tracker).all(axis=(1, 2)))

    @property
    def channels(self) -> Sequence[str]:  # type: ignore[override]
        """The trackers, then "TRACKER turn" of those whose orientation was measured."""
        names = self.measurement.names
        return [*names, *(f"{names[k]} turn" for k in self.turned)]

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """Three rows a place [m]; three rows an orientation [m at the lever]."""
        m, turned = self.measurement, self.turned
        points, weight = m.of.places(scene.body, m.names), 1.0 / m.of.sigma**2
        out = [scene.rows_of(_kernels.point_rows, 3, points, m.x_world, np.full(len(points), weight))]
        if len(turned):
            segments, phi = np.repeat(points.segments[turned], 3), self._turns(scene, points)
            moves = np.stack([J[3:] for J in scene.segment_jacobians(points.segments[turned])])
            J = np.linalg.solve(se3.left_jacobian_so3(-phi), moves)
            groups, weights = len(points) + np.repeat(np.arange(len(turned)), 3), np.full(3 * len(turned), weight)
            J, r = m.of.lever * J.reshape(len(segments), -1), m.of.lever * phi.ravel()
            out.append(DofRows(J, r, weights, groups, segment=segments))
        return [replace(rows, loss=self.loss) for rows in out]

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Residuals of every tracker's place; orientations are no lengths and have none."""
        m = self.measurement
        points = m.of.places(scene.body, m.names)
        values = m.x_world - scene.positions(points)
        factor = self.loss.factor(np.square(values / m.of.sigma).sum(axis=1))
        return [Leftover(m.sensor, m.names, points.segments, values, factor, "m", m.x_world)]

    def _turns(self, scene: Scene, points: PointSet) -> NDArray:
        """(T, 3) [rad] rotation vectors in the world that take the body's trackers to the measured ones."""
        m, turned = self.measurement, self.turned
        Rs_world_segment = scene.frames[points.segments[turned], :9].reshape(-1, 3, 3)
        mounts = m.of.mounted([m.names[k] for k in turned], scene)
        return se3.log_so3(m.Rs_world_tracker[turned] @ (Rs_world_segment @ mounts).swapaxes(1, 2))
