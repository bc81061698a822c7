"""What `kinefit surface` reads: views of each camera, and seeds."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular
from kinefit._pictures import read_picture
from kinefit.errors import FileError, ObservationError, shortened
from kinefit.geometry.camera import Rig
from kinefit.photogrammetry.region_growing import Seeds
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.video import Video, images_in

PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


@dataclass(frozen=True)
class StateImages:
    """Photographs of each camera, one a state; or a video of each."""

    names: tuple[str, ...]
    photographs: tuple[tuple[Path, ...], ...]
    videos: tuple[Path, ...]


def read_views(calibration: Path, unit: str, views: Sequence[str]) -> tuple[Rig, StateImages]:
    """Cameras that are named, and their files; a calibration that states no image size has that of the first view.

    Raises
    ------
    ObservationError
        Fewer than two views, one without a name, photographs beside videos, or other numbers of photographs.
    FileError
        A file or folder that is not there or holds no image.
    """
    names, photographs, videos = [], [], []
    for view in views:
        name, sign, path = view.partition("=")
        if not sign or not path:
            raise ObservationError(f"view '{view}' is not CAMERA=PATH", remedy="Write it as left=left.png.")
        place = Path(path)
        names.append(name)
        if place.is_dir() or "*" in place.name:
            files = images_in(place, PHOTOGRAPHS)
            if not files:
                raise FileError("no images here", file=place, remedy="Give a photograph, a folder of them, a video.")
            photographs.append(tuple(files))
        elif place.suffix.lower() in PHOTOGRAPHS:
            photographs.append((place,))
        else:
            videos.append(place)
    if len(names) < 2 or (photographs and videos) or len({len(files) for files in photographs}) > 1:
        counts = ", ".join(str(len(files)) for files in photographs)
        problem = f"these {len(names)} views do not go together: {len(videos)} videos, photographs: {counts or 'none'}"
        raise ObservationError(problem, remedy="Give at least two views: all videos, or all with as many photographs.")
    if photographs:
        size = read_photograph(photographs[0][0]).shape[1::-1]
    else:
        with Video(videos[0]) as video:
            size = video.size
    metres = float(unit) if _is_number(unit) else unit
    rig = read_calibration(calibration, unit=metres, image_size=size)
    return rig.select(tuple(names)), StateImages(tuple(names), tuple(photographs), tuple(videos))


def read_photograph(path: Path) -> NDArray:
    """An image (H, W) or (H, W, 3) RGB in 0..255: uint8, or float32 of a file with more bits, its brightest pixel 255.

    Raises
    ------
    FileError
        As `read_picture`; values that are not finite, or no light at all in more than eight bits.
    """
    if path.suffix.lower() in (".tif", ".tiff"):  # float is read in no other way
        picture = read_picture(path, cv2.IMREAD_UNCHANGED)
        picture = picture if picture.ndim == 2 else picture[..., 2::-1]
    else:
        picture = read_picture(path, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH)
    if picture.dtype == np.uint8:
        return picture
    brightest = float(picture.max())
    if not 0.0 < brightest < np.inf or picture.min() < 0.0:
        problem = f"grey values range from {picture.min():g} to {brightest:g}"
        raise FileError(problem, file=path, remedy="Give photographs with finite values, 0 for black and not all 0.")
    return np.asarray(picture * np.float32(255.0 / brightest))


def read_seeds(path: Path, views: int) -> list[Seeds]:
    """Seeds from the first camera to each other one, of a CSV file: a row has u and v in every view.

    Raises FileError for a file without points, or with other columns.
    """
    remedy = "Give u and v [px] of each point in every view, as in u1,v1,u2,v2."
    try:
        with regular(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            rows = [(reader.line_num, row) for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"cannot be read: {error}", file=path, remedy="Write numbers separated by commas.") from None
    if rows and not _is_number(rows[0][1][0]):
        rows = rows[1:]
    for line, row in rows:
        bad = next((cell for cell in row if cell.strip() and not _is_number(cell)), None)
        if bad is not None or len(row) != 2 * views:
            problem = f"{len(row)} columns, not {2 * views}" if bad is None else f"'{shortened(bad, 60)}' is no number"
            raise FileError(problem, file=path, place=f"line {line}", remedy=remedy)
    table = np.array([[float(cell) if cell.strip() else np.nan for cell in row] for _, row in rows])
    if not len(table):
        raise FileError("the file has no points", file=path, remedy=remedy)
    return [Seeds.of(table[:, :2], table[:, 2 * k : 2 * k + 2]) for k in range(1, views)]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
