"""Rendered sequences of rigid objects in the manner of RBOT: real clutter behind, moving light, noise, an occluder.

They are not that benchmark's sequences, and their numbers are not its numbers. An object of coloured parts with a grain
turns and moves before a photograph; the camera's image has noise, is blurred by lens and motion, and has soft edges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import data
from benchmarks.papers.silhouettes.silhouettes_car import surface as car_surface
from kinefit.bodies import Body, BodyState, PointSet, load_body
from kinefit.bodies.rendering import Canvas, lens_of
from kinefit.bodies.surfaces.mesh import MeshSurface
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.bodies.tree import KinematicTree
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig

SIZE, FOCAL = (640, 512), 650.0
RATE = 30.0  # [Hz]
KINDS = ("regular", "light", "noise", "occlusion")
TUNED = ("rabbit", "lamp", "box", "figure")  # objects on which settings were chosen ...
TOLD = ("duck", "can", "car", "drill")  # ... and those of which figures are told
_BLUR = 0.8  # [px] of the lens and of the sensor's colour filter
_SHUTTER = 0.2  # of the time between two images: what moves by 25 px is blurred over 5, as in the real recording
_FAR = 0.75  # [m] of an object that is 0.2 m long


@dataclass(frozen=True, eq=False)
class Thing:
    """An object: its body, and the colours (T, 3) in 0..1 of its triangles with the contrast of their grain."""

    body: Body
    vertices: NDArray
    faces: NDArray
    colours: NDArray
    grain: float


@dataclass(frozen=True, eq=False)
class Sequence:
    """Images (H, W, 3) uint8 RGB of one object, and where it truly was: (F, 4, 4) T_camera_object."""

    name: str
    body: Body
    rig: Rig
    images: list[NDArray]
    truth: NDArray


def rigid(name: str, vertices: NDArray, faces: NDArray) -> Body:
    """A body of one segment that moves freely."""
    none = np.zeros(0)
    tree = KinematicTree((name,), np.array([-1]), np.zeros((1, 3)), (), none, np.zeros((0, 3)), none, none, none, none,
                         none)  # fmt: skip
    points = PointSet(("middle",), np.zeros(1, int), np.zeros((1, 3)))
    surface = MeshSurface(0, vertices, faces)
    return Body(name, tree, ("free",), ("whole",), np.zeros(1, int), points, surfaces=(surface,))


def _ball(at: NDArray, half: NDArray, turn: NDArray, power: float) -> tuple[NDArray, NDArray]:
    """A closed superquadric about a place: half axes [m], rotation vector, power 1 for an ellipsoid, less for a box."""
    a, b = np.linspace(-np.pi / 2, np.pi / 2, 17)[1:-1], np.linspace(0, 2 * np.pi, 28, endpoint=False)

    def bent(x: NDArray) -> NDArray:
        return np.sign(x) * np.abs(x) ** power

    ring = np.stack([
        bent(np.cos(a))[:, None] * bent(np.cos(b)), bent(np.cos(a))[:, None] * bent(np.sin(b)),
        np.repeat(bent(np.sin(a))[:, None], len(b), axis=1),
    ], axis=-1).reshape(-1, 3)  # fmt: skip
    x = np.concatenate([[[0, 0, -1.0]], ring, [[0, 0, 1.0]]]) * np.asarray(half)
    n, m = len(a), len(b)
    faces = [(0, 1 + (k + 1) % m, 1 + k) for k in range(m)]
    for j in range(n - 1):
        for k in range(m):
            p, q = 1 + j * m + k, 1 + j * m + (k + 1) % m
            faces += [(p, q, q + m), (p, q + m, p + m)]
    top = len(x) - 1
    faces += [(top, 1 + (n - 1) * m + k, 1 + (n - 1) * m + (k + 1) % m) for k in range(m)]
    return x @ se3.exp_so3(np.asarray(turn, float)).T + at, np.array(faces)


_SHAPES: dict[str, tuple[float, list[tuple]]] = {  # grain, then parts: place, half axes, turn, power, colour
    "rabbit": (0.15, [
        ((0, 0, 0), (0.055, 0.06, 0.075), (0, 0, 0), 1, (0.72, 0.68, 0.62)),
        ((0.02, 0, 0.09), (0.04, 0.035, 0.038), (0, 0, 0), 1, (0.75, 0.7, 0.66)),
        ((0.01, 0.02, 0.145), (0.01, 0.014, 0.04), (0.2, 0, 0), 1, (0.8, 0.6, 0.58)),
        ((0.01, -0.02, 0.145), (0.01, 0.014, 0.04), (-0.4, 0, 0), 1, (0.8, 0.6, 0.58)),
        ((0.05, 0.03, -0.06), (0.035, 0.016, 0.014), (0, 0, 0), 1, (0.7, 0.66, 0.6)),
        ((0.05, -0.03, -0.06), (0.035, 0.016, 0.014), (0, 0, 0), 1, (0.7, 0.66, 0.6)),
        ((-0.06, 0, -0.04), (0.018, 0.018, 0.018), (0, 0, 0), 1, (0.95, 0.93, 0.9))]),
    "lamp": (0.05, [
        ((0, 0, -0.1), (0.06, 0.06, 0.012), (0, 0, 0), 0.4, (0.25, 0.3, 0.55)),
        ((0, 0, -0.02), (0.01, 0.01, 0.09), (0, 0, 0), 0.6, (0.6, 0.6, 0.62)),
        ((0.04, 0, 0.08), (0.055, 0.045, 0.035), (0, 0.6, 0), 0.8, (0.28, 0.33, 0.6)),
        ((0.03, 0.03, -0.085), (0.012, 0.012, 0.012), (0, 0, 0), 1, (0.8, 0.15, 0.1))]),
    "box": (0.3, [
        ((0, 0, 0), (0.07, 0.035, 0.095), (0, 0, 0), 0.15, (0.75, 0.2, 0.15)),
        ((0.0, 0.0, 0.06), (0.0705, 0.0355, 0.022), (0, 0, 0), 0.12, (0.85, 0.8, 0.7))]),
    "duck": (0.08, [
        ((0, 0, 0), (0.075, 0.055, 0.05), (0, 0, 0), 1, (0.85, 0.75, 0.15)),
        ((0.05, 0, 0.065), (0.036, 0.034, 0.036), (0, 0, 0), 1, (0.85, 0.76, 0.18)),
        ((0.092, 0, 0.06), (0.018, 0.016, 0.007), (0, 0, 0), 1, (0.85, 0.35, 0.1)),
        ((-0.075, 0, 0.025), (0.022, 0.02, 0.03), (0, 0.6, 0), 1, (0.82, 0.72, 0.14)),
        ((0.0, 0.05, 0.005), (0.045, 0.012, 0.028), (0, 0, 0.1), 1, (0.8, 0.68, 0.1))]),
    "can": (0.2, [
        ((0, 0, 0), (0.06, 0.06, 0.07), (0, 0, 0), 0.3, (0.2, 0.5, 0.3)),
        ((0.1, 0, 0.03), (0.065, 0.012, 0.012), (0, -0.7, 0), 0.7, (0.22, 0.52, 0.33)),
        ((-0.075, 0, 0.02), (0.012, 0.01, 0.05), (0, 0, 0), 0.5, (0.15, 0.4, 0.25)),
        ((0, 0, 0.085), (0.045, 0.008, 0.012), (0, 0, 0), 0.6, (0.6, 0.6, 0.55))]),
    "drill": (0.06, [
        ((0, 0, 0.05), (0.085, 0.028, 0.03), (0, 0, 0), 0.5, (0.12, 0.28, 0.38)),
        ((-0.04, 0, -0.03), (0.02, 0.02, 0.065), (0, 0.15, 0), 0.6, (0.12, 0.12, 0.13)),
        ((-0.035, 0, -0.1), (0.045, 0.03, 0.02), (0, 0, 0), 0.3, (0.13, 0.27, 0.36)),
        ((0.115, 0, 0.05), (0.035, 0.01, 0.01), (0, 0, 0), 0.7, (0.55, 0.55, 0.56))]),
}  # fmt: skip


@cache
def thing(name: str) -> Thing:
    """An object by its name."""
    if name == "car":
        vertices, faces = car_surface().triangles((96, 40))
        vertices = vertices * 0.7
        high = vertices[faces].mean(axis=1)[:, 1]
        colours = np.where((high > 0.045)[:, None], (0.2, 0.25, 0.3), (0.7, 0.12, 0.1))
        return Thing(rigid(name, vertices, faces), vertices, faces, colours, 0.05)
    if name == "figure":
        human = load_body("humanoid10")
        mesh = body_mesh(human)
        angles = np.random.default_rng(3).normal(0, 0.4, len(human.tree.coordinates))
        angles = np.clip(human.tree.usual + angles, human.tree.lower, human.tree.upper)
        vertices = mesh.posed(human.tree.forward(np.eye(4), angles)[0])
        vertices = (vertices - vertices.mean(axis=0)) * 0.12
        palette = np.array([(0.75, 0.55, 0.45), (0.2, 0.25, 0.5), (0.6, 0.2, 0.2), (0.3, 0.3, 0.3)])
        return Thing(rigid(name, vertices, mesh.faces), vertices, mesh.faces, palette[mesh.face_segment % 4], 0.1)
    grain, parts = _SHAPES[name]
    x, f, c = np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3))
    for at, half, turn, power, colour in parts:
        v, t = _ball(np.array(at), np.array(half), np.array(turn), power)
        x, f = np.concatenate([x, v]), np.concatenate([f, t + len(x)])
        c = np.concatenate([c, np.tile(colour, (len(t), 1))])
    x = x - x.mean(axis=0)
    return Thing(rigid(name, x, f), x, f, c, grain)


def camera() -> Camera:
    """What all sequences are seen by; it is the world."""
    return Camera("cam", SIZE, [[FOCAL, 0, SIZE[0] / 2 - 0.5], [0, FOCAL, SIZE[1] / 2 - 0.5], [0, 0, 1]])


def motion(frames: int, random: np.random.Generator) -> NDArray:
    """(F, 4, 4) a hand's: 15 mm and 7 degrees from image to image, median, as RBOT's; within the image."""
    t, out = np.arange(frames), np.tile(np.eye(4), (frames, 1, 1))
    out[:, :3, 3] = (0.0, 0.0, _FAR)
    R0 = se3.exp_so3(random.uniform(-1.5, 1.5, 3))
    turn, shift = np.zeros((frames, 3)), np.zeros((frames, 3))
    for _ in range(4):
        period, phase = random.uniform(25, 90, 6), random.uniform(0, 2 * np.pi, 6)
        waves = np.sin(2 * np.pi * t[:, None] / period + phase) * period / (2 * np.pi)
        turn += waves[:, :3] * random.normal(0, 1, 3)
        shift += waves[:, 3:] * random.normal(0, 1, 3)
    turn *= np.radians(7.0) / np.median(np.linalg.norm(np.diff(turn, axis=0), axis=1))
    shift *= 0.015 / np.median(np.linalg.norm(np.diff(shift, axis=0), axis=1))
    bound = np.array([0.2, 0.14, 0.22])
    out[:, :3, 3] += bound * np.tanh(shift / bound)
    for k in range(frames):
        out[k, :3, :3] = se3.exp_so3(turn[k]) @ R0
    return out


@cache
def plates() -> tuple[NDArray, ...]:
    """Photographs of real clutter (H, W, 3) in 0..1, larger than an image; patches of colour where there are none."""
    out = []
    folder = data("region_cat")
    if folder is not None:
        out.append(cv2.imread(str(folder / "img" / "0030.png"))[..., ::-1] / 255.0)
    folder = data("video_balancing_4cam")
    for k in range(1, 5) if folder is not None else ():
        out.append(cv2.imread(str(folder / f"background_plate_cam0{k}.png"))[..., ::-1] / 255.0)
    if not out:
        random = np.random.default_rng(0)
        image = np.zeros((700, 900, 3))
        for _ in range(400):
            at, half = random.uniform((0, 0), (900, 700)), random.uniform(10, 90)
            cv2.circle(image, tuple(int(v) for v in at), int(half), random.uniform(0, 1, 3).tolist(), -1)
        out.append(image)
    sized = []
    for image in out:
        by = max(1.25 * SIZE[0] / image.shape[1], 1.25 * SIZE[1] / image.shape[0])
        sized.append(cv2.resize(image, None, fx=by, fy=by, interpolation=cv2.INTER_AREA))
    return tuple(sized)


def face_normals(x: NDArray, faces: NDArray) -> NDArray:
    """(T, 3) unit normals of triangles (T, 3) with corners (V, 3), outwards."""
    corners = x[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12))


def drawn(what: Thing, T: NDArray, light: NDArray, canvas: Canvas, cam: Camera) -> tuple[NDArray, NDArray]:
    """Colours (h, w, 3) and cover (h, w) of an object in a canvas of twice the camera's size."""
    lens = 2 * lens_of(cam) + (0.0, 0.0, 0.5, 0.5)
    x = what.vertices @ T[:3, :3].T + T[:3, 3]
    raster = canvas.draw(x, what.faces, lens, cull=True)
    colour, cover = np.zeros((*raster.face.shape, 3), np.float32), (raster.face >= 0).astype(np.float32)
    v, u = np.nonzero(raster.face >= 0)
    z, face = raster.depth[v, u], raster.face[v, u]
    seen = np.stack([(u - lens[2]) / lens[0] * z, (v - lens[3]) / lens[1] * z, z], axis=1)
    own = (seen - T[:3, 3]) @ T[:3, :3]
    share = 0.45 + 0.55 * np.maximum(face_normals(x, what.faces) @ light, 0.0)
    grain = np.sin(own @ (190.0, 310.0, 130.0)) * np.sin(own @ (-270.0, 90.0, 240.0)) + np.sin(own @ (60, -80, 110.0))
    colour[v, u] = what.colours[face] * (share[face] * (1.0 + what.grain * grain))[:, None]
    return colour, cover


