"""The built-in detector, quality "balanced", on the balancing trial, from four videos alone; and on a seated person."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import amount, data, figure, quick, recording
from benchmarks.timing import timed
from kinefit.fitting.multiview.association import choose_people
from kinefit.geometry.camera import ImageFrame
from kinefit.observations import Detections
from kinefit.readers.assets import CAMERAS
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.landmarks.detections import read_detections
from kinefit.takes.preparing import detecting

_GOALS = {
    "detect_speed": ("frames/s", ">= 12"), "detect_landmarks_difference": ("px", "<= 4"),
    "detect_masks_iou": ("", ">= 0.95"), "detect_frames_tracked": ("%", "== 100"),
    "detect_wrong_person": ("pictures", "== 0"), "detect_seated_tracked": ("%", "== 100"),
    "detect_processor_time": ("ms a picture", "<= 41.7"),
}  # fmt: skip
_RUNS = amount(3, 1)  # the fastest counts: other programs only slow it down


def run() -> None:
    """Print every figure of the built-in detector."""
    trial, seated = recording("video_balancing_4cam"), data("mv4_upperbody_caliscope")
    detecting.networks(None, print)
    with tempfile.TemporaryDirectory() as folder:
        _trial(trial, Path(folder))
        if seated is not None and not quick():
            _seated(seated, Path(folder))


def _detect(videos: dict[str, Path], folder: Path) -> dict[str, Detections]:
    span = amount(None, (0.0, 0.4))  # [s]
    jobs = [detecting.DetectionJob(n, video, folder / f"{n}.npz", seconds=span) for n, video in videos.items()]
    detecting.detect(jobs, detecting.DetectionSettings(masks=True, quality="balanced"), force=True, tell=print)
    return {job.camera: read_detections(job.file) for job in jobs}


def _trial(trial: Path, folder: Path) -> None:
    videos = {name: trial / "videos" / f"{name}.mp4" for name in CAMERAS}
    walls, processor = [], []
    for _ in range(_RUNS):
        with timed(walls, clock=time.perf_counter), timed(processor):
            found = _detect(videos, folder)
    frames = len(found[CAMERAS[0]])
    cores = min(detecting.cores(), len(CAMERAS))
    print(f"  {frames} frames of {len(CAMERAS)} cameras in {min(walls):.2f} s on {cores} cores, everything included")
    _figure("detect_speed", frames / min(walls))
    _figure("detect_processor_time", 1000 * min(processor) / (frames * len(CAMERAS)))  # 12 frames/s on two cores
    rig = read_calibration(trial / "Calib_refined_static.toml").select(CAMERAS)
    images = [ImageFrame.letterboxed(rig[name].size, found[name].size) for name in CAMERAS]
    chosen = choose_people(rig, [found[name].keypoints(image_frame=im) for name, im in zip(CAMERAS, images)])
    errors, overlaps, present = [], [], 0
    for name, person in zip(CAMERAS, chosen):
        there = np.flatnonzero(person >= 0)
        present += len(there)
        truth = np.load(trial / f"mediapipe_landmarks_{name}.npy")
        points = found[name].points[there, person[there]]
        seen = truth[there, :, 2] > 0.5
        gap = np.linalg.norm(points - truth[there, :, :2], axis=-1)
        errors.append(gap[seen])
        looked = there[:: amount(1, 5)]
        iou = [_overlap(found[name], f, int(person[f]), trial / "person_masks" / name / f"{f:03d}.png") for f in looked]
        overlaps += iou
        print(f"  {name}: median {np.median(errors[-1]):.2f} px, masks {np.mean(iou):.3f}, lowest {min(iou):.3f}")
    _figure("detect_landmarks_difference", float(np.median(np.concatenate(errors))))
    _figure("detect_masks_iou", float(np.mean(overlaps)))
    _figure("detect_frames_tracked", 100 * present / (len(CAMERAS) * frames))
    _figure("detect_wrong_person", float(np.sum(np.array(overlaps) < 0.5)))


def _overlap(found: Detections, frame: int, person: int, path: Path) -> float:
    """Shared over common area of a mask with the one on file."""
    mine, theirs = found.mask(frame, person), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert mine is not None
    return float((mine & (theirs > 127)).sum() / (mine | (theirs > 127)).sum())


def _seated(seated: Path, folder: Path) -> None:
    rig = read_calibration(seated / "config.toml")
    ports = {name: seated / f"port_{name.removeprefix('cam_')}.mp4" for name in rig.names}
    found = _detect(ports, folder)
    _figure("detect_seated_tracked", 100 * float(np.mean([found[name].seen.any(axis=1) for name in rig.names])))


def _figure(name: str, value: float) -> None:
    unit, goal = _GOALS[name]
    figure(name, value, unit, goal)
