"""Landmarks that a network lifted from one image to space: how far each lies nearer or farther than the hips.

What the image itself shows of a landmark is the keypoints' to say. Of the landmarks in space only their depth counts
here, along the ray to the hips and from the middle of the hips, enlarged to the size of the body. So these rows are of
the same sum of squares for a body of any size, and what is left of the network's metres is one measurement of the
person: `person_size`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.bodies.limbs import rigid_pairs
from kinefit.geometry.lines import placed
from kinefit.observations import Keypoints, LiftedFrame
from kinefit.sensors.base import Hints, Matched, Measurement, Sensor
from kinefit.sensors.channels import known_points
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.scene import Scene
from kinefit.solving.rows import AnyRows, PairRows

HIPS = "left_hip", "right_hip"
"""The landmarks from whose middle a network counts."""

SIZE_STD = 0.08
"""Standard deviation of the logarithm of a person's size by a network's metres, `person_size`: 5 % between the cameras
of one person, and the network takes all people for nearly as tall: 9 % too much and too little for two others."""

_NETWORK_SIZE = 0.91  # of a person, by its metres: 0.94, 0.94, 0.90, 0.85 in each camera of the balancing trial
MIN_BONE_SHARE = 0.5  # of the longest bone: lengths in face, hands and feet are 0.2 to 1.5 times the person's


class LiftedSensor(Sensor):
    """A network that lifts the landmarks of one camera's image to space.

    Parameters
    ----------
    camera : str, of the rig
    sigma : float [m] standard deviation of a landmark's depth against that of the hips
    """

    places_points = True

    def __init__(self, camera: str, sigma: float) -> None:
        self.name, self.camera, self.sigma = f"lifted {camera}", camera, sigma

    def prepare(self, frame: LiftedFrame, scene: Scene) -> LiftedMeasurement:
        """Those landmarks that the body has.

        Raises
        ------
        BodyError, CalibrationError
            A keypoint set that the body does not have, a camera that the rig does not have.
        """
        scene.rig.index(self.camera)
        known = set(known_points(scene.body, frame.keypoint_set).names)
        seen = np.isfinite(frame.x).all(axis=1) & np.isfinite(frame.uv).all(axis=1)
        here = [k for k, name in enumerate(frame.names) if name in known and seen[k]]
        return LiftedMeasurement(self, frame, tuple(frame.names[k] for k in here), frame.x[here], frame.uv[here])


@dataclass(frozen=True, eq=False)
class OnBody:
    """Landmarks on a body: points (K,), the middle of the hips, both (K + 1,), and pairs (M,) `length` [m] apart."""

    points: PointSet
    hips: PointSet
    both: PointSet
    against: NDArray  # (K, 2) segments of the points, and of the hips
    first: NDArray
    second: NDArray
    length: NDArray


def long_bones(body: Body, points: PointSet) -> list[tuple[int, int, int, float]]:
    """Those of `rigid_pairs` of points of a body that are long, beside the longest."""
    pairs = rigid_pairs(body, points)
    longest = max((pair[3] for pair in pairs), default=0.0)
    return [pair for pair in pairs if pair[3] > MIN_BONE_SHARE * longest]


@lru_cache(maxsize=64)
def _on(body: Body, keypoint_set: str, names: tuple[str, ...]) -> OnBody:
    known = known_points(body, keypoint_set)
    points, middle = known.select(names), body.points_rest(known.select(HIPS)).mean(axis=0)
    pairs = long_bones(body, points)
    first, second = (np.array([pair[k] for pair in pairs], np.int64) for k in (0, 1))
    hips = PointSet(("hips",), np.zeros(1, np.int64), middle[None] - body.tree.rest[0])
    both = PointSet(
        (*points.names, "hips"), np.append(points.segments, 0), np.concatenate([points.points, hips.points])
    )
    against = np.column_stack([points.segments, np.zeros(len(points), np.int64)])
    return OnBody(points, hips, both, against, first, second, np.array([pair[3] for pair in pairs], float))


def _size(bones: OnBody, x: NDArray) -> NDArray:
    """(...) size of a body as a share of that of landmarks (..., K, 3) [m], by its long bones; 1 without any."""
    if not len(bones.length):
        return np.ones(x.shape[:-2])
    apart = x[..., bones.first, :] - x[..., bones.second, :]
    return np.asarray(np.sqrt(bones.length @ bones.length / np.square(apart).sum(axis=(-2, -1))))


def person_size(body: Body, record: Keypoints) -> float:
    """Size of the person of a record as a share of the body's, by the network's metres; NaN where they are unknown.

    Its logarithm has a standard deviation of `SIZE_STD`.
    """
    known = set(known_points(body, record.keypoint_set).names)
    here = [k for k, name in enumerate(record.names) if name in known]
    bones = _on(body, record.keypoint_set, tuple(record.names[k] for k in here))
    if record.lifted is None or not len(bones.length):
        return np.nan
    sizes = _size(bones, record.lifted[:, 0, here])
    sizes = sizes[np.isfinite(sizes)]
    return 1.0 / (_NETWORK_SIZE * float(np.median(sizes))) if len(sizes) else np.nan


class LiftedMeasurement(Measurement):
    """Landmarks of one image.

    Parameters
    ----------
    of : LiftedSensor
    frame : LiftedFrame they are of
    names : (K,)
    x : (K, 3) [m] from the middle of the hips, along u, v and away from the camera
    uv : (K, 2) [px]
    """

    def __init__(self, of: LiftedSensor, frame: LiftedFrame, names: tuple[str, ...], x: NDArray, uv: NDArray) -> None:
        self.sensor, self.time, self.of, self.keypoint_set = of.name, frame.time, of, frame.keypoint_set
        self.names, self.x, self.uv = names, x, uv

    def on(self, body: Body) -> OnBody:
        """The landmarks on a body."""
        return _on(body, self.keypoint_set, self.names)

    def size_on(self, body: Body) -> float:
        """How much larger this body is than the person that the network takes for granted."""
        return float(_size(self.on(body), self.x))

    def match(self, scene: Scene, reach: float) -> LiftedMatched:
        """As they are named."""
        camera = scene.rig[self.of.camera]
        ray = scene.positions(self.on(scene.body).hips)[0] - camera.centre_world
        return LiftedMatched(self, ray / np.linalg.norm(ray), self.size_on(scene.body))

    def hints(self, scene: Scene) -> Hints:
        """The landmarks in space, at the distance at which they appear as large as they do."""
        points = self.on(scene.body).points
        return Hints(points, placed(scene.rig[self.of.camera], self.x * self.size_on(scene.body), self.uv))


@dataclass(frozen=True, eq=False)
class LiftedMatched(Matched):
    """Landmarks with the direction in which their depth counts, frozen.

    Parameters
    ----------
    measurement : LiftedMeasurement
    ray : (3,) unit, from the camera to the hips, in the world
    size : float, by which the network's person is enlarged; by more on a larger body, with as much more deviation
    """

    measurement: LiftedMeasurement
    ray: NDArray
    size: float
    lasts = 0.9

    @property
    def channels(self) -> Sequence[str]:
        """The landmarks."""
        return self.measurement.names

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """A row a landmark: its depth behind the middle of the hips."""
        m = self.measurement
        bones = m.on(scene.body)
        x = scene.positions(bones.both)
        ref, x = np.broadcast_to(x[-1], (len(x) - 1, 3)), x[:-1]
        size = m.size_on(scene.body)
        residual = size * m.x[:, 2] - (x - ref) @ self.ray
        weight = np.full(len(x), (self.size / (size * m.of.sigma)) ** 2)
        return [PairRows(bones.against, x, ref, np.broadcast_to(self.ray, x.shape), residual, weight)]

    def evidence(self, scene: Scene) -> Evidence:
        """No evidence for or against a segment: errors of lifted landmarks are correlated over time."""
        return Evidence(*np.zeros((2, len(scene.body.tree.segments))))
