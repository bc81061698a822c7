"""Read characters of animation programs: a skeleton in its rest pose, ready for retargeting."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._files import parse_toml, read_text
from kinefit.bodies.limbs import FACE
from kinefit.bodies.motion import rotation_between_up
from kinefit.bodies.toml.joint_names import CHARACTER_BONES, ENDS, FINGERS, SEGMENTS, VRM0_FINGERS
from kinefit.errors import FileError, check_choice, names_file
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.readers.skeletons.common import text_of
from kinefit.readers.skeletons.gltf import MALFORMED, Gltf, read_gltf

KINDS = {".glb": "glb", ".vrm": "glb", ".gltf": "glb", ".bvh": "bvh"}
"""{ending of a character file: format of the retargeted motion}."""

_MAX_NODES = 20_000  # detailed characters have 2,000
_MAX_VERTICES = 2_000_000  # detailed characters have 500,000
_MAX_SHEAR = 1e-3  # of a node's scaled rotation: less is rounding


@dataclass(frozen=True, eq=False)
class Character:
    """A skeleton in its rest pose, in a world with y up.

    Parameters
    ----------
    path : Path
    names : (J,) of the nodes.
    parents : (J,) int, -1 for none.
    order : (J,) int, parents before their children.
    positions : (J, 3) [m]
    rotations : (J, 3, 3) of their frames, without scale; reflections if the file has some.
    scales : (J,) factor of lengths in each node.
    world : (3, 3) rotation that takes the file's world to one with y up.
    joints : (J,) bool, nodes of the skin; all nodes without a skin.
    vrm_joints : {segment: index}, joints that a VRM file assigns.
    points, owners : (P, 3) [m], (P,) int
        Vertices of the mesh in the rest pose, each with the node of the largest weight; empty without a mesh.
    unit : float, metres of the file's unit.
    gltf, text : content of the file, one of the two.
    """

    path: Path
    names: tuple[str, ...]
    parents: NDArray
    order: NDArray
    positions: NDArray
    rotations: NDArray
    scales: NDArray
    world: NDArray
    joints: NDArray
    vrm_joints: Mapping[str, int]
    points: NDArray
    owners: NDArray
    unit: float = 1.0
    gltf: Gltf | None = None
    text: str = ""

    def in_parent(self, node: int, places: NDArray) -> NDArray:
        """Transform points (F, 3) [m] from the world to the frame and unit of a node's parent in the rest pose."""
        parent = int(self.parents[node])
        if parent < 0:
            return np.asarray(places @ self.world / self.unit)
        away = (places - self.positions[parent]) @ self.rotations[parent]
        return np.asarray(away / (self.scales[parent] * self.unit))


@names_file
def read_character(path: str | PathLike[str]) -> Character:
    """Read a character from a GLB, VRM, glTF or BVH file, in the pose of its nodes.

    For BVH that is the pose of all angles zero, or the first frame if that pose is not upright.

    Raises
    ------
    FileError
        Another format, not readable, without nodes, or unevenly scaled.
    """
    path = Path(path)
    kind = KINDS.get(path.suffix.lower())
    if kind is None:
        remedy = f"Give a character as {', '.join(KINDS)}; FBX becomes GLB in Blender."
        raise FileError(f"'{path.suffix}' is no format of characters", remedy=remedy)
    return _from_gltf(path) if kind == "glb" else _from_bvh(path)


@names_file
def read_names(path: str | PathLike[str]) -> dict[str, str]:
    """Read a table of joint names: TOML of lines `segment = "joint"`.

    Returns
    -------
    {segment (of `SEGMENTS`, `FINGERS`, `FACE` or `ENDS`): name of a joint}

    Raises
    ------
    FileError
        Not TOML, an unknown segment, or a name that is no text.
    """
    table = parse_toml(read_text(path, "the table", remedy="Give a TOML file."), path)
    for segment, name in table.items():
        known = (*SEGMENTS, *FINGERS, *FACE, *ENDS)
        check_choice("segment", segment, known, FileError, remedy='A line is: thigh_l = "LeftUpLeg".')
        if not isinstance(name, str):
            raise FileError("is no name of a joint", place=segment, remedy="Write it in quotes.")
    return dict(table)


def _order(parents: NDArray) -> NDArray:
    """(J,) node numbers, parents before their children; raises FileError for a cycle."""
    out, children = list[int](), [list[int]() for _ in parents]
    for node, parent in enumerate(parents.tolist()):
        (out if parent < 0 else children[parent]).append(node)
    for node in out:
        out += children[node]
    if len(out) != len(parents):
        raise FileError("its nodes form a circle")
    return np.array(out, int)


def _from_gltf(path: Path) -> Character:
    gltf = read_gltf(path)
    try:
        parents = gltf.parents()
        if not 0 < len(parents) <= _MAX_NODES:
            count = f"more than {_MAX_NODES}" if len(parents) else "no"
            raise FileError(f"holds {count} nodes", remedy="Export the character alone, with its skeleton.")
        return _of_gltf(gltf, parents, _order(parents), path)
    except MALFORMED as error:
        problem = f"is no whole glTF file ({type(error).__name__}: {error})"
        raise FileError(problem, remedy="Export the character again, as GLB.") from error


