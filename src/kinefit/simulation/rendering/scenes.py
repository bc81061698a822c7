"""Rendered scenes: rooms, people, and the images of cameras in them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body
from kinefit.bodies.motion import UP_AXES, Motion
from kinefit.bodies.rendering import Canvas, Raster, scaled, subdivided
from kinefit.bodies.surfaces.mesh import BodyMesh
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.simulation.figures import places, shifted_camera

PARTS = ("floor", "wall", "table")
_BACK_WALL_DISTANCE = 1.0  # [m] from the body to the wall behind it
_SIDE_WALL_DISTANCE = 1.3  # [m] from the body to the side walls
_CEILING_HEIGHT = 3.0  # [m]
_SURFACE_MARGIN = 0.1  # [m] between landmarks and the body's surface
_TABLE_SIZE = np.array([0.6, 0.72, 0.8])  # [m] width, height, depth
_TABLE_DISTANCE = 0.25  # [m] from the body to the table
_MAX_EDGE = 0.5  # [m] of a triangle: lens distortion applies to corners only


@dataclass(frozen=True, eq=False)
class Room:
    """Static triangles of a room.

    Parameters
    ----------
    vertices : (V, 3) [m] in the world
    faces : (T, 3) int, counter-clockwise seen from inside the room
    parts : (T,) int, number in `PARTS` of each
    """

    vertices: NDArray
    faces: NDArray
    parts: NDArray


def room(motion: Motion, camera: Camera) -> Room:
    """A room around a motion, with the camera facing a wall behind the body.

    Parameters
    ----------
    motion : Motion
        Its lowest landmark is on the floor; the table is outside the volume of the motion.
    camera : Camera in the motion's world
    """
    up = np.array(UP_AXES[motion.up])
    ahead = camera.T_camera_world[2, :3] - (camera.T_camera_world[2, :3] @ up) * up
    if np.linalg.norm(ahead) < 1e-3:  # looks straight down or up
        ahead = camera.T_camera_world[1, :3] - (camera.T_camera_world[1, :3] @ up) * up
    ahead /= np.linalg.norm(ahead)
    axes = np.stack([np.cross(ahead, up), up, ahead])  # right, up, ahead of the camera
    body = places(motion) @ axes.T
    low = body.min(axis=0) - [_SURFACE_MARGIN, 0.03, _SURFACE_MARGIN]
    high = body.max(axis=0) + _SURFACE_MARGIN
    eye = axes @ camera.centre_world
    left = min(low[0], eye[0]) - _SIDE_WALL_DISTANCE
    right = max(high[0], eye[0]) + _SIDE_WALL_DISTANCE + _TABLE_SIZE[0]
    front, back, floor = min(low[2], eye[2]) - 0.3, high[2] + _BACK_WALL_DISTANCE, low[1]
    top = max(floor + _CEILING_HEIGHT, eye[1] + 0.3)
    table = np.array([high[0] + _TABLE_DISTANCE, floor, 0.5 * (low[2] + high[2])])
    pieces = [
        (0, _rectangle([left, floor, front], [right - left, 0, 0], [0, 0, back - front])),
        (1, _rectangle([left, floor, back], [right - left, 0, 0], [0, top - floor, 0])),
        (1, _rectangle([left, floor, front], [0, 0, back - front], [0, top - floor, 0])),
        (1, _rectangle([right, floor, back], [0, 0, front - back], [0, top - floor, 0])),
        (1, _rectangle([right, floor, front], [left - right, 0, 0], [0, top - floor, 0])),
        (1, _rectangle([right, top, front], [left - right, 0, 0], [0, 0, back - front])),
        *((2, side) for side in _box(table, _TABLE_SIZE)),
    ]
    cut = [subdivided(corners, np.array([[0, 1, 2], [0, 2, 3]]), _MAX_EDGE) for _, corners in pieces]
    starts = np.cumsum([0, *(len(x) for x, _ in cut)])
    return Room(
        np.concatenate([x for x, _ in cut]) @ axes,
        np.concatenate([f + start for (_, f), start in zip(cut, starts)]),
        np.concatenate([np.full(len(f), part) for (_, f), (part, _) in zip(cut, pieces)]),
    )


def _rectangle(corner: list[float], across: list[float], along: list[float]) -> NDArray:
    """(4, 3) corners, counter-clockwise seen from the side opposite to across × along.

    The axes right, up and ahead are left-handed, which reverses the sign of the product.
    """
    a, b, c = (np.array(v, float) for v in (corner, across, along))
    return np.stack([a, a + b, a + b + c, a + c])


def _box(corner: NDArray, size: NDArray) -> list[NDArray]:
    """The five sides of a box that are not on the floor, facing outwards."""
    (x, y, z), (w, h, d) = corner, size
    return [
        _rectangle([x, y + h, z], [w, 0, 0], [0, 0, d]),
        _rectangle([x, y, z], [w, 0, 0], [0, h, 0]),
        _rectangle([x + w, y, z + d], [-w, 0, 0], [0, h, 0]),
        _rectangle([x, y, z + d], [0, 0, -d], [0, h, 0]),
        _rectangle([x + w, y, z], [0, 0, d], [0, h, 0]),
    ]


@dataclass(frozen=True, eq=False)
class RenderedView:
    """One frame of a scene in one camera.

    Parameters
    ----------
    raster : Raster
        `segment` is the segment of the body, or the number of segments plus the part of the room.
    camera : Camera
    vertices : (V, 3) [m] of all triangles, in the world
    faces : (T, 3) int
    frames : (S, 12) poses of the segments, from `KinematicTree.forward`
    """

    raster: Raster
    camera: Camera
    vertices: NDArray
    faces: NDArray
    frames: NDArray

    @cached_property
    def normals(self) -> NDArray:
        """(T + 1, 3) unit normals of the triangles in the world; the last, for empty pixels, is zero."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        return np.append(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12), [[0.0] * 3], 0)

    @cached_property
    def x_camera(self) -> NDArray:
        """(H, W, 3) [m] surface point of each pixel in the camera's frame; not finite for empty pixels."""
        a, b = self.camera.ray_table
        return np.stack([a, b, np.ones_like(a)], axis=-1) * self.raster.depth[..., None]

    @cached_property
    def cosine(self) -> NDArray:
        """(H, W) cosine between the surface's normal and the ray; 0 for empty pixels."""
        a, b = self.camera.ray_table
        rays = np.stack([a, b, np.ones_like(a)], axis=-1) / np.sqrt(a * a + b * b + 1.0)[..., None]
        normals = (self.normals @ self.camera.T_camera_world[:3, :3].T)[self.raster.face]
        return np.abs(np.einsum("hwk,hwk->hw", normals, rays))

    @cached_property
    def x_rest(self) -> NDArray:
        """(H, W, 3) [m] surface point of each pixel in the body's rest pose (root frame); room points in the world.

        A point of a surface has the same x_rest in all cameras and frames. Empty pixels have zero.
        """
        R, t = self.camera.T_camera_world[:3, :3], self.camera.T_camera_world[:3, 3]
        out = (np.where(self.raster.seen[..., None], self.x_camera, 0.0) - t) @ R
        segment = self.raster.segment
        body = (segment >= 0) & (segment < len(self.frames))
        f = self.frames[segment[body]]
        out[body] = np.einsum("nj,njk->nk", out[body] - f[:, 9:], f[:, :9].reshape(-1, 3, 3))
        out[~self.raster.seen] = 0.0
        return out


