"""Rendered people near a depth camera of the SR305's kind, by the command's road: hands and elbows against the truth.

    python -m benchmarks depth depth_near

Each take is ten images, 0.7 s apart, of one person who stands 0.6 to 1 m before the camera, cut by the image below and
often beside, and moves one hand or both: open or as a fist, to the side, before the trunk, at the camera. Bodies are
drawn with surfaces that the tracker does not have (metaballs, fingers, folds of cloth). The sensor leaves holes at
edges, on slanted surfaces and by chance. Settings were chosen on odd numbers, five images each; even ones are printed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.scenes.takes import tracked
from benchmarks.timing import took
from kinefit import load_body
from kinefit.bodies import Body, BodyState
from kinefit.bodies.motion import BELIEVED, Motion
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.bodies.surfaces.mesh import BodyMesh
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Camera
from kinefit.simulation.rendering.scenes import SimulatedScene
from kinefit.simulation.rendering.sensors import DepthSensor, measured_depth
from kinefit.simulation.retarget import known_motion
from kinefit.solving.correspondences import collision_rows

SR305 = DepthSensor(
    "sr305", (640, 480), 476.0, 0.2, 1.5, (0.001, 0.002, 0.2), oblique=0.5, grazing=0.2, baseline=0.026, lateral=0.7,
    edges_lost=0.7, holes=0.004,
)
TAKES, IMAGES, RATE, UNIT = amount(30, 1), amount(10, 2), 1.5, 0.000125
WITHIN = 0.04  # [m] of the truth
_SHOWN = 0.3  # share of a hand's or forearm's pixels that must be its foremost ones in the image, to be asked for
_BLOTCH, _BLOTCHES = 14, 0.06  # [px] size and share of the image of the holes that are larger than a pixel
_FOLDS = 0.006  # [m] standard deviation of cloth about a trunk and upper arms
_TAKE = """[take]
rate = {rate}
up = "-y"
[[depth]]
name = "depth"
file = "{folder}"
rate = {rate}
unit = {unit}
intrinsics = [{f}, {f}, {cx}, {cy}]
range = [0.2, 2.0]
"""
_ARM = {"arm_flex": (0, 150), "arm_add": (-90, 10), "arm_rot": (-80, 80), "elbow_flex": (0, 130), "pro_sup": (0, 160),
        "wrist_flex": (-40, 40), "wrist_dev": (-15, 20)}  # fmt: skip
_PARTS = tuple((kind, side) for side in "rl" for kind in ("hand", "elbow"))


@dataclass(frozen=True, eq=False)
class NearTake:
    """One person before the camera.

    Parameters
    ----------
    images : K x (480, 640) [m]
    truth : Motion of K frames, camera's world with y up
    camera : Camera
    seen : K x {(kind, side)} hands and elbows that the image shows
    """

    images: Sequence[NDArray]
    truth: Motion
    camera: Camera
    seen: Sequence[frozenset[tuple[str, str]]]


def run() -> None:
    """Print the figures."""
    gaps: list[NDArray] = []
    lost: list[NDArray] = []
    asked, spent = [], []
    for seed in range(0, 2 * TAKES, 2):
        take = near_take(seed)
        motion, seconds = took(partial(motion_of, take))
        spent.append(seconds / len(take.images))
        g, gone = errors(take, motion)
        gaps, lost = [*gaps, g], [*lost, gone]
        asked.append([[part in seen for part in _PARTS] for seen in take.seen])
    gap, gone, use = (np.concatenate(a) for a in (gaps, lost, asked))
    right = (gap <= WITHIN) | gone
    figure("depth_near_right", 100 * float(right[use].mean()),
           f"% of hands and elbows within 4 cm, or said to be lost, {len(gap)} images", ">= 95")  # fmt: skip
    figure("depth_near_found", 100 * float((gap[use] <= WITHIN).mean()), "% of hands and elbows within 4 cm", ">= 70")
    figure("depth_near_seconds", float(np.median(spent)), "s CPU an image, median take", "<= 3")
    figure("depth_near_seconds_worst", float(np.max(spent)), "s CPU an image, slowest take", "<= 8")


def motion_of(take: NearTake) -> Motion:
    """Its motion by `track_take` with defaults, in the camera's frame."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "images"
        folder.mkdir()
        for k, depth in enumerate(take.images):
            cv2.imwrite(str(folder / f"{k}.png"), np.rint(depth / UNIT).astype(np.uint16))
        K = take.camera.matrix
        return tracked(_TAKE.format(rate=RATE, folder=folder, unit=UNIT, f=K[0, 0], cx=K[0, 2], cy=K[1, 2]))[0]


