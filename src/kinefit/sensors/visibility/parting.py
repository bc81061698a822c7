"""Assign the pixels of an image to people, by the bodies that are predicted in it.

A pixel belongs to the body whose rendered surface is nearest to the measured point, across the image and in depth.
Without a depth only the distance across the image counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera
from kinefit.observations import DepthFrame
from kinefit.sensors.scene import Scene

_MAX_BODY_DISTANCE = 0.4  # [m] farther points belong to no body: an arm that has moved since the last frame is nearer


def drawn_together(scenes: Sequence[Scene], camera: Camera) -> NDArray | None:
    """(h, w) [m] rendered depth of the nearest of several bodies, downsampled, inf where none; None for no bodies."""
    images = [s.surface.depth(s.surface.posed(s.state), s.placed(camera)).copy() for s in scenes if s.body.surfaces]
    return np.minimum.reduce(images) if images else None


def of_others(depth: NDArray, own: NDArray, others: NDArray | None, camera: Camera) -> NDArray:
    """(H, W) bool: the measured point is nearer to another body than to the own one.

    Parameters
    ----------
    depth : (H, W) [m], 0 or less where nothing was measured
    own, others : (h, w) [m] rendered depth of the own body and of all others, inf where there is none
    camera : of the depth image
    """
    if others is None or not np.isfinite(others).any():
        return np.zeros(depth.shape, bool)
    away = _distance(depth, others, camera)
    return (depth > 0.0) & (away < _MAX_BODY_DISTANCE) & (away < _distance(depth, own, camera))


def without_others(frame: DepthFrame, others: Sequence[Scene], camera: Camera) -> DepthFrame:
    """A depth image with 0 at the pixels of other bodies."""
    drawn = drawn_together(others, camera)
    if drawn is None:
        return frame
    theirs = of_others(frame.depth, np.full_like(drawn, np.inf), drawn, camera)
    return replace(frame, depth=np.where(theirs, np.float32(0.0), frame.depth))


def outside_others(mask: NDArray, own: NDArray, others: NDArray) -> NDArray:
    """(h, w) bool: pixels of a silhouette that are nearer to another rendered body than to the own one.

    Parameters
    ----------
    mask : (h, w) silhouette of all people
    own, others : (h', w') [m] rendered depth, inf for no body; where they overlap the nearer one has the pixel
    """
    if not np.isfinite(others).any():
        return np.zeros(mask.shape, bool)
    front = np.isfinite(others) & (others < own)
    away = [cv2.distanceTransform((~seen).astype(np.uint8), cv2.DIST_L2, 3) for seen in (front, np.isfinite(own))]
    nearer = cv2.resize(away[0] - away[1], mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray((mask > 0) & (nearer < 0.0))


def _distance(depth: NDArray, drawn: NDArray, camera: Camera) -> NDArray:
    """(H, W) [m] distance of each measured point from the nearest rendered point of a body."""
    seen = np.isfinite(drawn)
    if not seen.any():
        return np.full(depth.shape, np.inf)
    away, label = cv2.distanceTransformWithLabels(
        (~seen).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(label.max()) + 1, np.float32)
    table[label[seen]] = drawn[seen]
    rows, columns = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(depth.shape, drawn.shape))
    cells = np.ix_(rows, columns)
    pixel = depth / camera.matrix[0, 0] * (camera.size[0] / drawn.shape[1])  # [m] width of a drawn pixel
    return np.asarray(np.hypot(away[cells] * pixel, depth - table[label[cells]]))