@dataclass(frozen=True, eq=False)
class SimulatedScene:
    """A known motion, the triangles of its body, and the room around it.

    Parameters
    ----------
    motion : Motion
    mesh : BodyMesh
    room : Room or None
    """

    motion: Motion
    mesh: BodyMesh
    room: Room | None = None

    @classmethod
    def of(cls, motion: Motion, camera: Camera | None = None) -> SimulatedScene:
        """Scene of a motion; with a room around it if a camera is given, which looks into the room."""
        return cls(motion, body_mesh(motion.body), None if camera is None else room(motion, camera))

    @cached_property
    def faces(self) -> NDArray:
        """(T, 3) int32 triangles of the body, then of the room."""
        parts = [np.asarray(self.mesh.faces)]
        if self.room is not None:
            count = len(self.mesh.vertices)
            parts.append(self.room.faces + count)
        return np.ascontiguousarray(np.concatenate(parts), np.int32)

    @cached_property
    def labels(self) -> NDArray:
        """(T,) int, segment of every triangle; the number of segments plus the part for triangles of the room."""
        parts = [np.asarray(self.mesh.face_segment)]
        if self.room is not None:
            parts.append(self.room.parts + len(self.motion.body.tree.segments))
        return np.concatenate(parts)

    def view(self, frame: int, camera: Camera) -> RenderedView:
        """Render a frame of the motion in a camera, without errors."""
        state = self.motion.state(frame)
        frames, _ = self.motion.body.tree.forward(state.T_world_root, state.angles)
        vertices = self.mesh.posed(frames)
        if self.room is not None:
            vertices = np.concatenate([vertices, self.room.vertices])
        raster = Canvas(camera.size).draw_for(camera, vertices, self.faces, cull=True, labels=self.labels)
        return RenderedView(raster, camera, vertices, self.faces, frames)


def centred_camera(
    name: str, size: tuple[int, int], focal: float, T_camera_world: NDArray | None = None
) -> Camera:
    """A camera without distortion whose principal point is the centre of its image.

    Parameters
    ----------
    size : (width, height) [px]
    focal : float [px]
    T_camera_world : (4, 4) [m], default: the identity
    """
    K = np.array([[focal, 0.0, 0.5 * (size[0] - 1)], [0.0, focal, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]])
    return Camera(name, size, K, (), "radtan", T_camera_world)  # type: ignore[arg-type]


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
        return left, shifted_camera(left, f"{self.name}_right", self.baseline)


COLOUR = ColourSensor("colour", (640, 480), 575.0)
STEREO = StereoSensor("stereo", (320, 240), 290.0)


@checked
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