def errors(take: NearTake, motion: Motion) -> tuple[NDArray, NDArray]:
    """(K, 4) of `_PARTS` [m] from the truth, and whether each is said to be lost."""
    T = take.camera.T_camera_world
    true = take.truth.positions() @ T[:3, :3].T + T[:3, 3]
    found, names = motion.positions(), motion.body.landmarks.names
    gap, lost = np.empty((2, len(true), len(_PARTS)))
    for k, (kind, side) in enumerate(_PARTS):
        points = [f"{side}_elbow"] if kind == "elbow" else [f"{side}_wrist", f"{side}_metacarpal_phalanx_3"]
        a, b = (
            x[:, [n.index(p) for p in points]].mean(axis=1)
            for x, n in ((true, take.truth.body.landmarks.names), (found, names))
        )
        gap[:, k] = np.linalg.norm(a - b, axis=1)
        segment = motion.body.tree.segments.index(f"{'forearm' if kind == 'elbow' else 'hand'}_{side}")
        lost[:, k] = motion.segment_quality[:, segment] < BELIEVED
    return gap, lost > 0


def near_take(seed: int) -> NearTake:
    """Images and truth of a number."""
    rng = np.random.default_rng([seed, 32])
    body = _person(rng)
    states = _states(body, rng, IMAGES)
    roots, angles = np.array([s.T_world_root for s in states]), np.array([s.angles for s in states])
    truth = known_motion(body, RATE, roots, angles)
    T = np.diag([1.0, -1.0, -1.0, 1.0])  # at the origin, looks along -z
    camera = SR305.camera(T, name="depth")
    room = SimulatedScene.of(truth, camera).room if rng.random() < 0.3 else None
    folds = rng.normal(size=(3, 4)), rng.uniform(15.0, 60.0, (3, 4, 3)), rng.uniform(0.0, 6.3, (3, 4))
    fist = {"r": rng.random() < 0.35, "l": rng.random() < 0.35}
    images, seen = [], []
    for k in range(IMAGES):
        mesh = _dressed(body, fist, folds)
        scene = SimulatedScene(truth, mesh, room)
        depth = measured_depth(scene, k, camera, SR305, rng)
        images.append(np.where(_blotches(rng, depth.shape), 0.0, depth).astype(np.float32))
        seen.append(_shown(scene, k, camera))
    return NearTake(images, truth, camera, seen)


def _person(rng: np.random.Generator) -> Body:
    body = load_body("humanoid_metaballs")
    return body.scaled(np.exp(rng.normal(0.0, 0.05) + rng.normal(0.0, 0.03, len(body.scale_groups))))


def _states(body: Body, rng: np.random.Generator, count: int) -> list[BodyState]:
    """Poses that one could move through, 0.7 s apart."""
    side, both = ("r", "l")[int(rng.random() < 0.4)], rng.random() < 0.3
    kind = ("raised", "at the camera", "across", "beside")[int(rng.integers(4))]
    away, yaw = rng.uniform(0.6, 1.0), np.radians(rng.uniform(-40.0, 40.0))
    height, shift, lean = rng.uniform(-0.1, 0.25), rng.uniform(-0.15, 0.15), np.radians(rng.uniform(-5.0, 20.0))
    out: list[BodyState] = []
    for _ in range(2000):
        if len(out) == count:
            break
        at = yaw + np.radians(rng.normal(0.0, 6.0))
        x = np.array([np.sin(at), 0.0, np.cos(at)])  # the root's x axis is ahead, the camera is at +z of the person
        y = np.cos(lean) * np.array([0.0, 1.0, 0.0]) + np.sin(lean) * x
        z = np.cross(x, y) / np.linalg.norm(np.cross(x, y))
        angles = np.array(body.default_state().angles)
        for name, spread in (("lumbar_extension", 5), ("neck_extension", 12), ("neck_rotation", 15)):
            angles[body.tree.coordinate(name)] += np.radians(rng.normal(0.0, spread))
        for s in "rl":
            before = out[-1].angles if out and rng.random() < 0.8 else None
            for name, (low, high) in _ARM.items():
                j = body.tree.coordinate(f"{name}_{s}")
                if s != side and not both:
                    angles[j] += np.radians(rng.normal(0.0, 5.0))
                elif before is not None:
                    angles[j] = before[j] + np.radians(rng.normal(0.0, 12.0))
                else:
                    angles[j] = np.radians(rng.uniform(low, high))
        T = np.eye(4)
        T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
        state = BodyState(T, np.clip(angles, body.tree.lower, body.tree.upper))
        chest = body.tree.segment_poses(T[None], state.angles[None])[0][body.tree.segments.index("thorax"), :3, 3]
        T[:3, 3] = np.array([shift, -0.1 - height, -away]) - chest
        if _likely(body, BodyState(T, state.angles), kind, side):
            out.append(BodyState(T, state.angles))
    while len(out) < count:  # a body that finds no second pose holds still
        out.append(out[-1] if out else BodyState(T, body.default_state().angles))
    return out


def _likely(body: Body, state: BodyState, kind: str, side: str) -> bool:
    """Whether a pose is of a kind, with the hand before the camera and no part within another."""
    names = body.landmarks.names
    x = body.positions(state, body.landmarks)
    hand, elbow, shoulder = (x[names.index(f"{side}_{n}")] for n in ("metacarpal_phalanx_3", "elbow", "shoulder"))
    wrist, z = x[names.index(f"{side}_wrist")], -hand[2]
    u, v = SR305.focal * hand[0] / z, -SR305.focal * hand[1] / z
    if z < 0.28 or abs(u) > 290 or abs(v) > 210:
        return False
    along = (wrist - elbow) / np.linalg.norm(wrist - elbow)
    of = {
        "raised": along[1] > 0.6, "at the camera": along[2] > 0.8, "across": hand[2] - shoulder[2] > 0.15,
        "beside": abs(hand[0] - shoulder[0]) > 0.25,
    }  # fmt: skip
    rows = collision_rows(_THIN[0], state, margin=-0.04, sigma=0.01)
    return bool(of[kind]) and not np.any(rows.weight * np.square(rows.residual) > 0.0)


