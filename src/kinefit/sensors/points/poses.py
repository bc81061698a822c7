"""Joints in space that another program estimated: where each lies against the middle of the hips, and the hips' path.

What such a program does not know of itself is asked of the take: by how much its metres are off, a constant offset of
each of its joints from the body's, and, where its world is not the take's, the transform between them. Its errors last
over frames, and are larger along the ray of the camera. Its size is an unknown of the sensor, not read off the body's
bones in each row: rows of an arm would then depend on the lengths of legs.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.bodies.motion import UP_AXES
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.losses import Loss
from kinefit.observations import BodyTrackerFrame
from kinefit.sensors.base import Hints, Leftover, Matched, Measurement, Sensor, Unknown, of_kind
from kinefit.sensors.points.body_trackers import Place, places_on
from kinefit.sensors.points.lifted import long_bones
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import MARKER_LOSS, TrackSettings
from kinefit.solving.correspondences import _kernels
from kinefit.solving.equations import design
from kinefit.solving.rows import AnyRows, DofRows

HIPS = ("thigh_l", "thigh_r", "l_hip", "r_hip")
"""Places of the body whose middle joints are counted from."""

_SIDE = re.compile(r"^[lr]_|_[lr]$")
_LEAN_STD = np.radians(5.0)  # of the vertical of another world: OpenCap Monocular's leans by 4 degrees
_HEADING_STD = np.radians(20.0)  # of its heading as single poses place it, which may see a person turned
_FOLLOWING_PATH_STD = 1.0  # [m] of the hips in another world: at 0.03 their path makes a stated stature 5 % too large
_FULL_ERROR_DISTANCE = 0.4  # [m] along the bones: nearer to the hips errors are less in proportion, down to half
_PLACING_FRAMES = 100  # whose poses place another world; more change nothing


@dataclass(frozen=True)
class PoseErrors:
    """Standard deviations of what another program estimated.

    Parameters
    ----------
    sigma : float [m] of a joint against the middle of the hips, across the camera's ray
    depth_factor : float, as many times as large it is along the ray
    root : float [m] of the middle of the hips, in the take's world
    offset : float [m] of the constant offsets of its joints from the body's along each axis; 0: there are none
    size : float, of the logarithm of the size of its person

    Raises
    ------
    ObservationError
        Not positive.
    """

    sigma: float = 0.02
    depth_factor: float = 2.0
    root: float = 0.03
    offset: float = 0.0
    size: float = 0.05

    def __post_init__(self) -> None:
        positive = self.sigma, self.depth_factor, self.root, self.size
        if not (all(0.0 < value < np.inf for value in positive) and 0.0 <= self.offset < np.inf):
            raise ObservationError(f"not all are positive: {self}", remedy="Give positive numbers.")


class PoseSensor(Sensor):
    """Joints that another program estimated. Give it to `Tracker(..., sensors=[...])` or to a `Recording`.

    Parameters
    ----------
    name : as its frames (`BodyTrackerFrame`) are named
    points : {joint of the program: place on the body}, both of `HIPS` among them
    lengths : {(joint, joint): [m]} median distances of the program's joints, which tell the size of its person
    errors : PoseErrors
    camera : of the rig, from whose image it was estimated; None if unknown
    up : vertical axis of the take, where frames are in another world, which other sensors of the take place; "camera":
        frames are in the axes of `camera`; None: they are in the take's world

    Raises
    ------
    ObservationError
        No hips among the joints.
    """

    places_points = True
    state_attributes = ("placings",)

    def __init__(
        self, name: str, points: Mapping[str, Place], lengths: Mapping[tuple[str, str], float],
        errors: PoseErrors | None = None, *, camera: str | None = None, up: str | None = None,
    ) -> None:  # fmt: skip
        self.name, self.points, self.lengths, self.camera, self.up = name, dict(points), dict(lengths), camera, up
        self.errors, self.placings = errors or PoseErrors(), np.zeros((0, 4))
        self.follows, self.is_placed = up is not None, up in (None, "camera")
        self.hips = tuple(joint for joint, place in self.points.items() if place in HIPS)
        if len(self.hips) != 2:
            remedy = 'Name both hips in joints = { NAME = "thigh_l", NAME = "thigh_r", ... }.'
            raise ObservationError(f"{len(self.hips)} hips among the joints {', '.join(self.points)}", remedy=remedy)
        own = {_kind(place)[0]: self._free_axes(place) for place in self.points.values()}
        axes = [f"{kind} {axis}" for kind, free in own.items() for axis in free]
        self.unknowns = {"size": Unknown(0.0, self.errors.size)}
        self.unknowns |= {axis: Unknown(0.0, self.errors.offset) for axis in axes if self.errors.offset}
        if not self.is_placed:
            turns = [_HEADING_STD if axis in (up or "") else _LEAN_STD for axis in "xyz"]
            self.unknowns |= {f"r{axis}": Unknown(0.0, std) for axis, std in zip("xyz", turns)}

    @staticmethod
    def _free_axes(place: Place) -> str:
        """Axes of its offset: all others are counted from the hips, and amid landmarks a joint is by definition."""
        if not isinstance(place, str):
            return ""
        return "z" if place in HIPS else "xyz" if _kind(place)[1] else "xy"

    def prepare(self, frame: BodyTrackerFrame, scene: Scene) -> PoseMeasurement:
        """The joints that were estimated; none where a hip is missing.

        Raises
        ------
        BodyError
            A place that the body does not have.
        """
        of_kind(frame, BodyTrackerFrame, f"a frame of the sensor '{self.name}'", "Give its data in such a record.")
        seen = {n: x for n, x in zip(frame.names, frame.x_world) if n in self.points and np.isfinite(x).all()}
        names = tuple(seen) if all(hip in seen for hip in self.hips) else ()
        self.places(scene.body, names)
        return PoseMeasurement(self, frame.time, names, np.reshape([seen[n] for n in names], (-1, 3)))

    def learn(self, measurement: PoseMeasurement, scene: Scene, sure: bool) -> None:
        """Place its world by a pose of the take, where it is another one: lost limbs do not count, as poses vote."""
        if self.is_placed or len(self.placings) >= _PLACING_FRAMES or not measurement.names:
            return
        e, x, target = np.array(UP_AXES[self.up or ""]), measurement.x, scene.positions(measurement.on(scene))
        hips, here = measurement.middle(x), measurement.middle(target)
        a, b = x - hips, target - here
        a, b = a - np.outer(a @ e, e), b - np.outer(b @ e, e)
        turn = np.arctan2(np.sum(np.cross(a, b) @ e), np.sum(a * b))
        R, size = se3.exp_so3(turn * e), self.size(scene)
        self.placings = np.vstack([self.placings, [turn, *(here - size * R @ hips)]])

    def T_world_file(self, scene: Scene) -> NDArray | None:
        """(4, 4) [m] from the program's frame to the world, as it was placed; None if it is not placed yet."""
        if self.up == "camera":
            return se3.inverse(scene.rig[self.camera or ""].T_camera_world)
        if self.up is None:
            return np.eye(4)
        if not len(self.placings):
            return None
        turn, shift = self.placings[:, 0], self.placings[:, 1:]
        middle = np.angle(np.exp(1j * turn).sum())
        middle += np.median(np.angle(np.exp(1j * (turn - middle))))
        near = np.argsort(np.abs(np.angle(np.exp(1j * (turn - middle)))))[: (len(turn) + 1) // 2]
        return se3.transform(se3.exp_so3(middle * np.array(UP_AXES[self.up])), np.median(shift[near], axis=0))

    def places(self, body: Body, names: Sequence[str]) -> PointSet:
        """(K,) where joints are on a body; BodyError for a place that it does not have."""
        return places_on(body, "joint", tuple(names), tuple(self.points[name] for name in names))

    def offsets(self, names: Sequence[str], scene: Scene) -> NDArray:
        """(K, 3) [m] offsets of joints in the frames of their segments; of left and right one is the other's mirror."""
        kinds = [_kind(self.points[name]) for name in names]
        values = [[scene.value(self.name, f"{kind} {axis}", 0.0) for axis in "xyz"] for kind, _ in kinds]
        return np.reshape(values, (-1, 3)) * [(1.0, 1.0, side or 0.0) for _, side in kinds]

    def size(self, scene: Scene) -> float:
        """By how much the program's metres are too small; where that is not estimated, as the body's long bones say."""
        known = scene.value(self.name, "size", np.nan)
        return float(np.exp(known)) if np.isfinite(known) else self.size_on(scene.body)

    def size_on(self, body: Body) -> float:
        """How much larger a body is than the program's person, by their long bones; 1 without any."""
        return _size(body, tuple(self.points.items()), tuple(self.lengths.items()))

    def person_size(self, body: Body) -> tuple[float, float] | None:
        """Size of its person as a share of the body's, and the standard deviation of its logarithm."""
        return 1.0 / self.size_on(body), self.errors.size


@lru_cache(maxsize=256)
def _kind(place: Place) -> tuple[str, int]:
    """Name of a place without its side, and its side: 1 right, -1 left, 0 in the middle."""
    name = place if isinstance(place, str) else place[0]
    side = _SIDE.search(name) if isinstance(place, str) else None
    return _SIDE.sub("", name), 0 if side is None else 1 if "r" in side[0] else -1


@lru_cache(maxsize=256)
def _size(
    body: Body, points: tuple[tuple[str, Place], ...], lengths: tuple[tuple[tuple[str, str], float], ...]
) -> float:
    names, known = tuple(name for name, _ in points), dict(lengths)
    bones = long_bones(body, places_on(body, "joint", names, tuple(place for _, place in points)))
    both = [(length, known.get((names[a], names[b]), np.nan)) for a, b, _, length in bones]
    ours, theirs = np.reshape([pair for pair in both if np.isfinite(pair[1])], (-1, 2)).T
    return float(np.sqrt(ours @ ours / (theirs @ theirs))) if len(ours) else 1.0


@dataclass(frozen=True, eq=False)
class PoseMeasurement(Measurement):
    """Joints of one time.

    Parameters
    ----------
    of : PoseSensor
    time : float [s]
    names : (K,); x : (K, 3) [m] in the program's frame
    """

    of: PoseSensor
    time: float
    names: tuple[str, ...]
    x: NDArray

    @property
    def sensor(self) -> str:  # type: ignore[override]
        """Name of the sensor."""
        return self.of.name

    def on(self, scene: Scene) -> PointSet:
        """(K,) the joints on the body of a scene, with their offsets."""
        points = self.of.places(scene.body, self.names)
        return PointSet(points.names, points.segments, points.points + self.of.offsets(self.names, scene))

    def sigmas(self, scene: Scene) -> NDArray:
        """(K,) [m] standard deviations of the joints against the hips: less for those of the pelvis itself."""
        tree, points = scene.body.tree, self.of.places(scene.body, self.names)
        bones = np.zeros(len(tree.segments))
        for k, parent in enumerate(tree.parents):
            if parent >= 0:
                bones[k] = bones[parent] + np.linalg.norm(tree.rest[k] - tree.rest[parent])
        away = (bones[points.segments] + np.linalg.norm(points.points, axis=1)) / self.of.size(scene)
        return np.asarray(self.of.errors.sigma * np.clip(away / _FULL_ERROR_DISTANCE, 0.5, 1.0))

    def middle(self, x: NDArray) -> NDArray:
        """(...) the mean over the hips of values (K, ...) of all joints."""
        return np.asarray(x[[self.names.index(hip) for hip in self.of.hips]].mean(axis=0))

    def match(self, scene: Scene, reach: float) -> PoseMatched:
        """Match joints by their names, in the program's world as it is placed."""
        loss = replace(MARKER_LOSS, scale=MARKER_LOSS.scale * max(reach / TrackSettings.near, 1.0))
        T, eye = self.of.T_world_file(scene), None
        seen_by = self.of.camera or (scene.rig.names[0] if len(scene.rig) == 1 else None)
        if seen_by is not None and self.names:
            eye = self.middle(scene.positions(self.on(scene))) - scene.rig[seen_by].centre_world
        return PoseMatched(self, loss, T, eye)

    def hints(self, scene: Scene) -> Hints:
        """Places of the joints; none while the program's world is not placed."""
        T = self.of.T_world_file(scene)
        if T is None or not self.names:
            return Hints()
        points = self.of.places(scene.body, self.names)
        return Hints(points, se3.apply(T, self.of.size(scene) * self.x))


@dataclass(frozen=True, eq=False)
class PoseMatched(Matched):
    """Joints with what was decided for them.

    Parameters
    ----------
    measurement : PoseMeasurement
    loss : Loss of a joint
    T_world_file : (4, 4) [m] the program's frame, as it was placed; None: there are no rows yet
    ray : (3,) from the camera to the hips in the world; None without a camera
    """

    measurement: PoseMeasurement
    loss: Loss
    T_world_file: NDArray | None
    ray: NDArray | None
    lasts = 0.9

    @property
    def channels(self) -> Sequence[str]:  # type: ignore[override]
        """The joints, then "root" of the hips' path."""
        return (*self.measurement.of.points, "root")

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """Three rows a joint, against the middle of the hips, and three of that."""
        m, errors = self.measurement, self.measurement.of.errors
        if self.T_world_file is None or not m.names:
            return []
        points, size = m.on(scene), m.of.size(scene)
        left, axes = self._left(scene, points), np.eye(3)
        if self.ray is not None:
            axes = se3.shortest_turn(np.array([0.0, 0.0, 1.0]), self.ray).T
        path = _FOLLOWING_PATH_STD if m.of.follows else errors.root
        std = np.tile(np.append(m.sigmas(scene), path)[:, None], 3)
        std[:, 2] *= 1.0 if self.ray is None else errors.depth_factor
        ids = [self.channels.index(name) for name in (*m.names, "root")]

        def jacobian() -> NDArray:
            rows = scene.rows_of(_kernels.point_rows, 3, points, scene.positions(points), np.ones(len(points)))
            J = design(scene.body, scene.state, rows).reshape(len(points), 3, -1)
            middle = m.middle(J)
            return np.asarray((axes @ np.concatenate([J - middle, middle[None]])).reshape(3 * len(std), -1))

        weight = (size * std) ** -2.0  # in the program's metres: a larger size is not surer, and has no larger errors
        hips = points.segments[m.names.index(m.of.hips[0])]
        segments = np.repeat([*points.segments, scene.body.tree.parents[hips]], 3)
        residual = (left @ axes.T).ravel()
        return [DofRows(jacobian, residual, weight.ravel(), np.repeat(ids, 3), loss=self.loss, segment=segments)]

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Residuals of every joint against the middle of the hips."""
        m = self.measurement
        if self.T_world_file is None or not m.names:
            return []
        points = m.on(scene)
        values = self._left(scene, points)[:-1]
        factor = self.loss.factor(np.square(values / m.sigmas(scene)[:, None]).sum(axis=1))
        return [Leftover(m.sensor, m.names, points.segments, values, factor, "m", scene.positions(points) + values)]

    def _left(self, scene: Scene, points: PointSet) -> NDArray:
        """(K + 1, 3) [m] measured minus fitted, along the world's axes, of joints against the hips, and of the hips."""
        m = self.measurement
        assert self.T_world_file is not None
        R = (
            se3.exp_so3(np.array([scene.value(m.sensor, f"r{axis}", 0.0) for axis in "xyz"]))
            @ self.T_world_file[:3, :3]
        )
        seen, x = m.of.size(scene) * m.x @ R.T, scene.positions(points)
        root = m.middle(seen) + self.T_world_file[:3, 3] - m.middle(x)
        return np.vstack([(seen - m.middle(seen)) - (x - m.middle(x)), root])
