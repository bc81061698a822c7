"""GLB (binary glTF 2.0): an animated skinned figure for browsers, game engines and animation programs."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np
import pygltflib as gl
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.errors import ExportError
from kinefit.exporters.atomic import write_bytes
from kinefit.exporters.skeletons.common import bone_names, plain_names, slides
from kinefit.exporters.skeletons.rest import Rest, rest_pose
from kinefit.motion import Motion
from kinefit.rendering.tubes import TubeMesh, body_mesh

_TYPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_COMPONENTS = {"float32": gl.FLOAT, "uint32": gl.UNSIGNED_INT, "uint16": gl.UNSIGNED_SHORT, "uint8": gl.UNSIGNED_BYTE}


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
    gltf, buffer = gl.GLTF2(asset=gl.Asset(version="2.0", generator="kinefit")), _Buffer()
    joints, pose = bone_names(body, names, path), rest_pose(body, rest, names, path)
    gltf.nodes = [
        gl.Node(
            name=name,
            translation=[float(v) for v in pose.offsets[s]],
            children=[int(c) for c in np.flatnonzero(tree.parents == s)],
        )
        for s, name in enumerate(joints)
    ]
    roots = [0]
    if body.surfaces or body.skin is not None:
        mesh = pose.posed(body_mesh(body, cylinders=cylinders), body)
        gltf.meshes, gltf.materials = [_mesh(mesh, buffer)], [_material()]
        inverse_bind = np.tile(np.eye(4), (len(joints), 1, 1))
        inverse_bind[:, :3, 3] = -pose.positions
        matrices = buffer.add(inverse_bind.transpose(0, 2, 1))  # column after column
        gltf.skins = [gl.Skin(inverseBindMatrices=matrices, joints=list(range(len(joints))), skeleton=0)]
        gltf.nodes.append(gl.Node(name=plain_names([body.name])[0], mesh=0, skin=0))
        roots.append(len(joints))
    gltf.scenes, gltf.scene = [gl.Scene(name=motion.name, nodes=roots)], 0
    gltf.animations = [_animation(motion, pose, buffer)]
    gltf.accessors, gltf.bufferViews = buffer.accessors, buffer.views
    gltf.buffers = [gl.Buffer(byteLength=len(buffer.data))]
    gltf.set_binary_blob(bytes(buffer.data))
    write_bytes(path, b"".join(gltf.save_to_bytes()))


class _Buffer:
    """The binary part of the file, and how it is cut up."""

    def __init__(self) -> None:
        self.data, self.views, self.accessors = bytearray(), [], []  # type: ignore[var-annotated]

    def add(self, array: NDArray, *, target: int | None = None, bounds: bool = False, **more: Any) -> int:
        """Append an array of (N, ...) and return the number of its accessor; floats are stored as float32."""
        array = np.ascontiguousarray(array, np.float32 if array.dtype.kind == "f" else array.dtype)
        self.views.append(gl.BufferView(buffer=0, byteOffset=len(self.data), byteLength=array.nbytes, target=target))
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        flat = array.reshape(len(array), -1)
        limits = {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()} if bounds else {}
        kind = {"componentType": _COMPONENTS[array.dtype.name], "type": _TYPES[array.shape[1:]]}
        self.accessors.append(gl.Accessor(bufferView=len(self.views) - 1, count=len(array), **kind, **limits, **more))
        return len(self.accessors) - 1


def _mesh(mesh: TubeMesh, buffer: _Buffer) -> gl.Mesh:
    weights = mesh.weights.astype(np.float32)
    segments = np.where(weights > 0, mesh.segments, 0).astype(np.uint16)
    colours = np.pad(mesh.colours, ((0, 0), (0, 1)), constant_values=255)
    attributes = gl.Attributes(
        POSITION=buffer.add(mesh.vertices, target=gl.ARRAY_BUFFER, bounds=True),
        NORMAL=buffer.add(mesh.normals, target=gl.ARRAY_BUFFER),
        COLOR_0=buffer.add(colours, target=gl.ARRAY_BUFFER, normalized=True),
        JOINTS_0=buffer.add(segments, target=gl.ARRAY_BUFFER),
        WEIGHTS_0=buffer.add(weights, target=gl.ARRAY_BUFFER),
    )
    indices = buffer.add(mesh.triangles.astype(np.uint32).ravel(), target=gl.ELEMENT_ARRAY_BUFFER)
    return gl.Mesh(name="surface", primitives=[gl.Primitive(attributes=attributes, indices=indices, material=0)])


def _material() -> gl.Material:
    look = gl.PbrMetallicRoughness(baseColorFactor=[1.0, 1.0, 1.0, 1.0], metallicFactor=0.0, roughnessFactor=0.75)
    return gl.Material(name="skin", pbrMetallicRoughness=look, alphaMode="OPAQUE", alphaCutoff=None)


def _animation(motion: Motion, pose: Rest, buffer: _Buffer) -> gl.Animation:
    tree = motion.body.tree
    turns, places = pose.local_moves(motion, "y")
    turning = np.zeros(len(tree.segments), bool)
    turning[tree.owners[~tree.prismatic]] = turning[0] = True
    moving = slides(motion.body)
    moving[0] = True
    times = buffer.add(motion.times - motion.times[0], bounds=True)
    out = gl.Animation(name=plain_names([motion.name])[0], samplers=[], channels=[])

    def channel(segment: int, what: str, values: NDArray) -> None:
        out.samplers.append(gl.AnimationSampler(input=times, output=buffer.add(values), interpolation="LINEAR"))
        target = gl.AnimationChannelTarget(node=segment, path=what)
        out.channels.append(gl.AnimationChannel(sampler=len(out.samplers) - 1, target=target))

    for s in range(len(tree.segments)):
        if turning[s]:
            channel(s, "rotation", np.roll(turns[:, s], -1, axis=-1))  # glTF: x, y, z, w
        if moving[s]:
            channel(s, "translation", places[:, s])
    return out
