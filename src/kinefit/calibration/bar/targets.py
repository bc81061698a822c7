"""The two bright targets of a bar, found in images to a fraction of a pixel."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.calibration.board.detection import grey_image
from kinefit.calibration.board.sources import Frames, NumberedImages, evenly, opened, sample
from kinefit.errors import CalibrationError

_SAMPLES = 25  # images of which the median is the scene without the bar: it is elsewhere in more than half of them
_LEVEL = 0.3  # of the way from the surroundings to the peak: grey values below it are no part of a target
_FAINT = 0.35  # of the two targets' contrast, up to which other bright spots count as noise
_LEAST_CONTRAST = 30.0  # grey values above the surroundings: less is noise and JPEG blocks
_LARGEST = 0.06  # of the image's width: larger bright things are no targets
_LONGEST = 3.0  # times as long as wide: a target that moves during exposure; longer ones are reflections
_FEWEST_PIXELS = 3  # of which a centroid is taken

Progress = Callable[[str, int, int], object]


@dataclass(frozen=True, eq=False)
class BarViews:
    """What one camera saw of a bar.

    Parameters
    ----------
    size : (width, height) [px]
    ends : {frame: (2, 2) [px]}
        Centroids of both targets, in any order: which is which is not known in an image.
    looked : int
        Images that were looked at.
    """

    size: tuple[int, int]
    ends: dict[int, NDArray]
    looked: int


def find_bars(
    sources: Mapping[str, Path | dict[int, Path]], *, max_frames: int = 400, include: tuple[int, ...] = (),
    progress: Progress | None = None,
) -> dict[str, BarViews]:
    """Centroids of the two targets in all cameras, at the same frames of each.

    What stays bright where it is (lamps, windows) is taken away: the median of some images over the recording. An
    image counts in which exactly two compact bright spots stand out.

    Parameters
    ----------
    sources : as `camera_sources` gives them.
    max_frames : int
        So many frames at most, evenly over the recording.
    include : frames that are looked at in any case.

    Raises
    ------
    CalibrationError
        A camera in which two targets are never seen, or videos of different lengths.
    """
    with opened(sources) as cameras:
        wanted, seen = evenly(cameras, max_frames, include), {}
        total = len(wanted) * len(cameras)
        for n, (name, camera) in enumerate(cameras.items()):
            still = _still(camera)
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
                _refuse(name, counts)
            seen[name] = BarViews(camera.size, ends, len(counts))
    return seen


def targets_in(grey: NDArray, still: NDArray | None = None) -> NDArray:
    """(K, 2) [px] centroids of the bright compact spots of an image, brightest first; faint ones are left out.

    The centroid is that of the grey values above a level between the surroundings and the peak (H.-G. Maas, Image
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
    if peak < _LEAST_CONTRAST:
        return np.empty((0, 2))
    level = ground + max(_LEVEL * _FAINT * peak, 0.5 * _LEAST_CONTRAST)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats((risen > level).astype(np.uint8), connectivity=8)
    found = []
    for k in np.argsort(-boxes[1:, cv2.CC_STAT_AREA])[:50] + 1:
        left, top, width, height, area = boxes[k]
        spot = np.where(labels[top : top + height, left : left + width] == k,
                        risen[top : top + height, left : left + width] - ground, 0.0)
        contrast = float(spot.max())
        if area < _FEWEST_PIXELS or max(width, height) > _LARGEST * grey.shape[1] or contrast < _FAINT * peak:
            continue
        centre, shape = _centroid(np.maximum(spot - _LEVEL * contrast, 0.0))
        if shape < _LONGEST and 1 < left + width / 2 < grey.shape[1] - 2 and 1 < top + height / 2 < grey.shape[0] - 2:
            found.append((contrast * np.sqrt(area), left + centre[0], top + centre[1]))
    return np.array([[u, v] for _, u, v in sorted(found, reverse=True)]).reshape(-1, 2)


def _centroid(weight: NDArray) -> tuple[NDArray, float]:
    """Centroid (u, v) of weights (H, W), and how many times as long as wide they are."""
    v, u = np.mgrid[: weight.shape[0], : weight.shape[1]]
    total = float(weight.sum())
    centre = np.array([np.sum(u * weight), np.sum(v * weight)]) / total
    du, dv = u - centre[0], v - centre[1]
    spread = np.array([[np.sum(weight * du * du), np.sum(weight * du * dv)], [0.0, np.sum(weight * dv * dv)]]) / total
    spread[1, 0] = spread[0, 1]
    small, large = np.linalg.eigvalsh(spread + np.eye(2) / 12.0)  # a pixel has a width of its own
    return centre, float(np.sqrt(large / small))


def _still(camera: NumberedImages | Frames) -> NDArray | None:
    images = [grey_image(image) for image in sample(camera, _SAMPLES)]
    return np.median(images, axis=0).astype(np.float32) if len(images) >= 5 else None


def _refuse(name: str, counts: list[int]) -> None:
    most = max(set(counts), key=counts.count) if counts else 0
    raise CalibrationError(
        f"two bright targets are seen in none of {len(counts)} images; most have {most}", place=f"camera {name}",
        remedy="Darken the room or the exposure until the two targets are by far the brightest things that move.",
    )
