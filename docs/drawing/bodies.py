"""Bodies in a light: a mesh by its segments' colours, a figure on a floor, skins of metaballs, a ride down a slope."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from benchmarks.gear_takes import rendered_snowboarder
from numpy.typing import NDArray
from PIL import Image

import kinefit
from drawing import results
from kinefit import Motion, read_motion
from kinefit.bodies import Body, BodyState
from kinefit.bodies.rendering import Canvas
from kinefit.bodies.rendering.looks import body_mesh, side_colour
from kinefit.exporters import write_motion
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.readers.videos.video import Video

PAPER = (247, 249, 251)
_HEIGHT, _STEP, _SPEED = 360, 4, 80  # [px], every which frame, [ms] each is shown
_FIGURE = 300  # [px] width
_FINER = 3  # times: the figure is rendered so much larger, then reduced


def demo() -> None:
    """The moving image of README: the overlay videos of `kinefit demo` beside the figure in 3D."""
    motion = read_motion(results.demo() / "motion.npz")
    videos = [Video(path) for path in sorted((results.demo() / "overlays").glob("*.mp4"))]
    count = min(len(motion), *map(len, videos))
    frames = [
        np.hstack([*(results.reduced(video.read(i), height=_HEIGHT) for video in videos), _swaying(motion, i, count)])
        for i in range(0, count, _STEP)
    ]
    first, *others = map(Image.fromarray, [*frames, *frames[-2:0:-1]])
    file = results.IMAGES / "demo.webp"
    first.save(file, save_all=True, append_images=others, duration=_SPEED, loop=0, quality=60)


def _swaying(motion: Motion, i: int, count: int) -> NDArray:
    angle = np.radians(30.0 + 40.0 * np.sin(np.pi * i / count))
    return figure(motion, i, angle)


def figure(motion: Motion, i: int, angle: float, size: tuple[int, int] = (_FIGURE, _HEIGHT)) -> NDArray:
    """(H, W, 3) uint8 RGB of the body in frame i on a floor, from a direction [rad] about the vertical axis z."""
    x = motion.positions()
    low, high = x.reshape(-1, 3).min(axis=0), x.reshape(-1, 3).max(axis=0)
    middle = 0.5 * (low + high)
    camera = looking(middle, middle + 4.6 * np.array([np.cos(angle), np.sin(angle), 0.25]),
                     (_FINER * size[0], _FINER * size[1]), 1.9 * _FINER * size[1])  # fmt: skip
    image = np.full((camera.size[1], camera.size[0], 3), PAPER, np.uint8)
    for k in np.arange(-5, 6) * 0.25:
        for line in ([[k, -1.25], [k, 1.25]], [[-1.25, k], [1.25, k]]):
            ends = camera.project(np.column_stack([np.array(line) + middle[:2], [low[2], low[2]]]))
            a, b = (tuple(int(v) for v in end) for end in ends)
            cv2.line(image, a, b, (214, 221, 228), _FINER, cv2.LINE_AA)
    shade(image, motion.body, motion.state(i), camera)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def looking(
    target: NDArray, eye: NDArray, size: tuple[int, int], focal: float, up: Sequence[float] = (0, 0, 1)
) -> Camera:  # fmt: skip
    """A camera at a place that looks at another."""
    z = (target - eye) / np.linalg.norm(target - eye)
    across = np.cross(z, up)
    R = np.stack([across / np.linalg.norm(across), np.cross(z, across / np.linalg.norm(across)), z])
    K = np.array([[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]])
    return Camera("figure", size, K, T_camera_world=se3.transform(R, -R @ eye))


def shade(
    image: NDArray, body: Body, state: BodyState, camera: Camera,
    colour: Callable[[str], Sequence[int]] = side_colour,
) -> None:  # fmt: skip
    """Draw a body's skin, or its surfaces, into an image (H, W, 3) RGB, in a light from above the camera."""
    mesh = body_mesh(body)
    frames = body.tree.forward(state.T_world_root, state.angles)[0][mesh.segments]  # from the rest pose
    x = np.einsum("vk,vkij,vj->vi", mesh.weights, frames[..., :9].reshape(*frames.shape[:2], 3, 3), mesh.vertices)
    x += np.einsum("vk,vki->vi", mesh.weights, frames[..., 9:])
    corners = x[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    smooth = np.zeros_like(x)
    for k in range(3):
        np.add.at(smooth, mesh.triangles[:, k], normals)
    faces = smooth[mesh.triangles].mean(axis=1)
    faces /= np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), 1e-12)
    light = camera.T_world_camera[:3, :3] @ [0.35, -0.7, -0.6]
    bright = 0.55 + 0.45 * np.clip(faces @ (light / np.linalg.norm(light)), -0.2, 1.0)
    raster = Canvas(camera.size).draw_for(camera, x, mesh.triangles, cull=True)
    own = np.array([colour(name) for name in body.tree.segments], float)
    of = mesh.segments[np.arange(len(x)), mesh.weights.argmax(axis=1)][mesh.triangles[:, 0]]
    colours = np.clip(bright[:, None] * (0.65 * own[of] + 70.0), 0, 255).astype(np.uint8)
    image[raster.seen] = colours[raster.face][raster.seen]


