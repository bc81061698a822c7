"""Videos and images in which boards are detected: one source for each camera, at the same frames."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._pictures import read_picture
from kinefit.errors import CalibrationError, FileError
from kinefit.readers.videos.video import Video
from kinefit.rigs.board import detection
from kinefit.rigs.board.detection import Board, CameraViews

_IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_VIDEO_ENDINGS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".mts", ".wmv")
_SUGGESTION_IMAGES = 6  # of each camera, in which another board is searched for if the named one is not visible
_MAX_LENGTH_DIFFERENCE = 5  # frames, of videos of one recording: a recorder may stop later

Progress = Callable[[str, int, int], object]


class NumberedImages:
    """Images of one camera by frame number; like `Video`, but some frames may be missing."""

    def __init__(self, files: Mapping[int, Path]) -> None:
        self.files = dict(sorted(files.items()))
        first = self.read(next(iter(self.files)))
        self.size: tuple[int, int] = (first.shape[1], first.shape[0])

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the existing frames."""
        return tuple(self.files)

    def read(self, frame: int) -> NDArray[np.uint8]:
        """One frame, (H, W, 3) RGB; raises CalibrationError for an image of another size."""
        image = read_picture(self.files[frame])
        size = (image.shape[1], image.shape[0])
        if getattr(self, "size", size) != size:
            raise CalibrationError(
                f"has {size[0]}x{size[1]} px, the images before it {self.size[0]}x{self.size[1]}",
                file=self.files[frame],
                remedy="Calibrate images of one size; remove the others.",
            )
        return image

    def close(self) -> None:
        """Do nothing: no file stays open."""


