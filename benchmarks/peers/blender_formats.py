"""Joint centres of an animated figure as Blender imports it, from BVH (in metres) or GLB.

Run as `python -m benchmarks.peers.blender_formats FOLDER` with the peer's python. The folder holds formats.json: rate
(whole), frames, files {format: file}. Places of the heads of all bones in Blender's world (z up) go to
blender-FORMAT.npz there, {bone: (F, 3) [m]}.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy
import numpy as np


def heads(path: Path, rate: int, frames: int) -> dict[str, np.ndarray]:
    """{bone: (F, 3)} of the armature that a file gives."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = rate
    if path.suffix == ".bvh":
        bpy.ops.import_anim.bvh(filepath=str(path), frame_start=0)
    else:
        bpy.ops.import_scene.gltf(filepath=str(path))
    (figure,) = (thing for thing in bpy.context.scene.objects if thing.type == "ARMATURE")
    out = {bone.name: np.empty((frames, 3)) for bone in figure.pose.bones}
    first = round(figure.animation_data.action.frame_range[0])  # of BVH 1, of glTF 0
    for frame in range(frames):
        bpy.context.scene.frame_set(first + frame)
        bpy.context.view_layer.update()
        for bone in figure.pose.bones:
            out[bone.name][frame] = figure.matrix_world @ bone.head
    return out


def main(folder: Path) -> None:
    """Read all files and print where the results lie."""
    given = json.loads((folder / "formats.json").read_text(encoding="utf-8"))
    for name, file in given["files"].items():
        np.savez(folder / f"blender-{name}.npz", **heads(folder / file, given["rate"], given["frames"]))
    print(json.dumps({"peer": "blender", "version": bpy.app.version_string}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
