"""Depth in recordings of sensors: Azure Kinect MKV (and any 16-bit grey video), RealSense bag."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError, FileError, KinefitError, ObservationError, extra, names_file
from kinefit.geometry.camera import Camera
from kinefit.readers.depth.images import DepthSource
from kinefit.readers.videos.video_files import open_container

# Depth modes of the Azure Kinect: size [px] -> (width of the binned sensor, offset of the crop) [px]; source: Azure
# Kinect Sensor SDK, mode_specific_calibration.c.
_AZURE_MODES = {(320, 288): (512, (96, 90)), (640, 576): (1024, (192, 180)), (512, 512): (512, (0, 0)),
                (1024, 1024): (1024, (0, 0))}  # fmt: skip
_GREY = ("gray16le", "gray16be", "gray12le", "gray10le", "gray14le")


class _StreamTrack:
    """Frames of one track of a container, by number in order of time."""

    def __init__(self, path: Path, index: int, raw: bool, times: list[int]) -> None:
        self._path, self._index, self._raw, self._times = path, index, raw, times
        self._container: Any = None
        self._items: Iterator[tuple[int | None, Any]] = iter(())
        self._next = -1

    def __call__(self, i: int) -> NDArray:
        if i != self._next:
            self._seek(i)
        try:
            for pts, item in self._items:
                if pts == self._times[i]:
                    self._next = i + 1
                    return self._counts(item, i)
                if pts is None or pts > self._times[i]:
                    break
        except av.FFmpegError as error:
            raise FileError(f"cannot be decoded ({error})", file=self._path, place=f"frame {i}") from error
        raise FileError("frame cannot be found again", file=self._path, place=f"frame {i}", remedy="Copy it again.")

    def _seek(self, i: int) -> None:
        if self._container is None:
            self._container = open_container(self._path)
        stream = self._container.streams[self._index]
        self._container.seek(self._times[i], stream=stream, backward=True)
        packets = self._container.demux(stream)
        if self._raw:
            self._items = ((packet.pts, packet) for packet in packets)
        else:  # frames may depend on those before them, back to the last key frame
            self._items = ((frame.pts, frame) for packet in packets for frame in packet.decode())

    def _counts(self, item: Any, i: int) -> NDArray:
        if not self._raw:
            return item.to_ndarray(format="gray16le").astype(np.float32)
        codec = self._container.streams[self._index].codec_context
        data = bytes(item)
        if len(data) != 2 * codec.width * codec.height:
            raise FileError(
                f"{len(data)} bytes for {codec.width}x{codec.height} px", file=self._path, place=f"frame {i}",
                remedy="The recording is damaged here: cut it before this frame.",
            )  # fmt: skip
        return np.frombuffer(data, ">u2").reshape(codec.height, codec.width).astype(np.float32)


@names_file
def track_source(path: Path, name: str) -> DepthSource:
    """Source of an Azure Kinect recording, or of any lossless video of one 16-bit grey channel.

    Raises
    ------
    FileError
        No readable video, no depth track, or no frames.
    ObservationError
        A video that is no depth.
    CalibrationError
        An attached calibration that cannot be read.
    """
    try:
        with open_container(path) as container:
            stream = _depth_stream(container)
            index, base = stream.index, float(stream.time_base)
            codec = stream.codec_context
            if codec is None:
                raise FileError("a codec that FFmpeg does not know", remedy="Copy the recording again.")
            size, raw = (codec.width, codec.height), codec.codec_tag.lower() == "b16g"
            pixels = None if codec.format is None else codec.format.name  # old PyAV has no `pix_fmt` then
            if not raw and pixels not in _GREY:
                remedy = "Give 16-bit grey (FFV1 gray16le) or the depth track of an Azure Kinect recording."
                raise ObservationError(f"its video is {codec.name} {pixels}, not depth", remedy=remedy)
            rate = float(stream.average_rate or 0) or None
            camera = _azure_camera(container, name, size)
            times = sorted({p.pts for p in container.demux(stream) if p.size and p.pts is not None})
    except (av.FFmpegError, OSError, ValueError) as error:
        raise FileError(f"not a readable video ({error})", remedy="Copy it again.") from error
    if not times:
        raise FileError("its depth track has no frames", remedy="Record for longer.")
    seconds = np.array(times) * base
    return DepthSource(
        len(times), _StreamTrack(path, index, raw, times), size, 0.001, camera is not None, seconds - seconds[0],
        camera, rate,
    )  # fmt: skip


def has_depth_track(path: Path) -> bool:
    """Whether a container has a video track that its recorder names as depth."""
    try:
        with open_container(path) as container:
            return any(map(_is_named_depth, container.streams.video))
    except KinefitError:
        return False


def _is_named_depth(stream: Any) -> bool:
    return stream.metadata.get("title", "").upper() == "DEPTH" or "K4A_DEPTH_MODE" in stream.metadata


def _depth_stream(container: Any) -> Any:
    videos = container.streams.video
    if named := list(filter(_is_named_depth, videos)):
        return named[0]
    if len(videos) == 1:
        return videos[0]
    titles = ", ".join(s.metadata.get("title", f"track {s.index}") for s in videos) or "none"
    raise FileError(f"no depth track; its video tracks: {titles}", remedy="Record with the depth camera on.")


def _azure_camera(container: Any, name: str, size: tuple[int, int]) -> Camera | None:
    """Depth camera from the attached calibration, at the origin; None without one.

    Parameters are cx cy fx fy, as shares of the sensor's size with (0, 0) its corner, k1..k6, the centre of distortion
    (0), p2, p1. The Brown-Conrady model is OpenCV's rational one; "Rational6KT" has half its tangential terms' mixed
    part, which these sensors set to nearly zero.
    """
    attached = [bytes(s.data) for s in container.streams if s.type == "attachment" and getattr(s, "data", None)]
    text = next((data for data in attached if b"CalibrationInformation" in data), None)
    if text is None:
        return None
    try:
        cameras = json.loads(text.rstrip(b"\0"))["CalibrationInformation"]["Cameras"]
        intrinsics = next(c["Intrinsics"] for c in cameras if c["Location"] == "CALIBRATION_CameraLocationD0")
        cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = [float(v) for v in intrinsics["ModelParameters"][:14]]
    except (ValueError, KeyError, TypeError, StopIteration, RecursionError) as error:
        raise CalibrationError(
            f"its attached calibration cannot be understood ({error})", remedy="Give intrinsics."
        ) from error
    if size not in _AZURE_MODES:
        raise CalibrationError(f"no depth mode of an Azure Kinect has {size} px", remedy="Give intrinsics.")
    binned, (u, v) = _AZURE_MODES[size]
    K = [[fx * binned, 0, cx * binned - u - 0.5], [0, fy * binned, cy * binned - v - 0.5], [0, 0, 1]]
    return Camera(name, size, K, (k1, k2, p1, p2, k3, k4, k5, k6))  # type: ignore[arg-type]


class _Bag:
    """Depth frames of a RealSense recording, by number; going back restarts it."""

    def __init__(self, rs: Any, path: Path) -> None:
        self._rs, self._path, self._next = rs, path, 0
        self._pipe: Any = None

    def start(self) -> Any:
        """Start playing as fast as possible; returns the pipeline's profile."""
        self.stop()
        config, self._pipe = self._rs.config(), self._rs.pipeline()
        config.enable_device_from_file(str(self._path), repeat_playback=False)
        profile = self._pipe.start(config)
        profile.get_device().as_playback().set_real_time(False)
        self._next = 0
        return profile

    def stop(self) -> None:
        """Close the file."""
        if self._pipe is not None:
            self._pipe.stop()
            self._pipe = None

    def frames(self) -> Iterator[Any]:
        """All remaining depth frames."""
        while self._pipe is not None:
            ok, both = self._pipe.try_wait_for_frames(2000)
            if not ok:
                return
            frame = both.get_depth_frame()
            if frame:
                self._next += 1
                yield frame

    def __call__(self, i: int) -> NDArray:
        if self._pipe is None or i < self._next:
            self.start()
        for frame in self.frames():
            if self._next == i + 1:
                return np.asanyarray(frame.get_data()).astype(np.float32)
        raise FileError("the recording ends before", file=self._path, place=f"frame {i}", remedy="Copy it again.")


