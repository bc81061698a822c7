"""Faces made unrecognisable in pictures: in circles that are given, or where the fitted head lies."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import PointSet
from kinefit.errors import ExportError
from kinefit.geometry.camera import Camera, ImageFrame
from kinefit.motion import Motion

_REACH = 0.8  # of the head's length, from its middle to where nothing is shown sharp: beyond chin, crown and ears
_BLOCKS = 4  # over the head: a face is known down to about ten
_ALL_BLOCKS = 12  # over the longer side of a picture that shows faces one knows not where


def without_face(
    image: NDArray[np.uint8], motion: Motion, frame: int | None, camera: Camera, image_frame: ImageFrame | None = None
) -> NDArray[np.uint8]:
    """A picture (H, W, 3) uint8 with the tracked person's head blurred; all of it where the head was not tracked.

    What is blurred is three standard deviations larger than the head. Other people in the picture stay as they are.

    Raises
    ------
    ExportError
        The body has no head.
    """
    tree, ends = motion.body.tree, motion.body.segment_ends()
    if "head" not in tree.segments or tree.segments.index("head") not in ends:
        raise ExportError("pictures with faces blurred, of a body without a head", remedy="Leave pictures out.")
    head = tree.segments.index("head")
    if frame is None or motion.quality[frame] <= 0 or motion.lost[frame, head]:
        return hide_all(image)
    tip = np.asarray(ends[head], float)
    points = PointSet(("neck", "crown"), np.array([head, head]), np.stack([np.zeros(3), tip]))
    std = float(np.linalg.norm(motion.joint_std[frame, head]))
    middle = motion.body.positions(motion.state(frame), points).mean(axis=0)
    reach = _REACH * float(np.linalg.norm(tip)) + 3 * std
    if not np.isfinite(reach):
        return hide_all(image)
    image_frame = image_frame or ImageFrame.identity()
    around = middle + reach * np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])
    uv = image_frame.from_calibration(camera.project(around))
    if not np.isfinite(uv).all():  # partly or all behind the camera, or beside its lens
        ahead = around @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
        return hide_all(image) if ahead.max() > 0.0 else np.array(image)
    radius = float(np.linalg.norm(uv[:-1] - uv[-1], axis=1).max())
    return hide_circles(image, np.array([[*uv[-1], radius]]))


def hide_circles(image: NDArray[np.uint8], circles: NDArray) -> NDArray[np.uint8]:
    """A copy of a picture (H, W, 3) uint8 in which nothing can be made out within circles (N, 3) [px] u, v, radius."""
    out = np.array(image, order="C")
    classes = np.ceil(np.log2(np.maximum(circles[:, 2], 1.0)))
    for size in np.unique(classes):  # circles of nearly one radius at once, large ones last
        mask = np.zeros(image.shape[:2], np.uint8)
        for u, v, radius in circles[classes == size]:
            cv2.circle(mask, (round(u), round(v)), max(1, round(radius)), 1, -1)
        left, top, width, height = cv2.boundingRect(mask)
        if width and height:
            part, inside = (a[top : top + height, left : left + width] for a in (out, mask))
            cv2.copyTo(_coarse(part, 2 * 2**size / _BLOCKS), inside, part)
    return out


def hide_all(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A copy of a picture in which nobody can be recognised."""
    return _coarse(image, max(image.shape[:2]) / _ALL_BLOCKS)


def _coarse(image: NDArray[np.uint8], block: float) -> NDArray[np.uint8]:
    """The picture in blocks of so many pixels, blended."""
    height, width = image.shape[:2]
    few = (max(1, round(width / block)), max(1, round(height / block)))
    small = cv2.resize(image, few, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
