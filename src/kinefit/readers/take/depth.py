"""Depth sensors of a take: their recordings, and the cameras that they are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from kinefit.errors import CalibrationError, TakeError
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations.videos import CloudVideo, DepthVideo
from kinefit.readers.depth.recordings import is_unordered, read_clouds, read_depth
from kinefit.readers.take.cameras import TakeCameras
from kinefit.readers.take.entries import DepthEntry

_MAX_RATE_DIFFERENCE = 0.01  # rates that differ by less are one


def depth_notes(videos: Iterable[DepthVideo | CloudVideo], rate: float) -> Iterator[str]:
    """How the times of depth differ from those of the take [Hz]: other rates, frames that are missing."""
    for video in videos:
        if abs(video.rate / rate - 1.0) > _MAX_RATE_DIFFERENCE:
            yield (
                f"depth {video.sensor} has {video.rate:.4g} Hz, the take {rate:.4g} Hz: "
                "each depth image counts at the step nearest to it"
            )
        if len(video.gaps):
            first = int(video.gaps[0])
            gap = video.times[first] - video.times[first - 1]
            yield (
                f"depth {video.sensor} lacks frames in {len(video.gaps)} places, the first before frame {first} "
                f"({gap:.3g} s instead of {1.0 / video.rate:.3g} s)"
            )


def load_depth(entry: DepthEntry, cameras: TakeCameras) -> DepthVideo | CloudVideo:
    """A `[[depth]]` of a take, with its camera; rates of other streams are for recordings that do not state theirs.

    Raises
    ------
    CalibrationError
        Nothing states the sensor's intrinsics, or its images have another size than its calibration.
    TakeError, ObservationError, FileError
        As `read_depth`.
    """
    usual = cameras.take.rate or next(iter(cameras.rates.values()), None)
    assert entry.file is not None
    if is_unordered(entry.file):
        return _clouds(entry, cameras.rig, usual)
    video = _video(entry, usual)
    return replace(video, camera=_camera(entry, video, cameras.rig))


def _clouds(entry: DepthEntry, rig: Rig | None, rate: float | None) -> CloudVideo:
    odd = [key for key in ("size", "intrinsics", "background") if getattr(entry, key) is not None]
    if odd:
        raise TakeError(f"'{odd[0]}' has no use with clouds of points", remedy="Remove it.")
    assert entry.file is not None
    camera = entry.camera or entry.name
    clouds = read_clouds(
        entry.file, sensor=entry.name, unit=entry.unit or 1.0, rate=entry.rate, default_rate=rate,
        range=entry.range or (0.0, np.inf), time_unit=entry.time_unit, time_offset=entry.time_offset,
        T_world_sensor=rig[camera].T_world_camera if rig is not None else None,
    )  # fmt: skip
    return replace(clouds, on_body=entry.on_body or entry.segment is not None, segment=entry.segment)


def _video(entry: DepthEntry, rate: float | None) -> DepthVideo:
    if entry.segment is not None:
        problem = "'segment' is for clouds of points, but these are images"
        raise TakeError(problem, remedy="Give one PCD or PLY file a frame, of the points on this segment alone.")
    assert entry.file is not None
    given: dict[str, Any] = {"sensor": entry.name, "unit": entry.unit, "size": entry.size}
    video = read_depth(
        entry.file, rate=entry.rate, default_rate=rate, range=entry.range or (0.0, np.inf), time_unit=entry.time_unit,
        time_offset=entry.time_offset, **given,
    )  # fmt: skip
    if entry.size is not None and tuple(video.size) != tuple(entry.size):
        problem = f"size = {list(entry.size)}, but the images have {video.size[0]}x{video.size[1]} px"
        raise TakeError(problem, remedy="Remove size: it is for raw files.")
    background = read_depth(entry.background, **given) if entry.background is not None else None
    return replace(video, background=background, on_body=entry.on_body)


def stated_camera(entry: DepthEntry, size: tuple[int, int] | None, rig: Rig | None) -> Camera | None:
    """A sensor's camera for images of a size [px]: of the calibration, or of its intrinsics in the take; None for none.

    Raises
    ------
    CalibrationError
        A camera that is not calibrated, or at another size.
    TakeError
        A principal point outside of the image.
    """
    if rig is not None:
        camera = replace(rig[entry.camera or entry.name], name=entry.name)
        if size is not None and camera.size != tuple(size):
            raise CalibrationError(
                f"its images have {size[0]}x{size[1]} px, its calibration is of {camera.size}",
                remedy="Calibrate it at the size that it records in.",
            )  # fmt: skip
        return camera
    if entry.intrinsics is None or size is None:
        return None
    fx, fy, cx, cy = entry.intrinsics
    camera = Camera(entry.name, size, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], entry.distortion)  # type: ignore[arg-type]
    if not (0 < cx < size[0] and 0 < cy < size[1]):
        raise TakeError(
            f"principal point ({cx:g}, {cy:g}) outside of {size[0]}x{size[1]} px",
            remedy="Give intrinsics = [fx, fy, cx, cy] of images of this size.",
        )  # fmt: skip
    return camera


def _camera(entry: DepthEntry, video: DepthVideo, rig: Rig | None) -> Camera:
    """The sensor's camera: as it is stated, or of the recording itself."""
    if (stated := stated_camera(entry, video.size, rig)) is not None:
        return stated
    if video.camera is None:
        raise CalibrationError(
            "nothing states its intrinsics",
            remedy="Write intrinsics = [fx, fy, cx, cy] [px], or add [calibration] with a camera of this name.",
        )  # fmt: skip
    return replace(video.camera, name=entry.name)
