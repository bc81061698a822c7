"""Video files, frame-exact: one (`Video`) or several cameras in step (`VideoSet`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import FileError, ObservationError, choices

_FORWARD = 64  # frames that are decoded and dropped rather than sought over
_HIDDEN = ("vp8",)  # codecs with packets that show nothing, so that packets cannot be counted
_REMEDY = "Copy the file again from its source, or re-encode it."


class Video:
    """One video file, read by frame number in order of presentation.

    The frames are counted by walking through the file, not taken from its header; the display rotation that phones
    write beside the picture is applied.

    Parameters
    ----------
    path : path
        Whatever FFmpeg decodes.

    Raises
    ------
    FileError
        No such file, no video in it, or less in it than its header says; the message tells how many frames can be read.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileError("no such video", file=self.path, remedy="Check the path; relative paths start at the take.")
        self._container = _open(self.path)
        try:
            self._stream = self._container.streams.video[0]
            self._pts = _presentation_times(self.path)
            self._index = {pts: i for i, pts in enumerate(self._pts)}
            self._restart()
            first = self._decode(0)
            self._quarter_turns = round(_rotation(first) / 90) % 4
        except BaseException:
            self.close()
            raise
        height, width = (first.height, first.width) if self._quarter_turns % 2 == 0 else (first.width, first.height)
        self.size: tuple[int, int] = (width, height)
        self.rate: float = self._measure_rate()
        self._restart()

    def __len__(self) -> int:
        return len(self._pts)

    def __repr__(self) -> str:
        return f"Video({str(self.path)!r}: {len(self)} frames, {self.size[0]}x{self.size[1]}, {self.rate:g} Hz)"

    def __enter__(self) -> Video:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; reading afterwards is an error."""
        self._container.close()

    @property
    def times(self) -> NDArray:
        """(N,) [s] when each frame is shown, from the first frame; uneven where the rate varies."""
        return (np.array(self._pts) - self._pts[0]) * float(self._stream.time_base or 0)

    def read(self, i: int) -> NDArray[np.uint8]:
        """Frame `i` as (H, W, 3) uint8 RGB, upright."""
        if not 0 <= i < len(self):
            raise ObservationError(f"no frame {i}; there are 0 to {len(self) - 1}", file=self.path)
        image = self._decode(i).to_ndarray(format="rgb24")
        return np.ascontiguousarray(np.rot90(image, self._quarter_turns)) if self._quarter_turns else image

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[NDArray[np.uint8]]:
        """Frames `start` up to and without `stop` (default: the end), each as `read` gives them."""
        for i in range(start, len(self) if stop is None else stop):
            yield self.read(i)

    def _restart(self, i: int = 0) -> None:
        """Let the decoder continue at or before frame `i`."""
        if i:
            self._container.seek(self._pts[i], stream=self._stream, backward=True)
        else:
            self._container.close()
            self._container = _open(self.path)
            self._stream = self._container.streams.video[0]
            self._stream.thread_type = "AUTO"
        self._decoder = self._container.decode(self._stream)
        self._next = 0  # lower bound of the frame that comes next

    def _decode(self, i: int) -> Any:
        if not self._next <= i <= self._next + _FORWARD:
            self._restart(i)
        for attempt in ("here", "from the start"):
            try:
                for frame in self._decoder:
                    found = self._index.get(frame.pts)
                    if found is None or found < i:
                        continue
                    self._next = found + 1
                    if found == i:
                        return frame
                    break  # the seek overshot
            except (av.FFmpegError, ValueError) as error:
                if attempt != "here":
                    raise FileError(f"frame {i} cannot be decoded ({error})", file=self.path, remedy=_REMEDY) from error
            if attempt == "here":
                self._restart()
        raise FileError(f"frame {i} of {len(self)} is missing or damaged", file=self.path, remedy=_REMEDY)

    def _measure_rate(self) -> float:
        stated, span = float(self._stream.average_rate or 0), self.times[-1]
        measured = (len(self) - 1) / span if span > 0 else 0.0
        if not (stated or measured):
            raise FileError("the video tells no frame rate", file=self.path, remedy="Give it: ffmpeg -r RATE -i ...")
        return stated if stated and (not measured or abs(measured / stated - 1) < 0.02) else measured


class VideoSet:
    """Several cameras in step: for every common time one image per camera.

    Parameters
    ----------
    paths : {camera: path}
    time_offsets : {camera: float [s]}, optional
        Added to frame / rate to get the common time; 0 where not given. Each time takes the nearest frame.
    frames : (start, stop), optional
        Steps of the common time to use, t = step / rate; default is all that every camera saw.

    Raises
    ------
    ObservationError
        Streams of different rate or (without `frames`) of different length; the message tells each camera's.
    """

    def __init__(
        self,
        paths: Mapping[str, str | PathLike[str]],
        time_offsets: Mapping[str, float] | None = None,
        *,
        frames: tuple[int, int] | None = None,
    ) -> None:
        if not paths:
            raise ObservationError("no videos", remedy="Name at least one camera and its file.")
        for camera in time_offsets or {}:
            if camera not in paths:
                raise ObservationError(f"time offset: {choices('camera', camera, paths)}")
        self.videos: dict[str, Video] = {}
        try:
            for camera, path in paths.items():
                self.videos[camera] = Video(path)
            self.rate: float = next(iter(self.videos.values())).rate
            offsets = {c: (time_offsets or {}).get(c, 0.0) for c in paths}
            lengths = {c: len(video) for c, video in self.videos.items()}
            check_rates({c: video.rate for c, video in self.videos.items()})
            start, stop = common_frames(lengths, offsets, self.rate, frames)
        except BaseException:
            self.close()
            raise
        self.times: NDArray = np.arange(start, stop) / self.rate  # (N,) [s] of the take
        self._frames = {c: np.rint((self.times - offsets[c]) * self.rate).astype(int) for c in paths}

    def __len__(self) -> int:
        return len(self.times)

    def __enter__(self) -> VideoSet:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def __iter__(self) -> Iterator[dict[str, NDArray[np.uint8]]]:
        return (self.read(i) for i in range(len(self)))

    def close(self) -> None:
        """Close all files."""
        for video in self.videos.values():
            video.close()

    def read(self, i: int) -> dict[str, NDArray[np.uint8]]:
        """{camera: (H, W, 3) uint8 RGB} at `times[i]`."""
        if not 0 <= i < len(self):
            raise ObservationError(f"no step {i}; there are 0 to {len(self) - 1}", place="videos")
        return {camera: video.read(int(self._frames[camera][i])) for camera, video in self.videos.items()}


def check_rates(rates: Mapping[str, float], *, file: str | PathLike[str] | None = None) -> None:
    """Refuse streams whose rates [Hz] differ by more than 0.1 %."""
    if max(rates.values()) > 1.001 * min(rates.values()):
        listed = ", ".join(f"{name} {rate:.6g} Hz" for name, rate in rates.items())
        raise ObservationError(
            f"streams of different rate: {listed}", file=file,
            remedy="Correct rate = ... of [[keypoints]], or resample the videos: ffmpeg -i IN -r RATE OUT.",
        )


def common_frames(
    lengths: Mapping[str, int],
    time_offsets: Mapping[str, float],
    rate: float,
    frames: tuple[int, int] | None = None,
    *,
    file: str | PathLike[str] | None = None,
) -> tuple[int, int]:
    """Steps (start, stop) of the common time t = step / rate at which every stream has a frame.

    Raises ObservationError where streams of different length come without `frames`, or `frames` exceeds what all saw.
    """
    begins = {name: round(time_offsets.get(name, 0.0) * rate) for name in lengths}
    start, stop = max(begins.values()), min(begins[name] + n for name, n in lengths.items())
    shifts = {name: f" from step {begin}" if begin else "" for name, begin in begins.items()}
    listed = ", ".join(f"{name} {n} frames{shifts[name]}" for name, n in lengths.items())
    if start >= stop:
        raise ObservationError(f"no time that all streams saw: {listed}", file=file, remedy="Check the time offsets.")
    if frames is None:
        if len(set(lengths.values())) > 1:
            raise ObservationError(
                f"streams of different length: {listed}", file=file,
                remedy=f"If they start together, take what all saw: frames = [{start}, {stop}].",
            )
        return start, stop
    if not start <= frames[0] < frames[1] <= stop:
        raise ObservationError(
            f"frames [{frames[0]}, {frames[1]}] are not in every stream: {listed}", file=file,
            remedy=f"All saw frames = [{start}, {stop}].",
        )
    return frames


def _open(path: Path) -> Any:
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError, ValueError) as error:
        raise FileError(f"not a readable video, 0 frames ({_reason(error)})", file=path, remedy=_REMEDY) from error
    if not container.streams.video:
        container.close()
        raise FileError("there is no video stream in this file", file=path, remedy="Name a video file.")
    return container


def _reason(error: Exception) -> str:
    """What FFmpeg says, without its error number and the path."""
    return str(getattr(error, "strerror", None) or error)


def _presentation_times(path: Path) -> list[int]:
    """Times of all frames that are shown, sorted, in the stream's time base."""
    pts: list[int | None] = []
    packets, problem = 0, ""
    with _open(path) as container:
        stream = container.streams.video[0]
        stated, rate, base = stream.frames, float(stream.average_rate or 0), float(stream.time_base or 0)
        if not stated and len(container.streams) == 1 and container.duration and container.size > 0:
            stated = int(container.duration / av.time_base * rate * 0.98) - 2  # of the duration, which is rounded
        try:
            for packet in container.demux(stream):
                if packet.size and packet.is_corrupt:
                    problem = problem or "damaged packet"
                elif packet.size:
                    packets += 1
                    if not packet.is_discard:
                        pts.append(packet.pts)
        except (av.FFmpegError, ValueError) as error:
            problem = str(error)
        hidden = stream.codec_context.name in _HIDDEN
    if problem or packets < stated:
        told = f" of {stated}" if stated > packets else ""
        raise FileError(
            f"the video is truncated: {packets}{told} frames can be read" + (f" ({problem})" if problem else ""),
            file=path, remedy="Copy the file again, or keep its readable part: ffmpeg -i IN -c copy OUT.",
        )
    if hidden or None in pts or len(set(pts)) < len(pts) or not base:
        pts = _decoded_times(path)
    if not pts:
        raise FileError("no frame of this video can be decoded", file=path, remedy=_REMEDY)
    return sorted(pts)  # type: ignore[type-var,arg-type]


def _decoded_times(path: Path) -> list[int | None]:
    with _open(path) as container:
        try:
            pts = [frame.pts for frame in container.decode(video=0)]
        except (av.FFmpegError, ValueError) as error:
            raise FileError(f"the video cannot be decoded ({error})", file=path, remedy=_REMEDY) from error
    if None in pts or len(set(pts)) < len(pts):
        raise FileError("frames without times", file=path, remedy="Repack it: ffmpeg -i IN -c copy OUT.mp4.")
    return pts


def _rotation(frame: Any) -> float:
    """Counterclockwise rotation [deg] that the file asks for."""
    data = frame.side_data.get("DISPLAYMATRIX")  # by name: PyAV up to 18 iterates over values, from 19 on over keys
    if data is None:
        return 0.0
    a, b = np.frombuffer(bytes(data), np.int32)[:2]
    return float(-np.degrees(np.arctan2(b, a)))
