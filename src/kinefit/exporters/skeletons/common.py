"""What all skeleton formats need: names and units of choice, rest poses, Euler angles without jumps."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body
from kinefit.bodies.motion import UP_AXES, Motion, continuous_quaternions, rotation_between_up
from kinefit.bodies.rendering.looks import TubeMesh
from kinefit.bodies.toml.joint_names import CHARACTER_BONES, segment_names
from kinefit.errors import ExportError, check_choice, spelled
from kinefit.geometry import se3

NAMES = ("kinefit", "bvh", "mixamo", "cmu", "opensim", "hanim", *CHARACTER_BONES)
"""Conventions of names: the body's own, its aliases, those of characters in game engines."""

UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
"""Units of length in a metre."""

_LOCKED = 1e-7  # cosine of the middle angle below which the outer two turn about one axis


def moving_segments(body: Body) -> NDArray:
    """(S,) bool: the root, and segments whose joint can slide, so that their offset changes."""
    out = np.zeros(len(body.tree.segments), bool)
    out[body.tree.owners[body.tree.prismatic]] = out[0] = True
    return out


def check_frames(motion: Motion, path: str | PathLike[str]) -> None:
    """Raise ExportError for a motion without frames."""
    if not len(motion):
        raise ExportError("a motion without frames cannot be animated", file=path)


def linear_colours(colours: NDArray) -> NDArray:
    """Colours (..., 3) of sRGB, 0 to 255, as linear intensities 0 to 1."""
    return np.asarray((colours / 255.0) ** 2.2)


def turning_segments(body: Body) -> NDArray:
    """(S,) bool: the root, and segments whose joint can turn."""
    out = np.zeros(len(body.tree.segments), bool)
    out[body.tree.owners[~body.tree.prismatic]] = out[0] = True
    return out


def numbers(values: ArrayLike, form: str) -> str:
    """Numbers in a row as text, each in a form such as ".9g"; no minus before zero."""
    return " ".join(f"{value + 0.0:{form}}" for value in np.ravel(values).tolist())


def euler_zxy(rotations: NDArray, before: NDArray | None = None) -> NDArray:
    """Angles (F, ..., 3) [rad] about body-fixed z, x, y of rotations (F, ..., 3, 3), R = Rz Rx Ry, continuous over F.

    Of the two triples that give the same rotation, and of all whole turns, the nearest to the frame before is taken.
    At gimbal lock the first angle stays as it was, so that the triple always gives the rotation. `before` (..., 3) is
    the triple of the frame before the first.
    """
    R = np.asarray(rotations, float)
    out = np.empty((*R.shape[:-2], 3))
    before = np.zeros(R.shape[1:-2] + (3,)) if before is None else before
    for frame in range(len(R)):
        out[frame] = before = _nearest_zxy(R[frame], before)
    return out


def euler(rotations: NDArray, axes: str, before: NDArray | None = None) -> NDArray:
    """Angles (F, ..., 3) [rad] about three different body-fixed axes in this order, of rotations (F, ..., 3, 3).

    They do not jump over F, as of `euler_zxy`. `before` (..., 3) are the angles of the frame before the first.
    """
    i, j, k = ("xyz".index(axis) for axis in axes)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    as_zxy = rotations[..., [[j], [k], [i]], [j, k, i]]  # axes renamed; where that mirrors, turns go the other way
    return sign * euler_zxy(as_zxy, None if before is None else sign * before)


def _nearest_zxy(R: NDArray, before: NDArray) -> NDArray:
    locked = np.hypot(R[..., 0, 1], R[..., 1, 1]) < _LOCKED
    z = np.where(locked, before[..., 0], np.arctan2(-R[..., 0, 1], R[..., 1, 1]))
    one, other = _given_z(R, z, before), _given_z(R, z + np.pi, before)
    nearer = np.sum((one - before) ** 2, -1) <= np.sum((other - before) ** 2, -1)
    return np.where((nearer | locked)[..., None], one, other)