_THIN = [load_body("humanoid")]  # whose parts are tested for running into each other


def _dressed(body: Body, fist: dict[str, bool], folds: tuple[NDArray, ...]) -> BodyMesh:
    """The body's mesh with folds of cloth, and hands with fingers, stretched or in a fist."""
    tree = body.tree
    hands = {tree.segments.index(f"hand_{s}"): s for s in "rl"}
    others = replace(body, surfaces=tuple(s for s in body.surfaces if s.segment not in hands))
    mesh, amplitude = body_mesh(others), _FOLDS * folds[0]
    waves = np.sin(np.einsum("ckj,nj->nck", folds[1], mesh.vertices) + folds[2])
    cloth = np.isin(mesh.segment, [tree.segments.index(n) for n in ("abdomen", "thorax", "upperarm_r", "upperarm_l")])
    vertices = mesh.vertices + cloth[:, None] * np.einsum("nck,ck->nc", waves, amplitude / 2.0)
    parts = [(vertices, mesh.faces, mesh.segment, mesh.face_segment)]
    for s, side in hands.items():
        size = float(np.linalg.norm(body.landmarks.points[body.landmarks.names.index(f"{side}_metacarpal_phalanx_3")]))
        own = body_mesh(replace(body, surfaces=tuple(_hand(s, size / 0.092, side, fist[side]))), around=10, along=4)
        parts.append((own.vertices, own.faces + sum(len(p[0]) for p in parts), own.segment, own.face_segment))
    v, f, of, owner = (np.concatenate(a) for a in zip(*parts))
    return BodyMesh(v, f.astype(np.int32), of.astype(np.int32), owner.astype(np.int32))


def _hand(s: int, size: float, side: str, fist: bool) -> list[TaperedCylinder]:
    """Palm, four fingers and a thumb, pointing down, the thumb ahead as at rest of the arm."""
    k = size if side == "r" else -size  # fingers side by side along z
    out = [TaperedCylinder(s, (0.0, 0.015, 0.0), (0.0, -0.095 * size, 0.0), ((0.02, 0.028), (0.014, 0.042)))]
    for i, length in enumerate((0.072, 0.08, 0.074, 0.058)):
        z, spread = (0.03 - 0.02 * i) * k, (0.10 - 0.07 * i) * length * np.sign(k)
        begin = (0.0, -0.09 * size, z)
        if fist:
            bend, tip = (-0.035 * size, -0.085 * size, z), (-0.03 * size, -0.05 * size, z)
            out.append(TaperedCylinder(s, begin, bend, ((0.011, 0.011),) * 2, (0, 1, 0)))
            out.append(TaperedCylinder(s, bend, tip, ((0.011, 0.01),) * 2))
        else:
            tip = (0.0, -(0.09 + length) * size, z + spread)
            out.append(TaperedCylinder(s, begin, tip, ((0.01, 0.01), (0.007, 0.007))))
    end = (-0.035 * size, -0.075 * size, 0.02 * k) if fist else (0.0, -0.085 * size, 0.075 * k)
    return [*out, TaperedCylinder(s, (0.0, -0.025 * size, 0.025 * k), end, ((0.013, 0.013), (0.009, 0.009)))]


def _blotches(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray:
    """(H, W) bool, holes of some pixels' size."""
    smooth = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), _BLOTCH / 2.0)
    return np.asarray(smooth > np.quantile(smooth, 1.0 - _BLOTCHES))


def _shown(scene: SimulatedScene, k: int, camera: Camera) -> frozenset[tuple[str, str]]:
    """Hands and elbows that lie within the image and are not hidden."""
    view = scene.view(k, camera)
    out, tree = set(), scene.motion.body.tree
    x, names = scene.motion.positions()[k], scene.motion.body.landmarks.names
    for kind, side in _PARTS:
        s = tree.segments.index(f"{'forearm' if kind == 'elbow' else 'hand'}_{side}")
        u, v = camera.project(x[names.index(f"{side}_{'elbow' if kind == 'elbow' else 'wrist'}")][None])[0]
        if not (0 <= u < camera.size[0] and 0 <= v < camera.size[1]):
            continue
        faces = scene.mesh.faces[scene.mesh.face_segment == s]
        alone = SimulatedScene(scene.motion, replace(
            scene.mesh, faces=faces, face_segment=np.full(len(faces), s, np.int32))).view(k, camera)  # fmt: skip
        own = int(alone.raster.seen.sum())
        if own and np.sum(view.raster.segment == s) > _SHOWN * own:
            out.add((kind, side))
    return frozenset(out)
