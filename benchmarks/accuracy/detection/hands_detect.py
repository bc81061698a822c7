"""Hands found in the images of two calibrated cameras that see a bare arm: how often, and how well the two agree.

The recording has no truth. Each point of the hand is triangulated from both cameras and looked for in both again.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import figure, quick, recording
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import triangulate
from kinefit.images.detectors.box_detector import Models
from kinefit.images.detectors.detection import detect_people
from kinefit.images.detectors.faces import HandFollower, HandModels
from kinefit.readers.videos.video import Video
from kinefit.takes.preparing import detecting

_GOALS = {
    "hands_stereo_found": ("% of images, the worse camera", ">= 90"), "hands_stereo_reprojection": ("px", "<= 3"),
    "hands_stereo_side": ("% of the hands found are of the one side", ">= 95"),
    "hands_ms": ("ms of processor a hand and image", "<= 25"),
}  # fmt: skip
_MIN_CONFIDENCE = 0.5
_FRAMES = 60  # of the quick form


def run() -> None:
    """Print every figure of the detector of hands."""
    folder, networks = recording("stereo_arm_handpose3d"), detecting.networks(None, print).folder
    hands, confidences, spent = zip(*(_detect(networks, folder / f"cam{k}_test.mp4") for k in (0, 1)))
    seen = [(c > _MIN_CONFIDENCE).any(axis=2) for c in confidences]  # (F, 2) left, right
    counts = sum(s.sum(axis=0) for s in seen)
    side = int(np.argmax(counts))
    figure("hands_stereo_found", 100 * min(s[:, side].mean() for s in seen), *_GOALS["hands_stereo_found"])
    uv = np.stack([np.where(s[:, side, None, None], h[:, side], np.nan) for s, h in zip(seen, hands)], axis=2)
    rig = Rig(tuple(_camera(folder, k) for k in (0, 1)))
    x = triangulate(rig, uv.reshape(-1, 2, 2)).reshape(*uv.shape[:2], 3)
    errors = [np.linalg.norm(camera.project(x) - uv[:, :, k], axis=-1) for k, camera in enumerate(rig)]
    figure("hands_stereo_reprojection", float(np.nanmedian(errors)), *_GOALS["hands_stereo_reprojection"])
    print(f"  median error {np.nanmedian(errors):.2f} px, 95 % within {np.nanpercentile(errors, 95):.2f} px")
    figure("hands_stereo_side", 100 * counts.max() / counts.sum(), *_GOALS["hands_stereo_side"])
    figure("hands_ms", 1e3 * sum(spent) / counts.sum(), *_GOALS["hands_ms"])


def _detect(networks: Path, path: Path) -> tuple[NDArray, NDArray, float]:
    """Hands (F, 2, 21, 2) [px] and confidence (F, 2, 21) in a video, and the seconds of processor without decoding."""
    with Video(path) as video:
        images = list(video.frames(0, _FRAMES if quick() else None))
        models, follower = Models(networks), HandFollower(HandModels(networks))
        began = time.process_time()
        found = detect_people(
            images, models, camera=path.stem, rate=video.rate, people=0, masks=False, adders={"hands": follower}
        )
        spent = time.process_time() - began
    assert found.hands is not None and found.hand_confidence is not None
    return found.hands[:, 0], found.hand_confidence[:, 0], spent


def _camera(folder: Path, k: int) -> Camera:
    """A camera of the recording; its unit is not known, and lengths are in that."""
    lines = (folder / f"c{k}.dat").read_text().splitlines()
    matrix = np.array([[float(v) for v in line.split()] for line in lines[1:4]])
    distortion = np.array([float(v) for v in lines[5].split()])
    pose = (folder / f"rot_trans_c{k}.dat").read_text().splitlines()
    T = np.eye(4)
    T[:3, :3] = [[float(v) for v in line.split()] for line in pose[1:4]]
    T[:3, 3] = [float(line) for line in pose[5:8]]
    return Camera(f"cam{k}", (720, 720), matrix, distortion, T_camera_world=T)
