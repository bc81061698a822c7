"""Lines in one image that points or edges of the body lie on: edges of known objects, ropes, rails (P1 2.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.correspondences import _kernels
from kinefit.geometry.camera import Camera
from kinefit.losses import Loss
from kinefit.observations import LineFrame
from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched, Measurement, Sensor
from kinefit.sensors.scene import Scene


class ImageLineSensor(Sensor):
    """Lines in the images of one camera, told by name.

    Parameters
    ----------
    name : str
    sigma : float [px] standard deviation of a point's distance from its line, in the calibration's image
    loss : Loss of a line, in its standard deviations; the two ends of an edge share it
    near : float [m] correspondence distance at which the loss holds as it is; it is wider while all is far off
    """

    def __init__(self, name: str, sigma: float, loss: Loss, near: float) -> None:
        self.name, self.sigma, self.loss, self.near = name, sigma, loss, near

    def prepare(self, frame: LineFrame, scene: Scene) -> ImageLineMeasurement:
        """Those lines that were seen.

        Raises
        ------
        BodyError
            A landmark that the body does not have.
        CalibrationError
            A camera that is not in the rig.
        """
        seen = np.isfinite(frame.ends).all(axis=(1, 2))
        points = [(k, n) for k in np.flatnonzero(seen) for n in frame.landmarks[k]]
        line = np.array([k for k, _ in points], np.int64)
        made = ImageLineMeasurement(
            self, frame.sensor, frame.time, tuple(n for _, n in points), line, np.ascontiguousarray(frame.ends[line])
        )
        scene.rig.index(frame.sensor)
        made.points_of(scene.body)  # which tells what the body lacks
        return made


class ImageLineMeasurement(Measurement):
    """Lines of one image.

    Parameters
    ----------
    of : ImageLineSensor
    camera : str
    time : float [s]
    names : (K,) landmarks; line : (K,) int, the line of each; those of one line are adjacent
    ends : (K, 2, 2) [px] two points of the line of each landmark, in the calibration's image
    """

    def __init__(
        self, of: ImageLineSensor, camera: str, time: float, names: tuple[str, ...], line: NDArray, ends: NDArray
    ) -> None:
        self.sensor, self.time, self.of = of.name, time, of
        self.camera, self.names, self.line, self.ends = camera, names, line, ends
        self._points: tuple[Body, PointSet] | None = None

    def points_of(self, body: Body) -> PointSet:
        """(K,) the landmarks on a body."""
        if self._points is None or self._points[0] is not body:
            self._points = body, body.landmarks.select(self.names)
        return self._points[1]

    def match(self, scene: Scene, reach: float) -> ImageLineMatched:
        """As the lines are named."""
        loss = self.of.loss
        return ImageLineMatched(self, replace(loss, scale=loss.scale * max(reach / self.of.near, 1.0)))


@dataclass(frozen=True, eq=False)
class ImageLineMatched(Matched):
    """Lines with their landmarks; measurement and the Loss of a line."""

    measurement: ImageLineMeasurement
    loss: Loss

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a landmark: its pixel should lie on the image line; one robust weight a line."""
        m = self.measurement
        points, k = m.points_of(scene.body), scene.rig.index(m.camera)
        camera = scene.rig.cameras[k]
        lines = image_lines(camera, m.ends, scene.positions(points))
        weight = np.full(len(points), 1.0 / m.of.sigma**2)
        index = np.full(len(points), k, np.int64)
        rows = scene.rows_of(_kernels.image_line_rows, 1, points, scene.rig.packed, index, lines, weight)
        return [replace(rows, group=np.ascontiguousarray(m.line[rows.group]), loss=self.loss)]


def image_lines(camera: Camera, ends: NDArray, x_world: NDArray) -> NDArray:
    """(K, 3) image lines a u + b v + c = 0 through two pixels each, for points of the world that should lie on them.

    A lens bends a straight edge: there it is the tangent to the edge's image where the edge is nearest to the point.

    Parameters
    ----------
    camera : Camera
    ends : (K, 2, 2) [px] in the calibration's image.
    x_world : (K, 3) [m]
    """
    u, v = ends[:, 0], ends[:, 1]
    lines = np.stack([u[:, 1] - v[:, 1], v[:, 0] - u[:, 0], u[:, 0] * v[:, 1] - v[:, 0] * u[:, 1]], axis=1)
    if not camera.distortion.any() and camera.model == "radtan":
        return lines
    rays = camera.ray(ends.reshape(-1, 2)).reshape(-1, 2, 3)
    normal = np.cross(rays[:, 0], rays[:, 1])  # of the plane in which camera and edge lie
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    away = x_world - camera.centre_world
    foot = away - np.sum(away * normal, axis=1, keepdims=True) * normal
    along = np.cross(normal, foot / np.linalg.norm(foot, axis=1, keepdims=True))
    uv, jacobian = camera.project_with_jacobian(camera.centre_world + foot)
    t = np.einsum("kij,kj->ki", jacobian, along)
    bent = np.stack([t[:, 1], -t[:, 0], t[:, 0] * uv[:, 1] - t[:, 1] * uv[:, 0]], axis=1)
    return np.where(np.isfinite(bent).all(axis=1, keepdims=True), bent, lines)
