"""Folders of PNG or JPEG images as a camera's video."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._pictures import read_picture
from kinefit.errors import FileError, ObservationError
from kinefit.readers.depth.images import listed

ENDINGS = (".png", ".jpg", ".jpeg")
_MAX_NUMBER_STEP = 1.5  # of the numbers in two names, in median steps: with more an image is missing


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
        _check_numbers(files)
        self._files, self.rate = files, float(rate)
        self._latest: tuple[int, NDArray[np.uint8]] = (0, read_picture(files[0]))
        self.size: tuple[int, int] = self._latest[1].shape[1::-1]

    def __len__(self) -> int:
        return len(self._files)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    @property
    def times(self) -> NDArray:
        """(N,) [s] from the first frame."""
        return np.arange(len(self)) / self.rate

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


def _check_numbers(files: list[Path]) -> None:
    numbers = [re.findall(r"\d+", file.stem)[-1:] for file in files]
    if not all(numbers):
        return
    steps = np.diff([float(number[0]) for number in numbers])
    if len(steps) and (steps <= 0).any():
        i = int(np.argmax(steps <= 0))
        raise ObservationError(
            f"two images with one number: {files[i].name} and {files[i + 1].name}", file=files[0].parent,
            remedy="Name those of this camera by a pattern: video = \"folder/left_*.png\".",
        )  # fmt: skip
    if len(steps) and (steps > _MAX_NUMBER_STEP * np.sort(steps)[(len(steps) - 1) // 2]).any():
        i = int(np.argmax(steps))
        raise ObservationError(
            f"images are missing between {files[i].name} and {files[i + 1].name}", file=files[0].parent,
            remedy="Copy them again, or remove all later images, or number them without a gap.",
        )  # fmt: skip
