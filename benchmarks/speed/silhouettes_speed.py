"""Time of a frame, from the images of four cameras to a judged pose; the renderer beside other ones.

Rendered: colour pictures of a body in two colours, without noise. Real: the masks of the balancing trial, made smaller
and outlined in each frame, with the humanoid as its take has it. Processor time of all threads, the least of several
rounds for each frame, the median of the frames: a loaded machine counts more, so a reference, products of matrices, and
the real frame beside the rendered one are printed along.

`KINEFIT_MODERNGL_PYTHON` and `KINEFIT_EMBREE_PYTHON` name interpreters that have moderngl (with a software OpenGL) and
trimesh with embreex; without them those figures are not measured.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.images.silhouettes_track import take_text
from benchmarks.figures import amount, figure, recording
from benchmarks.scenes.silhouettes_scene import of_meshes, ring, swaying
from benchmarks.scenes.takes import seen_of, tracked
from benchmarks.timing import timed
from kinefit.bodies import Body, load_body
from kinefit.bodies.rendering import Canvas, lens_of, render_body
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Rig
from kinefit.images.silhouette import colour_mask
from kinefit.observations import SilhouetteFrame
from kinefit.sensors.settings import TrackSettings

FRAMES, WARM, ROUNDS = amount(45, 15), 5, amount(6, 1)
RED, GREEN = (200, 60, 50), (30, 90, 40)

_GL = """
import sys, time
import numpy as np, moderngl
data = np.load(sys.argv[1])
x, faces, (fx, fy, cx, cy), (w, h) = data["x"].astype("f4"), data["faces"].astype("i4"), data["lens"], data["size"]
context = moderngl.create_standalone_context(backend="egl")
near, far = 0.05, 100.0
P = np.array([[2*fx/w, 0, 2*(cx+.5)/w-1, 0], [0, 2*fy/h, 2*(cy+.5)/h-1, 0],
              [0, 0, (far+near)/(far-near), -2*far*near/(far-near)], [0, 0, 1, 0]], "f4")
program = context.program(
  vertex_shader="#version 330\\nin vec3 p; uniform mat4 P; void main() {gl_Position = P*vec4(p,1);}",
  fragment_shader="#version 330\\nout int o; void main() {o = gl_PrimitiveID;}")
program["P"].write(P.T.tobytes())
buffer = context.buffer(x[0].tobytes())
array = context.vertex_array(program, [(buffer, "3f", "p")], context.buffer(faces.tobytes()))
colour, depth = context.texture((w, h), 1, dtype="i4"), context.depth_texture((w, h))
frame = context.framebuffer([colour], depth)
context.enable(moderngl.DEPTH_TEST)
best = np.inf
for _ in range(5):
    start = time.process_time()
    for v in x:
        frame.use(); frame.clear(); buffer.write(v.tobytes()); array.render(); ids = colour.read(); z = depth.read()
    best = min(best, time.process_time() - start)
print(context.info["GL_RENDERER"], file=sys.stderr)
print(1e3 * best / len(x))
"""

_EMBREE = """
import sys, time
import numpy as np, trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector
data = np.load(sys.argv[1])
x, faces, (fx, fy, cx, cy), (w, h) = data["x"], data["faces"], data["lens"], data["size"]
u, v = np.meshgrid(np.arange(w), np.arange(h))
d = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u, float)], -1).reshape(-1, 3)
o = np.zeros_like(d)
best = np.inf
for _ in range(3):
    start = time.process_time()
    for p in x[:5]:
        RayMeshIntersector(trimesh.Trimesh(p, faces, process=False)).intersects_first(o, d)
    best = min(best, time.process_time() - start)
