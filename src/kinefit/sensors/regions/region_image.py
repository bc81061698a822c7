"""Log ratios of colours about a contour: from an image with its tables, or from a stored band."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.images import _kernels_regions as kernels
from kinefit.images.regions import Ratios
from kinefit.sensors.regions.region_parts import Drawn, Lines

_MAX_LEVEL = 127  # of a stored log ratio, to either side of 0
# A stored band is an image whose colours are the numbers of levels, so that one kernel reads both.
_PALETTE = np.arange(32768, dtype=np.int32) % 256


@dataclass(frozen=True, eq=False)
class Coloured:
    """An image and the log ratio of each of its colours near each anchor.

    Parameters
    ----------
    image : (H, W, 3) uint8 RGB
    bins : (32768,) int32, see `colour_bins`
    ratios : Ratios
    """

    image: NDArray
    bins: NDArray
    ratios: Ratios

    def profiles(self, lines: Lines, drawn: Drawn, half: int, step: int, guard: float) -> NDArray:
        """(N, 2 half) log ratios along the normals of a contour, sampled every `step` [px]; see `kernels.profiles`."""
        out, r = np.empty((len(lines.anchor), 2 * half)), self.ratios
        kernels.profiles(
            self.image, self.bins, *r.packed, r.logs, lines.anchor, lines.outline, *drawn, lines.own, lines.beyond,
            half, step, guard, out,
        )  # fmt: skip
        return out


@dataclass(frozen=True, eq=False)
class Kept(Coloured):
    """A stored band of log ratios about a contour, in place of the image; unpacked on demand.

    Parameters
    ----------
    packed : bytes, (h, w) uint8 levels
    shape : (h, w)
    left, top : int [px] of the image
    """

    packed: bytes = b""
    shape: tuple[int, int] = (0, 0)
    left: int = 0
    top: int = 0

    @cached_property
    def _level_image(self) -> NDArray:
        levels = np.frombuffer(zlib.decompress(self.packed), np.uint8).reshape(self.shape)
        out = np.zeros((*self.shape, 3), np.uint8)
        out[..., 1], out[..., 2] = (levels >> 5) << 3, (levels & 31) << 3
        return out

    def profiles(self, lines: Lines, drawn: Drawn, half: int, step: int, guard: float) -> NDArray:
        """(N, 2 half) log ratios within the band, sampled every `step` [px]; 0 outside it."""
        moved = np.array(lines.outline)
        moved[:2] -= np.array([[self.left], [self.top]])
        there = drawn._replace(left=drawn.left - self.left, top=drawn.top - self.top)
        own = replace(lines, outline=moved, anchor=np.zeros_like(lines.anchor))
        out, r = np.empty((len(own.anchor), 2 * half)), self.ratios
        kernels.profiles(
            self._level_image, self.bins, *r.packed, r.logs, own.anchor, moved, *there, own.own, own.beyond, half, step,
            guard, out,
        )  # fmt: skip
        return out

    def __getstate__(self) -> dict[str, object]:
        return {k: v for k, v in self.__dict__.items() if k != "_level_image"}


def kept(seen: Coloured, lines: Lines, reach: int, most: float) -> Coloured:
    """The band of log ratios within `reach` [px] of a contour; `most` bounds a log ratio.

    Each pixel has the log ratio of the contour's nearest point, so that slightly shifted contours can read it, too.
    """
    height, width = seen.image.shape[:2]
    uv = np.rint(lines.outline[:2]).astype(np.int64)
    inside = (uv[0] >= 0) & (uv[0] < width) & (uv[1] >= 0) & (uv[1] < height)
    levels = Ratios.of_table(((np.arange(256) - _MAX_LEVEL) * (most / _MAX_LEVEL)).astype(np.float32)[None])
    none = np.zeros((1, 1, 3), np.uint8)
    if not inside.any():
        return Kept(none, _PALETTE, levels, zlib.compress(bytes([_MAX_LEVEL])), (1, 1), 0, 0)
    (u, v), number = uv[:, inside], np.flatnonzero(inside)
    left, top = max(int(u.min()) - reach, 0), max(int(v.min()) - reach, 0)
    crop = seen.image[top : int(v.max()) + reach + 1, left : int(u.max()) + reach + 1].astype(np.int32)
    away = np.ones(crop.shape[:2], np.uint8)
    away[v - top, u - left] = 0
    distance, label = cv2.distanceTransformWithLabels(away, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of = np.zeros(int(label.max()) + 1, np.int64)
    of[label[v - top, u - left]] = number
    colour = ((crop[..., 0] >> 3) << 10) | ((crop[..., 1] >> 3) << 5) | (crop[..., 2] >> 3)
    value = np.zeros(crop.shape[:2])
    j, i = np.nonzero(distance <= reach)
    point, bins = of[label[j, i]], seen.bins[colour[j, i]]
    inner = lines.anchor[point] < 0
    ratio = seen.ratios.between(lines.own[point], lines.beyond[point], bins)
    ratio[~inner] = seen.ratios.at(lines.anchor[point[~inner]], bins[~inner])
    value[j, i] = ratio
    packed = np.rint(value * (_MAX_LEVEL / most) + _MAX_LEVEL).astype(np.uint8)
    return Kept(none, _PALETTE, levels, zlib.compress(packed.tobytes(), 1), packed.shape, left, top)
