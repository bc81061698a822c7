"""Tables of a marker model for the label search: per segment positions, distances, deviations, joints.

Estimate from labelled frames of a take which labels it shows and how noisy each segment is (EM).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.markers.frame._kernels_evidence import least_squares
from kinefit.markers.model.model import MarkerModel

MIN_MARKER_SIGMA = 1e-3
"""[m] lower bound of the standard deviation of a marker's coordinate in its segment, for short training takes."""

UNSEEN_MOTION_SHARE = 0.7
"""Deviation that training does not show, as a share of the catalogue's: skin moves differently in other motions."""

RANGE_MARGIN = 0.03
"""[m] by which distances across a joint may exceed their training range."""

RANGE_MARGIN_SHARE = 0.15
"""Share of the training range that is added to this margin."""


@dataclass(frozen=True, eq=False)
class SegmentTable:
    """One segment in the tree of a chosen root.

    Parameters
    ----------
    index, parent, children : indices of the segment, its parent (-1 for the root) and its children
    markers : (k,) int
    x, D : (k, 3), (k, k) [m] reference positions and their distances
    sigma : (k,) [m] standard deviation of each coordinate
    shared : (k,) position of each marker in the parent's `markers`, or -1
    common : the markers with such a position
    joint_here, joint_there : (3,) [m] in this segment's and the parent's reference; None for the root
    spread : [m] standard deviation of the joint per coordinate
    low, high, width : (k', k) [m] range of distances to the parent's markers, and its margin; 0 without training
    """

    index: int
    parent: int
    children: tuple[int, ...]
    markers: NDArray
    x: NDArray
    D: NDArray
    sigma: NDArray
    shared: NDArray
    common: NDArray
    joint_here: NDArray | None
    joint_there: NDArray | None
    spread: float
    low: NDArray
    high: NDArray
    width: NDArray


@lru_cache(maxsize=64)
def segment_tables(model: MarkerModel, root: int) -> tuple[SegmentTable, ...]:
    """Tables of the model's segments, parents first, for any segment as the root."""
    links: dict[int, list[tuple[int, NDArray, NDArray, float, bool]]] = {s: [] for s in range(len(model.segments))}
    for j in model.joints:
        above, below, learnt = np.asarray(j.in_parent, float), np.asarray(j.in_child, float), j.exercised > 0
        links[j.parent].append((j.child, below, above, j.spread, learnt))
        links[j.child].append((j.parent, above, below, j.spread, learnt))
    found: list[SegmentTable] = []
    trained = any(j.exercised > 0 for j in model.joints)  # else the deviations are priors for any motion
    todo: list[tuple[int, int, NDArray | None, NDArray | None, float, bool]] = [(root, -1, None, None, 0.0, False)]
    while todo:
        s, parent, here, there, spread, learnt = todo.pop(0)
        children = [link for link in links[s] if link[0] != parent]
        todo += [(link[0], s, link[1], link[2], link[3], link[4]) for link in children]
        markers = np.array(model.segments[s], np.int64)
        x = np.ascontiguousarray(np.asarray(model.reference, float)[markers])
        parent_markers = list(model.segments[parent]) if parent >= 0 else []
        shared = np.array([parent_markers.index(m) if m in parent_markers else -1 for m in markers], np.int64)
        pairs = np.ix_(np.array(parent_markers, np.int64), markers)
        low, high = model.low[pairs], model.high[pairs]
        width = (RANGE_MARGIN + RANGE_MARGIN_SHARE * (high - low)) * (learnt and np.isfinite(high - low))
        sigmas = marker_sigmas(model.deviation[np.ix_(markers, markers)])
        D = np.linalg.norm(x[:, None] - x, axis=-1)
        found.append(
            SegmentTable(
                s, parent, tuple(link[0] for link in children), markers, x, D,
                np.hypot(sigmas, unseen_sigmas(D) * trained), shared, np.flatnonzero(shared >= 0), here, there, spread,
                np.nan_to_num(low), np.nan_to_num(high), np.nan_to_num(width),
            )
        )  # fmt: skip
    return tuple(found)


def unseen_sigmas(D: NDArray) -> NDArray:
    """(k,) [m] standard deviation of each coordinate due to motions outside of training; D (k, k) [m]."""
    mean = D.sum(1) / max(len(D) - 1, 1)
    return UNSEEN_MOTION_SHARE * (0.004 + 0.03 * mean) / np.sqrt(2.0)


