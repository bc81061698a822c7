"""USD (Universal Scene Description): an animated skinned figure (UsdSkel) for film and simulation programs."""

from __future__ import annotations

import re
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._files import writing
from kinefit.bodies import Body, MeshSurface
from kinefit.bodies.surfaces import Surface
from kinefit.errors import ExportError, extra
from kinefit.exporters.skeletons.common import UNITS, bone_names, length_factor, turned
from kinefit.exporters.skeletons.rest import Rest, rest_pose
from kinefit.geometry import se3
from kinefit.motion import Motion, rotation_between_up
from kinefit.rendering.tubes import TubeMesh, body_mesh

ENDINGS = (".usd", ".usda", ".usdc")
_UPS = ("y", "z")


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
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim" or "bvh"
        Names of the joints.
    rest : "body" or "t", optional
        Rest pose: the body's own, arms hanging, facing x; or a T facing z. Default: "t" with Mixamo's names.
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
    if not len(motion):
        raise ExportError("a motion without frames cannot be animated", file=path)
    factor, world = length_factor(unit, UNITS, path), turned(motion, up, path, _UPS)
    joints = joint_paths(motion.body, bone_names(motion.body, names, path))
    pose = rest_pose(motion.body, rest, names, path)
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


def _fill(stage: Any, motion: Motion, pose: Rest, joints: list[str], factor: float, cylinders: bool) -> None:
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
    rest, bind = _rest_poses(motion.body, pose, motion.up, factor)
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


def _rest_poses(body: Body, pose: Rest, up: str, factor: float) -> tuple[NDArray, NDArray]:
    """Poses (S, 4, 4) at rest in the parent's frame and in the skeleton's, upright; lengths in the file's unit."""
    upright = se3.transform(rotation_between_up("y", up), np.zeros(3))
    local = np.tile(np.eye(4), (len(body.tree.segments), 1, 1))
    local[:, :3, 3] = factor * pose.offsets
    local[0] = upright @ local[0]
    return local, upright @ se3.transform(np.eye(3), factor * pose.positions)


def _animation(stage: Any, motion: Motion, pose: Rest, joints: list[str], factor: float) -> Any:
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
    colour.Set(Vt.Vec3fArray.FromNumpy(np.float32((content.colours / 255.0) ** 2.2)))  # linear, of sRGB
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    followed, shares = np.int32(content.segments.ravel()), np.float32(content.weights.ravel())
    count = content.segments.shape[1]
    binding.CreateJointIndicesPrimvar(False, count).Set(Vt.IntArray.FromNumpy(followed))
    binding.CreateJointWeightsPrimvar(False, count).Set(Vt.FloatArray.FromNumpy(shares))
