"""Run by a Python that has bpy: imports an FBX file and prints where joints and skin are, as JSON."""

import json
import sys

import bpy

path, importer, frames = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
bpy.ops.wm.read_factory_settings(use_empty=True)
module, name = importer.split(".")
assert getattr(getattr(bpy.ops, module), name)(filepath=path) == {"FINISHED"}
scene = bpy.context.scene
(figure,) = (thing for thing in scene.objects if thing.type == "ARMATURE")
(skin,) = (thing for thing in scene.objects if thing.type == "MESH")
first, last = figure.animation_data.action.frame_range
told = {
    "fps": scene.render.fps / scene.render.fps_base, "frames": [first, last], "heads": [], "points": [],
    "groups": [group.name for group in skin.vertex_groups],
    "colours": [list(skin.data.materials[face.material_index].diffuse_color)[:3] for face in skin.data.polygons],
}  # fmt: skip
for frame in frames:
    scene.frame_set(round(first) + frame)
    bpy.context.view_layer.update()
    told["heads"].append({bone.name: list(figure.matrix_world @ bone.head) for bone in figure.pose.bones})
    shown = skin.evaluated_get(bpy.context.evaluated_depsgraph_get())
    told["points"].append([list(shown.matrix_world @ vertex.co) for vertex in shown.data.vertices])
print()
print(json.dumps(told))
