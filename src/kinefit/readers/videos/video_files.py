"""Frame-exact decoding of video files by FFmpeg; the reader of `Video` for files."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular
from kinefit._image_headers import MAX_IMAGE_PIXELS
from kinefit._pictures import check_image_size
from kinefit.errors import FileError
from kinefit.observations.clocks import is_even, nominal_rate

_MAX_SKIPPED_FRAMES = 64  # decoded and dropped; over more, seeking is faster
_MIN_CHUNKS_SHARE = 0.9  # of an AVI that its chunks fill; an unfinished one has a size of 0 there
_CODECS_WITH_HIDDEN_FRAMES = ("vp8",)  # their packets cannot be counted: some show nothing
_MIN_MPEG4_BYTES = 10  # of a frame; less says only that it repeats the one before, and nothing is decoded
_CAPTURE_RATE = "com.android.capture.fps"
_MAX_CAPTURE_ERROR = 0.1  # of the stored rate: a telephone's rate varies
_MIN_SLOW_MOTION_HZ = 100.0  # telephones capture it at 120 or more; at 60 Hz they leave out frames where it is dark
_MAX_TIME_LAPSE = 0.6  # of the stored rate
_TIME_CODE = re.compile(r"(\d\d):(\d\d):(\d\d)([:;.])(\d\d)")
_REMEDY = "Copy the file again from its source, or re-encode it."


class VideoFile:
    """One video file, whose frames are counted by reading all packets, as headers may be wrong."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._container = _open(path)
        try:
            self._stream = self._container.streams.video[0]
            self._pts, shown = _presentation_times(self.path)
            self._index = {pts: i for i, pts in enumerate(self._pts)}
            self._restart()
            first = self._decode(0)
            self._display = _display_axes(first, path)
        except BaseException:
            self.close()
            raise
        size = first.width, first.height
        self.size: tuple[int, int] = size[::-1] if self._display[0] else size
        self.times: NDArray = (np.array(shown) - shown[0]) * float(self._stream.time_base or 0)
        self.rate: float = self._measure_rate()
        self.note = ""
        captured = _capture_rate(self._container)
        if captured is not None and abs(captured / self.rate - 1.0) > _MAX_CAPTURE_ERROR:
            stated = f"captured at {captured:.6g} Hz as the file states ({_CAPTURE_RATE}), stored at {self.rate:.6g} Hz"
            self.note = f"{stated}: times are those of playing; frames left out in the dark and slow motion look alike"
            if captured < _MAX_TIME_LAPSE * self.rate or captured > max(_MIN_SLOW_MOTION_HZ, 1.9 * self.rate):
                kind = "slow motion" if captured > self.rate else "time lapse"
                self.note = f"{kind}: {stated}; times are those of the capture"
                self.times, self.rate = self.times * (self.rate / captured), captured
        self._restart()

    def __len__(self) -> int:
        return len(self._pts)

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def image(self, i: int) -> NDArray[np.uint8]:
        """Frame `i` as (H, W, 3) uint8 RGB, upright."""
        return _upright(self._decode(i), self._display)

    def _restart(self, i: int = 0) -> None:
        """Restart the decoder at or before frame `i`."""
        if i:
            self._container.seek(self._pts[i], stream=self._stream, backward=True)
        else:
            self._container.close()
            self._container = _open(self.path)
            self._stream = self._container.streams.video[0]
            self._stream.thread_type = "AUTO"
        self._decoder = _frames(self._container)
        self._next = 0  # lower bound of the frame that comes next

    def _decode(self, i: int) -> Any:
        if not self._next <= i <= self._next + _MAX_SKIPPED_FRAMES:
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
            raise FileError("the video states no frame rate", file=self.path, remedy="Give it: ffmpeg -r RATE -i ...")
        even = (rate for rate in (stated, measured) if rate and is_even(self.times, rate))
        return next(even, 0.0) or nominal_rate(self.times)


def _capture_rate(container: Any) -> float | None:
    """Rate [Hz] at which a telephone captured the frames, as the file states it; None where it does not."""
    try:
        rate = float(container.metadata.get(_CAPTURE_RATE, "nan"))
    except ValueError:
        return None
    return rate if 0.0 < rate < 1e5 else None


