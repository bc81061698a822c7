"""Frame-exact videos (`Video`): files, image folders, topics of ROS 2; the steps that several of them share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from kinefit._pictures import read_picture
from kinefit.errors import FileError, ObservationError, located
from kinefit.observations.clocks import frame_times, frames_by_name, is_even, steps_of, unevenness
from kinefit.readers.depth.images import listed
from kinefit.readers.ros.images import McapVideo
from kinefit.readers.ros.recordings import inside
from kinefit.readers.videos.video_files import VideoFile


class Video:
    """One video, read by frame number in order of presentation: a file, or images in a folder.

    The frames of a file are counted by reading all of it, not from its header; the display rotation that phones state
    is applied. Images are in the order of the numbers in their names. `times` (N,) [s] are the presentation times from
    the first frame on. They are uneven if the rate varies or frames were dropped; `rate` [Hz] is then nominal.

    Parameters
    ----------
    path : path
        A file that FFmpeg decodes; a folder of PNG or JPEG images, or a pattern ("cam01/img_*.png"); or a topic of an
        MCAP recording of ROS 2 ("session.mcap/front/color/image_raw"; extra `ros`).
    rate : float [Hz], optional
        Required for images, which state none; ignored for files, which state their own.

    Raises
    ------
    FileError
        No such file, no video in it, or a truncated one; the message has the number of readable frames.
    ObservationError
        Images without a rate, or with a gap in their numbers.
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
        times = self._source.times
        self.times: NDArray = frame_times(len(times), self.rate) if is_even(times, self.rate) else times

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
    def unevenness(self) -> str:
        """What is worth saying of the times: "variable frame rate, 60 Hz nominal, ...", or what names state."""
        return self._source.note or unevenness(self.times, self.rate)

    def frame_at(self, time: float) -> int | None:
        """Number of the frame nearest to a time [s] from the first frame; None if half a frame or more outside."""
        if not -0.5 <= time * self.rate <= self.times[-1] * self.rate + 0.5:
            return None
        return int(np.searchsorted((self.times[1:] + self.times[:-1]) / 2.0, time))

    def read(self, i: int) -> NDArray[np.uint8]:
        """Frame `i` as (H, W, 3) uint8 RGB, upright; raises ObservationError for a frame that is not there."""
        if not 0 <= i < len(self):
            raise ObservationError(f"no frame {i}; there are 0 to {len(self) - 1}", file=self.path)
        return self._source.image(i)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[NDArray[np.uint8]]:
        """Yield frames `start` to `stop`, exclusive (default: the end), as (H, W, 3) uint8 RGB."""
        for i in range(start, len(self) if stop is None else stop):
            yield self.read(i)


def common_frames(
    clocks: Mapping[str, NDArray],
    rate: float,
    frames: tuple[int, int] | None = None,
    *,
    overlap: bool = False,
    file: str | PathLike[str] | None = None,
) -> tuple[int, int]:
    """Steps (start, stop) of the common time t = step / rate that every stream covers.

    Streams with another or a varying rate may differ in length by up to two of their frames.

    Parameters
    ----------
    clocks : {stream: (N,) [s]} times of its frames in the take
    rate : float [Hz] of the take
    frames : (start, stop), optional, requested steps
    overlap : bool, streams may start and end independently: without `frames`, their overlap
    file : path, optional, of the take, for messages

    Raises
    ------
    ObservationError
        Streams of different length without `frames`, or `frames` outside of their overlap.
    """
    spans = {name: steps_of(times, rate) for name, times in clocks.items()}
    start, stop = max(begin for begin, _ in spans.values()), min(end for _, end in spans.values())
    uneven = {name: np.median(np.diff(times)) for name, times in clocks.items() if not is_even(times, rate)}
    listed = ", ".join(
        f"{n} {end - begin} frames{f' of {rate:.4g} Hz' * (n in uneven)}{f' from step {begin}' * bool(begin)}"
        for n, (begin, end) in spans.items()
    )
    if start >= stop:
        raise ObservationError(f"no time that all streams share: {listed}", file=file, remedy="Check the time offsets.")
    if frames is None:
        slack = np.ceil(2.0 * rate * max(uneven.values(), default=0.0) - 1e-6)
        if not overlap and np.ptp([end - begin for begin, end in spans.values()]) > slack:
            raise ObservationError(
                f"streams of different length: {listed}", file=file,
                remedy=f"If they start together, use the frames that all share: frames = [{start}, {stop}].",
            )
        return start, stop
    if not start <= frames[0] < frames[1] <= stop:
        raise ObservationError(
            f"frames [{frames[0]}, {frames[1]}] are not in every stream: {listed}", file=file,
            remedy=f"All share frames = [{start}, {stop}].",
        )
    return frames


ENDINGS = (".png", ".jpg", ".jpeg")


class ImageFolder:
    """Images of a folder, or of a pattern of names, as the frames of a video; read on demand.

    Parameters
    ----------
    path : Path
    rate : float [Hz]
        Images state none; None raises.

    Raises
    ------
    FileError
        No images; an image that cannot be decoded.
    ObservationError
        No rate; numbers in the names with a gap.
    """

    def __init__(self, path: Path, rate: float | None) -> None:
        files = images_in(path)
        if not files:
            raise FileError("no images here", file=path, remedy="Name a video, or a folder of PNG or JPEG images.")
        if rate is None or not 0 < rate < 1e6:
            problem = "a folder of images states no frame rate"
            raise ObservationError(problem, file=path, remedy="Write rate = ... (frames per second) into [take].")
        with located(path, None):
            numbered = frames_by_name([file.name for file in files], "images")
            numbered.refuse_gaps("images")
        self._files, self.rate = files, float(rate)
        self.times, self.note = numbered.on_clock(self.rate, "images")  # (N,) [s] from the first frame
        self._latest: tuple[int, NDArray[np.uint8]] = (0, read_picture(files[0]))
        self.size: tuple[int, int] = self._latest[1].shape[1::-1]

    def __len__(self) -> int:
        return len(self._files)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def image(self, i: int) -> NDArray[np.uint8]:
        """Frame `i` as (H, W, 3) uint8 RGB; raises FileError for a damaged image, or one of another size."""
        if self._latest[0] != i:
            picture = read_picture(self._files[i])
            if picture.shape[1::-1] != self.size:
                sizes = [f"{width}x{height}" for width, height in (picture.shape[1::-1], self.size)]
                problem = f"{sizes[0]} px, but the first image has {sizes[1]}"
                raise FileError(problem, file=self._files[i], remedy="All images of a camera must have one size.")
            self._latest = i, picture
        return self._latest[1].copy()


def images_in(path: Path, endings: Sequence[str] = ENDINGS) -> list[Path]:
    """Image files of a folder or a pattern, in the order of the numbers in their names."""
    return [file for file in listed(path) if file.suffix.lower() in endings]