def _part(T: NDArray, share: float) -> NDArray:
    """A share of a small motion (4, 4)."""
    return np.asarray(se3.exp(share * se3.log(T)))


def rendered(name: str, kind: str, seed: int, frames: int) -> Sequence:
    """A sequence of one of `KINDS`."""
    random = np.random.default_rng((seed, sorted((*TUNED, *TOLD)).index(name), KINDS.index(kind)))
    what, cam, truth = thing(name), camera(), motion(frames, random)
    plate = plates()[int(random.integers(len(plates())))]
    room = np.array(plate.shape[:2]) - SIZE[::-1]
    corner = random.uniform(0, room).astype(int)
    drift = random.uniform(-0.3, 0.3, 2) * room / frames  # the camera's own motion: what is behind moves too
    canvas = Canvas((2 * SIZE[0], 2 * SIZE[1]))
    before = thing("lamp" if name != "lamp" else "rabbit")
    axis = random.normal(size=3)
    images = []
    for k in range(frames):
        light = np.array([0.3, -0.6, -0.75])
        if kind in ("light", "noise", "occlusion"):  # RBOT's three harder variants all have moving light
            light = se3.exp_so3(axis / np.linalg.norm(axis) * 2 * np.pi * k / 90) @ light
        y, x = np.clip(corner + k * drift, 0, room).astype(int)
        image = plate[y : y + SIZE[1], x : x + SIZE[0]].astype(np.float32)
        ahead = truth[min(k + 1, frames - 1)] @ np.linalg.inv(truth[k])  # while the shutter is open
        blurred = [truth[k]] + [_part(ahead, share) @ truth[k] for share in (-_SHUTTER / 2, _SHUTTER / 2)]
        layers = [(what, blurred)]
        if kind == "occlusion":
            T = np.array(truth[k])
            T[:3, :3] = se3.exp_so3(np.array([0.02 * k, 0.5, 0.03 * k]))
            T[:3, 3] *= 0.85
            T[:3, 3] += [0.12 * np.sin(2 * np.pi * k / 45), 0.08 * np.cos(2 * np.pi * k / 60), 0.0]
            layers.append((replace(before, vertices=0.6 * before.vertices), [T]))
        for one, poses in layers:
            seen = [drawn(one, T, light, canvas, cam) for T in poses]
            colour, cover = (np.mean([s[n] for s in seen], axis=0, dtype=np.float32) for n in (0, 1))
            small = [cv2.resize(a, SIZE, interpolation=cv2.INTER_AREA) for a in (colour, cover)]
            image = image * (1.0 - small[1][..., None]) + small[0]
        image = cv2.GaussianBlur(image, (0, 0), _BLUR)
        noise = 0.03 if kind == "noise" else 0.006
        image = image + noise * random.standard_normal(image.shape, np.float32)
        images.append(np.clip(255 * image, 0, 255).astype(np.uint8))
    return Sequence(f"{name}, {kind}", what.body, Rig((cam,)), images, truth)


Follow = Callable[[Sequence, int], NDArray]


def away(T: NDArray, truth: NDArray) -> tuple[float, float]:
    """How far a pose is from the truth [mm], [deg]."""
    R = T[:3, :3].T @ truth[:3, :3]
    turn = np.degrees(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0)))
    return 1e3 * float(np.linalg.norm(T[:3, 3] - truth[:3, 3])), float(turn)


def state_of(T: NDArray) -> BodyState:
    """A state of a rigid body."""
    T = np.array(T)
    u, _, vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = u @ vt
    return BodyState(T, np.zeros(0))
