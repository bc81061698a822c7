"""Scene: what a measurement is compared with: a body in a pose, the cameras, other measurements of that time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.morphs.morphing import MorphedPose, Morphing
from kinefit.geometry.camera import Camera, Rig
from kinefit.sensors.visibility.visibility import TrackedSurface
from kinefit.solving.correspondences import targets
from kinefit.solving.correspondences.contours.outlines import on_moved_joints
from kinefit.solving.rows import DofRows, Rows

SURFACE_SAMPLES = 600  # points of a body's surface that are compared with depth images


@dataclass(frozen=True)
class Unknown:
    """A sensor's own unknown, such as a rope's length, with its prior.

    Parameters
    ----------
    mean, std : float, of the prior: in metres, radians, seconds or pixels.
    """

    mean: float
    std: float


class Scene:
    """A body at a state, with the cameras that see it.

    Scenes of one body share its surface and its morphs, and compute everything else on demand: a scene at another
    state costs next to nothing.

    Parameters
    ----------
    body : Body
    state : BodyState
    rig : Rig of all cameras
    time : float [s] of the state
    velocity : (6 + D,) [m/s, rad/s], optional
        Of the body, for measurements of another time than the scene's.
    values : {sensor: {name: value}}, optional
        Estimates of the sensors' own unknowns, such as the length of a rope; see `Unknown`.
    unknowns : {sensor: {name: Unknown}}, optional
        All of them: rows of the sensor are less sure by those without an estimate.
    measurements : each a `Measurement`, of all sensors at this time, for sensors that use each other's
    surface : TrackedSurface of the body, made when it is first needed
    others : scenes of other bodies at the same time
    covariance : (6 + D, 6 + D) [m, rad], optional
        Of the state, if a fit has estimated it.
    """

    def __init__(
        self, body: Body, state: BodyState, rig: Rig, *, time: float = 0.0, velocity: NDArray | None = None,
        values: Mapping[str, Mapping[str, float]] | None = None, measurements: Sequence[Any] = (),
        surface: TrackedSurface | None = None, others: Sequence[Scene] = (), samples: int = SURFACE_SAMPLES,
        covariance: NDArray | None = None, unknowns: Mapping[str, Mapping[str, Unknown]] | None = None,
    ) -> None:  # fmt: skip
        self.covariance = covariance
        self.body, self.state, self.rig, self.time, self.velocity = body, state, rig, time, velocity
        self.values, self.measurements, self.others = values or {}, tuple(measurements), tuple(others)
        self.unknowns = unknowns or {}
        self._samples = samples
        self._shared: dict[str, Any] = {} if surface is None else {"surface": surface}
        self._frames: NDArray | None = None
        self._made: dict[Any, Any] = {}

    def at(self, state: BodyState, **changes: Any) -> Scene:
        """The same scene with the body in another state; `changes` are other arguments of a scene."""
        given: dict[str, Any] = {
            "rig": self.rig, "time": self.time, "velocity": self.velocity, "values": self.values,
            "measurements": self.measurements, "others": self.others, "samples": self._samples,
            "unknowns": self.unknowns, **changes,
        }  # fmt: skip
        out = Scene(self.body, state, **given)
        out._shared = self._shared
        return out

    def at_time(self, time: float) -> Scene:
        """The scene at another time [s]: the body moves with its velocity.

        A velocity holds for about one frame: correct larger clock offsets beforehand.
        """
        if self.velocity is None or not abs(time - self.time) > 1e-9:
            return self
        return self.at(self.state.retract((time - self.time) * self.velocity), time=time)

    def value(self, sensor: str, name: str, default: float) -> float:
        """The estimate of a sensor's own unknown, in its unit [m, rad, s or px]; the default without one."""
        return self.values.get(sensor, {}).get(name, default)

    def placed(self, camera: Camera) -> Camera:
        """A sensor's camera with the extrinsics that the scene's rig has for its name; unchanged if the rig has none.

        So rows of every sensor follow a rig whose extrinsics are estimated. Repeated calls return the same object.
        """
        if any(c is camera for c in self.rig.cameras) or camera.name not in self.rig:
            return camera
        return _placed(camera, self.rig[camera.name])

    @property
    def surface(self) -> TrackedSurface:
        """The body's surface, with buffers to render it.

        Raises
        ------
        BodyError
            A body without surfaces.
        """
        if "surface" not in self._shared:
            self._shared["surface"] = TrackedSurface(self.body, self._samples)
        return self._shared["surface"]

    @property
    def morphing(self) -> Morphing | None:
        """Morphing of a body whose joint centres move with its angles; None if the tree alone places the segments."""
        if "morphing" not in self._shared:
            moving = None
            if self.body.morphs:
                own = self.surface.morphing if self.body.surfaces else Morphing(self.body)
                moving = own if own.moves_joints else None
            self._shared["morphing"] = moving
        return self._shared["morphing"]

    @property
    def pose(self) -> MorphedPose:
        """The body's skin in the world, morphed."""
        return self.surface.pose(self.state)

    @property
    def frames(self) -> NDArray:
        """(S, 12) of the segments: rotation (row-major), then translation [m]; see `KinematicTree.forward`."""
        if self._frames is None:
            if self.morphing is not None:
                self._frames = self.morphing.pose(self.state).frames
            else:
                self._frames = self.body.tree.forward(self.state.T_world_root, self.state.angles)[0]
        return self._frames

    def once(self, key: Any, make: Callable[[], NDArray]) -> NDArray:
        """The array that `make` returns, cached for this state under a key, of any shape (...,); do not change it."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def positions(self, points: PointSet) -> NDArray:
        """(K, 3) [m] points of the body in the world."""
        if self.morphing is not None:
            return self.morphing.pose(self.state).positions(points)
        return self.body.positions(self.state, points)

    def segment_jacobian(self, segment: int) -> NDArray:
        """(6, 6 + D) twist (v, ω) of a segment about the root's origin for each degree of freedom."""
        return self.segment_jacobians([segment])[0]

    def segment_jacobians(self, segments: Iterable[int]) -> list[NDArray]:
        """(6, 6 + D) of each of several segments; see `segment_jacobian`."""
        if self.morphing is not None:
            pose = self.morphing.pose(self.state)
            return [pose.segment_jacobian(int(s)) for s in segments]
        tree = self.body.tree
        screws = tree.forward(self.state.T_world_root, self.state.angles)[1]
        return [tree.segment_jacobian(screws, int(s)) for s in segments]

    def position(self, name: str) -> NDArray:
        """(3,) [m] a landmark of the body in the world."""
        return self.positions(self.body.landmarks.select((name,)))[0]

    def rows_of(self, kernel: Any, lines: int, points: PointSet, *given: Any) -> Rows | DofRows:
        """Rows of a compiled row kernel for points of the body, with the derivatives of moving joint centres."""
        if self.morphing is None:
            return targets.fill(kernel, lines, self.body, self.state, points, *given)
        pose = self.morphing.pose(self.state)
        rows = targets.fill(kernel, lines, self.body, self.state, points, *given, frames=pose.frames)
        return on_moved_joints(pose, rows)

    def along(
        self, points: PointSet, direction: NDArray, residual: NDArray, sigma: NDArray | float, **options: Any
    ) -> Rows | DofRows:
        """One row for each of K points: it should lie further along a direction (K, 3) by a residual (K,) [m].

        The short way for your own sensor; sigma [m]. `options` are `group` and `loss` of `Rows.of`.
        """
        x, n = self.positions(points), np.broadcast_to(np.asarray(direction, float), (len(points), 3))
        weight = np.broadcast_to(1.0 / np.square(np.asarray(sigma, float)), len(points))
        rows = Rows.of(points.segments, x, n, np.broadcast_to(residual, len(points)), weight, **options)
        return rows if self.morphing is None else on_moved_joints(self.morphing.pose(self.state), rows)


@lru_cache(maxsize=64)
def _placed(camera: Camera, there: Camera) -> Camera:
    same = np.array_equal(there.T_camera_world, camera.T_camera_world)
    return camera if same else camera.with_pose(there.T_camera_world)
