"""Real recordings as takes that can be made wrong, and all that `kinefit track` can run with their right files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, data
from benchmarks.tracking import DETECTORS, TRIAL, take_text
from kinefit.errors import AssetError, ObservationError
from kinefit.fitting.multiview.followed import follow
from kinefit.geometry.camera import Rig
from kinefit.observations import MEDIAPIPE_33
from kinefit.readers.assets import write_sample_take
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.takes.missing import prepared

_CAMERA = '[[camera]]\nname = "{0}"\nsize = [{1}, {2}]\n'
_KEYPOINTS = '[[keypoints]]\ncamera = "{0}"\nfile = "{0}.npy"\nformat = "mediapipe"\nframe = "calibration"\n'
_MARKERS = ("markers", "markers_pycgm", "markers_bmc_run", "forces_nimblephysics")
_Y_UP = ("data__c3d__nick_freeform_001", "data__c3d__squat")  # C3D files whose y points up, by their people
_SR305 = "intrinsics = [476.007, 476.007, 313.683, 242.755]\nunit = 0.000125\n"
_KINECT = "intrinsics = [577.0, 577.0, 320.0, 240.0]\nsize = [640, 480]\n"


@dataclass(frozen=True)
class Inputs:
    """One person's keypoints and the cameras: what a take is written of.

    Parameters
    ----------
    name : of the recording
    rig, points : Rig of C cameras; of each (F, 33, 3) [px, px, confidence] in the calibration's image
    rate, up : of the take
    shifted : the camera whose x is negated; turn : [deg] of a camera; late : frames
    is_off : whether its calibration is known to be off, so that biases are no false alarm
    boxed : {camera: video} of letterboxed images, `image` what the take says of them
    """

    name: str
    rig: Rig
    points: tuple[NDArray, ...]
    rate: float
    up: str
    shifted: int = 1
    turn: float = 5.0
    late: int = 5
    is_off: bool = False
    boxed: tuple[tuple[str, Path], ...] = ()
    image: str = "letterboxed"
    unit: str = "m"
    names: tuple[str, ...] = MEDIAPIPE_33

    @property
    def wrong_up(self) -> str:
        """Another axis."""
        return {"z": "y", "x": "z"}[self.up]

    def write(self, folder: Path) -> Path:
        """A take of its own in a new folder."""
        folder.mkdir(parents=True)
        write_calibration(self.rig, folder / "calibration.toml")
        text = f'[take]\nrate = {self.rate}\nup = "{self.up}"\nframes = [0, {min(map(len, self.points))}]\n'
        text += f'[calibration]\nfile = "calibration.toml"\nunit = "{self.unit}"\n'
        for camera, points in zip(self.rig, self.points, strict=True):
            video = dict(self.boxed).get(camera.name)
            text += _CAMERA.format(camera.name, *camera.size) if video is None else (
                f'[[camera]]\nname = "{camera.name}"\nvideo = "{video}"\nimage = "{self.image}"\n'
            )
            text += _KEYPOINTS.format(camera.name)
            np.save(folder / f"{camera.name}.npy", points)
        (folder / "take.toml").write_text(text, encoding="utf-8")
        return folder / "take.toml"


def recordings(where: Path) -> Iterator[Inputs]:
    """Those of which all parts are there; the videos are looked through by the built-in detector."""
    trial, landmarks = data(TRIAL), data("mv4_landmarks_caliscope")
    seated, two = amount((data("mv4_upperbody_caliscope"), data("video_two_people_4cam")), (None, None))
    if trial is not None:
        boxed = tuple((name, trial / "videos" / f"{name}.mp4") for name in ("cam01", "cam02"))
        yield _read(where, "balancing", take_text(trial, "mediapipe"), boxed=boxed)
    if landmarks is not None and not amount(False, True):
        text = f'[take]\nrate = 30.0\nup = "x"\n[calibration]\nfile = "{landmarks}/config.toml"\n' + "".join(
            f'[[camera]]\nname = "cam_{c}"\n[[keypoints]]\ncamera = "cam_{c}"\nformat = "caliscope"\n'
            'set = "MEDIAPIPE_33"\n'
            f'file = "{landmarks}/HOLISTIC/xy_HOLISTIC.csv"\n' for c in range(4)
        )  # fmt: skip
        yield _read(where, "landmarks", text, shifted=2, turn=10.0, late=20)  # its second camera is the origin
    for name, folder, rate, cameras, text in (
        ("seated", seated, 6.0, [(f"cam_{c}", f"port_{c}") for c in range(4)], "config.toml"),
        ("two people", two, 60.0, [(f"cam0{c}", f"cam0{c}") for c in range(1, 5)], "Calib.qca.txt"),
    ):
        if folder is not None:
            take = f'[take]\nrate = {rate}\n[calibration]\nfile = "{folder}/{text}"\n' + "".join(
                f'[[camera]]\nname = "{camera}"\nvideo = "{folder}/{video}.mp4"\n' for camera, video in cameras
            )
            try:
                yield _read(where, name, take, is_off=name == "two people")
            except (AssetError, ObservationError) as error:
                print(f"# {name}: left out ({error.problem})")


def _read(where: Path, name: str, text: str, **more: object) -> Inputs:
    path = where / f"{name.replace(' ', '_')}.toml"
    path.write_text(text, encoding="utf-8")
    take = prepared(read_take(path))
    seen = load_observations(take)
    assert seen.rig is not None
    own = follow(seen.rig, seen.keypoints, "moving").keypoints
    points = tuple(_of_file(k.points[:, 0], k.confidence[:, 0]) for k in own)
    rig = seen.rig.select(tuple(k.camera for k in own))
    return Inputs(name, rig, points, seen.rate, take.up, **more)  # type: ignore[arg-type]


def _of_file(uv: NDArray, confidence: NDArray) -> NDArray:
    """(F, 33, 3) as MediaPipe's arrays have it: what is unseen has no confidence."""
    seen = np.isfinite(uv).all(axis=-1)
    return np.concatenate([np.where(seen[..., None], uv, 0.0), np.where(seen, confidence, 0.0)[..., None]], axis=-1)


