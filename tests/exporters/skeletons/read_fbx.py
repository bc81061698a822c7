"""Run by a Python of its own: what ufbx, by the authors of that library, reads of an FBX file, as JSON.

Its binding 0.0.5 ends some processes when it frees what it read: so all is kept, and the process ends without cleaning.
"""

import json
import os
import sys

import ufbx

path, times = sys.argv[1], json.loads(sys.argv[2])
scene = ufbx.load_file(path)
settings, anim, stacks = scene.settings, scene.anim, list(scene.anim_stacks)
nodes, meshes, skins, poses = (list(kind) for kind in (scene.nodes, scene.meshes, scene.skin_deformers, scene.poses))
parents = [node.parent for node in nodes]
clusters = [list(skin.clusters) for skin in skins]
bones = [[cluster.bone_node for cluster in each] for each in clusters]
number = {node.typed_id: k for k, node in enumerate(nodes)}
locals_ = [[ufbx.evaluate_transform(anim, node, time) for node in nodes] for time in times]
told = {
    "version": scene.metadata.version, "warnings": [warning.description for warning in scene.metadata.warnings],
    "unit_m": settings.unit_meters, "rate": settings.frames_per_second, "up": settings.axes.up.name,
    "right": settings.axes.right.name, "front": settings.axes.front.name,
    "clips": [[stack.name, stack.time_begin, stack.time_end] for stack in stacks],
    "nodes": [node.name for node in nodes],
    "parents": [-1 if parent is None else number[parent.typed_id] for parent in parents],
    "local": [[[*t.translation, *t.rotation, *t.scale] for t in frame] for frame in locals_],
    "rest": [[list(column) for column in node.node_to_world] for node in nodes],
    "meshes": [[mesh.num_vertices, mesh.num_faces, [list(v) for v in mesh.vertices]] for mesh in meshes],
    "skin": [
        [bone.name, list(cluster.vertices), list(cluster.weights), [list(c) for c in cluster.geometry_to_bone]]
        for own, each in zip(bones, clusters) for bone, cluster in zip(own, each)
    ],
    "bind_poses": [pose.is_bind_pose for pose in poses],
}  # fmt: skip
print(json.dumps(told), flush=True)
os._exit(0)
