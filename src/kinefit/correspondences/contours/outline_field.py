"""Outlines by a distance field: the nearest point of a silhouette's outline is looked up, not searched.

One look-up a rim point, however long the outline; but it knows one direction only, and the nearest outline alone,
whichever way it faces. `outline_pairs` is what the tracker uses.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError


@dataclass(frozen=True, eq=False)
class OutlineField:
    """Signed distance of every pixel to the outline of a mask.

    Parameters
    ----------
    distance : (H, W) float32 [px], positive outside of the body, negative inside.
    gradient : (2, H, W) float32, its slope along u and v.
    """

    distance: NDArray
    gradient: NDArray

    @classmethod
    def of(cls, mask: ArrayLike) -> OutlineField:
        """Field of a mask (H, W) uint8, 255 where the body is.

        Raises
        ------
        ObservationError
            No mask of 8 bits, or one with no outline.
        """
        image = np.ascontiguousarray(mask)
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ObservationError(f"a mask of shape {image.shape} and type {image.dtype}", remedy="Give uint8.")
        body = (image > 127).astype(np.uint8)
        if not body.any() or body.all():
            raise ObservationError("a mask with no outline", remedy="Leave out images in which nothing is seen.")
        outside = cv2.distanceTransform(1 - body, cv2.DIST_L2, 5)
        inside = cv2.distanceTransform(body, cv2.DIST_L2, 5)
        distance = np.where(body > 0, 0.5 - inside, outside - 0.5).astype(np.float32)  # zero between the pixels
        smooth = cv2.GaussianBlur(distance, (0, 0), 1.0)
        slopes = [cv2.Sobel(smooth, cv2.CV_32F, *way, scale=0.125) for way in ((1, 0), (0, 1))]
        return cls(distance, np.stack(slopes))

    def tangents(
        self, outline: NDArray, *, reach: float = 30.0, angle: float = 1.0
    ) -> tuple[NDArray, tuple[NDArray, NDArray]]:
        """Tangents (4, K) of the outline nearest to points (4, N) of a rim, and pairs of both for `outline_rows`.

        Parameters
        ----------
        reach : float [px] beyond which there is none.
        angle : float [rad] beyond which the rim and the field's slope do not look the same way.
        """
        height, width = self.distance.shape
        u, v, a, b = outline
        i, j = np.rint(u).astype(int), np.rint(v).astype(int)
        within = np.flatnonzero((i >= 0) & (i < width) & (j >= 0) & (j < height))
        i, j = i[within], j[within]
        slope = self.gradient[:, j, i].astype(float)
        size = np.maximum(np.hypot(*slope), 1e-6)
        n = slope / size
        away = self.distance[j, i] + slope[0] * (u[within] - i) + slope[1] * (v[within] - j)
        near = (np.abs(away) <= reach) & (n[0] * a[within] + n[1] * b[within] >= np.cos(angle)) & (size > 0.3)
        kept = within[near]
        found = np.stack([u[kept] - away[near] * n[0, near], v[kept] - away[near] * n[1, near], *n[:, near]])
        return np.ascontiguousarray(found), (kept, np.arange(len(kept)))
