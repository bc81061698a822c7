"""Colour images of people with gear, with truth: a lab with a bike, and a slope outdoors with a rider on a snowboard.

Persons and gear are drawn in cloth with a grain that sticks to them, lit by a lamp or by the sun with hard shadows,
before walls, ground and things of many colours. Outdoors clouds pass before the sun, cameras follow with their
exposure, the shutter is open for half of the time between two images, and a second person walks about.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.scenes.regions_scene import face_normals
from kinefit.bodies.rendering import Canvas, Raster, scaled
from kinefit.bodies.surfaces import BodyMesh
from kinefit.geometry.camera import Camera, Rig
from kinefit.simulation.figures import look_at
from kinefit.simulation.rendering.scenes import GRAIN, grain_table

_FINE = 2  # rays along each side of a pixel, of what moves
_LENS, _NOISE = 0.6, 2.5  # [px] blur of a lens, [grey levels] noise of a value
_MAP, _REACH, _FAR = 1400, 4.5, 60.0  # pixels of a shadow's map, [m] about the middle that it covers, [m] to the lamp
_BIAS = 0.03  # [m] by which a surface does not shade itself


@dataclass(frozen=True, eq=False)
class Thing:
    """Rigid pieces that move: a mesh, colours (S, 3) in 0..1 of its segments, and their poses (F, S, 12) by frame."""

    mesh: BodyMesh
    paint: NDArray
    contrast: float
    frames: NDArray

    def posed(self, frame: float) -> NDArray:
        """(V, 3) [m] in the world, between two frames in proportion."""
        low = min(int(frame), len(self.frames) - 1)
        share, high = frame - low, min(low + 1, len(self.frames) - 1)
        x = self.mesh.posed(self.frames[low])
        return x if share == 0.0 or high == low else (1.0 - share) * x + share * self.mesh.posed(self.frames[high])


@dataclass(frozen=True, eq=False)
class Light:
    """What shines: direction (3,) towards it, colours (3,) of it and of all around; share (F,) of it, gains (F, C)."""

    towards: NDArray
    lamp: NDArray
    around: NDArray
    share: NDArray
    gain: NDArray


@dataclass(frozen=True, eq=False)
class GearScene:
    """Things that move, things that stand, cameras, light.

    Parameters
    ----------
    moving : Thing
    standing : Thing, of one frame
    rig : Rig
    light : Light
    ground : function of rays, that gives the places (N, 3) [m] they meet, colours (N, 3) and normals (N, 3)
    shutter : float, of the time between two frames
    seed : int
    """

    moving: Thing
    standing: Thing
    rig: Rig
    light: Light
    ground: Callable[[NDArray, NDArray], tuple[NDArray, NDArray, NDArray]]
    shutter: float
    seed: int
    _shadows: dict[float, tuple[Any, NDArray]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.light.share)

    def images(self, camera: Camera, frames: Sequence[int] | None = None):
        """(H, W, 3) uint8 RGB of one frame after another."""
        plate, number = _Plate(self, camera), self.rig.names.index(camera.name)
        canvas, random = Canvas(scaled(camera, _FINE).size), np.random.default_rng((self.seed, number))
        for f in range(len(self)) if frames is None else frames:
            yield self._image(plate, canvas, number, f, random)

    def empty(self, camera: Camera, frame: int = 0) -> NDArray:
        """(H, W, 3) uint8 RGB of the scene without what moves, in the light of a frame."""
        plate, number = _Plate(self, camera), self.rig.names.index(camera.name)
        random = np.random.default_rng((self.seed, number, 1))
        lit = plate.around + self.light.share[frame] * plate.lamp
        return _exposed(lit, self.light.gain[frame, number], random)

    def _image(self, plate: _Plate, canvas: Canvas, number: int, f: int, random: np.random.Generator) -> NDArray:
        out = np.zeros_like(plate.lamp)
        times = [f] if not self.shutter else [max(f + self.shutter * s, 0.0) for s in (-0.35, 0.0, 0.35)]
        for t in times:
            sun = self.shadows(t)
            shaded = _hidden(sun, plate.at_sun)[..., None]
            image = plate.around + np.float32(self.light.share[f]) * plate.lamp * ~shaded
            x = self.moving.posed(t)
            raster = canvas.draw_for(plate.fine, x, self.moving.mesh.faces, cull=True)
            seen = raster.seen & (raster.depth < plate.depth)
            colour, lit = _coloured(
                self.moving, x, self.moving.frames[f], plate.fine, raster, seen, self.light, plate.middle, sun
            )
            v, u = (np.flatnonzero(seen.any(axis=k))[[0, -1]] // _FINE for k in (1, 0))
            here = slice(v[0], v[1] + 1), slice(u[0], u[1] + 1)
            box = tuple(slice(_FINE * h.start, _FINE * h.stop) for h in here)
            lamp, around = (np.float32(c) for c in (self.light.share[f] * self.light.lamp, self.light.around))
            light = around + lit[box][..., None] * lamp
            size = here[1].stop - here[1].start, here[0].stop - here[0].start
            fine = colour[box] * light, seen[box].astype(np.float32)
            own, cover = (cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in fine)
            image[here] = image[here] * (1.0 - cover[..., None]) + own
            out += image
        return _exposed(out / len(times), self.light.gain[f, number], random)

    def shadows(self, time: float) -> NDArray:
        """(M, M) [m] depth of what moves as the lamp sees it, at a time in frames; kept, as all cameras ask for it."""
        if time not in self._shadows:
            middle = self.moving.posed(0).mean(axis=0)
            sun = _sun(self.light, middle, self.moving.posed(time), self.moving.mesh.faces)
            rows, columns = (np.flatnonzero(np.isfinite(sun).any(axis=axis)) for axis in (1, 0))
            box = tuple(slice(found.min(initial=0), found.max(initial=0) + 1) for found in (rows, columns))
            self._shadows[time] = box, sun[box].copy()  # 300 whole maps take 14 GB
        sun = np.full((_MAP, _MAP), np.inf, np.float32)
        sun[self._shadows[time][0]] = self._shadows[time][1]
        return sun


class _Plate:
    """What stands, as a camera sees it: light from around, light of the lamp, depth, places as the lamp has them."""

    def __init__(self, scene: GearScene, camera: Camera) -> None:
        light, thing = scene.light, scene.standing
        self.camera, self.fine = camera, scaled(camera, _FINE)
        self.middle = scene.moving.posed(0).mean(axis=0)
        a, b = camera.ray_table
        rays = np.stack([a, b, np.ones_like(a)], axis=-1)
        x, albedo, normal = scene.ground(camera.centre_world, rays @ camera.T_camera_world[:3, :3])
        z = (x - camera.centre_world) @ camera.T_camera_world[2, :3]
        vertices = thing.posed(0)
        raster = Canvas(camera.size).draw_for(camera, vertices, thing.mesh.faces)
        seen = raster.depth < z
        sun = _sun(light, self.middle, vertices, thing.mesh.faces)
        colour, lit = _coloured(thing, vertices, thing.frames[0], camera, raster, seen, light, self.middle, sun)
        depth = np.where(seen, raster.depth, z)
        x = camera.centre_world + (rays * depth[..., None]) @ camera.T_camera_world[:3, :3]
        self.depth = cv2.resize(depth.astype(np.float32), self.fine.size)
        self.at_sun = _at_sun(light, self.middle, x)
        lit = np.where(seen, lit, np.clip(normal @ light.towards, 0.0, 1.0) * ~_hidden(sun, self.at_sun))
        albedo = np.where(seen[..., None], colour, albedo)
        self.around = (albedo * light.around).astype(np.float32)
        self.lamp = (albedo * light.lamp * lit[..., None]).astype(np.float32)


def _exposed(lit: NDArray, gain: NDArray, random: np.random.Generator) -> NDArray:
    """(H, W, 3) uint8 of light, through lens and sensor."""
    image = cv2.GaussianBlur((255.0 * gain * lit).astype(np.float32), (0, 0), _LENS)
    return np.clip(np.rint(image + _NOISE * random.standard_normal(image.shape, np.float32)), 0, 255).astype(np.uint8)


def _coloured(
    thing: Thing, x: NDArray, frames: NDArray, camera: Camera, raster: Raster, seen: NDArray, light: Light,
    middle: NDArray, sun: NDArray,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Colours (h, w, 3) and light of the lamp (h, w) in 0..1 of the pixels seen of a thing."""
    mesh, lamp = thing.mesh, _lamp(light, middle)
    towards = face_normals(x, mesh.faces) @ light.towards
    colour, lit = np.zeros((*seen.shape, 3), np.float32), np.zeros(seen.shape, np.float32)
    _shade(
        seen, raster.depth, raster.face, camera.ray_table, camera.T_camera_world, towards,
        mesh.face_segment, frames, thing.paint, thing.contrast, grain_table(), GRAIN, lamp.T_camera_world,
        lamp.matrix[0, 0], lamp.matrix[0, 2], sun, colour, lit,
    )  # fmt: skip
    return colour, lit


