"""Estimate from labelled frames of a take which labels it shows and how noisy each segment is (EM)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.markers.frame._kernels_evidence import least_squares
from kinefit.markers.frame.tables import segment_tables
from kinefit.markers.model.model import MarkerModel

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
