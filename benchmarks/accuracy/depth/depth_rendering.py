"""The z-buffer: time for a body of 14,000 triangles, beside Open3D's ray casting (Embree) of the same triangles.

`KINEFIT_OPEN3D_PYTHON` names an interpreter that has open3d; without it that figure is not measured.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import NotMeasured, figure
from benchmarks.timing import timed
from kinefit.bodies.rendering import Canvas
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.geometry.camera import Camera
from kinefit.simulation import KINECT, TOF, in_front, squat_and_wave

REPEATS, FRAMES = 7, 20

_PEER = """
import sys, time
import numpy as np, open3d as o3d
data = np.load(sys.argv[1])
x, faces, rays = data["x"].astype(np.float32), data["faces"].astype(np.uint32), data["rays"].astype(np.float32)
best = np.inf
for _ in range(5):
    start = time.process_time()
    for frame in x:
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(o3d.core.Tensor(frame), o3d.core.Tensor(faces))
        hit = scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)["t_hit"].numpy()
    best = min(best, time.process_time() - start)
np.savez(sys.argv[2], ms=1e3 * best / len(x), depth=hit)
"""


def run() -> None:
    """Print every figure of drawing."""
    motion = squat_and_wave()
    mesh = body_mesh(motion.body, around=32, along=10)
    print(f"# {len(mesh.faces)} triangles, {len(mesh.vertices)} corners, {motion.body.name}")
    large, least = in_front(motion, KINECT.camera()), in_front(motion, TOF.camera())
    ms = {camera.size: drawn_ms(motion, mesh, camera) for camera in (large, least)}
    figure("render_640_ms", ms[large.size], "ms/image", "<= 1")
    figure("render_160_ms", ms[least.size], "ms/image", "<= 0.1")
    coarse = body_mesh(motion.body)
    figure("render_160_body_ms", drawn_ms(motion, coarse, least), "ms/image", "<= 0.1")
    _beside_open3d(motion, mesh, large, ms[large.size])


def drawn_ms(motion, mesh, camera: Camera) -> float:  # type: ignore[no-untyped-def]
    """CPU time [ms] of one image, vertices given in the world; the least of a few rounds over some frames."""
    canvas, posed = Canvas(camera.size), _posed(motion, mesh)
    canvas.draw_for(camera, posed[0], mesh.faces, cull=True)
    spent: list[float] = []
    for _ in range(REPEATS):
        with timed(spent, 1e3 / len(posed)):
            for vertices in posed:
                canvas.draw_for(camera, vertices, mesh.faces, cull=True)
    return min(spent)


def _posed(motion, mesh) -> NDArray:  # type: ignore[no-untyped-def]
    states = [motion.state(frame) for frame in range(FRAMES)]
    return np.array([mesh.posed(motion.body.tree.forward(s.T_world_root, s.angles)[0]) for s in states])


def _beside_open3d(motion, mesh, camera: Camera, ms: float) -> None:  # type: ignore[no-untyped-def]
    python = os.environ.get("KINEFIT_OPEN3D_PYTHON")
    goals = (("render_vs_embree", "x", ">= 5"), ("render_vs_embree_depth_p99", "mm", "<= 0.1"))
    if not python:
        raise NotMeasured("KINEFIT_OPEN3D_PYTHON names no interpreter")
    R, t = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
    x = _posed(motion, mesh) @ R.T + t
    a, b = camera.ray_table
    rays = np.concatenate([np.zeros((*a.shape, 3)), np.stack([a, b, np.ones_like(a)], axis=-1)], axis=-1)
    with tempfile.TemporaryDirectory() as folder:
        given, got = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(given, x=x, faces=mesh.faces, rays=rays)
        done = subprocess.run([python, "-c", _PEER, given, got], capture_output=True, text=True, timeout=300)
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
            for name, unit, goal in goals:
                figure(name, None, unit, goal, reason)
            return
        with np.load(got) as peer:
            theirs, depth = float(peer["ms"]), peer["depth"]
    mine = Canvas(camera.size).draw_for(camera, _posed(motion, mesh)[-1], mesh.faces, cull=True).depth
    both = np.isfinite(mine) & np.isfinite(depth)
    away = np.abs(mine[both] - depth[both])
    print(f"# Embree: {theirs:.1f} ms; kinefit {ms:.2f} ms; the same pixels seen: "
          f"{(np.isfinite(mine) == np.isfinite(depth)).mean():.5f}")  # fmt: skip
    figure(*goals[0][:1], theirs / ms, *goals[0][1:])
    figure(*goals[1][:1], 1e3 * float(np.quantile(away, 0.99)), *goals[1][1:])