def marker_sigmas(deviation: NDArray) -> NDArray:
    """(k,) [m] standard deviations of coordinates from those (k, k) of distances: d_ij² ≈ s_i² + s_j²."""
    k = len(deviation)
    if k < 2:
        return np.full(k, 0.01)
    square = np.where(np.isfinite(deviation), deviation, np.nanmedian(deviation)) ** 2
    np.fill_diagonal(square, 0.0)
    total = square.sum() / (2 * (k - 1))
    mean = total / k
    own = (square.sum(1) - total) / (k - 2) if k > 2 else np.full(k, mean)
    return np.sqrt(np.maximum(own, max(0.25 * mean, MIN_MARKER_SIGMA**2)))


PRIOR_PRESENCE = 0.95
"""Prior share of frames that show a label."""

PRIOR_FRAMES = 1.0
"""Weight of this prior, in frames."""

PRIOR_DEGREES = 6.0
"""Weight of the model's standard deviations, in degrees of freedom."""

MIN_NOISE = 0.7
MAX_NOISE = 2.5
"""Limits of a segment's noise factor: the frames of one take are too alike for more."""

MIN_CONFIDENCE = 0.9
"""Only labels of this confidence count for the noise: less certain ones were selected by a good fit."""


@dataclass(frozen=True, eq=False)
class Identification:
    """Labels of one frame's points.

    Parameters
    ----------
    assignment : (M,) int, the point of each label of the model; -1 if missing or unknown
    confidence : (M,) probability, 0 to 1, that `guess` is right; 0 without one
    cost : -log likelihood ratio of the best explanation to no point being a marker
    ambiguous : whether a label has a guess below the required probability
    scale : estimated noise, as a factor on the model's deviations
    guess : (M,) int, the most probable point of each label, however improbable; -1 for none
    """

    assignment: NDArray
    confidence: NDArray
    cost: float
    ambiguous: bool
    scale: float = 1.0
    guess: NDArray | None = None


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Presence of labels and noise of segments, estimated from frames of a take.

    Parameters
    ----------
    presence : (M,) in 0..1, share of the frames that show each label
    noise : (S,) factor on the deviations of each segment
    """

    presence: NDArray
    noise: NDArray

    @property
    def odds(self) -> NDArray:
        """(M,) log odds of each label's presence relative to the median presence."""
        mean = float(np.median(self.presence))
        return np.log(self.presence / (1 - self.presence)) - np.log(mean / (1 - mean))


def learn_beliefs(model: MarkerModel, frames: Sequence[tuple[NDArray, Identification]]) -> Beliefs:
    """Estimate presence and noise from labelled frames: the M step; `identify` with the result is the E step.

    Parameters
    ----------
    frames : points (N, 3) [m] and identification of each frame
    """
    presence_sums = np.zeros(len(model))
    squares, freedom = np.zeros(len(model.segments)), np.zeros(len(model.segments))
    for points, found in frames:
        guess = found.assignment if found.guess is None else found.guess
        presence_sums += np.where(guess >= 0, found.confidence, 0.0)
        certain_points = np.where(found.confidence >= MIN_CONFIDENCE, found.assignment, -1)
        for t in segment_tables(model, 0):
            visible = certain_points[t.markers] >= 0
            n = int(visible.sum())
            if n > 3:
                x, y = t.x[visible], points[certain_points[t.markers[visible]]]
                squares[t.index] += least_squares(n, x, y, 1 / t.sigma[visible] ** 2, np.empty((3, 3)))
                freedom[t.index] += 3 * n - 6
    presence = np.clip((presence_sums + PRIOR_PRESENCE * PRIOR_FRAMES) / (len(frames) + PRIOR_FRAMES), 0.02, 0.98)
    per_frame = freedom / max(len(frames), 1)  # frames are alike: together they count as three
    mean = np.where(freedom > 0, squares / np.maximum(freedom, 1), 1.0)
    noise = np.sqrt((PRIOR_DEGREES + 3 * per_frame * mean) / (PRIOR_DEGREES + 3 * per_frame))
    return Beliefs(presence, np.clip(noise, MIN_NOISE, MAX_NOISE))
