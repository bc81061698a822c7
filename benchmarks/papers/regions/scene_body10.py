"""The rendered ten-part body in `scene_body10`: its body, its truth, and how far a tracker is from it.

`KINEFIT_SCENE` names the folder that holds `body10/` and `body10occl/`, written by the scene's own generator.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import timed
from kinefit.bodies import Body, BodyState, KinematicTree, PointSet
from kinefit.bodies.surfaces import MeshSurface
from kinefit.bodies.surfaces.mesh import BodyMesh, read_obj
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import ColourFrame, DepthFrame

RATE = 30.0  # [Hz] of the rendered frames
LOST = 100.0  # [mm] ADD above which a part counts as lost, as with M3T
FOUND = 50.0  # [mm] ADD below which a part counts as found
SPREAD = 1.0  # [rad] of the angles about zero: a prior that one measured patch outweighs
# [rad] Ranges that any human body has (M3T was given none): elbows, knees, and twists of limbs about their own length.
_RANGES = {("farm", 3): (-2.7, 0.1), ("shin", 3): (-0.1, 2.7),
           ("thigh", 4): (-0.8, 0.8), ("uarm", 4): (-1.6, 1.6), ("head", 4): (-1.4, 1.4)}  # fmt: skip
_AXES = {5: (0.0, 0.0, 1.0), 4: (0.0, 1.0, 0.0), 3: (1.0, 0.0, 0.0)}  # column of `free`: local rotation is Rz Ry Rx


def folder(name: str) -> Path | None:
    """The folder of a rendered scene, or None where there is none."""
    root = os.environ.get("KINEFIT_SCENE")
    path = Path(root) / name if root else None
    return path if path is not None and (path / "gt.txt").exists() and (path / "depth").is_dir() else None


@dataclass(frozen=True, eq=False)
class Scene:
    """One rendered sequence.

    Parameters
    ----------
    folder : Path
    body : Body, ten segments with meshes, 25 degrees of freedom.
    rig : Rig with the depth camera "depth", which is the world.
    truth : (F, 10, 4, 4) [m] T_camera_segment
    """

    folder: Path
    body: Body
    rig: Rig
    truth: NDArray

    def __len__(self) -> int:
        return len(self.truth)

    @cached_property
    def states(self) -> list[BodyState]:
        """True states, by inverse kinematics."""
        return [_state(self.body, Ts) for Ts in self.truth]

    @cached_property
    def mesh(self) -> BodyMesh:
        return body_mesh(self.body)

    def raw(self, i: int) -> NDArray:
        """(480, 640) uint16 [mm] depth as it lies on the disk."""
        import cv2

        image = cv2.imread(str(self.folder / "depth" / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise FileNotFoundError(self.folder / "depth" / f"{i:06d}.png")
        return image

    def depth(self, i: int) -> DepthFrame:
        """Depth of a frame."""
        return as_frame(self.raw(i), i / RATE)

    def colour(self, i: int) -> NDArray:
        """(480, 640, 3) uint8 RGB of a frame."""
        import cv2

        image = cv2.imread(str(self.folder / "color" / f"{i:06d}.png"), cv2.IMREAD_COLOR)
        if image is None:
            raise FileNotFoundError(self.folder / "color" / f"{i:06d}.png")
        return np.ascontiguousarray(image[..., ::-1])

    def seen(self, i: int, kinds: Sequence[str]) -> Callable[[float], list[Any]]:
        """What sensors of some kinds ("depth", "region") saw in a frame, as read from the disk, as frames of a time."""
        raw = self.raw(i) if "depth" in kinds else None
        image = self.colour(i) if "region" in kinds else None

        def frames(time: float) -> list[Any]:
            depth = [] if raw is None else [as_frame(raw, time)]
            return depth if image is None else [*depth, ColourFrame("depth", time, image)]

        return frames

    def posed(self, state: BodyState) -> NDArray:
        """(V, 3) [m] the meshes' vertices in the world."""
        return self.mesh.posed(self.body.tree.forward(state.T_world_root, state.angles)[0])

    def true_vertices(self, i: int) -> NDArray:
        """(V, 3) [m] the meshes' vertices where they truly are."""
        m = self.mesh
        local = m.vertices - self.body.tree.rest[m.segment]
        T = self.truth[i][m.segment]
        return np.einsum("vij,vj->vi", T[:, :3, :3], local) + T[:, :3, 3]

    def add(self, state: BodyState, i: int) -> NDArray:
        """(10,) [mm] mean distance of each part's vertices from their true place."""
        away = np.linalg.norm(self.posed(state) - self.true_vertices(i), axis=1)
        return 1e3 * np.bincount(self.mesh.segment, away) / np.bincount(self.mesh.segment)


def as_frame(raw: NDArray, time: float) -> DepthFrame:
    """A depth frame of an image of uint16 [mm]."""
    return DepthFrame("depth", time, raw.astype(np.float32) * np.float32(1e-3))


