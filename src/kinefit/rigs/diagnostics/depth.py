"""Check what a depth camera's images say of its unit, its lens and its kind of distance."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.findings import Finding
from kinefit.images.depth_scene import background_model, foreground
from kinefit.observations import DepthVideo
from kinefit.readers.take.file import Take

_MAX_IMAGES = 16  # of a recording, spread over it
_MIN_BLOB_SHARE = 0.01  # of the image that moves before the background
_MAX_PERSON_EXTENT = 2.7  # [m] of what moves: a person with an arm stretched upwards has 2.6
_TYPICAL_EXTENT = 1.7  # [m]
_MAX_CENTRE_OFFSET = 0.15  # of the image's side, of the principal point: of depth cameras below 0.06
_MIN_PLANE_POINTS = 500
_PLANE_SAMPLES = 300
_PLANE_ERROR = 0.006  # of the distance, of points on a plane
_MIN_PLANE_SHARE = 0.25  # of the image, on its largest plane
_MIN_PLANE_GAIN = 1.3  # of the plane's points, if distances are along the rays

UNCHECKED = (
    "Depth alone: not checked are the poses of its cameras, whether the image is mirrored, whether the intrinsics are "
    "those of another stream, and the unit where no person moves."
)
"""What `kinefit check` cannot say of depth without videos."""


def depth_findings(take: Take, videos: Sequence[DepthVideo]) -> list[Finding]:
    """Findings on units, principal points and distances along rays of a take's depth cameras."""
    out, units = list[Finding](), {entry.name: entry.unit or 0.001 for entry in take.depth}
    for video in videos:
        if video.camera is not None and video.sensor in units:
            sample = np.unique(np.linspace(0, len(video) - 1, _MAX_IMAGES, dtype=int))
            images = [video.frame(int(i)).depth for i in sample]
            out += _unit(video, images, units[video.sensor]) + _centre(video) + _along_rays(video, images[0])
    return out


def moving_extent(video: DepthVideo, images: Sequence[NDArray]) -> float | None:
    """Largest side [m] of the box of what moves before the background, median of images (H, W) [m]; None if unclear."""
    assert video.camera is not None
    empty = images if video.background is None else [video.background.frame(0).depth]
    background = background_model(empty, share=0.2 if video.background is None else 0.5)
    extents = []
    for depth in images:
        moves = depth > 0.0 if video.on_body else foreground(depth, background) & (background > 0.0)
        labels, stats = cv2.connectedComponentsWithStats(moves.astype(np.uint8), connectivity=4)[1:3]
        blob = int(np.argmax(stats[:, cv2.CC_STAT_AREA] * (np.arange(len(stats)) > 0)))
        if blob and stats[blob, cv2.CC_STAT_AREA] > _MIN_BLOB_SHARE * depth.size:
            sides = stats[blob, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]] / np.diag(video.camera.matrix)[:2]
            extents.append(float(np.median(depth[labels == blob]) * sides.max()))
    return float(np.median(extents)) if 2 * len(extents) >= len(images) else None


def _unit(video: DepthVideo, images: Sequence[NDArray], unit: float) -> list[Finding]:
    """A moving thing that is too large to be a person."""
    extent = moving_extent(video, images)
    if extent is None or extent < _MAX_PERSON_EXTENT:
        return []
    text = f"What moves before {video.sensor} is {extent:.3g} m large in most images: a person is smaller."
    remedy = f"Write its unit [m of a count]: about {unit * _TYPICAL_EXTENT / extent:.1g} would fit a person."
    return [Finding("doubt", "unit", text, (video.sensor,), "A guess.", remedy)]


def _centre(video: DepthVideo) -> list[Finding]:
    """A principal point far from the middle of the image."""
    assert video.camera is not None
    centre, size = video.camera.matrix[:2, 2], np.array(video.size)
    off = float(np.abs((centre - (size - 1) / 2.0) / size).max())
    if off < _MAX_CENTRE_OFFSET:
        return []
    text = f"The principal point of {video.sensor}, {centre[0]:.4g}, {centre[1]:.4g}, is {100 * off:.0f} % of a side "
    remedy = "Give the intrinsics of the depth stream at this size, not those of the colour stream."
    return [Finding("doubt", "intrinsics", f"{text}off its middle.", (video.sensor,), "A guess.", remedy)]


def _along_rays(video: DepthVideo, depth: NDArray) -> list[Finding]:
    """Distances along the rays, given as depth: walls and floors are curved."""
    assert video.camera is not None
    step = max(int(np.sqrt(depth.size / 5000)), 1)
    z, table = depth[::step, ::step].ravel(), video.camera.ray_table[:, ::step, ::step].reshape(2, -1)
    known = (z > 0.0) & np.isfinite(table).all(axis=0)
    rays = np.column_stack([*table[:, known], np.ones(known.sum())])
    points = rays * z[known, None]
    shares = [known.mean() * _plane_share(x) for x in (points, points / np.linalg.norm(rays, axis=1)[:, None])]
    if shares[1] < max(_MIN_PLANE_SHARE, _MIN_PLANE_GAIN * shares[0]):
        return []
    on_plane = f"{100 * shares[0]:.0f} and {100 * shares[1]:.0f} % of the pixels lie on it"
    text = f"A wall before {video.sensor} is curved by its depths, and flat if they are along rays ({on_plane})."
    remedy = "Convert them: depth = distance / |ray|, with ray = ((u - cx) / fx, (v - cy) / fy, 1)."
    return [Finding("doubt", "radial", text, (video.sensor,), "A guess.", remedy)]


def _plane_share(x: NDArray) -> float:
    """Share of points (N, 3) [m] on their largest plane, by random triples."""
    if len(x) < _MIN_PLANE_POINTS:
        return 0.0
    rng = np.random.default_rng(0)
    a, b, c = x[rng.integers(0, len(x), (3, _PLANE_SAMPLES))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals, a = normals[lengths > 1e-9] / lengths[lengths > 1e-9, None], a[lengths > 1e-9]
    off = np.abs(x @ normals.T - np.einsum("ij,ij->i", normals, a))
    return float((off < _PLANE_ERROR * np.linalg.norm(x, axis=1)[:, None]).mean(axis=0).max(initial=0.0))
