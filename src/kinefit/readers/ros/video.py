"""Image topics of an MCAP recording (ROS 2) as videos; the reader of `Video` for such paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.readers.ros.images import COLOURS, colours, is_colour, refuse_encoding
from kinefit.readers.ros.recordings import COMPRESSED, IMAGE, Messages, Topics, median_rate, reading

_MAX_GAP_S = 0.5  # without an image, or three frames if that is longer
_MAX_REPEATS = 100  # mean number of frames that show one image; a tenth of it where half of all images were dropped


class McapVideo:
    """Images resampled to the recording's median rate: each frame shows the image nearest in time.

    Frame 0 is at the recording's first image of any topic, so that cameras of one recording are in step.

    Parameters
    ----------
    path : Path of the recording
    topic : str or None
        None: the only one with images in colour or grey.

    Raises
    ------
    FileError
        The extra is not installed, or the file is damaged.
    ObservationError
        No such topic, an unknown encoding, no unique image topic; a gap of more than half a second and three frames;
        times that give no rate.
    """

    def __init__(self, path: Path, topic: str | None) -> None:
        with reading(path) as reader:
            topics = Topics(reader, path)
            fitting = [t for t in topics.of(IMAGE, COMPRESSED) if is_colour(topics.first(t))]
            refuse_encoding(topics, topic, "image", (*COLOURS, "jpeg", "png"))
            self.topic = topics.chosen(topic, fitting, "images in colour or grey")
            times, logged = topics.times(self.topic)
            first = colours(topics.first(self.topic), path)
        rate = median_rate(times, self.topic, path)
        gaps = np.flatnonzero(np.diff(times, prepend=0.0) > max(_MAX_GAP_S, 3.0 / rate))
        if len(gaps):
            begin, end = (0.0, *times)[gaps[0]], times[gaps[0]]
            raise ObservationError(
                f"no image on the topic {self.topic} from {begin:.2f} to {end:.2f} s", file=path,
                remedy="Cut the recording to the time that all its cameras share: `mcap filter`.",
            )  # fmt: skip
        self.path, self.size = path, (int(first.shape[1]), int(first.shape[0]))
        self.rate = round(rate, 6)
        if times[-1] * self.rate > _MAX_REPEATS * len(times):
            problem = f"the images on the topic {self.topic} come in bursts at {self.rate:g} Hz, with gaps between"
            raise ObservationError(problem, file=path, remedy="Record them with the times at which they were taken.")
        at = np.arange(round(times[-1] * self.rate) + 1) / self.rate
        after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
        self._shown = np.where(at - times[after - 1] <= times[after] - at + 1e-6, after - 1, after)
        self._messages, self._last = Messages(path, self.topic, logged), (0, first)

    def __len__(self) -> int:
        return len(self._shown)

    def close(self) -> None:
        """Close the file."""
        self._messages.close()

    @property
    def times(self) -> NDArray:
        """(N,) [s] from the recording's first image."""
        return np.arange(len(self)) / self.rate

    def image(self, i: int) -> NDArray[np.uint8]:
        """Frame `i` as (H, W, 3) uint8 RGB; raises ObservationError for an image of another size."""
        number = int(self._shown[i])
        if number != self._last[0]:
            image = colours(self._messages(number), self.path)
            if image.shape[1::-1] != self.size:
                problem = f"{image.shape[1]}x{image.shape[0]} px, but the first image has {self.size[0]}x{self.size[1]}"
                remedy = "All images of a camera must have one size."
                raise ObservationError(problem, file=self.path, place=f"{self.topic}, frame {i}", remedy=remedy)
            self._last = number, image
        return self._last[1].copy()
