"""Synthetic takes of a known motion: videos, keypoints, calibration, take file; tiny ones that warm kernels up."""

from __future__ import annotations

import os
import tempfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from kinefit.errors import ExportError
from kinefit.geometry.camera import Camera, Rig
from kinefit.motion import UP_AXES, Motion
from kinefit.observations import DepthFrame, Keypoints
from kinefit.readers.calibration.read import write_calibration
from kinefit.simulation.figures import draw_figure, in_front
from kinefit.simulation.keypoints import simulate_keypoints, studio_rig
from kinefit.simulation.movements import squat_and_wave
from kinefit.simulation.rendering.sensors import KINECT, simulate_depth
from kinefit.simulation.retarget import cut
from kinefit.tracking.recording import Recording
from kinefit.tracking.tracker import Tracker
from kinefit.tracking.video import track

_IMAGE_SIZE = (544, 960)  # [px]
_KEYPOINT_SIGMA = 2.0  # [px] in the take file


def write_synthetic_take(folder: str | os.PathLike[str], motion: Motion | None = None, *, seed: int = 0) -> Path:
    """Write a take of a drawn figure: four videos with keypoints, calibration and take.toml.

    Parameters
    ----------
    folder : path
        Made where it does not exist; files of the same names in it are replaced.
    motion : Motion, optional
        Of the figure, at the videos' rate; default: `squat_and_wave`. Images are wide for a motion that goes far.
    seed : int
        Of the keypoints' errors: 1.5 px noise, 5 % outliers, 5 % undetected.

    Returns
    -------
    Path
        The take file, written last.

    Raises
    ------
    ExportError
        The folder cannot be written. It then contains no take file.
    """
    folder, motion = Path(folder), motion or squat_and_wave()
    low, high = (limit(motion.positions(), axis=(0, 1)) for limit in (np.min, np.max))
    goes_far = np.argmax(high - low) != "xyz".index(motion.up[-1])
    rig = studio_rig(motion, size=_IMAGE_SIZE[::-1] if goes_far else _IMAGE_SIZE)
    detections = simulate_keypoints(motion, rig, "MEDIAPIPE_33", noise_px=1.5, outliers=0.05, missing=0.05, seed=seed)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as name:
            staging = Path(name)
            for camera, keypoints in zip(rig, detections):
                _write_video(motion, camera, staging / f"{camera.name}.mp4")
                np.save(staging / f"mediapipe_{camera.name}.npy", _landmarks(keypoints))
            write_calibration(rig, staging / "calibration.toml")
            (staging / "take.toml").write_text(_take(motion, rig), encoding="utf-8")
            for path in sorted(staging.iterdir(), key=lambda path: path.name == "take.toml"):
                path.replace(folder / path.name)
    except OSError as error:  # PyAV's file errors are OSErrors too
        raise ExportError(
            f"the synthetic take cannot be written ({error.strerror or error})", file=folder,
            remedy="Give a folder that can be written, on a disk with 10 MB free.",
        ) from error
    return folder / "take.toml"


def _write_video(motion: Motion, camera: Camera, path: Path) -> None:
    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(motion.rate).limit_denominator(1001))
        stream.width, stream.height = camera.size
        stream.pix_fmt = "yuv420p"
        for frame in range(len(motion)):
            picture = av.VideoFrame.from_ndarray(draw_figure(motion, frame, camera), format="bgr24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def _landmarks(keypoints: Keypoints) -> np.ndarray:
    """(F, 33, 3) landmarks in MediaPipe's format: x, y [px] and visibility, zero for undetected ones."""
    array = np.concatenate([keypoints.points[:, 0], keypoints.confidence[:, 0, :, None]], axis=-1)
    return np.nan_to_num(array).astype(np.float32)


def _take(motion: Motion, rig: Rig) -> str:
    parts = [
        "# A simulated figure in four cameras. No recording of a person.\n",
        f'[take]\nname = "{motion.name}"\nrate = {motion.rate}\nup = "{motion.up}"\nbody = "{motion.body.name}"\n',
        '[calibration]\nfile = "calibration.toml"\n',
    ]
    parts += [f'[[camera]]\nname = "{name}"\nvideo = "{name}.mp4"\n' for name in rig.names]
    parts += [
        f'[[keypoints]]\ncamera = "{name}"\nfile = "mediapipe_{name}.npy"\nformat = "mediapipe"\n'
        f"sigma = {_KEYPOINT_SIGMA}\n"
        for name in rig.names
    ]
    return "\n".join(parts)


def warm_keypoints() -> None:
    """Run the fit of the person, tracking and smoothing once on keypoints."""
    motion = cut(squat_and_wave(), 0, 4)
    rig = studio_rig(motion)
    track(Recording.of_keypoints(rig, simulate_keypoints(motion, rig, "BODY_25B"), up=motion.up), motion.body)


def warm_depth() -> None:
    """Run depth tracking once, without a start pose, so the search for it is included."""
    motion = cut(squat_and_wave(), 0, 3)
    camera = in_front(motion, KINECT.camera(name="kinect"), near=KINECT.near, far=KINECT.far)
    video = simulate_depth(motion, camera, KINECT)
    tracker = Tracker(motion.body, Rig((camera,)), rate=motion.rate, up=UP_AXES[motion.up])
    for i in range(len(motion)):
        tracker.update([DepthFrame("kinect", motion.times[i], video.frame(i).depth)])
