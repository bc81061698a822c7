"""Seeds found without anybody's help: along lines of sight, in boxes, or SIFT features that two images share."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.triangulation import triangulate_robust
from kinefit.photogrammetry.region_growing import Seeds
from kinefit.photogrammetry.spline_image import SplineImage

_LARGEST = 1200  # [px] of an image in which features are sought: theirs are larger than grains of texture
_RATIO = 0.8  # Lowe's: of the distances of the best and the second descriptor, below which a feature is no repeated one
_BESIDE = 2.0  # [px of the image searched] that a feature may lie beside the lines of sight: three of its deviations


def sift_seeds(
    first: SplineImage,
    second: SplineImage,
    cameras: tuple[Camera, Camera] | None = None,
    *,
    mask: NDArray | None = None,
    count: int = 200,
) -> Seeds:
    """Features that agree in both images, the surest first; each with its turn and scale as deformation.

    Parameters
    ----------
    cameras : of the two images, if calibrated: features whose rays miss each other are left out
    mask : (H, W) bool, of the first image
    count : at most so many

    Returns
    -------
    Seeds
        Without any where the images share nothing, or their texture repeats.
    """
    features = [_features(image, mask if k == 0 else None) for k, image in enumerate((first, second))]
    (points1, turns1, found1), (points2, turns2, found2) = features
    nothing = Seeds(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    if found1 is None or found2 is None or min(len(found1), len(found2)) < 2:
        return nothing
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(found1, found2, k=2)
    told = sorted(
        (a.distance / max(b.distance, 1e-9), a.queryIdx, a.trainIdx) for a, b in (p for p in pairs if len(p) == 2)
    )
    told = [pair for pair in told if pair[0] < _RATIO]
    if not told:
        return nothing
    i, j = (np.array([pair[k] for pair in told]) for k in (1, 2))
    one, two = points1[i], points2[j]
    deformation = turns2[j] @ np.linalg.inv(turns1[i])
    keep = np.arange(len(one))
    if cameras is not None:
        scale = max(max(first.size), max(second.size)) / _LARGEST
        seen = np.stack([one, two], axis=1)
        _, agree, _ = triangulate_robust(Rig(cameras), seen, max_residual_px=_BESIDE * max(scale, 1.0))
        keep = np.flatnonzero(agree.all(axis=1))
    keep = keep[:count]
    return Seeds(one[keep], two[keep], deformation[keep])


def _features(image: SplineImage, mask: NDArray | None) -> tuple[NDArray, NDArray, NDArray | None]:
    """Places (K, 2) [px], turns and scales (K, 2, 2), and descriptors of features; strongest first."""
    scale = min(1.0, _LARGEST / max(image.size))
    pixels = cv2.resize(image.grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image.grey
    low, high = np.percentile(pixels, (1, 99))
    pixels = np.clip((pixels - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    area = None
    if mask is not None:
        area = cv2.resize(np.asarray(mask, np.uint8), pixels.shape[::-1], interpolation=cv2.INTER_NEAREST)
    sift = cv2.SIFT_create(3000)  # type: ignore[attr-defined]
    keys, descriptors = sift.detectAndCompute(pixels, area)
    points = np.array([key.pt for key in keys]).reshape(-1, 2)
    angle, size = np.deg2rad([key.angle for key in keys]), np.array([key.size for key in keys])
    cos, sin = size * np.cos(angle), size * np.sin(angle)
    turns = np.stack([cos, -sin, sin, cos], axis=-1).reshape(-1, 2, 2)
    return (points + 0.5) / scale - 0.5, turns, descriptors
