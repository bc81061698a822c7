"""Colour histograms of the body and of the background in CIELab, global and near each part of the contour.

P3 2.4 models both regions by densities p₁, p₂ of their colours. Here they are histograms, blended over time so that
light may change. A pixel of colour c supports the body by the log ratio log p₁(c) / p₂(c).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.images._kernels_regions import UNKNOWN

_PART_PIXELS = 10.0  # prior weight of the whole body's colours in those of a part: few for a hand
_UNIFORM_SHARE = 0.02  # of both densities, even over all colours: for unobserved colours, noise, reflections


@dataclass(frozen=True)
class SearchSettings:
    """Settings of the search for a body whose predicted pose is uncertain; see `sensors.region_search`.

    Parameters
    ----------
    side : float [cells], length of the body in the map of log ratios
    rotations : int, orientations that are tried at all positions
    best : int, number of these that are refined
    rounds, draws : int, rounds of refinement, and random poses in each
    starts : int, poses that the search returns
    doubt : float, cost of half a variance of deviation from the prediction, as a share of the largest possible score
    far : float, in lengths of the body, and turn : float [rad]
        Standard deviations of the prediction above which the search always runs.
    poor : float in 0..1, share of the contour that agrees, below which the search runs too
    """

    side: float = 28.0
    rotations: int = 24
    best: int = 4
    rounds: int = 4
    draws: int = 40
    starts: int = 3
    doubt: float = 0.004
    far: float = 0.3
    turn: float = 0.25
    poor: float = 0.55


@dataclass(frozen=True)
class RegionSettings:
    """Settings of the colour statistics, and of the search for the contour between body and background.

    Parameters
    ----------
    space : "lab" or "rgb", in which colours are binned
    levels : int, bins along each of the three axes
    parts : bool
        Whether each segment of the body has its own histogram, left and right together: skin, shirt, trousers. The
        contour of a segment in front of another is then used too, where their colours differ.
    anchors : int
        Points of the surface with a histogram of their own; 0 for one histogram per part.
    spread : float [pixels]
        Weight of the part's histogram in that of an anchor.
    rate, near_rate : float in 0..1
        Share of a new image in the histograms of the body, and of its surroundings. The first images weigh equally.
    far : float in 0..1
        Share of the whole image in the outside density; the rest comes from the body's surroundings.
    most : float
        Largest absolute log ratio of a single pixel.
    rule : "likelihood" or "shift"
        Position of the contour on a line by the likelihood of all positions; or by the rule of P3 2.4.2: one step
        outwards where the pixels at the contour look like the body, one step inwards where they do not.
    half : int, samples of a line to either side: of one pixel each in the last iterations, of several before
    heat : float
        Number of neighbouring pixels that count as one independent sample.
    tells : float
        Smallest log likelihood ratio of the best position to no contour on the line.
    alike : float [px]
        Correlation length of errors along the contour: each piece of this length counts as one measurement.
    lines : int, approximate number of contour points
    loss : float [standard deviations] scale of the robust loss
    flips : int, mirrored limbs that fits start from, every `TrackSettings.search_every`
    search : SearchSettings
    """

    space: Literal["lab", "rgb"] = "lab"
    levels: int = 20
    parts: bool = True
    anchors: int = 40
    spread: float = 100.0
    rate: float = 0.05
    near_rate: float = 0.15
    far: float = 0.5
    most: float = 5.0
    rule: Literal["likelihood", "shift"] = "likelihood"
    half: int = 12
    heat: float = 1.0
    tells: float = 6.0
    alike: float = 15.0
    lines: int = 200
    loss: float = 2.0
    flips: int = 2
    search: SearchSettings = field(default_factory=SearchSettings)


@lru_cache(maxsize=8)
def colour_bins(space: str, levels: int) -> tuple[NDArray, int]:
    """Bin (32768,) int32 of every colour of five bits a channel, and the number of bins.

    `levels` bins along each axis cover the range that sRGB has there. Bins without any colour are dropped.
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
    """Colour densities inside and outside of a body's contour.

    Parameters
    ----------
    inside : (G, B) of each body part
    near, far : (B,) of the body's surroundings, and of the whole image without the body
    own : (2, A, B) float32 pixel counts inside and outside near each anchor, older ones with less weight
    pixels : (G,) pixels of each part, averaged over time
    times : (G,) int, number of images in which each part was counted
    images : int, number of images that were blended in
    """

    inside: NDArray
    near: NDArray
    far: NDArray
    own: NDArray
    pixels: NDArray
    times: NDArray
    images: int = 1

    def blended(self, inside: NDArray, outside: NDArray, lines: CountLines, s: RegionSettings) -> RegionColours:
        """Blend in a new image: pixel counts of each part (G, B) and outside (2, B); `lines` adds those near anchors.

        The density of a part without pixels, as it is occluded, does not change.
        """
        share = 1.0 / (self.images + 1)
        rates = np.maximum(np.array([s.rate, s.near_rate]), share)
        own = self.own * (1.0 - rates).astype(np.float32)[:, None, None]
        if own.shape[1]:
            lines(rates, own)
        near, far = ((1 - rates[1]) * a + rates[1] * _density(b) for a, b in zip((self.near, self.far), outside))
        total = inside.sum(axis=1)
        rate = np.where(total > 0.0, np.maximum(s.rate, 1.0 / (self.times + 1)), 0.0)
        density = inside / np.maximum(total, 1.0)[:, None]
        body = (1.0 - rate)[:, None] * self.inside + rate[:, None] * density
        pixels = (1.0 - rate) * self.pixels + rate * total
        return RegionColours(body, near, far, own, pixels, self.times + (total > 0.0), self.images + 1)

    @classmethod
    def none(cls, bins: int, s: RegionSettings, parts: int = 1) -> RegionColours:
        """Empty statistics, before the first image."""
        none, own = np.zeros(bins), np.zeros((2, s.anchors, bins), np.float32)
        return cls(np.zeros((parts, bins)), none, none, own, np.zeros(parts), np.zeros(parts, np.int64), 0)

    def ratios(self, s: RegionSettings, of: NDArray | None = None) -> Ratios:
        """Log ratios of inside to outside. of (A,) int: the body part that each anchor lies on, default the first."""
        n, outside = self.inside.shape[1], s.far * self.far + (1 - s.far) * self.near
        total = self.pixels.sum()
        body = self.pixels @ self.inside / total if total > 0.0 else np.full(n, 1.0 / n)
        parts = (self.pixels[:, None] * self.inside + _PART_PIXELS * body) / (self.pixels + _PART_PIXELS)[:, None]
        general, floor = np.concatenate([parts, outside[None]]), _UNIFORM_SHARE / n

        def ratio(inside: NDArray) -> NDArray:
            ratios = np.log((inside + floor) / (outside + floor))
            return np.ascontiguousarray(np.clip(ratios, -s.most, s.most), np.float32)

        whole, logs = ratio(body), np.log(general + floor).astype(np.float32)
        if not s.anchors:
            every = np.arange(len(parts))
            none = np.zeros((2, len(parts), 1), np.float32), np.ones((2, len(parts)))
            return Ratios(whole, ratio(parts), *none, general, every, floor, s.most, logs)
        of = np.zeros(s.anchors, np.int64) if of is None else of
        table = np.full(self.own.shape[1:], UNKNOWN, np.float32)
        counted = self.own.sum(axis=2).astype(float) + s.spread
        return Ratios(whole, table, self.own, counted, s.spread * general, of, floor, s.most, logs)


