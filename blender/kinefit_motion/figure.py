"""An armature that moves as a motion of kinefit does."""

import bpy
import numpy as np
from mathutils import Matrix, Vector

from .lines import BODY_TO_Z_UP

PATH = "kinefit_file"
"""Custom property of the armature: the file that it came from."""

_TIP = 0.06  # [m] length of a bone that ends a limb
UNOBSERVED = -1.0


def build(motion, context, path=""):
    """Make the armature, its motion and its custom properties; the scene gets the motion's rate and length."""
    data = bpy.data.armatures.new(motion.name)
    figure = bpy.data.objects.new(motion.name, data)
    context.scene.collection.objects.link(figure)
    figure[PATH] = path
    for other in context.selected_objects:
        other.select_set(False)
    context.view_layer.objects.active = figure
    figure.select_set(True)
    _bones(motion, data)
    animate(figure, motion, _rest_frames(motion))
    _uncertainty(figure, motion)
    scene = context.scene
    scene.render.fps, scene.render.fps_base = round(motion.rate), round(motion.rate) / motion.rate
    scene.frame_start, scene.frame_end = 1, frames_of(motion)[-1]
    return figure


def frames_of(motion):
    """Numbers of the scene's frames, from 1; times that were dropped are gaps."""
    return [1 + round((t - motion.times[0]) * motion.rate) for t in motion.times]


def _bones(motion, data):
    bpy.ops.object.mode_set(mode="EDIT")
    rest = motion.rest
    for s, name in enumerate(motion.segments):
        bone = data.edit_bones.new(name)
        children = [rest[c] for c, parent in enumerate(motion.parents) if parent == s]
        above = motion.parents[s]
        way = np.mean(children, axis=0) - rest[s] if children else rest[s] - rest[above] if above >= 0 else (0, 0, 1.0)
        length = np.linalg.norm(way)
        way = np.array((0, 0, 1.0)) if length < 1e-4 else way / length
        bone.head = Vector(rest[s])
        bone.tail = Vector(rest[s] + way * (length if children and length > 0.01 else _TIP))
        if above >= 0:
            bone.parent = data.edit_bones[motion.segments[above]]
    bpy.ops.object.mode_set(mode="OBJECT")


def _rest_frames(motion):
    """{bone: (4, 4)} frames of the segments in the armature at rest."""
    out = {}
    for name, place in zip(motion.segments, motion.rest):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = BODY_TO_Z_UP, place
        out[name] = T
    return out


def animate(figure, motion, rest_frames):
    """Key all bones: each keeps to its segment as it does at rest."""
    poses = {name: motion.poses[:, s] for s, name in enumerate(motion.segments)}
    world = {}
    for name, T in rest_frames.items():
        at_rest = np.array(figure.data.bones[name].matrix_local)
        world[name] = poses[name] @ np.linalg.inv(T) @ at_rest
    key(figure, world, frames_of(motion), {name for name, parent in zip(motion.segments, motion.parents) if parent < 0})


def key(figure, world, frames, movers):
    """Key bones whose matrices in the armature {bone: (F, 4, 4)} are known; others keep to their parents.

    `movers` are keyed with their place, all others with their turn alone.
    """
    bones = figure.data.bones
    whole = dict(world)
    for bone in bones:  # parents stand before children
        if bone.name not in whole:
            local = np.array(bone.matrix_local)
            above = np.eye(4) if bone.parent is None else np.linalg.inv(np.array(bone.parent.matrix_local)) @ local
            parent = np.eye(4)[None] if bone.parent is None else whole[bone.parent.name]
            whole[bone.name] = parent @ above
    for name in world:
        bone, pose = bones[name], figure.pose.bones[name]
        local = np.array(bone.matrix_local)
        if bone.parent is not None:
            local = np.linalg.inv(np.array(bone.parent.matrix_local)) @ local
            above = np.linalg.inv(whole[bone.parent.name])
        else:
            above = np.eye(4)[None]
        basis = np.linalg.inv(local) @ above @ whole[name]
        pose.rotation_mode = "QUATERNION"
        before = None
        for frame, M in zip(frames, basis):
            turn = Matrix(M.tolist()).to_quaternion()
            if before is not None:
                turn.make_compatible(before)
            pose.rotation_quaternion = before = turn
            pose.keyframe_insert("rotation_quaternion", frame=frame)
            if name in movers:
                pose.location = M[:3, 3]
                pose.keyframe_insert("location", frame=frame)


def _uncertainty(figure, motion):
    frames = frames_of(motion)
    std = np.where(np.isfinite(motion.std), 1000.0 * motion.std, UNOBSERVED)
    kinds = {"kinefit_std_mm": std, "kinefit_quality": motion.quality, "kinefit_lost": motion.lost.astype(float)}
    for s, name in enumerate(motion.segments):
        pose = figure.pose.bones[name]
        for kind, values in kinds.items():
            for frame, value in zip(frames, values[:, s]):
                pose[kind] = float(value)
                pose.keyframe_insert(f'["{kind}"]', frame=frame)