def load_scene(path: Path) -> Scene:
    """Body, camera and truth of a rendered scene."""
    first, *lines = (path / "scene.txt").read_text().splitlines()
    _, width, height, *lens = first.split()
    fx, fy, cx, cy = (float(x) for x in lens)
    camera = Camera("depth", (int(width), int(height)), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
    parts = [line.split() for line in lines if line.strip()]
    centres = np.array([[float(x) for x in p[5:8]] for p in parts])
    body = _body(parts, centres, path / "meshes")
    poses = np.loadtxt(path / "gt.txt").reshape(-1, len(parts), 3, 4)
    truth = np.zeros((*poses.shape[:2], 4, 4))
    truth[..., :3, :], truth[..., 3, 3] = poses, 1.0
    truth[..., :3, 3] -= np.einsum("fpij,pj->fpi", poses[..., :3], centres)  # of the joints' frames, not of the boxes
    return Scene(path, body, Rig((camera,)), truth)


def _body(parts: list[list[str]], centres: NDArray, meshes: Path) -> Body:
    names = tuple(p[0] for p in parts)
    parents = np.array([int(p[2]) for p in parts])
    offsets = np.array([[float(x) for x in p[8:11]] for p in parts])
    offsets[1:] += centres[parents[1:]]
    coordinates, owners, axes, limits = [], [], [], []
    for s, part in enumerate(parts):
        for column, axis in _AXES.items() if s else ():
            if part[3][column - 3] == "1":
                coordinates.append(f"{names[s]}_r{'xyz'[column - 3]}")
                owners.append(s)
                axes.append(axis)
                limits.append(_RANGES.get((part[1], column), (-np.inf, np.inf)))
    zero = np.zeros(len(coordinates))
    lower, upper = np.transpose(limits)
    tree = KinematicTree(
        names, parents, offsets, tuple(coordinates), np.array(owners), np.array(axes), zero.astype(bool),
        lower, upper, zero, zero + SPREAD,
    )  # fmt: skip
    made: dict[str, MeshSurface] = {}
    surfaces = []
    for s, part in enumerate(parts):
        if part[1] not in made:
            made[part[1]] = MeshSurface(s, *read_obj(meshes / f"{part[1]}.obj"))
        surfaces.append(made[part[1]].on(s))
    landmarks = PointSet(names, np.arange(len(names)), np.zeros((len(names), 3)))
    return Body(
        "body10", tree, names, ("body",), np.zeros(len(names), np.int64), landmarks, surfaces=tuple(surfaces),
        stature=1.8,
    )  # fmt: skip


def _state(body: Body, Ts: NDArray) -> BodyState:
    """The state of exact poses (10, 4, 4): local rotations Rz Ry Rx taken apart."""
    tree, angles = body.tree, np.zeros(len(body.tree.coordinates))
    for s in range(1, len(Ts)):
        R = Ts[tree.parents[s], :3, :3].T @ Ts[s, :3, :3]
        found = {
            "rx": np.arctan2(R[2, 1], R[2, 2]),
            "ry": -np.arcsin(np.clip(R[2, 0], -1.0, 1.0)),
            "rz": np.arctan2(R[1, 0], R[0, 0]),
        }
        for d in range(tree.dof_start[s], tree.dof_start[s + 1]):
            angles[d] = found[tree.coordinates[d][-2:]]
    root = np.array(Ts[0])
    u, _, vt = np.linalg.svd(root[:3, :3])  # eight decimals in the file are no rotation to the last bit
    root[:3, :3] = u @ vt
    return BodyState(root, angles)


def disturbed(scene: Scene, i: int, degrees: float, rng: np.random.Generator) -> BodyState:
    """The true state with every joint turned by `degrees`: about a random axis, a hinge by a random sign."""
    tree, truth = scene.body.tree, np.array(scene.truth[i])
    turned = np.array(truth)
    for s in range(1, len(truth)):
        p = tree.parents[s]
        d = slice(tree.dof_start[s], tree.dof_start[s + 1])
        axes = tree.axes[d]
        weights = rng.normal(size=len(axes)) if len(axes) > 1 else rng.choice([-1.0, 1.0], 1)
        axis = weights / np.linalg.norm(weights) @ axes
        local = np.linalg.inv(truth[p]) @ truth[s]
        local[:3, :3] = local[:3, :3] @ _rotation(np.deg2rad(degrees) * axis)
        turned[s] = turned[p] @ local
    return _state(scene.body, turned)


def _rotation(vector: NDArray) -> NDArray:
    import cv2

    return cv2.Rodrigues(vector)[0]


@dataclass(frozen=True, eq=False)
class Run:
    """A tracked scene.

    Parameters
    ----------
    frames : (F,) int, which frames.
    add : (F, 10) [mm]
    ms : (F,) CPU time of each frame, from the raw image.
    flagged : (F, 10) bool, the tracker says "lost" or "not seen".
    lost : (F, 10) bool, it says "lost".
    results : all of them.
    """

    frames: NDArray
    add: NDArray
    ms: NDArray
    flagged: NDArray
    lost: NDArray
    results: Sequence[Any]

    @property
    def lost_share(self) -> float:
        """Share of part-frames with ADD above 100 mm."""
        return float((self.add > LOST).mean())


def run_scene(
    scene: Scene, tracker: Callable[[Body, Rig, float], Any], *, every: int = 1, frames: Iterable[int] | None = None,
    kinds: Sequence[str] = ("depth",),
) -> Run:  # fmt: skip
    """Follow a scene from its truth on, every few frames.

    Parameters
    ----------
    tracker : (body, rig, rate) -> an object with `start_at(state)` and `update(frames)`.
    kinds : of sensors, "depth", "region" or both
    """

    chosen = list(range(0, len(scene), every) if frames is None else frames)
    made = tracker(scene.body, scene.rig, RATE / every)
    made.start_at(scene.states[chosen[0]])
    add, ms, results = [], [], []
    for i in chosen:
        frames_at = scene.seen(i, kinds)
        with timed(ms, 1e3):
            result = made.update(frames_at(i / RATE))
        add.append(scene.add(result.state, i))
        results.append(result)
    lost = np.array([r.lost for r in results])
    hidden = np.array([r.hidden for r in results])
    return Run(np.array(chosen), np.array(add), np.array(ms), lost | hidden, lost, results)
