"""Colours of a body and of what is around it: histograms in CIELab, of the whole and near each part of the contour.

P3 2.4 models both regions by densities p₁, p₂ of their colours. Here they are histograms, blended over time so that
light may change. A pixel of colour c speaks for the body by log p₁(c) / p₂(c).
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

_THIN = 10.0  # [counted pixels] that the whole body's colours weigh as much as in those of a part: few for a hand
_FLOOR = 0.02  # share of both densities that is even over all colours: paint that was not seen yet, noise, reflections


@dataclass(frozen=True)
class SearchSettings:
    """How a body is sought where it is not known well where to expect it; see `sensors.region_search`.

    Parameters
    ----------
    side : float [cells] of the map of log ratios, length of the body in it
    rotations : int, tried with all places
    best : int, of these that are improved
    rounds, draws : int, how often, and with how many poses each
    starts : int, that are handed out
    doubt : float, share of what the body could explain by which half a variance off the prediction is worse
    far : float, in lengths of the body, and turn : float [rad]
        Standard deviations of the prediction from which a body is sought in any case.
    poor : float, share of the contour that agrees below which it is sought too
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
    """How regions are told apart, and how a contour is found between them.

    Parameters
    ----------
    space : "lab" or "rgb", in which colours are binned
    levels : int, bins along each of the three axes
    parts : bool
        Whether colours are counted apart for every segment of the body, left and right together: skin, shirt,
        trousers. Contours of one before another are then looked at, too, where their colours differ.
    anchors : int
        Points of the surface near which colours are counted apart; 0 for one statistic of each part alone.
    spread : float [pixels]
        The whole body's statistics weigh as much as so many pixels counted near an anchor.
    rate, near_rate : float in 0..1
        Share of a new image in the statistics of the body, and of what is around it; the first images count alike.
    far : float in 0..1
        Share of the whole image in what is around the body; the rest is counted near it.
    most : float
        Largest logarithm of the ratio of two densities that a single pixel may have.
    rule : "likelihood" or "shift"
        A line's place by the likelihood of all places along it; or the paper's rule: one step outwards where the
        contour's own pixels look like the body, one step inwards where they do not (P3 2.4.2).
    half : int, samples of a line to either side: of one pixel each in the last iterations, of several before
    heat : float
        Number of neighbouring pixels that tell as much as one, as they are alike.
    tells : float
        Logarithm by which the best place must explain a line better than no contour on it does.
    alike : float [px] of the contour along which errors are alike: as many measurements count as there are such pieces
    lines : int, contour points, about
    loss : float [standard deviations] scale of the robust loss
    flips : int, mirrored limbs that a fit is begun at, every `TrackSettings.search_every`
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
    """Bin (32768,) int32 of every colour of five bits a channel, and how many bins there are.

    Along each axis bins are as wide as fits `levels` of them into the range that sRGB has there; those that no colour
    falls into are left out.
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
    inside : (G, B) of each part of the body
    near, far : (B,) of what is near the body, of the whole image but the body
    own : (2, A, B) float32 pixels counted inside and outside near each anchor, older ones weighing less
    pixels : (G,) counted of each part, a mean over time
    times : (G,) int, in how many images each part was counted
    images : int, how many went in
    """

    inside: NDArray
    near: NDArray
    far: NDArray
    own: NDArray
    pixels: NDArray
    times: NDArray
    images: int = 1

    def blended(self, inside: NDArray, outside: NDArray, lines: CountLines, s: RegionSettings) -> RegionColours:
        """With the pixels of each part (G, B) and outside (2, B) of a new image, and those `lines` counts near anchors.

        A part of which nothing was counted, as it is hidden, stays as it was.
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
        """Before the first image."""
        none, own = np.zeros(bins), np.zeros((2, s.anchors, bins), np.float32)
        return cls(np.zeros((parts, bins)), none, none, own, np.zeros(parts), np.zeros(parts, np.int64), 0)

    def ratios(self, s: RegionSettings, of: NDArray | None = None) -> Ratios:
        """Log ratios inside to outside; `of` (A,) the part of the body that each anchor lies on, default the first."""
        n, outside = self.inside.shape[1], s.far * self.far + (1 - s.far) * self.near
        total = self.pixels.sum()
        body = self.pixels @ self.inside / total if total > 0.0 else np.full(n, 1.0 / n)
        parts = (self.pixels[:, None] * self.inside + _THIN * body) / (self.pixels + _THIN)[:, None]
        general, floor = np.concatenate([parts, outside[None]]), _FLOOR / n

        def ratio(inside: NDArray) -> NDArray:
            told = np.log((inside + floor) / (outside + floor))
            return np.ascontiguousarray(np.clip(told, -s.most, s.most), np.float32)

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
"""(2,) weights of a pixel inside and outside, (2, A, B) histograms that it is added to."""


@dataclass(frozen=True, eq=False)
class Ratios:
    """Log ratios of the densities inside and outside, each found when it is first looked up; see `kernels.profiles`.

    Parameters
    ----------
    whole : (B,) float32 of the body as a whole
    table : (A, B) float32 at each anchor, UNKNOWN where it was not asked for yet
    own, total, general, of, floor, most : what they are found from
    logs : (G + 1, B) float32 logarithms of the densities of each part and, last, of what is around
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
        """As `kernels.profiles` takes them."""
        return self.table, self.own, self.total, self.general, self.of, self.floor, self.most

    def at(self, anchor: NDArray, bins: NDArray) -> NDArray:
        """(N,) of bins (N,) at anchors (N,)."""
        if self.own.shape[2] == 1:
            return np.asarray(self.table[anchor, bins])
        rows = self.of[anchor], -1
        inside, outside = (
            (self.own[k, anchor, bins] + self.general[row, bins]) / self.total[k, anchor] for k, row in enumerate(rows)
        )
        return np.clip(np.log((inside + self.floor) / (outside + self.floor)), -self.most, self.most)

    def between(self, own: NDArray, beyond: NDArray, bins: NDArray) -> NDArray:
        """(N,) of bins (N,) where parts own (N,) lie before parts beyond (N,)."""
        return np.clip(self.logs[own, bins] - self.logs[beyond, bins], -self.most, self.most)

    @classmethod
    def of_table(cls, table: NDArray) -> Ratios:
        """Of a table (1, B) in which all is known."""
        none = np.zeros((2, 1, 1), np.float32), np.ones((2, 1)), np.zeros((2, table.shape[1])), np.zeros(1, np.int64)
        return cls(table[0], table, *none, 0.0, 0.0, np.zeros_like(table))


def _density(counts: NDArray) -> NDArray:
    """Counts (B,) as a density; even where nothing was counted."""
    total = counts.sum()
    return counts / total if total > 0 else np.full(len(counts), 1.0 / len(counts))