class Frames(Video):
    """A video of one camera, by steps of a common rate [Hz] (`put_on`), each nearest to one of its frames."""

    def put_on(self, rate: float) -> None:
        """Number the frames by steps of a rate [Hz]; some steps may have none."""
        self._frames = {round(float(time) * rate): i for i, time in enumerate(self.times)}

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the existing frames."""
        return tuple(self._frames)

    def read(self, i: int) -> NDArray[np.uint8]:
        """The frame of step `i` as (H, W, 3) uint8 RGB, upright."""
        return super().read(self._frames[i])


def camera_sources(paths: Iterable[str | PathLike[str]]) -> dict[str, Path | dict[int, Path]]:
    """Find the sources of all cameras, by name: a video, or images by frame number.

    A file is a video, named as the camera. A folder holds videos; or images whose names end or begin with the frame's
    number: left01.jpg, 01_right.jpg are two cameras, 01.jpg one with the folder's name; or one folder of such images
    for each camera.

    Raises
    ------
    FileError
        No such file or folder, or none of a known format.
    CalibrationError
        Two cameras of one name.
    """
    found: dict[str, Path | dict[int, Path]] = {}

    def add(name: str, source: Path | dict[int, Path], at: Path) -> None:
        if name in found:
            raise CalibrationError("two cameras of one name", file=at, place=f"camera {name}", remedy="Rename one.")
        found[name] = source

    for path in map(Path, paths):
        if path.is_file():
            add(path.stem, path, path)
            continue
        if not path.is_dir():
            raise FileError("no such file or folder", file=path, remedy="Give videos, or folders of images.")
        inside = sorted(path.iterdir())
        videos = [file for file in inside if file.suffix.lower() in _VIDEO_ENDINGS]
        images = [file for file in inside if file.suffix.lower() in _IMAGE_ENDINGS]
        folders = {sub.name: _images_in(sub) for sub in inside if sub.is_dir()}
        if videos:
            for video in videos:
                add(video.stem, video, video)
        elif images:
            for name, files in _by_camera(images, path.name).items():
                add(name, files, path)
        else:
            for name, listed in folders.items():
                if listed:
                    add(name, dict(enumerate(listed)), path)
        if not (videos or images or any(folders.values())):
            raise FileError(
                "it holds no video and no image", file=path,
                remedy=f"Known are {', '.join(_VIDEO_ENDINGS + _IMAGE_ENDINGS)}.",
            )  # fmt: skip
    return found


def _images_in(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in _IMAGE_ENDINGS)


def _by_camera(files: list[Path], folder: str) -> dict[str, dict[int, Path]]:
    out: dict[str, dict[int, Path]] = {}
    for n, file in enumerate(files):
        last = re.fullmatch(r"(?P<name>.*?)[\s_.-]*(?P<number>\d+)", file.stem)
        numbered = last or re.fullmatch(r"(?P<number>\d+)[\s_.-]+(?P<name>.+)", file.stem)
        name, number = (numbered["name"] or folder, int(numbered["number"])) if numbered else (folder, n)
        group = out.setdefault(name, {})
        group[number if number not in group else max(group) + 1] = file
    if max(len(group) for group in out.values()) == 1:  # names without meaning
        return {folder: dict(enumerate(files))}
    return out


def find_boards(
    sources: Mapping[str, Path | dict[int, Path]],
    board: Board,
    *,
    max_frames: int = 200,
    include: Sequence[int] = (),
    progress: Progress | None = None,
) -> tuple[Board, dict[str, CameraViews]]:
    """Detect the board in all cameras, at the same frames of each.

    Parameters
    ----------
    sources : of `camera_sources`.
    max_frames : int
        Largest number of frames, evenly spaced over the recording.
    include : frames to search in any case.

    Returns
    -------
    Board
        With the detected dictionary, if the given one has none.
    {camera: CameraViews}

    Raises
    ------
    CalibrationError
        A camera in which the board is never visible; the message names another board that is.
    """
    with opened(sources) as cameras:
        wanted = evenly(cameras, max_frames, include)
        if board.kind == "charuco" and not board.dictionary:
            board = detection.with_dictionary(board, [image for o in cameras.values() for image in sample(o, 4)])
        finder, seen, total = detection.Finder(board), {}, len(wanted) * len(cameras)
        for n, (name, camera) in enumerate(cameras.items()):
            views: list[detection.BoardView] = []
            own = set(camera.numbers)
            for i, frame in enumerate(wanted):
                view = finder.find(camera.read(frame), frame) if frame in own else None
                views += [view] if view is not None else []
                if progress:
                    progress("finding boards", n * len(wanted) + i + 1, total)
            seen[name] = CameraViews(camera.size, tuple(views))
        unseen = [name for name, views in seen.items() if not views.views]
        if unseen:
            _raise_unseen(board, unseen, cameras, any(views.views for views in seen.values()))
        if board.kind == "checkerboard":
            _check_whole(board, seen, cameras)
        return board, seen


@contextmanager
def opened(sources: Mapping[str, Path | dict[int, Path]]) -> Iterator[dict[str, NumberedImages | Frames]]:
    """Context with the opened cameras of `camera_sources`.

    Raises
    ------
    CalibrationError
        Videos of different lengths.
    """
    cameras: dict[str, NumberedImages | Frames] = {}
    try:
        for name, source in sources.items():
            cameras[name] = NumberedImages(source) if isinstance(source, dict) else Frames(source)
        videos = {name: camera for name, camera in cameras.items() if isinstance(camera, Frames)}
        for video in videos.values():
            video.put_on(max(other.rate for other in videos.values()))
        _check_lengths({name: video.numbers[-1] + 1 for name, video in videos.items()})
        yield cameras
    finally:
        for camera in cameras.values():
            camera.close()


def evenly(cameras: Mapping[str, NumberedImages | Frames], max_frames: int, include: Sequence[int] = ()) -> list[int]:
    """Numbers of at most `max_frames` frames, evenly spaced, and of the existing ones among `include`."""
    frames = sorted({frame for camera in cameras.values() for frame in camera.numbers})
    chosen = {frames[i] for i in np.linspace(0, len(frames) - 1, min(len(frames), max_frames)).astype(int)}
    return sorted(chosen | (set(include) & set(frames)))


def _check_lengths(lengths: Mapping[str, int]) -> None:
    if lengths and max(lengths.values()) - min(lengths.values()) > _MAX_LENGTH_DIFFERENCE:
        listed = ", ".join(f"{name} {count}" for name, count in lengths.items())
        raise CalibrationError(
            f"the videos have different numbers of frames ({listed}), so frames with one number differ in time",
            remedy="Cut them so that they begin and end together.",
        )


def sample(source: NumberedImages | Frames, count: int) -> list[NDArray]:
    """`count` images (H, W, 3), evenly spaced over the recording."""
    frames = source.numbers
    return [source.read(frames[i]) for i in np.unique(np.linspace(0, len(frames) - 1, count).astype(int))]


def _raise_unseen(board: Board, unseen: list[str], opened: Mapping[str, NumberedImages | Frames], others: bool) -> None:
    place = f"camera{'s' * (len(unseen) > 1)} {', '.join(unseen)}"
    if others:
        raise CalibrationError(
            f"the board {board} is not found there, but other cameras see it",
            place=place,
            remedy="Show the board to every camera, so near that its squares are 20 px or more; or remove the camera.",
        )
    images = [image for name in unseen for image in sample(opened[name], _SUGGESTION_IMAGES)]
    fits = detection.fitting_boards(board, images[: 2 * _SUGGESTION_IMAGES])
    tried = "other dictionaries, the legacy pattern and the board turned" if board.kind == "charuco" else "other sizes"
    found = f"one fits --board {fits[0]}" if fits else f"nor with {tried}"
    size = "squares" if board.kind == "charuco" else "inner corners, which are one less than squares"
    raise CalibrationError(
        f"no board {board} is found; {found}",
        place=place,
        remedy=f"Check columns and rows (of {size}) and that the images are sharp and the board whole.",
    )


def _check_whole(board: Board, seen: Mapping[str, CameraViews], opened: Mapping[str, NumberedImages | Frames]) -> None:
    """Raise CalibrationError if the board is a part of a larger one: the part would differ between images."""
    shown = [source.read(seen[name].views[i].frame) for name, source in opened.items() for i in (0, -1)]
    for other in detection.fitting_boards(board, shown[:4])[:1]:
        size, larger = sorted(board.size), sorted(other.size)
        if size != larger and all(a <= b for a, b in zip(size, larger)):
            raise CalibrationError(
                f"{board} is only a part of the board in view, {other}",
                place=f"cameras {', '.join(opened)}",
                remedy=f"Give --board {other}, if its squares have that size.",
            )
