"""Faces found in the images of a seated person before four cameras: how often, and where the other cameras have them.

The recording has no truth. In each camera the points of the mesh that bodies know are compared with where the meshes
of the others place them, two of three at least, triangulated frame by frame; so are the pose's points of the head.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from benchmarks.accuracy.detection.detect_quality import held_out
from benchmarks.figures import amount, figure, recording
from kinefit import load_body
from kinefit.images.detectors.box_detector import Models
from kinefit.images.detectors.detection import detect_people
from kinefit.images.detectors.faces import FaceFinder, FaceModels
from kinefit.images.detectors.layouts import BLAZEPOSE
from kinefit.observations import MEDIAPIPE_478, Detections
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.videos.video import Video
from kinefit.takes.preparing import detecting

_GOALS = {
    "faces_found": ("% of frames that two cameras or more find it in", ">= 95"),
    "faces_held_out": ("px, faces 120 to 165 px high", "<= 5"),
    "faces_ms": ("ms of processor a face and image", "<= 25"),
}  # fmt: skip
_FRAMES = 60  # first of the videos; then a board is held before the person
_MIN_CONFIDENCE = 0.5


class _TimedFinder(FaceFinder):
    """A finder that adds up the seconds of processor that it takes."""

    spent = 0.0

    def __call__(self, image, people):
        began = time.process_time()
        found = super().__call__(image, people)
        _TimedFinder.spent += time.process_time() - began
        return found


def run() -> None:
    """Print every figure of the detector of faces."""
    folder, networks = recording("mv4_upperbody_caliscope"), detecting.networks(None, print, "best")
    found = [_detect(networks, folder / f"port_{k}.mp4") for k in range(4)]
    rig = read_calibration(folder / "config.toml")
    face = np.stack([np.where((d.face_confidence[:, 0] > 0)[..., None], d.face[:, 0], np.nan) for d in found], axis=2)
    sure = [(d.confidence[:, 0] > _MIN_CONFIDENCE)[..., None] for d in found]
    pose = np.stack([np.where(s, d.points[:, 0], np.nan) for s, d in zip(sure, found)], axis=2)
    known = [MEDIAPIPE_478.index(name) for name in load_body("humanoid_face").keypoints("MEDIAPIPE_478").names]
    seen = np.isfinite(face).any(axis=(1, 3))  # (F, C)
    figure("faces_found", 100 * float((seen.sum(axis=1) >= 2).mean()), *_GOALS["faces_found"])
    off = np.stack([held_out(rig, face, c)[:, known] for c in range(4)])
    of_pose = np.stack([held_out(rig, pose, c)[:, BLAZEPOSE.head] for c in range(4)])
    for camera, mesh, head, share in zip(rig.names, off, of_pose, seen.mean(axis=0)):
        print(f"# {camera}: a face in {share:.0%}; {np.nanmedian(mesh):.1f} px, the pose's {np.nanmedian(head):.1f} px")
    print(f"# 95 % within {np.nanpercentile(off, 95):.1f} px; the pose's head {np.nanmedian(of_pose):.1f} px")
    figure("faces_held_out", float(np.nanmedian(off)), *_GOALS["faces_held_out"])
    figure("faces_ms", 1e3 * _TimedFinder.spent / seen.sum(), *_GOALS["faces_ms"])


def _detect(networks: detecting.Networks, path: Path) -> Detections:
    with Video(path) as video:
        images = list(video.frames(0, amount(_FRAMES, 6)))
        models, finder = Models(networks.folder, 1, networks.landmarks), _TimedFinder(FaceModels(networks.folder))
        return detect_people(
            images, models, camera=path.stem, rate=video.rate, people=1, masks=False, adders={"face": finder}
        )  # fmt: skip