def right_takes(where: Path) -> Iterator[tuple[str, Path]]:
    """Takes of all other recordings with their right files: another detector, the demo, markers, depth, one camera."""
    trial = data(TRIAL)
    texts = {} if trial is None else {f"balancing {d}": take_text(trial, d) for d in DETECTORS}
    for folder in filter(None, map(data, _MARKERS)):
        for file in sorted([*folder.rglob("*.c3d"), *folder.rglob("*.trc")]):
            up = "y" if file.suffix == ".trc" or file.stem in _Y_UP else "z"
            text = f'[take]\nup = "{up}"\nframes = [0, 25]\n[[markers]]\nfile = "{file}"\n'
            texts[f"markers {folder.name} {file.stem}"] = text
    for name, files, lines in (
        ("depth_sr305_upperbody", "*-231615/*.png", _SR305), ("depth_skeltrack_kinect1", "depth-data-*", _KINECT)
    ):  # fmt: skip
        folder = data(name)
        if folder is not None:
            depth = f'[[depth]]\nname = "depth"\nfile = "{folder}/{files}"\n{lines}'
            texts[name] = f'[take]\nrate = 5.0\nup = "-y"\n{depth}'
    mono = data("video_mono_opencap")
    for trial_name in ("STS", "walk_ts") if mono is not None else ():
        video = f'[[camera]]\nname = "cam"\nvideo = "{mono}/{trial_name}/video.mp4"\n'
        texts[f"one camera {trial_name}"] = f'[take]\nup = "y"\nframes = [0, 60]\n{video}'
    for number, (name, text) in enumerate(texts.items()):
        folder = where / f"right-{number}"
        folder.mkdir()
        (folder / "take.toml").write_text(text, encoding="utf-8")
        yield name, folder / "take.toml"
    try:
        yield "demo", write_sample_take(where / "demo")
    except AssetError as error:
        print(f"# demo: left out ({error.problem})")
