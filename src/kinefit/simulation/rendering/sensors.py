"""Simulate depth images of a known motion, with the errors of a depth camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering import scaled
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.observations.videos import DepthVideo
from kinefit.simulation.rendering.scenes import RenderedView, SimulatedScene, centred_camera

_MIN_EDGE_STEP = 0.1  # [m] within 3 x 3 pixels: an edge, for a sensor that matches patterns
_MIN_NOISE_COSINE = 0.2  # of incidence, below which a sensor's noise no longer grows


@dataclass(frozen=True)
class DepthSensor:
    """A depth camera and its errors.

    Parameters
    ----------
    name : str
    size : (width, height) [px]
    focal : float [px]
    near, far : float [m]
        Range; pixels outside it have no depth.
    noise : (a, b, z0) [m, 1/m, m]
        Standard deviation a + b (z - z0)² of a depth z, independent for every pixel and frame.
    oblique : float
        Exponent of incidence: the standard deviation is divided by cosine^oblique of the angle of incidence.
    grazing : float
        Cosine of incidence below which a pixel has no depth.
    samples : int
        Rays along each side of a pixel. A pixel across an edge has a depth between both surfaces (flying pixel): the
        mean weighted with 1/z², like the signal.
    baseline : float [m]
        From the lens to the projector on its right: pixels in the projector's shadow have no depth; 0 for none.
    disparity_step : float [px]
        Resolution of the pattern's disparity f baseline / z; 0 for none.
    lateral : float [px]
        Standard deviation of the place at which a pixel's depth is taken: ragged edges.
    edges_lost : share of the pixels at depth edges without depth
    holes : share of the pixels without depth, in spots of 2 x 2

    Raises
    ------
    ObservationError
        A range, number of samples or other value that is impossible.
    """

    name: str
    size: tuple[int, int]
    focal: float
    near: float
    far: float
    noise: tuple[float, float, float]
    oblique: float = 0.0
    grazing: float = 0.1
    samples: int = 1
    baseline: float = 0.0
    disparity_step: float = 0.0
    lateral: float = 0.0
    edges_lost: float = 0.0
    holes: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.near < self.far or self.samples < 1 or min(*self.noise, self.focal, *self.size) < 0:
            raise ObservationError(
                f"sensor {self.name}: near {self.near} m, far {self.far} m, {self.samples} samples, noise {self.noise}",
                remedy="Give 0 < near < far, at least one sample, and no negative values.",
            )

    def sigma(self, z: NDArray | float) -> NDArray | float:
        """Standard deviations [m], of any shape (...,), of depths z [m] of the same shape at normal incidence."""
        a, b, z0 = self.noise
        return a + b * (z - z0) ** 2

    def camera(self, T_camera_world: NDArray | None = None, *, name: str | None = None) -> Camera:
        """The sensor as a camera of a rig, with the pose T_camera_world (4, 4) [m]."""
        return centred_camera(name or self.name, self.size, self.focal, T_camera_world)

    def without_errors(self) -> DepthSensor:
        """The same sensor without errors, apart from its range."""
        none = dict.fromkeys(("baseline", "disparity_step", "lateral", "edges_lost", "holes", "grazing"), 0.0)
        return replace(self, noise=(0.0, 0.0, 0.0), samples=1, **none)  # type: ignore[arg-type]


TOF = DepthSensor(
    "tof", (160, 124), 181.0, 0.5, 7.5, (0.012, 0.003, 0.0), oblique=0.5, samples=3, holes=0.01
)
"""A time-of-flight camera of the SwissRanger's kind, 47.7 x 37.8 degrees: 2 cm of noise at 2 m, 9 cm at 5 m."""

KINECT = DepthSensor(
    "kinect", (640, 480), 575.0, 0.4, 4.5, (0.0012, 0.0019, 0.4), baseline=0.075, disparity_step=0.125,
    lateral=0.5, edges_lost=0.6, holes=0.002,
)
"""A structured-light camera of the first Kinect's kind; noise after Nguyen, Izadi and Lovell, 3DIMPVT 2012, eq. 3."""

DEPTH_SENSORS = {sensor.name: sensor for sensor in (TOF, KINECT)}


@checked
def simulate_depth(
    motion: Motion,
    camera: Camera,
    sensor: DepthSensor,
    *,
    room: bool = True,
    seed: int = 0,
    scene: SimulatedScene | None = None,
) -> DepthVideo:
    """Simulate the depth images of a motion in a sensor, one for each frame.

    Parameters
    ----------
    motion : Motion
    camera : Camera
        The sensor's, in the motion's world: `sensor.camera(T_camera_world)`, or any other lens.
    sensor : DepthSensor
        Its range and errors, such as `TOF` or `KINECT`.
    room : bool
        Whether floor, walls and a table are around the body.
    seed : int
        The same seed gives the same errors, in whatever order frames are read.
    scene : SimulatedScene, optional
        Of the motion, shared by several sensors; `room` is then ignored.

    Returns
    -------
    DepthVideo
        Every frame is rendered on demand.
    """
    scene = scene or SimulatedScene.of(motion, camera if room else None)

    def image(frame: int) -> NDArray:
        return measured_depth(scene, frame, camera, sensor, np.random.default_rng([seed, frame]))

    return DepthVideo(
        sensor=camera.name, rate=motion.rate, times=motion.times, size=camera.size, image=image, near=sensor.near,
        far=sensor.far, camera=camera, source="simulation",
    )  # fmt: skip


