"""Run by a Python that has bpy: imports a motion with the add-on, retargets it, prints where the joints are."""

import json
import sys

import bpy
import numpy as np

folder, lines, character, frames = sys.argv[1], sys.argv[2], sys.argv[3], json.loads(sys.argv[4])
sys.path.insert(0, folder)
bpy.ops.wm.read_factory_settings(use_empty=True)
import kinefit_motion  # noqa: E402

kinefit_motion.register()
assert bpy.ops.import_anim.kinefit(filepath=lines) == {"FINISHED"}
figure = bpy.context.view_layer.objects.active


def heads(thing, frame):
    bpy.context.scene.frame_set(frame)
    bpy.context.view_layer.update()
    return {bone.name: list(thing.matrix_world @ bone.head) for bone in thing.pose.bones}


told = {
    "fps": bpy.context.scene.render.fps / bpy.context.scene.render.fps_base,
    "last": bpy.context.scene.frame_end, "joints": [heads(figure, f) for f in frames], "std": [], "lost": [],
}
for f in frames:
    bpy.context.scene.frame_set(f)
    told["std"].append({b.name: b["kinefit_std_mm"] for b in figure.pose.bones})
    told["lost"].append({b.name: b["kinefit_lost"] for b in figure.pose.bones})
bpy.ops.import_scene.gltf(filepath=character)
(other,) = (o for o in bpy.context.scene.objects if o.type == "ARMATURE" and o is not figure)
other.animation_data_clear()
for thing in bpy.context.selected_objects:
    thing.select_set(False)
for thing in (figure, other):
    thing.select_set(True)
bpy.context.view_layer.objects.active = other
assert bpy.ops.object.kinefit_retarget() == {"FINISHED"}
told["retargeted"] = [heads(other, f) for f in frames]
try:
    bpy.ops.import_anim.kinefit(filepath=character)
    told["refused"] = ""
except RuntimeError as error:
    told["refused"] = str(error)
kinefit_motion.unregister()
print("\ntold " + json.dumps(told, default=float))
assert np.isfinite(told["fps"])