def stated_time_code(path: Path, rate: float) -> tuple[float, str] | None:
    """Time [s] and text of the first frame's time code; None of a video file without one.

    Parameters
    ----------
    rate : float [Hz] of the video. Codes count whole frames of the next whole rate, so that their seconds last longer
        at 29.97 Hz; drop-frame codes (29.97 and 59.94 Hz, with a semicolon) leave out numbers to make up for that.
    """
    if not path.is_file():
        return None
    with _open(path) as container:
        holders = [stream.metadata for stream in container.streams] + [container.metadata]
        text = next((found["timecode"] for found in holders if "timecode" in found), "")
    parts = _TIME_CODE.fullmatch(text)
    if parts is None:
        return None
    hours, minutes, seconds, frames = (int(parts[k]) for k in (1, 2, 3, 5))
    count = ((60 * hours + minutes) * 60 + seconds) * round(rate) + frames
    if parts[4] in ";.":
        whole = 60 * hours + minutes
        count -= round(rate / 15.0) * (whole - whole // 10)
    return count / rate, text


def first_image(path: Path) -> NDArray[np.uint8]:
    """The first image (H, W, 3) of a video file, RGB and upright; its frames are not counted, however long it is.

    Raises
    ------
    FileError
        Not readable, or no image in it.
    """
    container = _open(path)
    try:
        frame = next(_frames(container))
    except (av.FFmpegError, StopIteration, ValueError) as error:
        raise FileError(f"no image can be decoded ({error})", file=path, remedy=_REMEDY) from error
    finally:
        container.close()
    return _upright(frame, _display_axes(frame, path))


def image_at(
    path: Path, share: float, *, start: float = 0.0, stop: float | None = None, timeout: float = 0.1
) -> NDArray[np.uint8]:
    """An image (H, W, 3) about a share of the way through a video file, RGB and upright.

    No frame is counted, and what lies between two key frames is decoded for `timeout` [s] at most: it may be an earlier
    image.

    Parameters
    ----------
    share : 0 to 1, of the time from `start` to `stop` [s]; default: all of the video

    Raises
    ------
    FileError
        Not readable, or no image in it.
    """
    with _open(path) as container:
        stop = (container.duration or 0) / av.time_base if stop is None else stop
        aim = max(start + min(max(share, 0.0), 1.0) * (stop - start), 0.0)
        until, found = time.monotonic() + timeout, None
        container.streams.video[0].codec_context.skip_frame = "NONREF"  # what no other image needs
        try:
            container.seek(round(aim * av.time_base) + (container.start_time or 0), backward=True)
            for found in _frames(container):
                begin = (container.start_time or 0) / av.time_base
                if found.time is None or found.time - begin >= aim or time.monotonic() > until:
                    break
        except (av.FFmpegError, ValueError) as error:
            raise FileError(f"no image can be decoded ({error})", file=path, remedy=_REMEDY) from error
        if found is None:
            raise FileError("no image can be decoded", file=path, remedy=_REMEDY)
        return _upright(found, _display_axes(found, path))


def open_container(path: Path) -> Any:
    """Open a container by FFmpeg, with decoders limited to frames of `MAX_IMAGE_PIXELS`.

    Raises
    ------
    FileError
        Not readable, or a video with frames that are too large.
    """
    try:
        container = av.open(str(regular(path)), options={"max_pixels": str(MAX_IMAGE_PIXELS)})
    except (av.FFmpegError, OSError, ValueError) as error:
        raise FileError(f"not a readable video, 0 frames ({_reason(error)})", file=path, remedy=_REMEDY) from error
    try:
        for codec in (stream.codec_context for stream in container.streams.video):
            if codec is None:
                continue
            check_image_size((codec.width, codec.height), path, "video")
            if not codec.width * codec.height:  # unknown, or withheld by FFmpeg because it is too large
                problem = f"a video with frames of no size, or of more than {MAX_IMAGE_PIXELS // 10**6} million pixels"
                raise FileError(problem, file=path, remedy=_REMEDY)
    except FileError:
        container.close()
        raise
    return container


def _open(path: Path) -> Any:
    container = open_container(path)
    if not container.streams.video:
        container.close()
        raise FileError("there is no video stream in this file", file=path, remedy="Name a video file.")
    if container.streams.video[0].codec_context is None:
        container.close()
        raise FileError("a video of a codec that FFmpeg does not know", file=path, remedy=_REMEDY)
    return container


def _frames(container: Any) -> Iterator[Any]:
    """Decode the frames of the first video stream; empty packets, which stand for dropped frames, are passed over."""
    for packet in container.demux(container.streams.video[0]):
        if packet.size or packet.dts is None:
            yield from packet.decode()


def _reason(error: Exception) -> str:
    """FFmpeg's message, without its error number and the path."""
    if isinstance(error, MemoryError):  # also for impossible counts in a file
        return "it claims more data than fits into memory"
    return str(getattr(error, "strerror", None) or error)


def _presentation_times(path: Path) -> tuple[list[int], list[int]]:
    """Times of all frames by which FFmpeg names them, and at which they are shown, sorted, in the stream's time base.

    AVI states no times of presentation. Where its frames are in order they are shown in their places, but FFmpeg names
    some by the place of the next one.
    """
    pts: list[int | None] = []
    dts: list[int] = []
    packets, problem = 0, ""
    with _open(path) as container:
        stream = container.streams.video[0]
        stated, rate, base = stream.frames, float(stream.average_rate or 0), float(stream.time_base or 0)
        codec = stream.codec_context.name
        hidden = codec in _CODECS_WITH_HIDDEN_FRAMES
        alone = len(container.streams) == 1 and container.duration and container.size > 0
        duration = container.duration / av.time_base if alone else 0.0
        try:
            for packet in container.demux(stream):
                if packet.size and packet.is_corrupt:
                    problem = problem or "damaged packet"
                elif packet.size or packet.dts is not None:
                    packets += 1  # an empty one stands for a dropped frame
                    if packet.size and not packet.is_discard:
                        hidden |= codec == "mpeg4" and packet.size < _MIN_MPEG4_BYTES
                        pts.append(packet.pts)
                        dts += [packet.dts] if packet.dts is not None else []
        except (av.FFmpegError, ValueError) as error:
            problem = str(error)
        is_avi = container.format.name == "avi"
    last = base * max((time for time in pts if time is not None), default=0)
    if not stated and last < 0.98 * duration - 3.0 / (rate or np.inf):  # the duration is rounded
        stated = int(duration * rate * 0.98) - 2
    if problem or (packets < stated and not (is_avi and _is_whole(path))):
        total = f" of {stated}" if stated > packets else ""
        raise FileError(
            f"the video is truncated: {packets}{total} frames can be read" + (f" ({problem})" if problem else ""),
            file=path, remedy="Copy the file again, or keep its readable part: ffmpeg -i IN -c copy OUT.",
        )
    if hidden or None in pts or not base:
        pts = _decoded_times(path)
    if not pts:
        raise FileError("no frame of this video can be decoded", file=path, remedy=_REMEDY)
    named: list[int] = sorted(set(pts))  # type: ignore[type-var,arg-type]  # of two at one time, the first counts
    in_places = is_avi and named == pts and len(dts) == len(pts) and bool(np.all(np.diff(dts) > 0))
    return named, dts if in_places else named


def _decoded_times(path: Path) -> list[int | None]:
    with _open(path) as container:
        try:
            pts = [frame.pts for frame in _frames(container)]
        except (av.FFmpegError, ValueError) as error:
            raise FileError(f"the video cannot be decoded ({error})", file=path, remedy=_REMEDY) from error
    if None in pts:
        raise FileError("frames without times", file=path, remedy="Repack it: ffmpeg -i IN -c copy OUT.mp4.")
    return pts


def _is_whole(path: Path) -> bool:
    """Whether an AVI ends where its chunks do.

    FFmpeg passes over the empty packets by which capture programs mark dropped frames, which the header counts.
    """
    size, end = path.stat().st_size, 0
    with path.open("rb") as file:
        while (chunk := file.read(8))[:4] == b"RIFF":
            end += 8 + int.from_bytes(chunk[4:], "little")
            end += end % 2
            file.seek(end)
    return _MIN_CHUNKS_SHARE * size < end <= size + 1


def _upright(frame: Any, display: tuple[bool, bool, bool]) -> NDArray[np.uint8]:
    """Image (H, W, 3) of a frame as it is to be shown, see `_display_axes`."""
    is_transposed, is_mirrored, is_flipped = display
    image = frame.to_ndarray(format="rgb24")
    image = image.transpose(1, 0, 2) if is_transposed else image
    return np.ascontiguousarray(image[:: -1 if is_flipped else 1, :: -1 if is_mirrored else 1])


def _display_axes(frame: Any, path: Path) -> tuple[bool, bool, bool]:
    """Whether a frame is shown transposed, then mirrored left to right, then upside down, as the file states."""
    try:
        data = frame.side_data.get("DISPLAYMATRIX")  # by name: PyAV up to 18 iterates over values, from 19 on over keys
    except ValueError as error:  # of a kind that this PyAV does not know, such as Exif
        problem = f"metadata of its frames cannot be read, which may state how they are turned ({error})"
        remedy = "Re-encode it: ffmpeg -i IN -c:v libx264 -crf 10 OUT.mp4."
        raise FileError(problem, file=path, remedy=remedy) from error
    if data is None:
        return False, False, False
    a, b, _, c, d = (int(v) for v in np.frombuffer(bytes(data), np.int32)[:5])  # shown at (a x + c y, b x + d y)
    return (True, c < 0, b < 0) if abs(b) > abs(a) else (False, a < 0, d < 0)
