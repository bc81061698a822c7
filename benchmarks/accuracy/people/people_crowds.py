"""Simulated people among each other, and what cameras see of them: those behind others are hidden."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes.simulated import to_and_fro
from kinefit.bodies import load_body
from kinefit.bodies.motion import Motion
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import Keypoints
from kinefit.simulation import simulate_keypoints, studio_rig
from kinefit.simulation.movements import movement
from kinefit.simulation.movements import people as persons

RATE = 30.0
SET = "BODY_25B"
KINDS = ("cross", "shake hands", "hide", "leave", "crowd")
# Beside these: "throng", five people two thirds of a metre apart; "relieve", one leaves and another comes to the place.
_THICK = 0.09  # [m] half the thickness of what hides a point
_SEEN_THROUGH = 0.2  # share of hidden points that a detector gives all the same, from what it knows of people


@dataclass(frozen=True, eq=False)
class Crowd:
    """Several people and what cameras see of them.

    Parameters
    ----------
    motions : their true motions, of one length
    rig : Rig
    keypoints : records, in an order that changes from frame to frame
    order : of each record (F, P), the place of each person in the list
    there : (F, P) bool, who is in the room
    """

    motions: tuple[Motion, ...]
    rig: Rig
    keypoints: tuple[Keypoints, ...]
    order: tuple[NDArray, ...]
    there: NDArray


def crowd(kind: str, seed: int, frames: int = 150, keypoint_set: str = SET, noise_px: float = 3.0) -> Crowd:
    """People of one kind of scene; 3 px of noise, 10 % outliers, 10 % missing, four or five cameras."""
    random = np.random.default_rng(seed)
    count = {"crowd": 5, "throng": 5, "leave": 3, "relieve": 3}.get(kind, 2 + seed % 2)
    bodies = [one.body for one in persons(load_body("humanoid"), count=count, seed=seed)]
    rest = random.permutation(["wave", "clap", "squat", "bow", "point"])
    paths = _paths(kind, count, frames, random)
    motions = []
    for k, (body, path) in enumerate(zip(bodies, paths)):
        name = {"shake hands": "shake_hands" if k < 2 else rest[k], "cross": "walk"}.get(kind, rest[k])
        motions.append(along(movement(str(name), body, rate=RATE), path, frames))
    there = np.ones((frames, count), bool)
    if kind == "leave":
        there[frames // 3 : frames // 3 + 45, 1] = False
    if kind == "relieve":  # a quarter of a second to a second apart
        there[frames // 2 :, 1] = False
        there[: frames // 2 + random.integers(round(0.25 * RATE), round(RATE)), 2] = False
    rig = studio_rig(together(motions), cameras=4 + seed % 2)
    each = [
        simulate_keypoints(m, rig, keypoint_set, noise_px=noise_px, seed=100 * seed + k) for k, m in enumerate(motions)
    ]
    return Crowd(tuple(motions), rig, *listed(motions, rig, each, there, random, through=_SEEN_THROUGH), there)


def listed(
    motions: Sequence[Motion], rig: Rig, each: Sequence[Sequence[Keypoints]], there: NDArray,
    random: np.random.Generator, *, through: float = 0.0,
) -> tuple[tuple[Keypoints, ...], tuple[NDArray, ...]]:  # fmt: skip
    """Records of all people in one list, in an order that changes, and where each of them is in it (F, P).

    What another hides is not seen, but for a share `through` of it.
    """
    records, orders = [], []
    for c, camera in enumerate(rig):
        order = np.stack([random.permutation(len(motions)) for _ in range(len(there))])
        points = np.stack([e[c].points[:, 0] for e in each], axis=1)
        confidence = np.stack([e[c].confidence[:, 0] for e in each], axis=1)
        gone = hidden(motions, camera, there, each[0][c].keypoint_set)
        if through:
            gone &= random.uniform(size=confidence.shape) > through
        gone |= ~there[..., None]
        points[gone], confidence[gone] = np.nan, 0.0
        points = np.take_along_axis(points, order[:, :, None, None], axis=1)
        confidence = np.take_along_axis(confidence, order[:, :, None], axis=1)
        records.append(replace(each[0][c], points=points, confidence=confidence))
        orders.append(np.argsort(order, axis=1))
    return tuple(records), tuple(orders)


def _paths(kind: str, count: int, frames: int, random: np.random.Generator) -> list[NDArray]:
    """(F, 3) each: x, z on the floor [m] and heading [rad] (0 looks along x)."""
    t = np.linspace(0.0, 1.0, frames)
    out = []
    for k in range(count):
        angle = 2 * np.pi * k / count + random.uniform(-0.2, 0.2)
        x, z = 1.1 * np.cos(angle), 1.1 * np.sin(angle)
        heading = np.full(frames, random.uniform(-np.pi, np.pi))
        px, pz = np.full(frames, x), np.full(frames, z)
        if kind == "cross":
            side = 0.3 if k % 2 else -0.3
            way = angle if k % 2 == 0 else angle + 0.2
            along = 1.3 - 2.6 * t
            px, pz = along * np.cos(way) - side * np.sin(way), along * np.sin(way) + side * np.cos(way)
            heading = np.full(frames, np.pi - way)
        elif kind == "shake hands" and k < 2:
            px = np.full(frames, -0.35 if k == 0 else 0.35)
            pz = np.full(frames, 0.0)
            heading = np.full(frames, 0.0 if k == 0 else np.pi)
        elif kind == "hide" and k < 2:
            px = np.full(frames, 0.0) if k == 0 else 0.55 * np.cos(2 * np.pi * t)
            pz = np.full(frames, 0.0) if k == 0 else 0.55 * np.sin(2 * np.pi * t)
        elif kind == "throng":
            radius, turned = 0.55 + 0.1 * np.sin(2 * np.pi * t + k), angle + np.pi * t
            px, pz = radius * np.cos(turned), radius * np.sin(turned)
        elif kind == "relieve" and k == 2:
            px, pz = out[1][:, 0] + random.uniform(-0.1, 0.1), out[1][:, 1] + random.uniform(-0.1, 0.1)
        elif kind == "crowd":
            px = x + 0.3 * np.sin(2 * np.pi * t + k)
            pz = z + 0.3 * np.cos(2 * np.pi * t + k)
        out.append(np.column_stack([px, pz, heading]))
    return out


def along(motion: Motion, path: NDArray, frames: int) -> Motion:
    """A movement repeated to and fro, by a person who goes along a path."""
    at = to_and_fro(len(motion), frames)
    T = motion.Ts_world_root[at].copy()
    if motion.name == "walk":
        T[:, [0, 2], 3] = 0.0
    zero = np.zeros(frames)
    turn = se3.transform(
        se3.exp_so3(np.column_stack([zero, path[:, 2], zero])), np.column_stack([path[:, 0], zero, path[:, 1]])
    )
    return replace(_cut(motion, at), Ts_world_root=turn @ T)


def _cut(motion: Motion, at: NDArray) -> Motion:
    """The frames of a motion in another order, at times of their own."""
    from kinefit.simulation.retarget import known_motion

    return known_motion(
        motion.body, motion.rate, motion.Ts_world_root[at], motion.angles[at], up=motion.up, name=motion.name
    )


def together(motions: Sequence[Motion]) -> Motion:
    """One motion that goes wherever any of the people does, for the cameras to be set up around."""
    at = np.arange(len(motions[0])) % len(motions)
    T = np.stack([motions[k].Ts_world_root[f] for f, k in enumerate(at)])
    return replace(motions[0], Ts_world_root=T)


def hidden(motions: Sequence[Motion], camera: Camera, there: NDArray, keypoint_set: str = SET) -> NDArray:
    """(F, P, K) whether a body in front of it hides a point from a camera."""
    x = np.stack([m.positions(m.body.keypoints(keypoint_set)) for m in motions], axis=1)
    joints = np.stack([m.segment_poses()[..., :3, 3] for m in motions], axis=1)
    parents = motions[0].body.tree.parents
    ends = [(int(p), s) for s, p in enumerate(parents) if p >= 0]
    out = np.zeros(x.shape[:3], bool)
    away = np.linalg.norm(joints.mean(axis=2) - camera.centre_world, axis=-1)
    for a in range(len(motions)):
        for b in range(len(motions)):
            if a == b:
                continue
            uv = camera.project(x[:, a])
            p, q = (camera.project(joints[:, b, [e[i] for e in ends]]) for i in (0, 1))
            way = q - p
            along = np.einsum("fkej,fej->fke", uv[:, :, None] - p[:, None], way) / np.maximum(
                np.square(way).sum(axis=-1), 1e-9
            )[:, None]
            foot = p[:, None] + np.clip(along, 0.0, 1.0)[..., None] * way[:, None]
            near = np.linalg.norm(uv[:, :, None] - foot, axis=-1).min(axis=2)
            radius = _THICK * camera.matrix[0, 0] / away[:, b]
            before = away[:, b] < away[:, a]
            out[:, a] |= (near < radius[:, None]) & (before & there[:, b])[:, None]
    return out
