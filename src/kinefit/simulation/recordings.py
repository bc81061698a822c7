"""Write a simulated recording of a known motion by depth, stereo and colour cameras, as a take."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.motion import UP_AXES, Motion
from kinefit.errors import ExportError, ObservationError, choices
from kinefit.fitting import Recording, Tracker, track
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import DepthFrame, Keypoints
from kinefit.readers.calibration.read import write_calibration
from kinefit.simulation.figures import draw_figure, in_front, places, write_video
from kinefit.simulation.keypoints import simulate_keypoints, studio_rig
from kinefit.simulation.movements import squat_and_wave
from kinefit.simulation.rendering.scenes import COLOUR, STEREO, ColourSensor, SimulatedScene, picture
from kinefit.simulation.rendering.scenes import room as room_around
from kinefit.simulation.rendering.sensors import DEPTH_SENSORS, KINECT, DepthSensor, simulate_depth
from kinefit.simulation.retarget import cut

SENSORS = (*DEPTH_SENSORS, "stereo", "colour", "keypoints")
"""Sensors that `write_recording` can simulate."""

_DEPTH_UNIT = 0.001  # [m] of one count of a depth image
_KEYPOINT_NOISE_PX = 1.5  # [px]
_TITLE = "Simulated from a known motion. No recording of a person."
_KEYPOINT_SIGMA = 2.0  # [px] in the take file: noise and small outliers
_DISPARITY_SIGMA = 0.5  # [px] in the take file
_PREVIEW_HEIGHT = 240  # [px]
_FRAME_FILE = re.compile(r"\d{6}\.png")

Step = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class _Job:
    """A recording to write: scene, cameras by name, seed of the errors, and a progress function."""

    scene: SimulatedScene
    rig: Rig
    seed: int
    step: Step

    def frames(self, name: str) -> Iterator[int]:
        count = len(self.scene.motion)
        for frame in range(count):
            self.step(name, frame, count)
            yield frame
        self.step(name, count, count)


@checked
def write_recording(
    motion: Motion,
    folder: str | os.PathLike[str],
    sensors: Sequence[str] = ("kinect",),
    *,
    distance: float | None = None,
    azimuth: float = 0.0,
    height: float = 1.2,
    room: bool = True,
    seed: int = 0,
    step: Step | None = None,
    beside: Callable[[Path], None] | None = None,
    body: str | os.PathLike[str] | None = None,
) -> Path:
    """Write a take that sensors in front of a person would have recorded of a motion.

    Parameters
    ----------
    motion : Motion
        Each of its frames is a frame of every sensor.
    folder : path
        Created if it does not exist; files of the same names in it are replaced.
    sensors : of `SENSORS`
        "tof", "kinect": 16-bit PNG in millimetres; "stereo": two lossless grey videos; "colour": a video;
        "keypoints": a detector's keypoints in the colour camera.
    distance, azimuth, height : [m], [rad], [m]
        Place of the sensors, see `in_front`; default: each at the shortest distance with all of the motion in view.
    room : bool
        Whether floor, walls and a table are around the body.
    seed : int
        Of all errors.
    step : callable(what, done, total), optional
    beside : callable(folder), optional
        Writes further files next to the take (such as the truth); they appear with the rest or not at all.
    body : path, optional
        Body file for the take to name; default: the name of the motion's body in the catalogue.

    Returns
    -------
    Path
        The take file, written last.

    Raises
    ------
    ObservationError
        A sensor is unknown, or cannot have all of the motion in view and within its range.
    ExportError
        The folder cannot be written. It then contains no take file.
    """
    folder, chosen = Path(folder), list(dict.fromkeys(sensors))
    for name in chosen:
        if name not in SENSORS:
            raise ObservationError(choices("sensor", name, SENSORS))
    if not chosen:
        raise ObservationError("no sensor is given", remedy=f"Give at least one of: {', '.join(SENSORS)}.")
    cameras = _cameras(motion, chosen, distance, azimuth, height)
    scene = SimulatedScene.of(motion)
    if room:
        middle = places(motion).mean(axis=0)
        farthest = max(cameras, key=lambda camera: float(np.linalg.norm(camera.centre_world - middle)))
        scene = SimulatedScene(motion, scene.mesh, room_around(motion, farthest))
    job = _Job(scene, Rig(tuple(cameras)), seed, step or (lambda what, done, total: None))
    remedy = "Give a folder that can be written, on a disk with free space."
    with _staged(folder, "the recording cannot be written", remedy) as staging:
        entries = [entry for sensor in chosen for entry in _write_sensor(job, sensor, chosen, staging)]
        write_calibration(job.rig, staging / "calibration.toml")
        _save(staging / "preview.png", preview(job.scene, job.rig, seed=seed))
        text = _take_text(_TITLE, motion, entries, str(body or motion.body.name))
        (staging / "take.toml").write_text(text, encoding="utf-8")
        if beside is not None:
            beside(staging)
    return folder / "take.toml"


@contextmanager
def _staged(folder: Path, problem: str, remedy: str) -> Iterator[Path]:
    """Give a temporary folder, whose files move into `folder` when the block ends well.

    Raises
    ------
    ExportError
        The problem and its remedy, where the system refuses.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as name:
            yield Path(name)
            _move(Path(name), folder)
    except OSError as error:  # PyAV's file errors are OSErrors too
        raise ExportError(f"{problem} ({error.strerror or error})", file=folder, remedy=remedy) from error


