"""Videos, frame-exact: files, folders of images, topics of ROS 2; one (`Video`) or several in step (`VideoSet`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import FileError, ObservationError, choices
from kinefit.readers.image_folders import ImageFolder
from kinefit.readers.ros.recordings import inside
from kinefit.readers.ros.video import McapVideo
from kinefit.readers.video_files import VideoFile


class Video:
    """One video, read by frame number in order of presentation: a file, or images in a folder.

    The frames of a file are counted by walking through it, not taken from its header; the display rotation that phones
    write beside the picture is applied. Images are taken in the order of the numbers in their names.

    Parameters
    ----------
    path : path
        Whatever FFmpeg decodes; a folder of PNG or JPEG images, or a pattern of them ("cam01/img_*.png"); or a topic of
        an MCAP recording of ROS 2 ("session.mcap/front/color/image_raw"; extra `ros`).
    rate : float [Hz], optional
        Of images, which state none: it is needed there. A file states its own, which counts.

    Raises
    ------
    FileError
        No such file, no video in it, or less in it than its header says; the message tells how many frames can be read.
    ObservationError
        Images without a rate, or some of which are missing.
    """

    def __init__(self, path: str | PathLike[str], *, rate: float | None = None) -> None:
        self.path = Path(path)
        recording, pattern = inside(self.path), "*" in self.path.name
        if not (recording or pattern or self.path.exists()):
            raise FileError("no such video", file=self.path, remedy="Check the path.")
        self._source: VideoFile | ImageFolder | McapVideo
        if recording is not None:
            self._source = McapVideo(*recording)
        else:
            images = pattern or self.path.is_dir()
            self._source = ImageFolder(self.path, rate) if images else VideoFile(self.path)
        self.size: tuple[int, int] = self._source.size
        self.rate: float = self._source.rate

    def __len__(self) -> int:
        return len(self._source)

    def __repr__(self) -> str:
        return f"Video({str(self.path)!r}: {len(self)} frames, {self.size[0]}x{self.size[1]}, {self.rate:g} Hz)"

    def __enter__(self) -> Video:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; reading afterwards is an error."""
        self._source.close()

    @property
    def times(self) -> NDArray:
        """(N,) [s] when each frame is shown, from the first frame; uneven where the rate varies."""
        return self._source.times

    def read(self, i: int) -> NDArray[np.uint8]:
        """Frame `i` as (H, W, 3) uint8 RGB, upright."""
        if not 0 <= i < len(self):
            raise ObservationError(f"no frame {i}; there are 0 to {len(self) - 1}", file=self.path)
        return self._source.image(i)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[NDArray[np.uint8]]:
        """Frames `start` up to and without `stop` (default: the end), each as `read` gives them."""
        for i in range(start, len(self) if stop is None else stop):
            yield self.read(i)


class VideoSet:
    """Several cameras in step: for every common time one image per camera.

    Parameters
    ----------
    paths : {camera: path}
    time_offsets : {camera: float [s]}, optional
        Added to frame / rate to get the common time; 0 where not given. Each time takes the nearest frame.
    rate : float [Hz], optional
        Of folders of images, which state none.
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
        rate: float | None = None,
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
                self.videos[camera] = Video(path, rate=rate)
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
        videos = [rate for name, rate in rates.items() if name.startswith("video ")]
        remedy = "Correct rate = ... of [[keypoints]], or resample the videos: ffmpeg -i IN -r RATE OUT."
        alike = bool(videos) and max(videos) <= 1.001 * min(videos)
        if alike and abs(rates.get("take", videos[0]) / videos[0] - 1.0) > 0.001:
            remedy = "Leave rate out of [take]: the videos state theirs."
        raise ObservationError(f"streams of different rate: {listed}", file=file, remedy=remedy)


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
