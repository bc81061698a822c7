"""Read characters of animation programs, glTF 2.0 or BVH: a skeleton in its rest pose, ready for retargeting.

Of glTF the JSON, one binary buffer, and its arrays.
"""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from kinefit._files import parse_toml, read_bytes, read_text
from kinefit.bodies.limbs import FACE
from kinefit.bodies.motion import rotation_between_up
from kinefit.bodies.toml.joint_names import CHARACTER_BONES, ENDS, FINGERS, SEGMENTS, VRM0_FINGERS
from kinefit.errors import FileError, check_choice, names_file
from kinefit.geometry import se3
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.readers.skeletons.common import text_of

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_IMAGES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
MALFORMED = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError, OSError, struct.error,
)  # fmt: skip
"""Exceptions that a malformed glTF file raises while it is read."""

_LIST_KEYS = "nodes", "skins", "meshes", "animations", "accessors", "bufferViews", "buffers", "images"
_EXPORT_REMEDY = "Export the character again, as GLB."


@dataclass(frozen=True, eq=False)
class Gltf:
    """A glTF file.

    Parameters
    ----------
    json : dict of the file, with one buffer without URI and embedded images.
    binary : bytes of that buffer.
    """

    json: dict[str, Any]
    binary: bytes

    def array(self, number: int) -> NDArray | None:
        """(N, width) values of an accessor, normalised ones as fractions; None for a compressed or sparse one.

        Raises ValueError for overlapping elements.
        """
        accessor = self.json["accessors"][number]
        if "bufferView" not in accessor or "sparse" in accessor:
            return None
        view = self.json["bufferViews"][accessor["bufferView"]]
        kind, width = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        step = view.get("byteStride", kind.itemsize * width)
        if step < kind.itemsize * width:  # overlapping elements could be any number
            raise ValueError(f"byteStride {step}")
        shape, strides = (accessor["count"], width), (step, kind.itemsize)
        out = np.ndarray(shape, kind, self.binary, start, strides).astype(float)
        return out / np.iinfo(kind).max if accessor.get("normalized") and kind.kind in "iu" else out

    def parents(self) -> NDArray:
        """(N,) int, parent of every node, -1 for none."""
        out = np.full(len(self.json.get("nodes", [])), -1)
        for number, node in enumerate(self.json.get("nodes", [])):
            out[node.get("children", [])] = number
        return out

    def local(self, node: int) -> NDArray:
        """(4, 4) pose of a node in its parent, with its scale."""
        entry = self.json["nodes"][node]
        if "matrix" in entry:
            return np.reshape(np.array(entry["matrix"], float), (4, 4)).T
        x, y, z, w = entry.get("rotation", (0, 0, 0, 1))
        R = se3.rotation_from_quaternion(np.array([w, x, y, z], float))
        return se3.transform(R * np.array(entry.get("scale", (1, 1, 1)), float), entry.get("translation", (0, 0, 0)))


@names_file
def read_gltf(path: str | PathLike[str]) -> Gltf:
    """Read a GLB (also VRM) or glTF file; external buffers and images are embedded.

    Raises
    ------
    FileError
        Missing, truncated, not glTF 2.0, or an external file that is missing or outside of its folder.
    """
    path = Path(path)
    content = read_bytes(path)
    try:
        tree, binary = _chunks(content) if content[:4] == b"glTF" else (json.loads(content), b"")
        if not str(tree["asset"]["version"]).startswith("2."):
            raise FileError(f"is glTF {tree['asset']['version']}, not 2.0", remedy=_EXPORT_REMEDY)
        if wrong := [name for name in _LIST_KEYS if not isinstance(tree.get(name, []), list)]:
            raise ValueError(f"{wrong[0]} is no list")
        return _in_one(tree, binary, path)
    except MALFORMED as error:
        problem = f"is no whole glTF file ({type(error).__name__}: {error})"
        raise FileError(problem, remedy=_EXPORT_REMEDY) from error


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """JSON and binary chunk of a GLB."""
    _, version, total, length, kind = struct.unpack("<4sIII4s", content[:20])
    if version != 2 or total > len(content) or kind != b"JSON":
        raise ValueError("version, length or first chunk")
    tree, rest = json.loads(content[20 : 20 + length]), content[20 + length : total]
    size, kind = struct.unpack("<I4s", rest[:8]) if len(rest) >= 8 else (0, b"BIN\0")
    if kind != b"BIN\0" or len(rest) < size:
        raise ValueError("binary chunk")
    return tree, rest[8 : 8 + size]


def _in_one(tree: dict[str, Any], binary: bytes, path: Path) -> Gltf:
    """Merge all buffers into one, in order, and embed the images."""
    data, places = bytearray(), dict[str | None, tuple[int, int]]()

    def place(uri: str | None) -> tuple[int, int]:
        """Start and length of the content of a URI, which is embedded once."""
        if uri not in places:
            content = binary if uri is None else _content(uri, path)
            data.extend(bytes(-len(data) % 4))  # every piece begins at a multiple of four
            places[uri] = len(data), len(content)
            data.extend(content)
        return places[uri]

    buffers = tree.get("buffers", [])
    if any("uri" not in buffer for buffer in buffers[1:]):
        raise ValueError("a buffer without a URI that is not the first")
    starts = [place(buffer.get("uri"))[0] for buffer in buffers]
    for view in tree.get("bufferViews", []):
        start = starts[view["buffer"]]
        if start:
            view["byteOffset"] = view.get("byteOffset", 0) + start
        view["buffer"] = 0
        if view.get("byteOffset", 0) + view["byteLength"] > len(data):
            raise ValueError("a buffer is shorter than it should be")
    for image in tree.get("images", []):
        if "uri" in image:
            uri = image.pop("uri")
            named = _IMAGES.get(Path(uri).suffix.lower(), "image/png")
            image.setdefault("mimeType", uri[5:].partition(";")[0] if uri.startswith("data:") else named)
            start, length = place(uri)
            image["bufferView"] = len(tree.setdefault("bufferViews", []))
            tree["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": length})
    tree["buffers"] = [{**(tree.get("buffers") or [{}])[0], "byteLength": len(data)}]
    tree["buffers"][0].pop("uri", None)
    return Gltf(tree, bytes(data))


def _content(uri: str, path: Path) -> bytes:
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    file, folder = (path.parent / unquote(uri)).resolve(), path.parent.resolve()
    if not file.is_relative_to(folder):  # else a malicious character could embed any file of the user
        problem = f"it names a file outside of its folder: {uri}"
        raise FileError(problem, remedy="Move that file into the folder, or export the character as GLB.")
    return read_bytes(file)


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
