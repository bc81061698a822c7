"""Detect the two bright targets of a bar in images, to a fraction of a pixel.

Read the centroids of a bar's targets from a table.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import no_column, regular
from kinefit.errors import CalibrationError, FileError
from kinefit.rigs.board.detection import grey_image
from kinefit.rigs.board.sources import Frames, NumberedImages, Progress, evenly, opened, sample

_BACKGROUND_IMAGES = 25  # whose median is the scene without the bar: it is elsewhere in more than half of them
_SPOT_LEVEL = 0.3  # of the way from the background to the peak: lower grey values are no part of a target
_MIN_RELATIVE_CONTRAST = 0.35  # of a spot to the brightest one; fainter spots are noise
_MIN_CONTRAST = 30.0  # grey values above the background: less is noise and JPEG blocks
_MAX_SPOT_SIZE = 0.06  # of the image's width
_MAX_ASPECT = 3.0  # length over width of a target that moves during exposure; longer spots are reflections
_MIN_SPOT_PIXELS = 3  # for a centroid


@dataclass(frozen=True, eq=False)
class BarViews:
    """Detections of a bar in one camera.

    Parameters
    ----------
    size : (width, height) [px]
    ends : {frame: (2, 2) [px]}
        Centroids of both targets, in any order: an image does not distinguish them.
    looked : int
        Number of images searched.
    """

    size: tuple[int, int]
    ends: dict[int, NDArray]
    looked: int


def find_bars(
    sources: Mapping[str, Path | dict[int, Path]], *, max_frames: int = 400, include: tuple[int, ...] = (),
    progress: Progress | None = None,
) -> dict[str, BarViews]:
    """Detect the two targets in all cameras, at the same frames of each.

    The median of some images over the recording is subtracted, so that lamps and windows disappear. An image counts if
    exactly two compact bright spots remain.

    Parameters
    ----------
    sources : of `camera_sources`.
    max_frames : int
        Largest number of frames, evenly spaced over the recording.
    include : frames to search in any case.

    Raises
    ------
    CalibrationError
        A camera without any image of two targets, or videos of different lengths.
    """
    with opened(sources) as cameras:
        wanted, seen = evenly(cameras, max_frames, include), {}
        total = len(wanted) * len(cameras)
        for n, (name, camera) in enumerate(cameras.items()):
            still = _background(camera)
            own, ends, counts = set(camera.numbers), {}, []
            for i, frame in enumerate(wanted):
                if frame in own:
                    found = targets_in(grey_image(camera.read(frame)), still)
                    counts.append(len(found))
                    if len(found) == 2:
                        ends[frame] = found
                if progress:
                    progress("finding targets", n * len(wanted) + i + 1, total)
            if not ends:
                _raise_unseen(name, counts)
            seen[name] = BarViews(camera.size, ends, len(counts))
    return seen


def targets_in(grey: NDArray, still: NDArray | None = None) -> NDArray:
    """(K, 2) [px] centroids of the bright compact spots of an image, brightest first.

    The centroid is that of the grey values above a level between background and peak (H.-G. Maas, Image
    sequence based automatic multi-camera system calibration techniques, 1998).

    Parameters
    ----------
    grey : (H, W) grey values.
    still : (H, W), optional
        The scene without the bar.
    """
    risen = grey.astype(np.float32) if still is None else np.maximum(grey.astype(np.float32) - still, 0.0)
    ground = float(np.median(risen))
    peak = float(cv2.blur(risen, (2, 2)).max()) - ground  # one hot pixel is no target
    if peak < _MIN_CONTRAST:
        return np.empty((0, 2))
    level = ground + max(_SPOT_LEVEL * _MIN_RELATIVE_CONTRAST * peak, 0.5 * _MIN_CONTRAST)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats((risen > level).astype(np.uint8), connectivity=8)
    found = []
    for k in np.argsort(-boxes[1:, cv2.CC_STAT_AREA])[:50] + 1:
        left, top, width, height, area = boxes[k]
        spot = np.where(labels[top : top + height, left : left + width] == k,
                        risen[top : top + height, left : left + width] - ground, 0.0)
        contrast = float(spot.max())
        large = max(width, height) > _MAX_SPOT_SIZE * grey.shape[1]
        if area < _MIN_SPOT_PIXELS or large or contrast < _MIN_RELATIVE_CONTRAST * peak:
            continue
        centre, aspect = _centroid(np.maximum(spot - _SPOT_LEVEL * contrast, 0.0))
        inside = 1 < left + width / 2 < grey.shape[1] - 2 and 1 < top + height / 2 < grey.shape[0] - 2
        if aspect < _MAX_ASPECT and inside:
            found.append((contrast * np.sqrt(area), left + centre[0], top + centre[1]))
    return np.array([[u, v] for _, u, v in sorted(found, reverse=True)]).reshape(-1, 2)


def _centroid(weight: NDArray) -> tuple[NDArray, float]:
    """Centroid (u, v) of weights (H, W), and their aspect ratio (length over width)."""
    m = cv2.moments(weight.astype(float))  # OpenCV takes (H, 2) in single precision for a contour
    centre = np.array([m["m10"], m["m01"]]) / m["m00"]
    spread = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / m["m00"]
    small, large = np.linalg.eigvalsh(spread + np.eye(2) / 12.0)  # 1/12: variance of one pixel
    return centre, float(np.sqrt(large / small))


def _background(camera: NumberedImages | Frames) -> NDArray | None:
    images = [grey_image(image) for image in sample(camera, _BACKGROUND_IMAGES)]
    return np.median(images, axis=0).astype(np.float32) if len(images) >= 5 else None


def _raise_unseen(name: str, counts: list[int]) -> None:
    most = max(set(counts), key=counts.count) if counts else 0
    raise CalibrationError(
        f"none of {len(counts)} images shows two bright targets; most show {most}", place=f"camera {name}",
        remedy="Darken the room or the exposure until the two targets are much brighter than all else that moves.",
    )


_COLUMNS = ("camera", "frame", "u", "v")


@checked
def read_centroids(
    path: str | PathLike[str], sizes: Mapping[str, tuple[int, int]] | tuple[int, int]
) -> dict[str, BarViews]:
    """Read a CSV file with the columns camera, frame, u, v: one row for each target, two for each image.

    Parameters
    ----------
    path : of the table; u and v [px], (0, 0) being the centre of the first pixel.
    sizes : (width, height) [px] of all cameras' images, or {camera: size}.

    Raises
    ------
    FileError
        No such table, other columns, or a cell that is no number; with the line.
    CalibrationError
        A camera without a size, targets outside of the image, or no image with two targets.
    """
    path = Path(path)
    spots: dict[str, dict[int, list[list[float]]]] = {}
    try:
        with regular(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                problem = no_column(missing, reader.fieldnames)
                raise FileError(problem, file=path, remedy="Write camera,frame,u,v in its first line.")
            for line, row in enumerate(reader, 2):
                try:
                    frame, uv = int(row["frame"]), [float(row["u"]), float(row["v"])]
                except (TypeError, ValueError):
                    raise FileError("a frame, u or v is not a number", file=path, place=f"line {line}",
                                    remedy="Correct it, or remove the row.") from None  # fmt: skip
                if np.isfinite(uv).all():
                    spots.setdefault(str(row["camera"]).strip(), {}).setdefault(frame, []).append(uv)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"cannot be read: {error}", file=path, remedy="Give a CSV file.") from None
    out = {}
    for name, frames in spots.items():
        size = sizes.get(name) if isinstance(sizes, Mapping) else sizes
        if size is None:
            remedy = "Give its width and height."
            raise CalibrationError("no image size", file=path, place=f"camera {name}", remedy=remedy)
        ends = {frame: np.array(uv) for frame, uv in sorted(frames.items()) if len(uv) == 2}
        every = np.concatenate([np.array(uv) for uv in frames.values()])
        if (every < -0.5).any() or (every > np.array(size) - 0.5).any():
            raise CalibrationError(
                f"targets at {every.min():.0f} to {every.max():.0f} px in images of {size[0]}x{size[1]} px", file=path,
                place=f"camera {name}", remedy="Give the size of the images in which they were measured.",
            )  # fmt: skip
        if not ends:
            raise CalibrationError(
                "no image with two targets", file=path, place=f"camera {name}", remedy="Give two rows an image."
            )
        out[name] = BarViews((int(size[0]), int(size[1])), ends, len(frames))
    if not out:
        raise FileError("it holds no targets", file=path, remedy="Write a row for each target: camera,frame,u,v.")
    return out
