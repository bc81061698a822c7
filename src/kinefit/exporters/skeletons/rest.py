"""Rest poses of exported skeletons: as the body rests, or as a T facing z, where animation programs expect it.

A bone's frame is turned by a fixed rotation A against its segment's, so that all frames are parallel in the new rest
pose: R_world_bone = R_world_segment Aᵀ. Joint centres stay where they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.errors import ExportError, check_choice
from kinefit.exporters.skeletons.common import convention
from kinefit.geometry import se3
from kinefit.motion import Motion
from kinefit.motion_columns import continuous_quaternions
from kinefit.rendering.tubes import TubeMesh

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
    """A rest pose of `RESTS`; None: "t" where joints are named as Mixamo's, whose figures rest so, else "body".

    Raises
    ------
    ExportError
        An unknown rest pose; `path` for the message.
    """
    rest = rest or ("t" if convention(names) == "mixamo" else "body")
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
