"""Render colour or grey images of a known motion: skin and clothes with a texture fixed to the surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.motion import UP_AXES
from kinefit.rendering import scaled
from kinefit.simulation.placing import beside
from kinefit.simulation.rendering.room import PARTS
from kinefit.simulation.rendering.scenes import RenderedView, SimulatedScene, centred_camera

SKIN = (130, 160, 210)  # BGR, as all colours here
_COLOURS = {
    "skin": SKIN, "shirt": (70, 80, 170), "trousers": (120, 75, 55), "shoes": (45, 45, 50),
    "floor": (120, 135, 150), "wall": (165, 175, 170), "table": (75, 110, 140),
}  # fmt: skip
_COLOUR_OF_SEGMENT = {
    "head": "skin", "neck": "skin", "hand": "skin", "forearm": "skin",
    "thigh": "trousers", "shank": "trousers", "pelvis": "trousers", "foot": "shoes", "toes": "shoes",
}  # fmt: skip
_BACKGROUND_COLOUR = (105, 120, 95)
GRAIN = 0.015  # [m] cell of the texture: a little more than a pixel at three metres, so that few samples alias
_GRAIN_CELLS = 64  # after which the texture repeats
_CONTRAST = {"skin": 0.10}  # standard deviation as a share of the colour; cloth and walls have more
_DEFAULT_CONTRAST = 0.25
_BROW_HEIGHT = 2.5  # times the height of the mouth above the neck's joint
_CHIN_HEIGHT = 0.5  # times the height of the mouth above the neck's joint
_HAIR_COLOUR = (35, 45, 60)
_LIGHT_RANGE = (0.6, 1.0)  # brightness of surfaces facing away from the light, and facing it


@dataclass(frozen=True)
class ColourSensor:
    """A colour camera.

    Parameters
    ----------
    name : str
    size : (width, height) [px]
    focal : float [px]
    samples : int, rays along each side of a pixel
    noise : float, standard deviation of a value in 0..255
    near, far : float [m]

    Raises
    ------
    ObservationError
        `samples` is below 1; `noise` is negative or not finite.
    """

    name: str
    size: tuple[int, int]
    focal: float
    samples: int = 2
    noise: float = 2.0
    near: float = 0.2
    far: float = 20.0

    def __post_init__(self) -> None:
        if self.samples < 1 or not 0.0 <= self.noise < np.inf:
            problem = f"camera {self.name} has samples = {self.samples} and noise = {self.noise}"
            raise ObservationError(problem, remedy="Give at least one sample, and noise of 0 or more.")

    def camera(self, T_camera_world: NDArray | None = None, *, name: str | None = None) -> Camera:
        """The sensor as a camera of a rig, with the pose T_camera_world (4, 4) [m]."""
        return centred_camera(name or self.name, self.size, self.focal, T_camera_world)


@dataclass(frozen=True)
class StereoSensor(ColourSensor):
    """Two rectified grey cameras with parallel axes, `baseline` [m] apart."""

    baseline: float = 0.12

    def pair(self, left: Camera) -> tuple[Camera, Camera]:
        """The left camera and the right one."""
        return left, beside(left, f"{self.name}_right", self.baseline)


COLOUR = ColourSensor("colour", (640, 480), 575.0)
STEREO = StereoSensor("stereo", (320, 240), 290.0)


def picture(
    scene: SimulatedScene,
    frame: int,
    camera: Camera,
    sensor: ColourSensor = COLOUR,
    *,
    grey: bool = False,
    seed: int = 0,
) -> NDArray:
    """Image (H, W, 3) BGR, or (H, W) grey, 8 bit, of one frame of a scene.

    The texture is a function of the place on the surface, the same in all cameras and frames.

    Parameters
    ----------
    camera : Camera
    sensor : ColourSensor, for its samples and noise
    seed : int
        Of the noise, together with the frame and the camera's name.
    """
    view = scene.view(frame, scaled(camera, sensor.samples))
    colour = _shaded(scene, view)
    if grey:
        colour = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
    colour = cv2.resize(colour, camera.size, interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng([seed, frame, *camera.name.encode()]).standard_normal(colour.shape)
    return np.clip(np.round(colour + sensor.noise * noise), 0, 255).astype(np.uint8)


def depth_picture(depth: NDArray, near: float, far: float) -> NDArray:
    """Depth (H, W) [m] as colours (H, W, 3) BGR 8 bit: near red, far blue, black for pixels without depth."""
    share = np.clip((far - depth) / (far - near), 0.0, 1.0)
    out = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)
    out[depth <= 0.0] = 0
    return out


def _shaded(scene: SimulatedScene, view: RenderedView) -> NDArray:
    """(H, W, 3) float32 BGR without noise."""
    names = [*map(_colour_name, scene.motion.body.tree.segments), *PARTS]
    base = np.array([_COLOURS[name] for name in names] + [_BACKGROUND_COLOUR], np.float32)
    contrast = np.array([_CONTRAST.get(name, _DEFAULT_CONTRAST) for name in names] + [0.0], np.float32)
    label = view.raster.segment
    up = np.array(UP_AXES[scene.motion.up])
    light = 0.8 * up - 0.5 * view.camera.T_camera_world[2, :3] + 0.3 * view.camera.T_camera_world[0, :3]
    towards = np.clip(view.normals @ (light / np.linalg.norm(light)), 0.0, 1.0)
    shade = (_LIGHT_RANGE[0] + (_LIGHT_RANGE[1] - _LIGHT_RANGE[0]) * towards).astype(np.float32)[view.raster.face]
    shade *= 1.0 + contrast[label] * grain(view.x_rest, label)
    colour = base[label]
    for sleeve in _sleeves(scene.motion.body, view):
        colour[sleeve] = _COLOURS["shirt"]
    hair, collar = _hair_and_collar(scene.motion.body, view)
    colour[hair], colour[collar] = _HAIR_COLOUR, _COLOURS["shirt"]
    return np.clip(colour * shade[..., None], 0.0, 255.0)


def _sleeves(body: Body, view: RenderedView) -> list[NDArray]:
    """Masks (H, W) bool of the sleeves: pixels of a forearm above the wrist, for bodies without a hand segment."""
    tree, out = body.tree, []
    for side in "lr":
        wrist, name = f"{side}_wrist", f"forearm_{side}"
        if name in tree.segments and wrist in body.landmarks.names and f"hand_{side}" not in tree.segments:
            segment = tree.segment(name)
            along = body.points_rest(body.landmarks.select((wrist,)))[0] - tree.rest[segment]
            own = view.raster.segment == segment
            own[own] = (view.x_rest[own] - tree.rest[segment]) @ along < along @ along
            out.append(own)
    return out


def _colour_name(segment: str) -> str:
    part = segment.removesuffix("_l").removesuffix("_r")
    return _COLOUR_OF_SEGMENT.get(part, "shirt")


def _hair_and_collar(body: Body, view: RenderedView) -> tuple[NDArray, NDArray]:
    """Masks (H, W) bool of a head's pixels above the brow or behind the ears, and below the chin.

    Both are empty for bodies with a neck segment, whose heads are skin all over.
    """
    tree = body.tree
    hair, collar = (np.zeros(view.raster.segment.shape, bool) for _ in range(2))
    known = {"r_mouth", "r_tragion"} <= set(body.landmarks.names)
    if "head" in tree.segments and "neck" not in tree.segments and known:
        segment = tree.segment("head")
        mouth, ear = body.points_rest(body.landmarks.select(("r_mouth", "r_tragion"))) - tree.rest[segment]
        own = view.raster.segment == segment
        x = view.x_rest[own] - tree.rest[segment]
        hair[own] = (x[:, 1] > _BROW_HEIGHT * mouth[1]) | (x[:, 0] < ear[0])
        collar[own] = x[:, 1] < _CHIN_HEIGHT * mouth[1]
    return hair & ~collar, collar


@cache
def grain_table() -> NDArray:
    """Periodic texture (N, N, N), mean 0 and standard deviation 1, with blobs of 1.5, 4 and 12 cm."""
    random = np.random.default_rng(20)
    waves = np.fft.fftfreq(_GRAIN_CELLS)
    square = waves[:, None, None] ** 2 + waves[:, None] ** 2 + waves**2
    out = np.zeros((_GRAIN_CELLS,) * 3)
    for cells in (0.5, 1.3, 4.0):
        spectrum = np.fft.fftn(random.standard_normal(out.shape)) * np.exp(-2.0 * (np.pi * cells) ** 2 * square)
        layer = np.fft.ifftn(spectrum).real
        out += layer / layer.std()
    return ((out - out.mean()) / out.std()).astype(np.float32)


def grain(x: NDArray, label: NDArray) -> NDArray:
    """Texture (..., ), mean 0 and standard deviation 1, at places x (..., 3) [m]; another one for every label (...)."""
    cell = np.floor(x * (1.0 / GRAIN)).astype(np.int64) + (label.astype(np.int64) * 17)[..., None]
    i, j, k = np.moveaxis(cell % _GRAIN_CELLS, -1, 0)
    return grain_table()[i, j, k]
