"""Animated figures with their skin: GLB for browsers and game engines, USD for film and simulation."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterable, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_bytes, writing
from kinefit.bodies import Body, MeshSurface
from kinefit.bodies.motion import Motion
from kinefit.bodies.rendering.looks import TubeMesh, body_mesh
from kinefit.bodies.surfaces import Surface
from kinefit.errors import ExportError, extra
from kinefit.exporters.skeletons import common

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
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh", "vrm", "unity" or "unreal"
        Names of the joints.
    rest : "body" or "t", optional
        Rest pose: the body's own, arms hanging, facing x; or a T facing z. Default: "t" with the
        names of Mixamo, VRM, Unity and Unreal.
    cylinders : bool
        The body's cylinders in place of a skin.

    Raises
    ------
    ExportError
        A motion without frames, unknown names or rest pose, or the file cannot be written.
    """
    common.check_frames(motion, path)
    body, tree = motion.body, motion.body.tree
    joints, pose = common.bone_names(body, names, path), common.rest_pose(body, rest, names, path)
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
        nodes.append({"name": common.plain_names([body.name])[0], "mesh": 0, "skin": 0})
        scene["nodes"] = [0, len(joints)]
    file.animate(common.plain_names([motion.name])[0], motion.times, _courses(motion, pose))
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


def _add_skin(file: GltfFile, mesh: TubeMesh, pose: common.Rest) -> None:
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


def _courses(motion: Motion, pose: common.Rest) -> Iterator[tuple[int, str, NDArray]]:
    moving, turning = common.moving_segments(motion.body), common.turning_segments(motion.body)
    turns, places = pose.local_moves(motion, "y")
    for s in range(len(moving)):
        if turning[s]:
            yield s, "rotation", turns[:, s]
        if moving[s]:
            yield s, "translation", places[:, s]


ENDINGS = (".usd", ".usda", ".usdc")
_UPS = ("y", "z")


@checked
def write_usd(
    motion: Motion, path: str | PathLike[str], *, unit: str = "m", up: str = "y", names: str = "kinefit",
    rest: str | None = None, cylinders: bool = False,
) -> None:
    """Write a motion as USD: a skeleton with its animation, and a mesh that follows it, as of `write_glb`.

    The stage states its unit (metersPerUnit) and vertical axis (upAxis); a time code is a frame, 0 the first. The bind
    pose is the rest pose, upright. Characters that USD does not allow in names become "_": mixamorig_Hips.

    Parameters
    ----------
    motion : Motion
    path : path
        Ending in .usdc (binary), .usda (text) or .usd.
    unit : "m", "cm" or "mm"
    up : "y" or "z"
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh", "vrm", "unity" or "unreal"
        Names of the joints.
    rest : "body" or "t", optional
        Rest pose: the body's own, arms hanging, facing x; or a T facing z. Default: "t" with the
        names of Mixamo, VRM, Unity and Unreal.
    cylinders : bool
        The body's cylinders in place of a skin.

    Raises
    ------
    ExportError
        The extra "usd" is not installed; no frame; another ending; unknown unit, axis, names or rest pose; or the file
        cannot be written.
    """
    with extra("usd", "USD needs the package usd-core", ExportError, file=path):
        from pxr import Tf, Usd
    if Path(path).suffix not in ENDINGS:
        raise ExportError("not a name of a USD file", file=path, remedy=f"Let it end in one of {', '.join(ENDINGS)}.")
    common.check_frames(motion, path)
    factor, world = common.length_factor(unit, common.UNITS, path), common.turned(motion, up, path, _UPS)
    joints = joint_paths(motion.body, common.bone_names(motion.body, names, path))
    pose = common.rest_pose(motion.body, rest, names, path)
    with writing(path) as temporary:
        try:
            stage = Usd.Stage.CreateInMemory()
            _fill(stage, world, pose, joints, factor, cylinders)
            written = stage.GetRootLayer().Export(str(temporary))
        except Tf.ErrorException as error:
            raise ExportError("USD cannot write it", file=path, remedy="Check the path and the disk.") from error
        if not written:
            raise ExportError("USD cannot write it", file=path, remedy="Check the path and the disk.")