def _given_z(R: NDArray, z: NDArray, before: NDArray) -> NDArray:
    """The triple whose first angle is z, by whole turns nearest to the triple before."""
    c, s = np.cos(z), np.sin(z)
    x = np.arctan2(R[..., 2, 1], c * R[..., 1, 1] - s * R[..., 0, 1])
    y = np.arctan2(c * R[..., 0, 2] + s * R[..., 1, 2], c * R[..., 0, 0] + s * R[..., 1, 0])
    angles = np.stack([z, x, y], -1)
    return angles + 2.0 * np.pi * np.round((before - angles) / (2.0 * np.pi))


def bone_names(body: Body, names: str, path: str | PathLike[str]) -> list[str]:
    """Name of every segment in one of `NAMES`, however spelled, each once; `path` for messages.

    A segment without a counterpart there keeps its own name; without any it raises ExportError, unless for "bvh".
    """
    names = convention(names)
    check_choice("convention of names", names, NAMES, ExportError, file=path)
    found = segment_names(body, names)
    if names not in ("kinefit", "bvh") and not found:
        known = ", ".join(["kinefit", *(name for name in NAMES if segment_names(body, name))])
        remedy = f"It has those of: {known}. Or write them into its body file: names = {{ {names} = ... }}."
        raise ExportError(f"body '{body.name}' has no names of {names}", file=path, remedy=remedy)
    return plain_names(found.get(segment, segment) for segment in body.tree.segments)


def convention(names: str) -> str:
    """One of `NAMES`, of a text that spells it in another way: "H-Anim", "OpenSim"; another text as it is."""
    return spelled(names, NAMES)


def length_factor(unit: str, units: Mapping[str, float], path: str | PathLike[str]) -> float:
    """Units of length in a metre; ExportError where the format has no such unit."""
    check_choice("unit of length", unit, units, ExportError, file=path)
    return units[unit]


def turned(motion: Motion, up: str, path: str | PathLike[str], allowed: Iterable[str] = UP_AXES) -> Motion:
    """The motion in a world whose vertical axis is `up`; ExportError where the format has no such axis."""
    check_up(up, path, allowed)
    return motion.turned(up)


def check_up(up: str, path: str | PathLike[str], allowed: Iterable[str] = UP_AXES) -> None:
    """ExportError where a format has no such vertical axis."""
    check_choice("vertical axis of this format", up, allowed, ExportError, file=path)


def plain_names(names: Iterable[str]) -> list[str]:
    """Names without blanks and slashes, each once: a repeated one gets a number."""
    out: list[str] = []
    for name in names:
        base = plain = re.sub(r"[\s/\\]+", "_", name) or "_"
        count = 1
        while plain in out:
            count += 1
            plain = f"{base}_{count}"
        out.append(plain)
    return out


_T_NAMES = ("mixamo", *CHARACTER_BONES)  # whose characters rest with arms out to the sides, or nearly so

RESTS = ("body", "t")
"""Rest poses: the body's own (arms hanging, facing x), or arms out to the sides, palms down, facing z."""

_FACING = se3.exp_so3(np.array([0.0, -np.pi / 2, 0.0]))  # x, a body's front, to z
_ARMS = {"Right": -np.pi / 2, "Left": np.pi / 2}  # turn about x that takes a hanging arm out to its side
_PALMS_DOWN = np.array([0.0, 0.0, -np.pi / 2])  # then about z: palms, which face forward, turn down