@names_file
def bag_source(path: Path, name: str) -> DepthSource:
    """Source of a RealSense .bag, read by Intel's library.

    Raises
    ------
    FileError
        The library is not installed, or the recording cannot be read.
    CalibrationError
        A lens model that OpenCV lacks.
    """
    with extra("realsense", "a RealSense recording needs Intel's library", FileError):
        import pyrealsense2 as rs
    bag = _Bag(rs, path)
    try:
        profile = bag.start()
        lens = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
        unit = float(profile.get_device().first_depth_sensor().get_depth_scale())
        times = [frame.get_timestamp() * 1e-3 for frame in bag.frames()]
    except RuntimeError as error:
        raise FileError(f"no depth can be read from it ({error})", remedy="Record it again.") from error
    finally:
        bag.stop()
    K = [[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]]
    if any(lens.coeffs) and lens.model != rs.distortion.brown_conrady:
        raise CalibrationError(f"lens model {lens.model}", remedy="Give intrinsics of the undistorted depth image.")
    camera = Camera(name, (lens.width, lens.height), K, lens.coeffs if any(lens.coeffs) else ())  # type: ignore[arg-type]
    seconds = np.array(times)
    return DepthSource(len(times), bag, camera.size, unit, True, seconds - seconds[:1], camera)
