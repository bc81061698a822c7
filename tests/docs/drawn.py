"""Files and images that pages take for granted, drawn small: takes, boards, bars, pairs of cameras, surfaces."""

import json
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from benchmarks.bar_scene import bar_rig, draw_bar, wave_bar
from tests.rigs.board import test_calibrate as boards

import kinefit
from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces.places import sample
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import SilhouetteFrame
from kinefit.readers.calibration.read import write_calibration
from kinefit.rigs.board.detection import Board
from kinefit.simulation import cut, draw_figure, simulate_keypoints, squat_and_wave, studio_rig

RATE = 30.0
FRAMES = 16


@cache
def _drawn():
    """A motion, its cameras, keypoints and images (C, F, H, W, 3)."""
    motion = cut(squat_and_wave(), 0, FRAMES)
    rig = studio_rig(motion, size=(272, 480))
    rig = Rig(tuple(replace(camera, name=f"cam{i + 1:02d}") for i, camera in enumerate(rig)))
    seen = simulate_keypoints(motion, rig, "MEDIAPIPE_33", noise_px=0.8)
    return motion, rig, seen, [[draw_figure(motion, f, camera) for f in range(FRAMES)] for camera in rig]


def write_video(path, images, rate=RATE):
    height, width = images[0].shape[:2]
    out = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate, (width, height))
    for image in images:
        out.write(image)
    out.release()


def write_recording(folder, *, calibration=True, videos=True):
    """Videos, MediaPipe's files and calibration of a drawn figure, as somebody leaves them in a folder."""
    motion, rig, seen, images = _drawn()
    folder.mkdir(parents=True, exist_ok=True)
    for camera, keypoints, video in zip(rig, seen, images):
        if videos:
            write_video(folder / f"{camera.name}.mp4", video)
        array = np.concatenate([keypoints.points[:, 0], keypoints.confidence[:, 0, :, None]], axis=-1)
        np.save(folder / f"mediapipe_{camera.name}.npy", np.nan_to_num(array).astype(np.float32))
    if calibration:
        write_calibration(rig, folder / "calibration.toml")
    return motion, rig


