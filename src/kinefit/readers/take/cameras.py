"""Cameras of a take: as calibrated, and how images relate to that; without calibration level, with a typical lens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import UP_AXES
from kinefit.errors import CalibrationError, TakeError, choices
from kinefit.geometry.camera import Camera, ImageFrame, Rig
from kinefit.readers.calibration.read import found_notes, read_calibration
from kinefit.readers.take.entries import CameraEntry, Take
from kinefit.readers.videos.video import Video

DEFAULT_FIELD_OF_VIEW = 64.0
"""[deg] across the longer side of the image by default: videos of telephones have some 60 to 70."""


@dataclass(frozen=True, eq=False)
class TakeCameras:
    """The cameras of a take, as the loaders of its sensors need them.

    Parameters
    ----------
    take : Take
    rig : Rig or None, as calibrated or as assumed.
    images : {camera: ImageFrame}
    clocks : {camera: (N,) [s] of its video's frames, from the first on}
    rates : {stream: [Hz]} of the streams that were loaded so far.
    streams : {stream: (N,) [s] in the take}, likewise.
    sizes : {camera: (width, height) [px] of its video}
    """

    take: Take
    rig: Rig | None
    images: Mapping[str, ImageFrame]
    clocks: Mapping[str, NDArray]
    rates: dict[str, float]
    streams: dict[str, NDArray]
    sizes: Mapping[str, tuple[int, int]]

    def offset(self, name: str) -> float:
        """Time offset [s] of a camera."""
        return next(entry.time_offset for entry in self.take.cameras if entry.name == name)

    def video(self, name: str) -> Video:
        """The opened video of a camera, which has one; raises what opening it raises."""
        path = next(entry.video for entry in self.take.cameras if entry.name == name)
        assert path is not None
        return Video(path, rate=self.take.rate)

    def size(self, name: str) -> tuple[int, int]:
        """(width, height) [px] of a camera's calibration."""
        assert self.rig is not None
        return self.rig[name].size

    def image_size(self, name: str) -> tuple[int, int]:
        """(width, height) [px] of a camera's delivered image."""
        entry = next(entry for entry in self.take.cameras if entry.name == name)
        size = self.size(name)
        return self.sizes.get(name) or entry.size or (size[::-1] if entry.rotation % 180 else size)

    @property
    def fastest(self) -> float | None:
        """Rate [Hz] of the take's steps, from its streams; None if unknown."""
        return self.take.rate or max(self.rates.values(), default=None)


def is_alone(take: Take) -> bool:
    """Whether a take has one camera, and no calibration; `check_take` admits no sensor of another world."""
    return take.calibration is None and len(take.cameras) == 1


def is_uncalibrated(take: Take) -> bool:
    """Whether a take has several cameras whose poses only the people in view can determine."""
    return take.calibration is None and len(take.cameras) > 1


def is_level(take: Take) -> bool:
    """Whether a calibration determines the vertical; cameras found from people or assumed level do not."""
    return not (is_alone(take) or (is_uncalibrated(take) or found_notes(take.calibration)))


def assumed_camera(entry: CameraEntry, size: tuple[int, int] | None, take: Take) -> Camera:
    """The camera as the take states it, else with default intrinsics.

    It looks level, along the axis before the vertical one: y where z is up, x where y is.

    Raises
    ------
    TakeError
        Nothing tells the size of its image.
    """
    if size is None:
        raise TakeError(
            "the size of the image is not stated", file=take.path, place=f"camera {entry.name}",
            remedy="Give the camera its video, or size = [width, height].",
        )  # fmt: skip
    width, height = size
    focal = 0.5 * max(size) / np.tan(np.radians(entry.field_of_view or DEFAULT_FIELD_OF_VIEW) / 2.0)
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    up = np.array(UP_AXES[take.up], float)
    ahead = np.roll(np.abs(up), -1)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(ahead, up), -up, ahead])
    return Camera(entry.name, size, matrix, T_camera_world=T)


def what_is_assumed(take: Take) -> list[str]:
    """What the report of a take with one camera and no calibration has to say; nothing of any other."""
    if not is_alone(take):
        return []
    entry = take.cameras[0]
    lens = f"a field of view of {entry.field_of_view or DEFAULT_FIELD_OF_VIEW:g}°"
    lens += "" if entry.field_of_view else ", the default"
    out = [
        f"camera {entry.name} is alone and not calibrated: it is assumed level, with {lens}; a field of view 10 % "
        "wider places the person 10 % nearer. Error bars do not include this."
    ]
    if take.height is None:
        out.append("no height is stated: lengths and distances are uncertain by about 9 %, as the person's size is")
    return out