@njit
def _shade(
    seen, depth, face, rays, T, facing, segments, frames, paint, contrast, table, cell, lamp, focal, centre, sun,
    colour, lit,
):  # fmt: skip
    count, size = len(table), len(sun)
    for v in range(seen.shape[0]):
        for u in range(seen.shape[1]):
            if not seen[v, u]:
                continue
            z, s = depth[v, u], segments[face[v, u]]
            x0, x1, x2 = rays[0, v, u] * z - T[0, 3], rays[1, v, u] * z - T[1, 3], z - T[2, 3]
            p = T[0, 0] * x0 + T[1, 0] * x1 + T[2, 0] * x2
            q = T[0, 1] * x0 + T[1, 1] * x1 + T[2, 1] * x2
            r = T[0, 2] * x0 + T[1, 2] * x1 + T[2, 2] * x2
            a, b, c = p - frames[s, 9], q - frames[s, 10], r - frames[s, 11]
            i = math.floor((a * frames[s, 0] + b * frames[s, 3] + c * frames[s, 6]) / cell) + 17 * s
            j = math.floor((a * frames[s, 1] + b * frames[s, 4] + c * frames[s, 7]) / cell) + 17 * s
            k = math.floor((a * frames[s, 2] + b * frames[s, 5] + c * frames[s, 8]) / cell) + 17 * s
            grained = 1.0 + contrast * table[i % count, j % count, k % count]
            for n in range(3):
                colour[v, u, n] = paint[s, n] * grained
            far = lamp[2, 0] * p + lamp[2, 1] * q + lamp[2, 2] * r + lamp[2, 3]
            i = round((lamp[0, 0] * p + lamp[0, 1] * q + lamp[0, 2] * r + lamp[0, 3]) / far * focal + centre)
            j = round((lamp[1, 0] * p + lamp[1, 1] * q + lamp[1, 2] * r + lamp[1, 3]) / far * focal + centre)
            dark = 0 <= i < size and 0 <= j < size and sun[j, i] < far - _BIAS
            lit[v, u] = 0.0 if dark else max(facing[face[v, u]], 0.0)