def _of_gltf(gltf: Gltf, parents: NDArray, order: NDArray, path: Path) -> Character:
    Ms = np.array([gltf.local(node) for node in range(len(parents))])
    for node in order:
        if parents[node] >= 0:
            Ms[node] = Ms[parents[node]] @ Ms[node]
    names = tuple(node.get("name", f"node {n}") for n, node in enumerate(gltf.json["nodes"]))
    if wrong := [name for name in names if not isinstance(name, str)]:
        raise ValueError(f"a node's name is {wrong[0]!r}")
    in_skin = np.zeros(len(parents), bool)
    for skin in gltf.json.get("skins", []):
        in_skin[skin["joints"]] = True
    joints = in_skin if in_skin.any() else np.ones(len(parents), bool)
    sizes = np.linalg.norm(Ms[:, :3, :3], axis=1)
    scales = sizes.mean(axis=1)
    for node in np.flatnonzero(joints):
        R = Ms[node, :3, :3] / max(scales[node], 1e-12)
        if not np.allclose(R.T @ R, np.eye(3), atol=_MAX_SHEAR):
            remedy = "Apply the scale in the program that it comes from (Blender: Ctrl-A, Scale)."
            raise FileError("is scaled unevenly", place=f"node '{names[node]}'", remedy=remedy)
    points, owners = _vertices(gltf, Ms)
    if not (np.isfinite(Ms).all() and np.isfinite(points).all()):
        raise ValueError("a position that is not finite")
    rotations = Ms[:, :3, :3] / np.maximum(scales, 1e-12)[:, None, None]
    return Character(
        path, names, parents, order, Ms[:, :3, 3], rotations, scales, np.eye(3), joints, _vrm_joints(gltf.json), points,
        owners, gltf=gltf,
    )  # fmt: skip


def _vertices(gltf: Gltf, Ms: NDArray) -> tuple[NDArray, NDArray]:
    """Vertices (P, 3) of all skinned meshes at rest, and the node (P,) that moves each most."""
    points, owners = [np.zeros((0, 3))], [np.zeros(0, int)]
    for node in gltf.json["nodes"]:
        if "mesh" not in node or "skin" not in node:
            continue
        skin = gltf.json["skins"][node["skin"]]
        joints = np.array(skin["joints"])
        inverse = gltf.array(skin["inverseBindMatrices"]) if "inverseBindMatrices" in skin else None
        moves = Ms[joints] if inverse is None else Ms[joints] @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)
        for primitive in gltf.json["meshes"][node["mesh"]]["primitives"]:
            has = primitive["attributes"]
            if not {"POSITION", "JOINTS_0", "WEIGHTS_0"} <= set(has):
                continue
            x, which, weights = (gltf.array(has[name]) for name in ("POSITION", "JOINTS_0", "WEIGHTS_0"))
            if x is None or which is None or weights is None:
                continue
            if sum(map(len, points)) + len(x) > _MAX_VERTICES:
                remedy = "Export the character with a simpler mesh."
                raise FileError(f"has more than {_MAX_VERTICES} vertices", remedy=remedy)
            which, placed = which.astype(int), np.zeros_like(x)
            for joint, weight in zip(which.T, weights.T):
                M = moves[joint, :3]
                placed += weight[:, None] * (np.einsum("vij,vj->vi", M[..., :3], x) + M[..., 3])
            points.append(placed)
            owners.append(joints[which[np.arange(len(x)), np.argmax(weights, axis=1)]])
    return np.concatenate(points), np.concatenate(owners)


def _vrm_joints(file: Mapping[str, Any]) -> dict[str, int]:
    """{segment: node} that a VRM file assigns, version 0 or 1."""
    more = file.get("extensions", {})
    new = more.get("VRMC_vrm", {}).get("humanoid", {}).get("humanBones", {})
    old = more.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
    bones = {name: bone["node"] for name, bone in new.items()} | {bone["bone"]: bone["node"] for bone in old}
    joints = CHARACTER_BONES["vrm"] | ({} if new else VRM0_FINGERS)
    out = {segment: int(bones[name]) for segment, name in joints.items() if name in bones}
    if wrong := [name for name, node in out.items() if not 0 <= node < len(file["nodes"])]:
        raise ValueError(f"humanBones names a node for {wrong[0]} that the file does not have")
    return out


def _from_bvh(path: Path) -> Character:
    skeleton = read_bvh(path)
    parents, R = np.array(skeleton.parents), rotation_between_up(skeleton.up, "y")
    rest = skeleton.rest
    rotations = np.tile(np.eye(3), (len(parents), 1, 1))
    if np.ptp(rest @ R[1]) < 0.6 * np.ptp(skeleton.positions[0] @ R[1]):  # lying, or all bones along one axis
        rest, rotations = skeleton.positions[0], skeleton.Ts_world_joint[0, :, :3, :3]
    unit = re.search(r"\(unit (\S+) m\)$", skeleton.source)
    return Character(
        path, skeleton.names, parents, np.arange(len(parents)), rest @ R.T, R @ rotations, np.ones(len(parents)), R,
        np.ones(len(parents), bool), {}, np.zeros((0, 3)), np.zeros(0, int), unit=float(unit[1]) if unit else 1.0,
        text=text_of(path, "BVH"),
    )  # fmt: skip