def _metaballs(
    name: str, poses: Sequence[dict[str, float]], size: tuple[int, int], focal: float, away: Sequence[float]
) -> NDArray:  # fmt: skip
    """(H, W, 3) BGR: a body of the catalogue in poses {coordinate: degrees}, side by side, from `away` [m]."""
    body, parts = kinefit.load_body(name), []
    for pose in poses:
        angles = np.zeros(len(body.tree.coordinates))
        for coordinate, value in pose.items():
            angles[body.tree.coordinates.index(coordinate)] = np.radians(value)
        state = BodyState(np.eye(4), np.clip(angles, body.tree.lower, body.tree.upper))
        ends = body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, 3]
        middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
        camera = looking(middle, middle + away, (2 * size[0], 2 * size[1]), focal, up=(0, 1, 0))
        image = np.full((2 * size[1], 2 * size[0], 3), PAPER, np.uint8)
        shade(image, body, state, camera, lambda _: (214, 164, 140))
        parts.append(results.reduced(image, height=size[1]))
    return np.hstack(parts)[..., ::-1]


def body_skin() -> None:
    """The whole body of metaballs under one skin, in three poses."""
    squat = {f"{joint}_{side}": value for side in "lr" for joint, value in
             (("hip_flexion", 80.0), ("knee_angle", 95.0), ("ankle_angle", 20.0), ("arm_flex", 70.0))}  # fmt: skip
    spread = {f"arm_add_{side}": -80.0 for side in "lr"} | {f"hip_adduction_{side}": -20.0 for side in "lr"}
    image = _metaballs("humanoid_metaballs", [spread, squat, {}], (420, 460), 1400.0, (2.6, 0.5, 2.2))
    results.save("body_skin.png", image, palette=False)


def metaball_skin() -> None:
    """The arm of metaballs under one skin, straight and bent."""
    poses = [{}, {"elbow_flex_r": 60.0}, {"elbow_flex_r": 110.0}]
    image = _metaballs("arm_metaballs", poses, (300, 420), 1250.0, (0.3, 0.0, 1.5))
    results.save("metaball_skin.png", image, palette=False)


def replay() -> None:
    """Three frames of `kinefit replay`: a snowboarder on a slope."""
    out = results.folder("replay")
    write_motion(rendered_snowboarder(1).truth, out / "motion.npz")
    results.command("replay", out / "motion.npz", "-o", out / "ride.mp4", "--slope", 30, "--speed", 4, "--gain", 2)
    with Video(out / "ride.mp4") as video:
        shown = [results.reduced(video.read(i), width=400) for i in np.linspace(0, len(video) - 1, 3).astype(int)]
    results.save("replay.jpg", np.hstack(shown)[..., ::-1])
