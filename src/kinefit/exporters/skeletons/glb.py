"""GLB (binary glTF 2.0): an animated skinned figure for browsers, game engines and animation programs."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_bytes
from kinefit.errors import ExportError
from kinefit.exporters.skeletons.common import bone_names, moving_segments, plain_names
from kinefit.exporters.skeletons.rest import Rest, rest_pose
from kinefit.motion import Motion
from kinefit.rendering.tubes import TubeMesh, body_mesh

_TYPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_COMPONENTS = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
_VERTICES, _INDICES = {"target": 34962}, {"target": 34963}  # what a buffer is for


@checked
def write_glb(
    motion: Motion, path: str | PathLike[str], *, names: str = "kinefit", rest: str | None = None,
    cylinders: bool = False,
) -> None:  # fmt: skip
    """Write a motion as GLB, in metres and y up, as the format prescribes; time starts at 0.

    One mesh follows the bones: the body's own skin or a person's, rounded tubes about the surfaces of other bodies. The
    bind pose is the rest pose; the animation turns every joint that can turn and moves the root.

    Parameters
    ----------
    motion : Motion
    path : path
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim" or "bvh"
        Names of the joints.
    rest : "body" or "t", optional
        Rest pose: the body's own, arms hanging, facing x; or a T facing z. Default: "t" with Mixamo's names.
    cylinders : bool
        The body's cylinders in place of a skin.

    Raises
    ------
    ExportError
        A motion without frames, unknown names or rest pose, or the file cannot be written.
    """
    if not len(motion):
        raise ExportError("a motion without frames cannot be animated", file=path)
    body, tree = motion.body, motion.body.tree
    joints, pose = bone_names(body, names, path), rest_pose(body, rest, names, path)
    nodes: list[dict[str, Any]] = []
    for s, name in enumerate(joints):
        nodes.append({"name": name, "translation": pose.offsets[s].tolist()})
        if children := np.flatnonzero(tree.parents == s).tolist():
            nodes[s]["children"] = children
    scene = {"name": motion.name, "nodes": [0]}
    file = GltfFile({
        "asset": {"version": "2.0", "generator": "kinefit"}, "nodes": nodes, "scenes": [scene], "scene": 0,
    })  # fmt: skip
    if body.surfaces or body.skin is not None:
        _add_skin(file, pose.posed(body_mesh(body, cylinders=cylinders), body), pose)
        nodes.append({"name": plain_names([body.name])[0], "mesh": 0, "skin": 0})
        scene["nodes"] = [0, len(joints)]
    file.animate(plain_names([motion.name])[0], motion.times, _courses(motion, pose))
    write_bytes(path, file.packed())


class GltfFile:
    """A glTF file to be written as GLB: its JSON and its binary buffer, to which arrays are added."""

    def __init__(self, content: dict[str, Any], binary: bytes = b"") -> None:
        self.json, self.data = content, bytearray(binary)

    def add(self, array: NDArray, *, bounds: bool = False, view: Any = (), **more: Any) -> int:
        """Add an array (N, ...), floats as float32, and return the number of its accessor.

        `bounds`: with its lowest and highest values; `view` and `more`: entries of the view and of the accessor.
        """
        array = np.ascontiguousarray(array, np.float32 if array.dtype.kind == "f" else array.dtype)
        self.data += bytes(-len(self.data) % 4)
        views, accessors = (self.json.setdefault(key, []) for key in ("bufferViews", "accessors"))
        views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes, **dict(view)})
        self.data += array.tobytes()
        flat = array.reshape(len(array), -1)
        limits = {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()} if bounds else {}
        kind = {"componentType": _COMPONENTS[array.dtype.name], "type": _TYPES[array.shape[1:]]}
        accessors.append({"bufferView": len(views) - 1, "count": len(array), **kind, **limits, **more})
        return len(accessors) - 1

    def animate(self, name: str, times: NDArray, courses: Iterable[tuple[int, str, NDArray]]) -> None:
        """Add an animation before the others: of nodes, "rotation" (F, 4) w, x, y, z or "translation" (F, 3)."""
        clock = self.add(times - times[0], bounds=True)
        samplers, channels = list[dict[str, Any]](), list[dict[str, Any]]()
        for node, path, values in courses:
            values = np.roll(values, -1, axis=-1) if path == "rotation" else values  # glTF: x, y, z, w
            channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
            samplers.append({"input": clock, "output": self.add(values), "interpolation": "LINEAR"})
        animation = {"name": name, "samplers": samplers, "channels": channels}
        self.json["animations"] = [animation, *self.json.get("animations", [])]

    def packed(self) -> bytes:
        """The whole file."""
        self.data += bytes(-len(self.data) % 4)
        self.json["buffers"] = [{**self.json.get("buffers", [{}])[0], "byteLength": len(self.data)}]
        text = json.dumps(self.json, separators=(",", ":"), ensure_ascii=False).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(self.data), len(text), 0x4E4F534A)
        return head + text + struct.pack("<I4s", len(self.data), b"BIN\0") + bytes(self.data)


def _add_skin(file: GltfFile, mesh: TubeMesh, pose: Rest) -> None:
    weights = mesh.weights.astype(np.float32)
    segments = np.where(weights > 0, mesh.segments, 0).astype(np.uint16)
    colours = np.pad(mesh.colours, ((0, 0), (0, 1)), constant_values=255)
    attributes = {
        "POSITION": file.add(mesh.vertices, view=_VERTICES, bounds=True),
        "NORMAL": file.add(mesh.normals, view=_VERTICES),
        "COLOR_0": file.add(colours, view=_VERTICES, normalized=True),
        "JOINTS_0": file.add(segments, view=_VERTICES), "WEIGHTS_0": file.add(weights, view=_VERTICES),
    }  # fmt: skip
    indices = file.add(mesh.triangles.astype(np.uint32).ravel(), view=_INDICES)
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    look = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.75}
    inverse_bind = np.tile(np.eye(4), (len(pose.positions), 1, 1))
    inverse_bind[:, :3, 3] = -pose.positions
    matrices = file.add(inverse_bind.transpose(0, 2, 1))  # column after column
    file.json |= {
        "meshes": [{"name": "surface", "primitives": [primitive]}],
        "materials": [{"name": "skin", "pbrMetallicRoughness": look, "alphaMode": "OPAQUE"}],
        "skins": [{"inverseBindMatrices": matrices, "joints": list(range(len(inverse_bind))), "skeleton": 0}],
    }


def _courses(motion: Motion, pose: Rest) -> Iterator[tuple[int, str, NDArray]]:
    tree, moving = motion.body.tree, moving_segments(motion.body)
    turns, places = pose.local_moves(motion, "y")
    turning = np.zeros(len(tree.segments), bool)
    turning[tree.owners[~tree.prismatic]] = turning[0] = True
    for s in range(len(tree.segments)):
        if turning[s]:
            yield s, "rotation", turns[:, s]
        if moving[s]:
            yield s, "translation", places[:, s]