def measured_depth(
    scene: SimulatedScene, frame: int, camera: Camera, sensor: DepthSensor, random: np.random.Generator
) -> NDArray:
    """Depth image (H, W) float32 [m] of one frame; 0 for pixels without depth."""
    width, height = camera.size
    view = scene.view(frame, scaled(camera, sensor.samples))
    z, cosine = _pixels(view, sensor.samples, height, width)
    lost = ~np.isfinite(z) | (cosine <= sensor.grazing)
    if sensor.edges_lost:
        lost |= _edges(z) & (random.random(z.shape) < sensor.edges_lost)
    if sensor.baseline:
        lost |= _in_shadow(scene, frame, camera, sensor, z)
    if sensor.lateral:
        z, lost = _shifted(sensor.lateral, random, z, lost)
    z = np.where(lost, 1.0, z)
    sigma = sensor.sigma(z) / np.maximum(cosine, _MIN_NOISE_COSINE) ** sensor.oblique
    z = z + sigma * random.standard_normal(z.shape)
    if sensor.disparity_step:
        unit = camera.matrix[0, 0] * sensor.baseline / sensor.disparity_step
        z = unit / np.maximum(np.round(unit / np.maximum(z, 1e-3)), 1.0)
    if sensor.holes:
        spots = random.random((height // 2 + 1, width // 2 + 1)) < sensor.holes
        lost |= np.repeat(np.repeat(spots, 2, axis=0), 2, axis=1)[:height, :width]
    return np.where(lost | (z < sensor.near) | (z > sensor.far), 0.0, z).astype(np.float32)


def _pixels(view: RenderedView, n: int, height: int, width: int) -> tuple[NDArray, NDArray]:
    """Depth (H, W) [m], inf if most of a pixel is empty, and cosine (H, W) of incidence, averaged over each pixel."""
    z = view.raster.depth.astype(float)
    if n == 1:
        return z, view.cosine
    blocks, cosines = (
        a.reshape(height, n, width, n).swapaxes(1, 2).reshape(height, width, n * n) for a in (z, view.cosine)
    )
    hit = np.isfinite(blocks)
    weight = np.where(hit, 1.0 / np.where(hit, blocks, 1.0) ** 2, 0.0)
    total = np.maximum(weight.sum(axis=-1), 1e-12)
    mean = np.where(hit, weight * np.where(hit, blocks, 0.0), 0.0).sum(axis=-1) / total
    return np.where(2 * hit.sum(axis=-1) > n * n, mean, np.inf), (weight * cosines).sum(axis=-1) / total


def _edges(z: NDArray) -> NDArray:
    """(H, W) bool: pixels with a depth edge within the 3 x 3 pixels around."""
    z = np.where(np.isfinite(z), z, 100.0).astype(np.float32)
    window = np.ones((3, 3), np.uint8)
    return cv2.dilate(z, window) - cv2.erode(z, window) > _MIN_EDGE_STEP


def _in_shadow(scene: SimulatedScene, frame: int, camera: Camera, sensor: DepthSensor, z: NDArray) -> NDArray:
    """(H, W) bool: pixels whose point is occluded from the projector."""
    T = np.eye(4)
    T[0, 3] = -sensor.baseline
    projector = camera.with_pose(T @ camera.T_camera_world)
    lit = scene.view(frame, projector).raster.depth
    u = np.arange(z.shape[1]) - camera.matrix[0, 0] * sensor.baseline / z  # no shift for z = inf
    column = np.clip(np.round(u), 0, z.shape[1] - 1).astype(int)
    return np.take_along_axis(lit, column, axis=1) < z - _MIN_EDGE_STEP / 2


def _shifted(sigma: float, random: np.random.Generator, z: NDArray, lost: NDArray) -> tuple[NDArray, NDArray]:
    """Depths and lost pixels taken at randomly shifted places, with the standard deviation `sigma` [px]."""
    height, width = z.shape
    dv, du = np.round(sigma * random.standard_normal((2, height, width))).astype(int)
    rows = np.clip(np.arange(height)[:, None] + dv, 0, height - 1)
    columns = np.clip(np.arange(width) + du, 0, width - 1)
    return z[rows, columns], lost[rows, columns]
