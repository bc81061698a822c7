"""Which frames a report shows, and a picture of the person in one of them with the fit drawn on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.exporters.pictures.drawing import draw_body, draw_residuals, drawn_points
from kinefit.exporters.report.moments import doubtful_moments
from kinefit.geometry.camera import Camera, ImageFrame
from kinefit.motion import Motion, Residuals

MOMENTS = 6  # doubtful moments that have pictures
_MARGIN = 0.25  # of the person's box that is kept around it


def report_frames(motion: Motion) -> dict[int, str]:
    """{frame: what it is}: first, middle, last, the one of lowest quality, and those of the worst doubtful moments."""
    if not len(motion):
        return {}
    out: dict[int, str] = {0: "first", len(motion) // 2: "middle", len(motion) - 1: "last"}
    out.setdefault(int(np.argmin(motion.quality)), "lowest quality")
    for m in doubtful_moments(motion)[:MOMENTS]:
        out.setdefault(m.worst, "doubtful")
    return out


def close_up(
    image: NDArray[np.uint8],
    motion: Motion,
    frame: int,
    camera: Camera,
    *,
    image_frame: ImageFrame | None = None,
    residuals: Residuals | None = None,
) -> NDArray[np.uint8]:
    """The part of a picture (H, W, 3) uint8 RGB that shows the person, with the fit and the keypoints drawn on it."""
    image_frame = image_frame or ImageFrame.identity()
    out = np.array(image, order="C")
    draw_body(out, motion, frame, camera, image_frame)
    if residuals is not None and residuals.unit == "px":
        draw_residuals(out, residuals, frame, image_frame)
    uv = image_frame.from_calibration(camera.project(drawn_points(motion, frame)))
    uv = uv[np.isfinite(uv).all(axis=1)]
    size = np.array([out.shape[1], out.shape[0]], float)
    if not len(uv) or np.any(uv.max(axis=0) < 0) or np.any(uv.min(axis=0) > size):
        return out
    low, high = np.clip(uv.min(axis=0), 0, size), np.clip(uv.max(axis=0), 0, size)
    pad = _MARGIN * max(high - low)
    (left, top), (right, bottom) = np.clip(low - pad, 0, size).astype(int), np.clip(high + pad, 0, size).astype(int)
    return out[top:bottom, left:right] if right - left > 16 and bottom - top > 16 else out