CountLines = Callable[[NDArray, NDArray], None]
"""Adds pixels to histograms (2, A, B), with weights (2,) of a pixel inside and outside."""


@dataclass(frozen=True, eq=False)
class Ratios:
    """Log ratios of the densities inside and outside, computed at first use; see `kernels.profiles`.

    Parameters
    ----------
    whole : (B,) float32 of the body as a whole
    table : (A, B) float32 at each anchor, UNKNOWN where not computed yet
    own, total, general, of, floor, most : terms from which the table is computed
    logs : (G + 1, B) float32 logarithms of the densities of each part and, last, of the outside
    """

    whole: NDArray
    table: NDArray
    own: NDArray
    total: NDArray
    general: NDArray
    of: NDArray
    floor: float
    most: float
    logs: NDArray

    @property
    def packed(self) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray, float, float]:
        """Arguments of `kernels.profiles`: table (A, B), own (2, A, B), total (2, A), general (G + 1, B), of (A,)."""
        return self.table, self.own, self.total, self.general, self.of, self.floor, self.most

    def at(self, anchor: NDArray, bins: NDArray) -> NDArray:
        """Log ratios (N,) of bins (N,) at anchors (N,)."""
        if self.own.shape[2] == 1:
            return np.asarray(self.table[anchor, bins])
        rows = self.of[anchor], -1
        inside, outside = (
            (self.own[k, anchor, bins] + self.general[row, bins]) / self.total[k, anchor] for k, row in enumerate(rows)
        )
        return np.clip(np.log((inside + self.floor) / (outside + self.floor)), -self.most, self.most)

    def between(self, own: NDArray, beyond: NDArray, bins: NDArray) -> NDArray:
        """Log ratios (N,) of bins (N,) where parts own (N,) occlude parts beyond (N,)."""
        return np.clip(self.logs[own, bins] - self.logs[beyond, bins], -self.most, self.most)

    @classmethod
    def of_table(cls, table: NDArray) -> Ratios:
        """Log ratios from a complete table (1, B)."""
        none = np.zeros((2, 1, 1), np.float32), np.ones((2, 1)), np.zeros((2, table.shape[1])), np.zeros(1, np.int64)
        return cls(table[0], table, *none, 0.0, 0.0, np.zeros_like(table))


def _density(counts: NDArray) -> NDArray:
    """Counts (B,) as a density (B,); uniform where all are 0."""
    total = counts.sum()
    return counts / total if total > 0 else np.full(len(counts), 1.0 / len(counts))
