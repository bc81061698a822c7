"""What a colour or grey camera would have seen of a known motion: skin and clothes with a grain that sticks to them."""

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
from kinefit.simulation.rendering.scenes import RenderedView, SimulatedScene

SKIN = (130, 160, 210)  # BGR, as all colours here
_CLOTHES = {
    "skin": SKIN, "shirt": (70, 80, 170), "trousers": (120, 75, 55), "shoes": (45, 45, 50),
    "floor": (120, 135, 150), "wall": (165, 175, 170), "table": (75, 110, 140),
}  # fmt: skip
_WORN = {
    "head": "skin", "neck": "skin", "hand": "skin", "forearm": "skin",
    "thigh": "trousers", "shank": "trousers", "pelvis": "trousers", "foot": "shoes", "toes": "shoes",
}  # fmt: skip
_NOTHING = (105, 120, 95)
GRAIN = 0.015  # [m] of the grain: a little more than a pixel at three metres, so that few samples alias
_GRAINS = 64  # cells after which it repeats
_CONTRAST = {"skin": 0.10}  # share of the colour, one standard deviation; cloth and walls have more
_CLOTH = 0.25
_BROW, _CHIN = 2.5, 0.5  # times the height of the mouth above the neck's joint
_HAIR = (35, 45, 60)
_LIGHT = (0.6, 1.0)  # light of surfaces turned away from it, and towards it


@dataclass(frozen=True)
class ColourSensor:
    """A colour camera.

    Parameters
    ----------
    name : str
    size : (width, height) [px]
    focal : float [px]
    samples : int, rays along each side of a pixel.
    noise : float, standard deviation of a value in 0..255.
    near, far : float [m]
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
            problem = f"a camera {self.name} of {self.samples} samples and noise {self.noise}"
            raise ObservationError(problem, remedy="Give one sample or more, and noise of zero or more.")

    def camera(self, T_camera_world: NDArray | None = None, *, name: str | None = None) -> Camera:
        """The sensor as a camera of a rig."""
        (w, h), f = self.size, self.focal
        K = np.array([[f, 0, 0.5 * (w - 1)], [0, f, 0.5 * (h - 1)], [0, 0, 1.0]])
        return Camera(name or self.name, self.size, K, (), "radtan", T_camera_world)  # type: ignore[arg-type]


@dataclass(frozen=True)
class StereoSensor(ColourSensor):
    """Two grey cameras side by side, their axes parallel, rows aligned; `baseline` [m] apart."""

    baseline: float = 0.12

    def pair(self, left: Camera) -> tuple[Camera, Camera]:
        """The left camera, and the right one beside it."""
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
    """Picture (H, W, 3) BGR, or (H, W) grey, 8 bit, of one frame of a scene.

    The grain is a function of the place on the surface: both cameras of a stereo head, and all frames, see the same.

    Parameters
    ----------
    camera : Camera
    sensor : ColourSensor, for its samples and noise.
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
    """(H, W, 3) BGR 8 bit: depth [m] as colours, near red, far blue, black where nothing was measured."""
    share = np.clip((far - depth) / (far - near), 0.0, 1.0)
    out = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)
    out[depth <= 0.0] = 0
    return out


def _shaded(scene: SimulatedScene, view: RenderedView) -> NDArray:
    """(H, W, 3) float32 BGR without noise."""
    names = [*map(_worn, scene.motion.body.tree.segments), *PARTS]
    base = np.array([_CLOTHES[name] for name in names] + [_NOTHING], np.float32)
    contrast = np.array([_CONTRAST.get(name, _CLOTH) for name in names] + [0.0], np.float32)
    label = view.raster.segment
    up = np.array(UP_AXES[scene.motion.up])
    light = 0.8 * up - 0.5 * view.camera.T_camera_world[2, :3] + 0.3 * view.camera.T_camera_world[0, :3]
    towards = np.clip(view.normals @ (light / np.linalg.norm(light)), 0.0, 1.0)
    shade = (_LIGHT[0] + (_LIGHT[1] - _LIGHT[0]) * towards).astype(np.float32)[view.raster.face]
    shade *= 1.0 + contrast[label] * grain(view.x_rest, label)
    colour = base[label]
    for cloth in _sleeves(scene.motion.body, view):
        colour[cloth] = _CLOTHES["shirt"]
    hair, collar = _hair_and_collar(scene.motion.body, view)
    colour[hair], colour[collar] = _HAIR, _CLOTHES["shirt"]
    return np.clip(colour * shade[..., None], 0.0, 255.0)


def _sleeves(body: Body, view: RenderedView) -> list[NDArray]:
    """(H, W) bool a forearm: its pixels above the wrist, where the hand is part of the forearm: both would be bare."""
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


def _worn(segment: str) -> str:
    part = segment.removesuffix("_l").removesuffix("_r")
    return _WORN.get(part, "shirt")


def _hair_and_collar(body: Body, view: RenderedView) -> tuple[NDArray, NDArray]:
    """(H, W) bool each, a head's pixels above its brow or behind its ears, and those below its chin.

    Where the neck is part of the head: heads with a neck of their own are skin all over.
    """
    tree = body.tree
    hair, collar = (np.zeros(view.raster.segment.shape, bool) for _ in range(2))
    known = {"r_mouth", "r_tragion"} <= set(body.landmarks.names)
    if "head" in tree.segments and "neck" not in tree.segments and known:
        segment = tree.segment("head")
        mouth, ear = body.points_rest(body.landmarks.select(("r_mouth", "r_tragion"))) - tree.rest[segment]
        own = view.raster.segment == segment
        x = view.x_rest[own] - tree.rest[segment]
        hair[own] = (x[:, 1] > _BROW * mouth[1]) | (x[:, 0] < ear[0])
        collar[own] = x[:, 1] < _CHIN * mouth[1]
    return hair & ~collar, collar


@cache
def grain_table() -> NDArray:
    """(n, n, n) grain, periodic, mean 0 and deviation 1: three sizes of blobs, 1.5, 4 and 12 cm."""
    random = np.random.default_rng(20)
    waves = np.fft.fftfreq(_GRAINS)
    square = waves[:, None, None] ** 2 + waves[:, None] ** 2 + waves**2
    out = np.zeros((_GRAINS,) * 3)
    for cells in (0.5, 1.3, 4.0):
        spectrum = np.fft.fftn(random.standard_normal(out.shape)) * np.exp(-2.0 * (np.pi * cells) ** 2 * square)
        layer = np.fft.ifftn(spectrum).real
        out += layer / layer.std()
    return ((out - out.mean()) / out.std()).astype(np.float32)


def grain(x: NDArray, label: NDArray) -> NDArray:
    """(...) grain of mean 0 and deviation 1 at places x (..., 3) [m] of surfaces; every label (...) int has its own."""
    cell = np.floor(x * (1.0 / GRAIN)).astype(np.int64) + (label.astype(np.int64) * 17)[..., None]
    i, j, k = np.moveaxis(cell % _GRAINS, -1, 0)
    return grain_table()[i, j, k]