def joint_paths(body: Body, names: list[str]) -> list[str]:
    """Joints as UsdSkel names them, with all joints above: "pelvis/abdomen/thorax"."""
    out: list[str] = []
    taken: set[str] = set()
    for name, parent in zip(names, body.tree.parents):
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)
        plain = f"_{plain}" if plain[:1].isdigit() or not plain else plain
        while plain in taken:
            plain += "_"
        taken.add(plain)
        out.append(f"{out[parent]}/{plain}" if parent >= 0 else plain)
    return out


def _fill(stage: Any, motion: Motion, pose: common.Rest, joints: list[str], factor: float, cylinders: bool) -> None:
    from pxr import Gf, Usd, UsdGeom, UsdSkel

    UsdGeom.SetStageUpAxis(stage, motion.up.upper())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0 / factor)
    stage.SetTimeCodesPerSecond(motion.rate)
    stage.SetFramesPerSecond(motion.rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(motion) - 1)
    stage.GetRootLayer().documentation = f"{motion.name}, written by kinefit"
    root = UsdSkel.Root.Define(stage, "/Figure")
    stage.SetDefaultPrim(root.GetPrim())
    skeleton = UsdSkel.Skeleton.Define(stage, "/Figure/Skeleton")
    rest, bind = pose.matrices(motion.up, factor)
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(T.T.tolist()) for T in rest])  # USD multiplies rows
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(T.T.tolist()) for T in bind])
    animation = _animation(stage, motion, pose, joints, factor)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    if motion.body.surfaces or motion.body.skin is not None:
        mesh = pose.posed(body_mesh(motion.body, cylinders=cylinders), motion.body)
        _mesh(stage, mesh, bind[0], factor, skeleton)
    centres = factor * motion.joint_centres
    margin = factor * max((_reach(c) for c in motion.body.surfaces), default=0.0)
    extent = UsdGeom.Boundable(root).CreateExtentAttr()
    for frame, points in enumerate(centres):
        extent.Set([Gf.Vec3f(*(points.min(0) - margin).tolist()), Gf.Vec3f(*(points.max(0) + margin).tolist())],
                   Usd.TimeCode(frame))


def _reach(surface: Surface) -> float:
    """[m] from a segment's joint to the farthest of its surface, or somewhat more."""
    if isinstance(surface, MeshSurface):
        return float(np.linalg.norm(surface.vertices, axis=1).max())
    return max(float(np.linalg.norm(end)) + max(r) for end, r in zip((surface.start, surface.end), surface.radii))


def _animation(stage: Any, motion: Motion, pose: common.Rest, joints: list[str], factor: float) -> Any:
    from pxr import Gf, Usd, UsdSkel, Vt

    animation = UsdSkel.Animation.Define(stage, "/Figure/Skeleton/Animation")
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr([Gf.Vec3h(1, 1, 1)] * len(joints))
    quaternions, places = pose.local_moves(motion, motion.up)
    translations, rotations = animation.CreateTranslationsAttr(), animation.CreateRotationsAttr()
    for frame in range(len(motion)):
        at = Usd.TimeCode(frame)
        translations.Set(Vt.Vec3fArray.FromNumpy(np.float32(factor * places[frame])), at)
        rotations.Set([Gf.Quatf(w, x, y, z) for w, x, y, z in quaternions[frame].tolist()], at)
    return animation


def _mesh(stage: Any, content: TubeMesh, T_skeleton_root: NDArray, factor: float, skeleton: Any) -> None:
    from pxr import Sdf, UsdGeom, UsdSkel, Vt

    R = T_skeleton_root[:3, :3]
    points = np.float32(factor * (content.vertices @ R.T) + T_skeleton_root[:3, 3])
    mesh = UsdGeom.Mesh.Define(stage, "/Figure/Surface")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.float32(content.normals @ R.T)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(content.triangles), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.int32(content.triangles.ravel())))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
    colour = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
    )
    colour.Set(Vt.Vec3fArray.FromNumpy(np.float32(common.linear_colours(content.colours))))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    followed, shares = np.int32(content.segments.ravel()), np.float32(content.weights.ravel())
    count = content.segments.shape[1]
    binding.CreateJointIndicesPrimvar(False, count).Set(Vt.IntArray.FromNumpy(followed))
    binding.CreateJointWeightsPrimvar(False, count).Set(Vt.FloatArray.FromNumpy(shares))