@dataclass(frozen=True, eq=False)
class Rest:
    """A rest pose.

    Parameters
    ----------
    turns : (S, 3, 3) A, from segments' frames to bones'.
    offsets : (S, 3) [m] of every joint in its parent's bone.
    positions : (S, 3) [m] joint centres in the root's frame.
    """

    turns: NDArray
    offsets: NDArray
    positions: NDArray

    def local_poses(self, motion: Motion) -> NDArray:
        """T_parent_bone (F, S, 4, 4) of every bone; of the root T_world_bone."""
        Ts_world, parents = np.array(motion.segment_poses()), motion.body.tree.parents
        Ts_world[..., :3, :3] = Ts_world[..., :3, :3] @ self.turns.transpose(0, 2, 1)
        out = se3.inverse(Ts_world[:, np.maximum(parents, 0)]) @ Ts_world
        out[:, parents < 0] = Ts_world[:, parents < 0]
        return out

    def local_moves(self, motion: Motion, up: str) -> tuple[NDArray, NDArray]:
        """Of every bone in its parent, of the root in a world with the vertical axis `up`: how it turns and moves.

        Returns
        -------
        (F, S, 4) quaternions w, x, y, z without jumps of sign, (F, S, 3) [m] places
        """
        turns: list[NDArray] = []
        places = []
        for part in motion.parts():
            Ts = self.local_poses(part.turned(up))
            turns.append(continuous_quaternions(Ts[..., :3, :3], turns[-1][-1] if turns else None))
            places.append(Ts[..., :3, 3].copy())
        return np.concatenate(turns), np.concatenate(places)

    def matrices(self, up: str, factor: float) -> tuple[NDArray, NDArray]:
        """Poses (S, 4, 4) of bones in their parent's frame and in the world of `up`; lengths times `factor`."""
        upright = se3.transform(rotation_between_up("y", up), np.zeros(3))
        local = np.tile(np.eye(4), (len(self.offsets), 1, 1))
        local[:, :3, 3] = factor * self.offsets
        local[0] = upright @ local[0]
        return local, upright @ se3.transform(np.eye(3), factor * self.positions)

    def posed(self, mesh: TubeMesh, body: Body) -> TubeMesh:
        """A mesh about the body, which rests as the body does, in this rest pose."""
        if not len(mesh.vertices):
            return mesh
        turns = self.turns[mesh.segments]  # (V, 2, 3, 3)
        local = mesh.vertices[:, None] - body.tree.rest[mesh.segments]
        vertices = (turns @ local[..., None])[..., 0] + self.positions[mesh.segments]
        normals = (turns @ mesh.normals[:, None, :, None])[..., 0]
        weights = mesh.weights[..., None]
        normals = np.sum(weights * normals, axis=1)
        return replace(
            mesh, vertices=np.sum(weights * vertices, axis=1),
            normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        )


def rest_pose(body: Body, rest: str | None, names: str, path: str | PathLike[str]) -> Rest:
    """A rest pose of `RESTS`; None: "t" with the names of Mixamo, VRM, Unity or Unreal, else "body".

    Raises
    ------
    ExportError
        An unknown rest pose; `path` for the message.
    """
    rest = rest or ("t" if convention(names) in _T_NAMES else "body")
    check_choice("rest pose", rest, RESTS, ExportError, file=path)
    count = len(body.tree.segments)
    turns = np.tile(np.eye(3), (count, 1, 1)) if rest == "body" else np.stack([_turn(body, s) for s in range(count)])
    return _rest(body, turns)


def standing(body: Body) -> Rest:
    """The body's own rest pose, facing z: arms hanging, as H-Anim has its figures stand."""
    return _rest(body, np.tile(_FACING, (len(body.tree.segments), 1, 1)))


def _rest(body: Body, turns: NDArray) -> Rest:
    tree = body.tree
    offsets = np.array([turns[max(parent, 0)] @ o for parent, o in zip(tree.parents, tree.offsets)])
    positions = np.zeros((len(turns), 3))
    for s, parent in enumerate(tree.parents):
        positions[s] = offsets[s] + (positions[parent] if parent >= 0 else 0.0)
    return Rest(turns, offsets, positions)


def _turn(body: Body, segment: int) -> NDArray:
    """(3, 3) turn of a segment from the body's rest to the T: an arm's out to the side, of its lower part palm down."""
    above = []
    while segment >= 0:
        above.append(body.alias("bvh", body.tree.segments[segment]))
        segment = int(body.tree.parents[segment])
    for side, angle in _ARMS.items():
        if f"{side}Arm" in above:
            palm = se3.exp_so3(_PALMS_DOWN) if f"{side}ForeArm" in above else np.eye(3)
            return _FACING @ palm @ se3.exp_so3(np.array([angle, 0.0, 0.0]))
    return _FACING
