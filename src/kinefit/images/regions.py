"""Colours of a body and of what is around it: histograms in CIELab, of the whole and near each part of the contour.

P3 2.4 models both regions by densities p₁, p₂ of their colours. Here they are histograms, blended over time so that
light may change. A pixel of colour c speaks for the body by log p₁(c) / p₂(c).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

_FLOOR = 0.02  # share of both densities that any colour may have: paint that was not seen yet, noise, reflections


@dataclass(frozen=True)
class RegionSettings:
    """How regions are told apart, and how a contour is found between them.

    Parameters
    ----------
    space : "lab" or "rgb", in which colours are binned
    levels : int, bins along each of the three axes
    anchors : int
        Points of the surface near which colours are counted apart; 0 for one statistic of the whole body.
    spread : float [pixels counted]
        As many pixels of one anchor weigh as much as the whole body's statistics.
    rate, near_rate : float in 0..1
        Share of a new image in the statistics of the body, and of what is around it.
    far : float in 0..1
        Share of the whole image in what is around the body; the rest is counted near it.
    most : float
        Largest logarithm of the ratio of two densities that a single pixel may have.
    half : int, samples of a line to either side
    fine : float [px] length of half a line in the last iteration, at most `half` samples of one pixel
    heat : float
        Number of pixels along a line that count as one, as neighbours are alike.
    width : float [px] standard deviation of the edge's own blur
    lines : int, contour points, about
    """

    space: str = "lab"
    levels: int = 16
    anchors: int = 40
    spread: float = 100.0
    rate: float = 0.1
    near_rate: float = 0.3
    far: float = 0.5
    most: float = 3.0
    half: int = 12
    fine: float = 8.0
    heat: float = 3.0
    width: float = 1.5
    lines: int = 200
    alike: float = 10.0
    newton: bool = False
    tells: float = 3.0
    loss: float = 3.0


@lru_cache(maxsize=8)
def colour_bins(space: str, levels: int) -> tuple[NDArray, int]:
    """Bin (32768,) of every colour of five bits a channel, and how many bins there are.

    In CIELab a and b are binned over the range that sRGB has, so that a bin is about as wide along all three axes.
    """
    c = np.arange(32768)
    rgb = np.stack([c >> 10, (c >> 5) & 31, c & 31], axis=1).astype(np.float32) * (8 / 255) + np.float32(4 / 255)
    values = rgb if space == "rgb" else cv2.cvtColor(rgb[None], cv2.COLOR_RGB2Lab)[0]
    low, high = values.min(axis=0), values.max(axis=0)
    k = np.minimum((values - low) / (high - low) * levels, levels - 1).astype(np.int64)
    used, bins = np.unique((k[:, 0] * levels + k[:, 1]) * levels + k[:, 2], return_inverse=True)
    return np.ascontiguousarray(bins.ravel(), np.int32), len(used)


@dataclass(frozen=True, eq=False)
class RegionColours:
    """Densities of the colours inside and outside of a body's contour.

    Parameters
    ----------
    inside, near, far : (B,) of the body, of what is near it, of the whole image but the body
    own : (2, A, B) pixels counted inside and outside near each anchor, older ones weighing less
    """

    inside: NDArray
    near: NDArray
    far: NDArray
    own: NDArray

    def blended(self, new: RegionColours, s: RegionSettings) -> RegionColours:
        """With the statistics of a new image."""
        own = np.empty_like(self.own)
        for k, rate in enumerate((s.rate, s.near_rate)):
            np.multiply(self.own[k], 1.0 - rate, out=own[k])
            own[k] += rate * new.own[k]
        return RegionColours(
            (1 - s.rate) * self.inside + s.rate * new.inside, (1 - s.near_rate) * self.near + s.near_rate * new.near,
            (1 - s.near_rate) * self.far + s.near_rate * new.far, own,
        )  # fmt: skip

    def ratios(self, s: RegionSettings) -> tuple[NDArray, NDArray]:
        """Log ratios inside to outside: (B,) of the body as a whole, and (A, B) at each anchor, float32."""
        n = len(self.inside)
        outside = s.far * self.far + (1 - s.far) * self.near
        whole = _ratio(self.inside, outside, n, s.most)
        if not len(self.own[0]):
            return whole, whole[None]
        parts = []
        for counted, general in zip(self.own, (self.inside, outside)):
            total = counted.sum(axis=1, keepdims=True)
            parts.append((counted + np.float32(s.spread) * general.astype(np.float32)) / (total + s.spread))
        return whole, _ratio(*parts, n, s.most)


def _ratio(inside: NDArray, outside: NDArray, n: int, most: float) -> NDArray:
    floor = np.float32(_FLOOR / n)
    out = np.log((inside.astype(np.float32) + floor) / (outside.astype(np.float32) + floor))
    return np.ascontiguousarray(np.clip(out, -most, most), np.float32)


def normalised(counts: NDArray) -> NDArray:
    """Counts (B,) as a density; even where nothing was counted."""
    total = counts.sum()
    return counts / total if total > 0 else np.full(len(counts), 1.0 / len(counts))
