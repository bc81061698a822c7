"""What rendered scenes of people with gear hold: dressed persons, bikes, boxes and cones, a lab, a slope outdoors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.papers.regions.gear_scene import Thing
from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.bodies.surfaces import BodyMesh, TaperedCylinder
from kinefit.bodies.surfaces.mesh import triangles
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry import se3
from kinefit.simulation.rendering.scenes import grain

Ground = Callable[[NDArray, NDArray], tuple[NDArray, NDArray, NDArray]]
"""Of rays (..., 3) from a place (3,): where they end (..., 3) [m], colours (..., 3), normals (..., 3)."""

_BODY = {
    "head": 0, "hand": 0, "forearm": 0, "upperarm": 1, "clavicle": 1, "thorax": 1, "abdomen": 1, "pelvis": 2,
    "thigh": 2, "shank": 2, "foot": 3, "toes": 3,
}  # fmt: skip


_GRAINED = 0.12  # contrast of the grain of skin and cloth


def dressed(motion: Motion, random: np.random.Generator) -> Thing:
    """A person, and gear in black and grey: skin, shirt, trousers and shoes of colours drawn at random."""
    body = motion.body
    skin = np.array([0.75, 0.53, 0.42]) * random.uniform(0.6, 1.1)
    hues = random.uniform(0.0, 180.0) + np.array([0.0, random.uniform(50.0, 130.0)])
    cloth = [_colour(h % 180.0, random.uniform(90, 190), random.uniform(90, 210)) for h in hues]
    worn = np.array([skin, *cloth, np.full(3, random.uniform(0.15, 0.8))])
    gear = body.gear_scale[body.segment_scale] if body.gear_scale.any() else np.zeros(len(body.tree.segments), bool)
    names = [name.removesuffix("_r").removesuffix("_l") for name in body.tree.segments]
    paint = np.array([(0.2, 0.2, 0.22) if g else worn[_BODY[n]] for n, g in zip(names, gear)])
    frames = np.stack([body.tree.forward(T, a)[0] for T, a in zip(motion.Ts_world_root, motion.angles)])
    return Thing(body_mesh(body), paint, _GRAINED, frames)


def together(*things: Thing) -> Thing:
    """Several things as one; the grain of the first counts for all."""
    vertices, faces, segment, face_segment, v, s = [], [], [], [], 0, 0
    for thing in things:
        m = thing.mesh
        vertices.append(m.vertices)
        faces.append(m.faces + v)
        segment.append(m.segment + s)
        face_segment.append(m.face_segment + s)
        v, s = v + len(m.vertices), s + len(thing.paint)
    count = max(len(t.frames) for t in things)
    frames = [np.repeat(t.frames, count, axis=0) if len(t.frames) == 1 else t.frames for t in things]
    mesh = BodyMesh(*(np.concatenate(a) for a in (vertices, faces, segment, face_segment)))
    return Thing(mesh, np.concatenate([t.paint for t in things]), things[0].contrast, np.concatenate(frames, axis=1))


def piece(
    vertices: NDArray, faces: NDArray, colour: NDArray, frames: NDArray | None = None, contrast: float = 0.12
) -> Thing:
    """One rigid piece; frames (F, 4, 4) T_world_piece, by default where its vertices are."""
    Ts = np.eye(4)[None] if frames is None else frames
    packed = np.concatenate([Ts[:, :3, :3].reshape(-1, 9), Ts[:, :3, 3]], axis=1)[:, None]
    none = np.zeros(len(vertices), np.int32), np.zeros(len(faces), np.int32)
    return Thing(BodyMesh(vertices, faces.astype(np.int32), *none), np.array([colour], float), contrast, packed)


def tube(start: Sequence[float], end: Sequence[float], radius: float | tuple[float, float]) -> tuple[NDArray, NDArray]:
    """A round bar [m], or a cone."""
    a, b = (radius, radius) if isinstance(radius, float) else radius
    return triangles(TaperedCylinder(0, tuple(start), tuple(end), ((a, a), (b, b))), 12, 2)


def box(low: Sequence[float], high: Sequence[float]) -> tuple[NDArray, NDArray]:
    """A closed box [m]."""
    x = np.array(np.meshgrid(*zip(low, high), indexing="ij")).reshape(3, -1).T
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return x, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def ring(centre: Sequence[float], radius: float, thick: float) -> tuple[NDArray, NDArray]:
    """A wheel's tyre about the z axis [m]."""
    a, b = (np.linspace(0.0, 2.0 * np.pi, n, endpoint=False) for n in (40, 8))
    out = radius + thick * np.cos(b)
    x = np.stack([np.outer(np.cos(a), out), np.outer(np.sin(a), out), np.tile(thick * np.sin(b), (40, 1))], axis=-1)
    i, j = (n.ravel() for n in np.meshgrid(np.arange(40), np.arange(8), indexing="ij"))
    p, q, r, s = i * 8 + j, (i + 1) % 40 * 8 + j, (i + 1) % 40 * 8 + (j + 1) % 8, i * 8 + (j + 1) % 8
    return x.reshape(-1, 3) + centre, np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])