def write_take(folder, *, videos=False, name="take.toml"):
    """A take of that figure by its keypoints."""
    motion, rig = write_recording(folder, videos=videos)
    lines = [f'[take]\nrate = {motion.rate}\nup = "{motion.up}"', '[calibration]\nfile = "calibration.toml"']
    for camera in rig.names:
        video = f'video = "{camera}.mp4"\n' if videos else ""
        lines.append(
            f'[[camera]]\nname = "{camera}"\n{video}[[keypoints]]\ncamera = "{camera}"\nsigma = 2.0\n'
            f'format = "mediapipe"\nfile = "mediapipe_{camera}.npy"'
        )
    (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / name


def board_videos(folder, frames=18):
    """A ChArUco board that is waved a metre before two cameras, and lies on the floor in frame 12."""
    board = Board.parse("charuco:5x7:0.04:0.03:4X4_50")
    folder.mkdir(exist_ok=True)
    Ts = boards.waved(board, frames, tilt=0.7)
    Ts[:, :3, 3] *= 0.4
    Ts[12] = se3.transform(np.eye(3), np.array([-0.1, -0.1, -0.15]))
    for i, camera in enumerate(boards.studio(2, distortion=())):
        T_camera_world = np.array(camera.T_camera_world)
        T_camera_world[:3, 3] *= 0.42
        for f, T in enumerate(Ts):
            H = camera.matrix @ (T_camera_world @ T)[:3, [0, 1, 3]]
            cv2.imwrite(str(folder / f"cam{i + 1:02d}_{f:03d}.png"), boards.drawn(board, H))


def bar_videos(folder, floor=(0, 1)):
    """A bar of 0.9 m with two lights, waved before three cameras; on the floor in two frames."""
    rig = bar_rig(3, (640, 480))
    apart = np.linalg.norm(rig["cam0"].centre_world - rig["cam2"].centre_world)
    nearer = 4.21 / apart  # the page's distance between the first and the last
    rig = Rig(tuple(
        replace(c, T_camera_world=se3.transform(c.T_camera_world[:3, :3], c.T_camera_world[:3, 3] * nearer))
        for c in rig
    ))  # fmt: skip
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    ends = wave_bar(0.9, max(40, 1 + max(floor)), low=(-0.3, -0.3, 0.3), high=(0.3, 0.3, 0.9), seed=8)
    ends[floor[0]], ends[floor[1]] = [[-0.3, 0, 0.2], [0.6, 0, 0.2]], [[0.1, 0.4, 0.2], [0.1, -0.5, 0.2]]
    for f, places in enumerate(ends):
        for c, camera in enumerate(rig):
            image = draw_bar(camera, places, radius=0.03, seed=3 * f + c)
            cv2.imwrite(str(folder / f"cam{c + 1:02d}_{f:03d}.png"), image)
    return rig


def markers_of_leg():
    """Markers of pelvis, thigh and shank that turn about hip and knee in all ways."""
    random, count = np.random.default_rng(3), 40
    names = ("LASI", "RASI", "LPSI", "RPSI", "RTH1", "RTH2", "RTH3", "RKNE", "RSH1", "RSH2", "RSH3")
    pelvis, thigh, shank = (random.normal(size=(n, 3)) * 0.1 for n in (4, 4, 3))
    x = np.zeros((count, len(names), 3))
    for f in range(count):
        R_hip = se3.exp_so3(random.uniform(-0.6, 0.6, 3))
        R_knee = R_hip @ se3.exp_so3(np.array([0.0, 0.0, random.uniform(-1.2, 0.0)]))
        x[f, :4] = pelvis + (0.0, 1.0, 0.0)
        x[f, 4:8] = (0.0, 0.9, 0.0) + (thigh + (0.0, -0.2, 0.0)) @ R_hip.T
        x[f, 8:] = (0.0, 0.9, 0.0) + R_hip @ (0.0, -0.42, 0.0) + (shank + (0.0, -0.2, 0.0)) @ R_knee.T
    return kinefit.Markers(names, 60.0, x + 1e-4 * random.normal(size=x.shape), up="y")


def depth_of(body, state, camera):
    """(H, W) float32 [m] of a body alone; 0 beside it."""
    raster = render_body(body, state, camera)
    return np.where(raster.seen, raster.depth, 0.0).astype(np.float32)


def masks(w, steps):
    """Silhouettes of all cameras at some steps, and the states there."""
    states = [w.motion.state(i) for i in steps]
    seen = [
        [SilhouetteFrame(c.name, float(w.motion.times[i]), render_body(w.body, state, c).seen) for c in w.rig]
        for i, state in zip(steps, states)
    ]
    return seen, states


def ring(points):
    """A camera, the pose of a closed curve before it, and the mask of the curve's inside."""
    camera = Camera("cam", (320, 240), [[280.0, 0, 159.5], [0, 280.0, 119.5], [0, 0, 1]])
    R = se3.exp_so3(np.array([0.3, -0.2, 0.4])) @ np.diag([1.0, -1.0, -1.0])
    T = se3.transform(R, np.array([0.02, -0.03, 0.6]))
    uv = np.rint(16 * camera.project(se3.apply(T, points))).astype(np.int32)
    return camera, T, cv2.fillPoly(np.zeros((240, 320), np.uint8), [uv], 255, shift=4)


def nudged(T):
    return se3.exp(np.array([0.01, 0.02, -0.02, 0.1, 0.1, -0.1])) @ T


def speckles(shape, stretch=0.001):
    """Two float32 images of a speckled plate, before and after it was stretched along x."""
    random = np.random.default_rng(1)
    speckle = cv2.GaussianBlur(random.normal(size=shape), (0, 0), 2.0)
    before = np.clip(128 + 60 * speckle / speckle.std(), 0, 255).astype(np.float32)
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    after = cv2.remap(before, u - np.float32(stretch) * (u - shape[1] / 2) - 2, v + 1, cv2.INTER_CUBIC)
    return before, after


def stereo_pair():
    """Two cameras 0.12 m apart before a textured wall at 2 m, and their images."""
    K = [[290.0, 0, 159.5], [0, 290.0, 119.5], [0, 0, 1]]
    T = np.eye(4)
    T[0, 3] = -0.12
    rig = Rig((Camera("left", (320, 240), K), Camera("right", (320, 240), K, T_camera_world=T)))
    wide = np.clip(128 + 120 * cv2.GaussianBlur(np.random.default_rng(2).normal(size=(240, 360)), (0, 0), 1.5), 0, 255)
    shift = round(290.0 * 0.12 / 2.0)
    left = np.repeat(wide[:, 20:340, None], 3, axis=2).astype(np.uint8)
    right = np.repeat(wide[:, 20 + shift : 340 + shift, None], 3, axis=2).astype(np.uint8)
    return rig, left, right


def skin_points(body, state, count=1500):
    """(count, 3) [m] points of the body's surface in the world."""
    x, _, segment = sample(body, count, seed=0)
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    f = frames[segment]
    return (f[:, :9].reshape(-1, 3, 3) @ x[:, :, None])[..., 0] + f[:, 9:]


def write_openpose(folder, keypoints, numbers=None):
    """One JSON a frame, as OpenPose leaves them."""
    folder.mkdir(parents=True, exist_ok=True)
    for f in range(len(keypoints.points)) if numbers is None else numbers:
        people = []
        for uv, sure in zip(keypoints.points[f], keypoints.confidence[f]):
            numbers_of = np.nan_to_num(np.column_stack([uv, sure]))
            people.append({"person_id": [-1], "pose_keypoints_2d": numbers_of.ravel().round(3).tolist()})
        text = json.dumps({"version": 1.3, "people": people})
        (folder / f"{keypoints.camera}_{f:012d}_keypoints.json").write_text(text)