def _lamp(light: Light, middle: NDArray) -> Camera:
    """What the lamp sees about the middle."""
    focal = 0.5 * _MAP * _FAR / _REACH
    K = [[focal, 0, 0.5 * (_MAP - 1)], [0, focal, 0.5 * (_MAP - 1)], [0, 0, 1]]
    T = look_at(middle + _FAR * light.towards, middle, np.array([0.3, 1.0, 0.1]))
    return Camera("lamp", (_MAP, _MAP), K, (), "radtan", T)


def _at_sun(light: Light, middle: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
    """Places in the map of shadows (...) int, its size squared for those outside, and their depth (...) [m]."""
    lamp = _lamp(light, middle)
    local = x @ lamp.T_camera_world[:3, :3].T + lamp.T_camera_world[:3, 3]
    uv = np.rint(local[..., :2] / np.maximum(local[..., 2:], 1.0) * lamp.matrix[0, 0] + lamp.matrix[0, 2])
    inside = ((uv >= 0) & (uv < _MAP)).all(axis=-1)
    return np.where(inside, uv[..., 1] * _MAP + uv[..., 0], _MAP**2).astype(np.int64), local[..., 2]


def _sun(light: Light, middle: NDArray, x: NDArray, faces: NDArray) -> NDArray:
    """(M, M) [m] depth of triangles as the lamp sees them."""
    return np.array(Canvas((_MAP, _MAP)).draw_for(_lamp(light, middle), x, faces).depth)


def _hidden(sun: NDArray, at: tuple[NDArray, NDArray]) -> NDArray:
    """(...) bool, something is between the lamp and places that `_at_sun` gave."""
    return np.append(sun, np.inf)[at[0]] < at[1] - _BIAS


def clouds(count: int, rate: float, cameras: int, random: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Share (F,) of the sun that clouds leave, and gains (F, C) of cameras that follow it, each a little late."""
    t, phase = np.arange(count) / rate, random.uniform(0.0, 2.0 * np.pi)
    share = lambda t: 0.2 + 0.8 / (1.0 + np.exp(-6.0 * np.sin(2.0 * np.pi * t / 2.2 + phase)))
    late = random.uniform(0.1, 0.4, cameras)
    gain = (0.35 + 0.65 * share(t[:, None] - late)) ** -0.8
    return share(t), 0.85 * gain
