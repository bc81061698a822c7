"""Every figure of depth: `python -m benchmarks.depth`; only some parts: `python -m benchmarks.depth depth_scene`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "depth_surfaces": "closest points on tapered elliptical cylinders",
    "depth_grids": "closest points on meshes",
    "depth_rendering": "drawing a body, and what depth sensors would have seen",
    "depth_images": "depth image -> points",
    "depth_stereo": "stereo pair -> points; faces and hands by their colour",
    "skin_takes": "face and hands by their colour in fits of a real take",
    "depth_start": "pose and size from depth with no pose given",
    "depth_near": "rendered people near a depth camera, cut by the image, hands at the camera",
    "depth_real": "real recordings of depth",
    "depth_scene": "the rendered body of ten parts, on M3T's frames",
    "depth_voodoo": "the paper's experiment, graded by the truth",
    "depth_printed": "the paper's experiment by the paper's rules alone; a wave that depth alone loses",
    "depth_sitting": "sitting down before one depth camera, alone and with a tracker on the body",
    "depth_speed": "time a frame, by points and background; beside Open3D",
}

if __name__ == "__main__":
    run_parts(PARTS)