def _colour(hue: float, saturation: float, value: float) -> NDArray:
    """(3,) RGB in 0..1 of OpenCV's hue 0..180, saturation and value 0..255."""
    return cv2.cvtColor(np.uint8([[[hue, saturation, value]]]), cv2.COLOR_HSV2RGB)[0, 0] / 255.0


@cache
def _palette(seed: int, count: int = 24) -> NDArray:
    random = np.random.default_rng((seed, 7))
    return np.array([_colour(random.uniform(0, 180), random.uniform(10, 190), random.uniform(40, 240))
                     for _ in range(count)])  # fmt: skip


def _cells(p: NDArray, size: tuple[float, float], seed: int) -> NDArray:
    """(N, 3) colours at places p (N, 2) [m]: rectangles of a size [m], each of a colour of its own."""
    i, j = (np.floor(p[:, k] / size[k]).astype(np.int64) for k in range(2))
    return _palette(seed)[(i * 73856093 ^ j * 19349663 ^ seed * 83492791) % len(_palette(seed))]


def _noisy(colour: NDArray, x: NDArray, contrast: float) -> NDArray:
    none = np.zeros(len(x), np.int64)
    return np.clip(colour * (1.0 + contrast * (grain(0.15 * x, none) + 0.5 * grain(x, none)))[:, None], 0.02, 1.2)