print(1e3 * best / 5)
"""


def run() -> None:
    """Print the time of a frame and of one drawing."""
    body = of_meshes(load_body("humanoid"), 36, 9)
    triangles = len(body_mesh(body).faces)
    print(f"# {triangles} triangles, 640 x 480, image processing included; processor time of all threads")
    rig = ring(4)
    pictures = _pictures(body, rig)
    rendered_ms: dict[int, float] = {}
    for count, goal in ((4, "<= 20"), (1, "<= 8")):
        rounds = [_frame_ms(body, rig, pictures, count) for _ in range(ROUNDS)]
        ms, error = (min(values) for values in list(zip(*rounds))[::2])
        cpu = float(np.median(np.min([used for _, used, _ in rounds], axis=0)))
        rendered_ms[count] = cpu
        figure(f"silhouettes_{count}_cameras_ms", cpu, "ms/frame, rendered", goal)
        print(f"#   {ms:.1f} ms by the clock; {error:.1f} degrees off a joint, on average")
    _renderers(body, rig)
    _real(rendered_ms[4])


def _real(rendered_ms: float) -> None:
    """The frames of the trial, from its masks in memory."""
    folder = recording("video_balancing_4cam")
    names = "silhouettes_real_4_cameras_ms", "silhouettes_real_to_rendered"
    text = take_text(folder, "masks").replace("height = 1.75", "size = false")
    seen = seen_of(re.sub(r"frames = \[0, \d+\]", f"frames = [0, {FRAMES}]", text, count=1))
    start = tracked(re.sub(r"frames = \[0, \d+\]", "frames = [0, 2]", text, count=1), smooth=False)[0]
    assert seen.rig is not None
    masks = [[video.frame(i) for video in seen.of_kind("silhouette")] for i in range(FRAMES)]
    rounds: list[list[float]] = []
    iterations = 0
    for _ in range(ROUNDS):
        tracker = Tracker(start.body, seen.rig, rate=60.0, up="z", settings=TrackSettings(search=False))
        tracker.start_at(start.state(0))
        used = []
        for frames in masks:
            with timed(used, 1e3):
                result = tracker.update(frames)
            assert result is not None
            iterations += result.iterations
        rounds.append(used[WARM:])
    a = np.random.default_rng(0).random((300, 300))
    began = time.process_time()
    for _ in range(20):
        a = a @ a / np.linalg.norm(a)
    print(f"#   real: {iterations / FRAMES / ROUNDS:.1f} iterations a frame, masks of {masks[0][0].size} px; "
          f"reference, 20 products of 300 x 300: {1e3 * (time.process_time() - began):.1f} ms")  # fmt: skip
    real_ms = float(np.median(np.min(rounds, axis=0)))
    figure(names[0], real_ms, "ms/frame, masks of the balancing trial", "<= 20")
    figure(names[1], real_ms / rendered_ms, "of the rendered frame's, same run", "<= 1.2")


def _pictures(body: Body, rig: Rig) -> list[dict[str, np.ndarray]]:
    mesh, out = body_mesh(body), []
    for state in swaying(body, FRAMES):
        seen = {camera.name: render_body(body, state, camera, mesh=mesh).seen for camera in rig}
        out.append({name: np.where(s[..., None], RED, GREEN).astype(np.uint8) for name, s in seen.items()})
    return out


def _frame_ms(body: Body, rig: Rig, pictures: list[dict[str, np.ndarray]], count: int) -> tuple[float, NDArray, float]:
    """Median of a frame's time, processor times of frames [ms], and the mean error of the last frames' angles [deg]."""
    truth = swaying(body, FRAMES)
    tracker = Tracker(body, rig, rate=30.0, up=(0, 1, 0), settings=TrackSettings(search=False))
    tracker.start_at(truth[0])
    spent, used, off = [], [], []
    for i, seen in enumerate(pictures):
        with timed(spent, 1e3, clock=time.perf_counter), timed(used, 1e3):
            masks = {n: colour_mask(seen[n], (150, 20, 20), (255, 100, 100)) for n in rig.names[:count]}
            result = tracker.update([SilhouetteFrame(name, i / 30.0, mask) for name, mask in masks.items()])
        assert result is not None
        off.append(np.degrees(np.abs(result.state.angles - truth[i].angles)).mean())
    return float(np.median(spent[WARM:])), np.array(used[WARM:]), float(np.mean(off[-10:]))


def _renderers(body: Body, rig: Rig) -> None:
    mesh, camera = body_mesh(body), rig.cameras[0]
    R, t = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
    states = swaying(body, 20)
    x = np.array([mesh.posed(body.tree.forward(s.T_world_root, s.angles)[0]) @ R.T + t for s in states])
    lens, canvas = lens_of(camera), Canvas(camera.size)
    spent: list[float] = []
    for _ in range(5):
        with timed(spent, 1e3 / len(x)):
            for vertices in x:
                canvas.draw(vertices, mesh.faces, lens, cull=True)
    best = min(spent)
    print(f"# kinefit {best:.2f} ms a drawing")
    peers = (("OpenGL in software", "KINEFIT_MODERNGL_PYTHON", _GL, ">= 3"),
             ("Embree's rays", "KINEFIT_EMBREE_PYTHON", _EMBREE, ">= 5"))  # fmt: skip
    for name, variable, code, goal in peers:
        python = os.environ.get(variable)
        if not python:
            figure(f"renderer beside {name}", None, "x", goal, f"{variable} names no interpreter")
            continue
        with tempfile.TemporaryDirectory() as folder:
            given = Path(folder) / "in.npz"
            np.savez(given, x=x, faces=mesh.faces, lens=lens, size=camera.size)
            alone = {**os.environ, "OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}
            done = subprocess.run([python, "-c", code, given], capture_output=True, text=True, timeout=300, env=alone)
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
            figure(f"renderer beside {name}", None, "x", goal, reason)
            continue
        print(f"# {name}: {float(done.stdout):.2f} ms {done.stderr.strip()}")
        figure(f"renderer beside {name}", float(done.stdout) / best, "x", goal)