def read_rig(take: Take, exteriors: bool = True) -> Rig | None:
    """The calibrated cameras that a take names; None where it has no calibration, or no cameras.

    Raises CalibrationError where the calibration lacks one of them.
    """
    if take.calibration is None or not (take.cameras or take.depth):
        return None
    sizes = partial(calibrated_size, take)
    rig = read_calibration(take.calibration.file, unit=take.calibration.unit, image_size=sizes, exteriors=exteriors)
    names = [entry.name for entry in take.cameras] + [entry.camera or entry.name for entry in take.depth]
    for name in names:
        if name not in rig:
            raise CalibrationError(
                choices("calibration of camera", name, rig.names), file=take.calibration.file,
                remedy=f"Correct the camera's name in {take.path.name}, or calibrate this camera too.",
            )
    return rig.select(tuple(dict.fromkeys(names)))


def calibrated_size(take: Take, name: str) -> tuple[int, int] | None:
    """(width, height) [px] of a camera's image, for a calibration that does not state it; None if unknown.

    It is that of the camera's video, or its `size`, unless the take says that the image is not the calibration's. A
    camera that the take leaves out has the size (1, 1), which is never used.
    """
    if name not in {one.camera or one.name for one in take.depth} | {one.name for one in take.cameras}:
        return 1, 1
    entry = next((entry for entry in take.cameras if entry.name == name), None)
    if entry is None or entry.image != "as calibrated":
        return None
    size = entry.size
    if entry.video is not None:
        with Video(entry.video, rate=take.rate or 1.0) as video:
            size = video.size
    return size[::-1] if size and entry.rotation % 180 else size


def stated_frame(image: ImageFrame, frame: str | None, kind: str) -> ImageFrame | None:
    """From the calibration's image to that in which a `kind` of points is, by its entry's `frame`; None: they are one.

    Raises TakeError where it matters and is not stated.
    """
    if np.allclose(image.T_image_calibration, np.eye(3), atol=1e-9):
        return None
    if frame is None:
        problem = f"the video's image is not the calibration's, and it is not stated which the {kind} use"
        raise TakeError(problem, remedy='Write frame = "calibration" or frame = "video".')
    return image if frame == "video" else None


def stated_rate(rate: float | None, file: Path | None = None) -> float:
    """A rate [Hz]; TakeError where there is none."""
    if rate is None:
        raise TakeError("the rate is not stated", file=file, remedy="Write rate = ... into [take].")
    return rate


def turned_frame(calibrated: tuple[int, int], size: tuple[int, int], degrees: int, image: str) -> ImageFrame:
    """Image frame of a video that was rotated clockwise [deg], then "scaled" or "letterboxed" (or neither)."""
    frame = ImageFrame.rotated(calibrated, degrees)
    turned = calibrated if degrees % 180 == 0 else calibrated[::-1]
    make = {"scaled": ImageFrame.scaled, "letterboxed": ImageFrame.letterboxed}.get(image)
    return frame.then(make(turned, size)) if make else frame


def image_frame(entry: CameraEntry, rig: Rig | None, video_size: tuple[int, int] | None, take: Take) -> ImageFrame:
    """How the image of a camera relates to the calibration's.

    Raises TakeError or CalibrationError, with the line to write, where the sizes do not agree.
    """
    assert rig is not None
    if video_size and entry.size and entry.size != video_size:
        raise TakeError(
            f"size = {list(entry.size)}, but the video has {video_size[0]}x{video_size[1]}", file=take.path,
            place=f"camera {entry.name}", remedy="Remove size: the video has its own.",
        )
    calibrated = rig[entry.name].size
    turned = calibrated if entry.rotation % 180 == 0 else calibrated[::-1]
    size = video_size or entry.size or turned
    if entry.image != "as calibrated" or size == turned:
        return turned_frame(calibrated, size, entry.rotation, entry.image)
    ratio = size[0] * turned[1] / (size[1] * turned[0])
    line = (
        "rotation = 90 (or 270)" if size == turned[::-1]
        else 'image = "scaled"' if abs(ratio - 1) < 0.002
        else 'image = "letterboxed" (bars were added) or image = "scaled" (it was stretched)'
    )
    raise CalibrationError(
        f"the image has {size[0]}x{size[1]} px, but the calibration is of {calibrated[0]}x{calibrated[1]} px",
        file=take.path, place=f"camera {entry.name}", remedy=f"State how the image came about: {line}.",
    )