def _cameras(
    motion: Motion, chosen: Iterable[str], distance: float | None, azimuth: float, height: float
) -> list[Camera]:
    out = []

    def place(sensor: DepthSensor | ColourSensor, name: str) -> Camera:
        return in_front(
            motion, sensor.camera(name=name), distance=distance, azimuth=azimuth, height=height, near=sensor.near,
            far=sensor.far,
        )  # fmt: skip

    for name in chosen:
        if name in DEPTH_SENSORS:
            out.append(place(DEPTH_SENSORS[name], name))
        elif name == "stereo":
            out.extend(STEREO.pair(place(STEREO, "stereo_left")))
        elif "colour" not in [camera.name for camera in out]:
            out.append(place(COLOUR, "colour"))
    return out


def _write_sensor(job: _Job, sensor: str, chosen: Sequence[str], folder: Path) -> list[str]:
    """Write the files of one sensor; returns its entries of the take file."""
    if sensor in DEPTH_SENSORS:
        return _write_depth(job, DEPTH_SENSORS[sensor], folder)
    if sensor == "stereo":
        names = ("stereo_left", "stereo_right")
        for name in names:
            _write_video(job, name, STEREO, folder / f"{name}.mkv", grey=True)
        entries = [f'[[camera]]\nname = "{name}"\nvideo = "{name}.mkv"\n' for name in names]
        pair = f'[[stereo]]\nleft = "{names[0]}"\nright = "{names[1]}"\nsigma = {_DISPARITY_SIGMA}  # px\n'
        return [*entries, pair]
    if sensor == "colour":
        _write_video(job, "colour", COLOUR, folder / "colour.mp4", grey=False)
        return ['[[camera]]\nname = "colour"\nvideo = "colour.mp4"\n']
    entry = [] if "colour" in chosen else [f'[[camera]]\nname = "colour"\nsize = {list(COLOUR.size)}\n']
    return entry + [_write_keypoints(job, folder)]


def _write_depth(job: _Job, sensor: DepthSensor, folder: Path) -> list[str]:
    camera, motion = job.rig[sensor.name], job.scene.motion
    video = simulate_depth(motion, camera, sensor, seed=job.seed, scene=job.scene)
    (folder / sensor.name).mkdir()
    for frame in job.frames(sensor.name):
        counts = np.round(video.frame(frame).depth / _DEPTH_UNIT).astype(np.uint16)
        _save(folder / sensor.name / f"{frame:06d}.png", counts)
    distance = float(np.linalg.norm(places(motion).mean(axis=0) - camera.centre_world))
    return [
        f'[[depth]]\nname = "{sensor.name}"\nfile = "{sensor.name}"\n'
        f"unit = {_DEPTH_UNIT}\nrate = {float(motion.rate)}\n"
        f"range = [{sensor.near}, {sensor.far}]\nsigma = {float(sensor.sigma(distance)):.4f}\n"
    ]


def _save(path: Path, image: NDArray) -> None:
    if not cv2.imwrite(str(path), image):
        raise OSError(f"no image could be written to {path.name}")


def _write_video(job: _Job, name: str, sensor: ColourSensor, path: Path, *, grey: bool) -> None:
    camera = job.rig[name]
    images = (picture(job.scene, n, camera, sensor, grey=grey, seed=job.seed) for n in job.frames(name))
    write_video(path, images, job.scene.motion.rate, camera.size, lossless=grey)


