"""Check what a depth camera's images say of its unit, its lens and its kind of distance."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.findings import Edit, Finding
from kinefit.images.depth_scene import background_model, foreground
from kinefit.observations import DepthVideo
from kinefit.readers.take.entries import DepthEntry
from kinefit.readers.take.file import Take

_MAX_IMAGES = 16  # of a recording, spread over it
_MIN_BLOB_SHARE = 0.01  # of the image that moves before the background
_MAX_PERSON_EXTENT = 2.7  # [m] of what moves: a person with an arm stretched upwards has 2.6
_TYPICAL_EXTENT = 1.7  # [m]
_UNITS = (0.0001, 0.000125, 0.0002, 0.00025, 0.0005, 0.001)  # [m] of one count, of sensors and data sets
_MAX_UNIT_ERROR = 1.35  # of a person's extent to the typical one, either way
_MAX_CENTRE_OFFSET = 0.15  # of the image's side, of the principal point: of depth cameras below 0.06
_PLANE_SAMPLES = 300
_PLANE_ERROR = 0.006  # of the distance, of points on a plane
_MIN_PLANE_SHARE = 0.25  # of the image, on its largest plane
_MIN_PLANE_GAIN = 1.3  # of the plane's points, if distances are along the rays

UNCHECKED = (
    "Depth alone: not checked are the poses of its cameras, whether the image is mirrored, whether the intrinsics are "
    "those of another stream, and the unit where nobody moves."
)
"""What `kinefit check` cannot say of depth without videos."""


def depth_findings(take: Take, videos: Sequence[DepthVideo]) -> list[Finding]:
    """Findings on units, principal points and distances along rays of a take's depth cameras."""
    out = []
    for entry in take.depth:
        for video in (video for video in videos if video.sensor == entry.name and video.camera is not None):
            sample = np.unique(np.linspace(0, len(video) - 1, _MAX_IMAGES, dtype=int))
            images = [video.frame(int(i)).depth for i in sample]
            found = (_unit(entry, video, images), _centre(entry, video), _along_rays(entry, video, images[0]))
            out += [finding for finding in found if finding is not None]
    return out


def moving_extent(video: DepthVideo, images: Sequence[NDArray]) -> float | None:
    """Largest side [m] of the box of what moves before the background, median of images (H, W) [m]; None if unclear."""
    camera = video.camera
    assert camera is not None
    background = np.zeros_like(images[0])
    if not video.on_body:
        empty = images if video.background is None else [video.background.frame(0).depth]
        background = background_model(empty, share=0.2 if video.background is None else 0.5)
    extents = []
    for depth in images:
        moves = foreground(depth, background) & ((background > 0.0) | video.on_body)
        labels, stats = cv2.connectedComponentsWithStats(moves.astype(np.uint8), connectivity=4)[1:3]
        blob = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])) if len(stats) > 1 else 0
        if blob and stats[blob, cv2.CC_STAT_AREA] > _MIN_BLOB_SHARE * depth.size:
            z = float(np.median(depth[labels == blob]))
            width, height = stats[blob, cv2.CC_STAT_WIDTH], stats[blob, cv2.CC_STAT_HEIGHT]
            extents.append(z * max(width / camera.matrix[0, 0], height / camera.matrix[1, 1]))
    return float(np.median(extents)) if 2 * len(extents) >= len(images) else None


def _unit(entry: DepthEntry, video: DepthVideo, images: Sequence[NDArray]) -> Finding | None:
    """A moving thing that is too large to be a person."""
    extent = moving_extent(video, images) if len(images) > 2 or video.on_body else None
    if extent is None or extent < _MAX_PERSON_EXTENT:
        return None
    unit = entry.unit or 0.001
    factors = {other: extent * other / unit / _TYPICAL_EXTENT for other in _UNITS if other < unit}
    fitting = [other for other, ratio in factors.items() if 1.0 / _MAX_UNIT_ERROR < ratio < _MAX_UNIT_ERROR]
    best = min(fitting, key=lambda other: abs(np.log(factors[other])), default=None)
    text = f"What moves before {entry.name} is {extent:.3g} m large in most images: a person is smaller."
    remedy = f"If its counts are no millimetres, write unit = ... [m]{f'; {best:g} fits a person' if best else ''}."
    edits = (Edit("depth", "unit", f"{best:g}", entry.name),) if best and entry.unit is None else ()
    sure = "A guess: focal lengths that are too short, several people side by side and a vehicle look the same."
    return Finding("doubt", "unit", text, (entry.name,), sure, remedy, edits)


def _centre(entry: DepthEntry, video: DepthVideo) -> Finding | None:
    """A principal point far from the middle of the image."""
    assert video.camera is not None
    K, size = video.camera.matrix, np.array(video.size)
    off = (K[:2, 2] - (size - 1) / 2.0) / size
    if np.abs(off).max() < _MAX_CENTRE_OFFSET:
        return None
    text = f"{entry.name}: the principal point ({K[0, 2]:.4g}, {K[1, 2]:.4g}) is {100 * np.abs(off).max():.0f} %"
    text += f" of the side off the middle of its {size[0]}x{size[1]} px image."
    remedy = "Give the intrinsics of the depth stream at this size, not those of the colour stream."
    sure = "A guess: an image that was cropped on one side looks the same."
    return Finding("doubt", "intrinsics", text, (entry.name,), sure, remedy)


def _along_rays(entry: DepthEntry, video: DepthVideo, depth: NDArray) -> Finding | None:
    """Distances along the rays, given as depth: walls and floors are curved."""
    camera = video.camera
    assert camera is not None
    step = max(int(np.sqrt(depth.size / 5000)), 1)
    z, table = depth[::step, ::step].ravel(), camera.ray_table[:, ::step, ::step].reshape(2, -1)
    known = (z > 0.0) & np.isfinite(table).all(axis=0)
    rays, z = np.column_stack([*table[:, known], np.ones(known.sum())]), z[known]
    if len(z) < 500:
        return None
    points = rays * z[:, None]
    shares = [_plane_share(x) for x in (points, points / np.linalg.norm(rays, axis=1)[:, None])]
    if shares[1] < _MIN_PLANE_SHARE or shares[1] < _MIN_PLANE_GAIN * shares[0]:
        return None
    text = f"{entry.name}: the largest plane in view is curved by its depths ({100 * shares[0]:.0f} % of the points "
    text += f"lie on one plane), and flat if they are distances along the rays ({100 * shares[1]:.0f} %)."
    remedy = "Convert them: depth = distance / |ray|, with ray = ((u - cx) / fx, (v - cy) / fy, 1)."
    sure = "A guess: wrong distortion of the lens and a round room look the same."
    return Finding("doubt", "radial", text, (entry.name,), sure, remedy)


def _plane_share(x: NDArray) -> float:
    """Share of points (N, 3) [m] on their largest plane, by random triples."""
    rng = np.random.default_rng(0)
    a, b, c = x[rng.integers(0, len(x), (3, _PLANE_SAMPLES))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals, a = normals[lengths > 1e-9] / lengths[lengths > 1e-9, None], a[lengths > 1e-9]
    off = np.abs(x @ normals.T - np.einsum("ij,ij->i", normals, a))
    return float((off < _PLANE_ERROR * np.linalg.norm(x, axis=1)[:, None]).mean(axis=0).max(initial=0.0))
