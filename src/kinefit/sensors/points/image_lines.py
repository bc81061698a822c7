"""Lines in one image that points or edges of the body lie on: edges of known objects, ropes, rails (P1 2.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.geometry.camera import Camera
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.observations import LineFrame
from kinefit.sensors.base import Leftover, Matched, Measurement, Sensor
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, MIN_VISIBLE_OUTLINE, Evidence
from kinefit.sensors.scene import Scene
from kinefit.solving.correspondences import _kernels
from kinefit.solving.rows import AnyRows


class ImageLineSensor(Sensor):
    """Lines in the images of one camera, known by name.

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
            self, frame.sensor, frame.time, tuple(n for _, n in points), line, np.ascontiguousarray(frame.ends[line]),
            frame.names,
        )  # fmt: skip
        scene.rig.index(frame.sensor)
        made.points_of(scene.body)  # an error where the body lacks one
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
    titles : (L,) names of all lines of the sensor
    """

    def __init__(
        self, of: ImageLineSensor, camera: str, time: float, names: tuple[str, ...], line: NDArray, ends: NDArray,
        titles: tuple[str, ...],
    ) -> None:  # fmt: skip
        self.sensor, self.time, self.of, self.titles = of.name, time, of, titles
        self.camera, self.names, self.line, self.ends = camera, names, line, ends
        self._points: tuple[Body, PointSet] | None = None

    def points_of(self, body: Body) -> PointSet:
        """(K,) the landmarks on a body."""
        if self._points is None or self._points[0] is not body:
            self._points = body, body.landmarks.select(self.names)
        return self._points[1]

    def lines(self, scene: Scene) -> NDArray:
        """(K, 3) image lines a u + b v + c = 0 of the landmarks, where they are; see `image_lines`."""
        return image_lines(scene.rig[self.camera], self.ends, scene.positions(self.points_of(scene.body)))

    def across(self, scene: Scene) -> NDArray:
        """(K, 2) [px] the shortest way from each landmark's pixel to its line; NaN behind the camera."""
        uv, lines = scene.rig[self.camera].project(scene.positions(self.points_of(scene.body))), self.lines(scene)
        off = np.sum(lines[:, :2] * uv, axis=1) + lines[:, 2]
        return np.asarray(-(off / np.sum(lines[:, :2] ** 2, axis=1))[:, None] * lines[:, :2])

    def match(self, scene: Scene, reach: float) -> ImageLineMatched:
        """As the lines are named."""
        loss = self.of.loss
        return ImageLineMatched(self, replace(loss, scale=loss.scale * max(reach / self.of.near, 1.0)))


@dataclass(frozen=True, eq=False)
class ImageLineMatched(Matched):
    """Lines with their landmarks; measurement and the Loss of a line."""

    measurement: ImageLineMeasurement
    loss: Loss

    @property
    def sigma_known(self) -> bool:  # type: ignore[override]
        """Whether they are clicks, which have no robust loss: how far the fit is off says nothing about these."""
        return self.loss.kind == SQUARED.kind

    @property
    def channels(self) -> Sequence[str]:
        """All lines of the sensor."""
        return self.measurement.titles

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a landmark: its pixel should lie on the image line; one robust weight a line."""
        m = self.measurement
        points, k, lines = m.points_of(scene.body), scene.rig.index(m.camera), m.lines(scene)
        weight = np.full(len(points), 1.0 / m.of.sigma**2)
        index = np.full(len(points), k, np.int64)
        rows = scene.rows_of(_kernels.image_line_rows, 1, points, scene.rig.packed, index, lines, weight)
        return [replace(rows, group=np.ascontiguousarray(m.line[rows.group]), loss=self.loss)]

    def squares(self, scene: Scene) -> NDArray:
        """(L,) squared residual of each line, in variances: of both ends of an edge together."""
        across = self.measurement.across(scene) / self.measurement.of.sigma
        seen = np.isfinite(across).all(axis=1)
        _, line = np.unique(self.measurement.line[seen], return_inverse=True)
        return np.bincount(line, np.square(across[seen]).sum(axis=1))

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Of every landmark: from its pixel the shortest way to its line."""
        m = self.measurement
        points, values = m.points_of(scene.body), m.across(scene)
        seen = np.isfinite(values).all(axis=1)
        lines = int(m.line.max(initial=-1)) + 1
        square = np.bincount(m.line[seen], np.square(values[seen]).sum(axis=1), minlength=lines)
        factor = np.where(seen, self.loss.factor(square[m.line] / m.of.sigma**2), 0.0)
        measured = scene.rig[m.camera].project(scene.positions(points)) + values
        names = tuple(f"{m.titles[k]}: {name}" for k, name in zip(m.line, m.names))
        return [Leftover(m.sensor, names, points.segments, values, factor, "px", measured)]

    def evidence(self, scene: Scene) -> Evidence:
        """A line speaks for the segments of its landmarks within three standard deviations, and against them beyond."""
        out, m = np.zeros((2, len(scene.body.tree.segments))), self.measurement
        across, segments = m.across(scene) / m.of.sigma, m.points_of(scene.body).segments
        for line in np.unique(m.line[np.isfinite(across).all(axis=1)]):
            far = int(np.nansum(across[m.line == line] ** 2) >= AGREEMENT_SIGMAS**2)
            out[far, np.unique(segments[m.line == line])] += MIN_VISIBLE_OUTLINE
        return Evidence(*out)


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