def _write_keypoints(job: _Job, folder: Path) -> str:
    rig = Rig((job.rig["colour"],))
    (detected,) = simulate_keypoints(
        job.scene.motion, rig, "MEDIAPIPE_33", noise_px=_KEYPOINT_NOISE_PX, outliers=0.02, missing=0.05, seed=job.seed
    )
    return _write_landmarks(detected, folder)


def _write_landmarks(keypoints: Keypoints, folder: Path) -> str:
    """Write keypoints of one person in MediaPipe's format: x, y [px], visibility, all 0 for undetected ones.

    Returns
    -------
    str
        Their entry of a take file.
    """
    points = np.concatenate([keypoints.points[:, 0], keypoints.confidence[:, 0, :, None]], axis=-1)
    file = f"mediapipe_{keypoints.camera}.npy"
    np.save(folder / file, np.nan_to_num(points).astype(np.float32))
    return (
        f'[[keypoints]]\ncamera = "{keypoints.camera}"\nfile = "{file}"\nformat = "mediapipe"\n'
        f"sigma = {_KEYPOINT_SIGMA}\n"
    )


def preview(scene: SimulatedScene, rig: Rig, *, frame: int | None = None, seed: int = 0) -> NDArray:
    """Image (240, W, 3) BGR of one frame of all sensors of a recording, side by side; default: the middle frame.

    Depth is shown as colours: near red, far blue, black for pixels without depth.
    """
    from kinefit.exporters.pictures.drawing import depth_colours

    frame = len(scene.motion) // 2 if frame is None else frame
    points, images = places(scene.motion).reshape(len(scene.motion), -1, 3)[frame], []
    for camera in rig:
        if camera.name in DEPTH_SENSORS:
            video = simulate_depth(scene.motion, camera, DEPTH_SENSORS[camera.name], seed=seed, scene=scene)
            z = points @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
            image = depth_colours(video.frame(frame).depth, z.min() - 0.5, z.max() + 1.5)[..., ::-1]
        else:
            grey = camera.name != "colour"
            image = picture(scene, frame, camera, STEREO if grey else COLOUR, grey=grey, seed=seed)
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if grey else image
        size = (round(_PREVIEW_HEIGHT * camera.size[0] / camera.size[1]), _PREVIEW_HEIGHT)
        is_enlarged = camera.size[1] < _PREVIEW_HEIGHT
        images.append(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if is_enlarged else cv2.INTER_AREA))
    return np.hstack(images)


def _take_text(title: str, motion: Motion, entries: Sequence[str], body: str) -> str:
    """A take file of a simulated motion, with its calibration and entries, as text."""
    head = [
        f"# {title}\n",
        f"[take]\nname = {json.dumps(motion.name, ensure_ascii=False)}\nrate = {float(motion.rate)}\n"
        f'up = "{motion.up}"\nbody = {json.dumps(body, ensure_ascii=False)}\n',
        '[calibration]\nfile = "calibration.toml"\n',
    ]
    return "\n".join([*head, *entries])


def _move(staging: Path, folder: Path) -> None:
    """Move the new files into the folder; the old take file is removed first, the new one moved last."""
    (folder / "take.toml").unlink(missing_ok=True)
    for path in sorted(staging.iterdir(), key=lambda path: path.name == "take.toml"):
        target = folder / path.name
        if path.is_dir() and target.is_dir():
            for old in target.iterdir():  # frames of a longer recording; other files stay
                if _FRAME_FILE.fullmatch(old.name):
                    old.unlink()
            for new in path.iterdir():
                new.replace(target / new.name)
        else:
            shutil.move(path, target)


_IMAGE_SIZE = (544, 960)  # [px]
_FOUR_CAMERAS = "A simulated figure in four cameras. No recording of a person."


@checked
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
    remedy = "Give a folder that can be written, on a disk with 10 MB free."
    with _staged(folder, "the synthetic take cannot be written", remedy) as staging:
        entries = [f'[[camera]]\nname = "{camera}"\nvideo = "{camera}.mp4"\n' for camera in rig.names]
        for camera, keypoints in zip(rig, detections):
            figures = (draw_figure(motion, frame, camera) for frame in range(len(motion)))
            write_video(staging / f"{camera.name}.mp4", figures, motion.rate, camera.size)
            entries.append(_write_landmarks(keypoints, staging))
        write_calibration(rig, staging / "calibration.toml")
        text = _take_text(_FOUR_CAMERAS, motion, entries, motion.body.name)
        (staging / "take.toml").write_text(text, encoding="utf-8")
    return folder / "take.toml"


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