def lab_ground(centre: NDArray, half: float, seed: int):
    """A room with posters and shelves at its walls, and a tiled floor."""

    def ground(eye: NDArray, rays: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        middle, size = np.array([centre[0], 1.6, centre[2]]), np.array([half, 1.6, half])
        low, high = middle - size, middle + size
        with np.errstate(divide="ignore"):
            t = np.where(rays > 0, (high - eye) / rays, (low - eye) / rays)
        axis = np.argmin(t, axis=-1)
        x = eye + rays * np.take_along_axis(t, axis[..., None], -1)
        normal = -np.sign(np.take_along_axis(rays, axis[..., None], -1)) * np.eye(3)[axis]
        p, kind = x.reshape(-1, 3), axis.ravel()
        wall = np.where((kind == 0)[:, None], p[:, [2, 1]], p[:, [0, 1]])
        plain = np.array([0.78, 0.77, 0.72])
        inner = (np.abs(wall / (0.55, 0.7) % 1.0 - 0.5) < 0.36).all(axis=1) & (wall[:, 1] > 0.7)
        poster = 0.55 * _cells(wall, (0.11, 0.14), seed) + 0.35 * _cells(wall, (0.55, 0.7), seed + 1)
        colour = np.where(inner[:, None], poster, plain)
        shelf = wall[:, 1] <= 0.7
        colour[shelf] = 0.8 * _cells(wall, (0.17, 0.35), seed + 2)[shelf]
        floor = kind == 1
        tile = _cells(p[:, [0, 2]], (0.5, 0.5), seed + 3) * 0.15 + np.array([0.42, 0.36, 0.3])
        tile *= np.where(((p[:, [0, 2]] / 0.5) % 1.0 < 0.03).any(axis=1), 0.6, 1.0)[:, None]
        colour = np.where(floor[:, None], np.where((p[:, 1] < 1.0)[:, None], tile, plain), colour)
        return x, _noisy(colour, p, 0.08).reshape(x.shape), normal

    return ground


def slope_ground(centre: NDArray, radius: float, seed: int):
    """Ground of snow, grass and earth; houses, trees and sky about it."""

    def ground(eye: NDArray, rays: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        with np.errstate(divide="ignore"):
            t = np.where(rays[..., 1] < 0.0, -eye[1] / rays[..., 1], np.inf)
        flat, to = rays[..., [0, 2]], (eye - centre)[[0, 2]]
        a, b, c = np.sum(flat * flat, -1), flat @ to, to @ to - radius**2
        far = (-b + np.sqrt(np.maximum(b * b - a * c, 0.0))) / a
        wall = far < t
        x = eye + rays * np.where(wall, far, t)[..., None]
        p, w = x.reshape(-1, 3), wall.ravel()
        normal = np.where(wall[..., None], np.array([0.0, 0.3, 0.0]), np.array([0.0, 1.0, 0.0]))
        none = np.zeros(len(p), np.int64)
        wave = grain(0.04 * p, none) + 0.6 * grain(0.013 * p, none + 3)
        kinds = np.array([[0.85, 0.87, 0.9], [0.36, 0.42, 0.2], [0.42, 0.33, 0.25], [0.6, 0.55, 0.45]])
        colour = kinds[np.digitize(wave, (-0.1, 0.7, 1.4))]
        along = np.stack([np.arctan2(p[:, 2] - centre[2], p[:, 0] - centre[0]) * radius, p[:, 1]], axis=1)
        house = np.sin(along[:, 0] * 0.55) + 0.3 * np.sin(along[:, 0] * 2.3)
        edge = np.stack([0.1 * along[:, 0], 0 * w, 0 * w], axis=1)
        line = 2.0 + 2.2 * (np.floor(2.0 * house) / 2.0) + 0.5 * grain(edge, none)
        facade = 0.75 * _cells(along, (0.9, 1.1), seed) + 0.2 * _cells(along, (0.23, 0.3), seed + 1)
        wood = np.array([0.14, 0.24, 0.12]) * (1.3 + 0.5 * grain(0.08 * p, none))[:, None]
        behind = np.where((house > 0.2)[:, None], facade, wood)
        cloud = np.column_stack([along * (0.02, 0.05), 0 * w])
        sky = np.array([0.62, 0.74, 0.92]) + 0.12 * grain(cloud, none)[:, None]
        colour = np.where(w[:, None], np.where((along[:, 1] > np.maximum(line, 0.8))[:, None], sky, behind), colour)
        return x, _noisy(colour, p, 0.12).reshape(x.shape), normal

    return ground


def scattered(
    random: np.random.Generator, centre: NDArray, near: float, far: float, count: int, seed: int
) -> list[Thing]:
    """Boxes, posts and cones that stand about, between two distances [m] from a place."""
    out = []
    for _ in range(count):
        turn, away = random.uniform(0.0, 2.0 * np.pi), random.uniform(near, far)
        at = centre + away * np.array([np.cos(turn), 0.0, np.sin(turn)])
        at[1] = 0.0
        size, colour = random.uniform((0.15, 0.3, 0.15), (0.5, 1.3, 0.5)), _palette(seed)[random.integers(24)]
        shape = random.integers(3)
        if shape == 0:
            v, f = box(-0.5 * size * (1, 0, 1), size * (0.5, 1, 0.5))
        elif shape == 1:
            v, f = tube((0, 0, 0), (0, 2.0 * size[1], 0), 0.2 * float(size[0]))
        else:
            v, f = tube((0, 0.1, 0), (0, 1.6 * size[1], 0), (float(size[0]), 0.03))
        v = v @ se3.exp_so3(np.array([0.0, turn, 0.0])).T + at
        out.append(piece(v, f, colour))
    return out


def bike_stands(motion: Motion) -> list[Thing]:
    """What a body file leaves out of a bike: wheels, fork, stays, chain wheel; and the roller on which it stands."""
    T = motion.segment_poses()[0, motion.body.tree.segment("bike")]
    dark, frame = np.array([0.1, 0.1, 0.11]), np.array([0.75, 0.12, 0.1])
    rear, front = (-0.41, 0.07, 0.0), (0.60, 0.07, 0.0)
    parts = [(ring(hub, 0.325, 0.015), dark) for hub in (rear, front)]
    parts.append((ring((0, 0, 0.035), 0.09, 0.006), dark))
    for side in (-1.0, 1.0):
        stay = (-0.41, 0.07, 0.05 * side)
        parts += [
            (tube((0.41, 0.48, 0.05 * side), (0.60, 0.07, 0.05 * side), 0.012), frame),
            (tube((-0.16, 0.52, 0.03 * side), stay, 0.009), frame), (tube((0.0, 0.0, 0.04 * side), stay, 0.01), frame),
        ]  # fmt: skip
    parts += [(box((x, -0.28, -0.22), (x + d, -0.16, 0.22)), dark) for x, d in ((-0.75, 0.2), (-0.25, 0.13))]
    for angle in np.arange(6) * np.pi / 6.0:
        for hub in (rear, front):
            d = 0.32 * np.array([np.cos(angle), np.sin(angle), 0.0])
            parts.append((tube(hub - d, hub + d, 0.002), np.array([0.5, 0.5, 0.5])))
    return [piece(se3.apply(T, v), f, colour) for (v, f), colour in parts]


def painted(thing: Thing, body: Body, segment: str, colour: Sequence[float]) -> Thing:
    """A thing with one segment in another colour."""
    paint = np.array(thing.paint)
    paint[body.tree.segment(segment)] = colour
    return replace(thing, paint=paint)
