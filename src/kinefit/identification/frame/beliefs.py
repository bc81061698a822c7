"""What frames of a take tell of the others: which labels it has, and how noisy each segment is (EM)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.frame._kernels_evidence import least_squares
from kinefit.identification.frame.tables import segment_tables
from kinefit.identification.model.model import MarkerModel

if TYPE_CHECKING:
    from kinefit.identification.frame.identify import Identification

USUAL, FRAMES = 0.95, 1.0
"""Share of frames that show a label, before any was looked at, and how many frames that counts for."""

FIRM = 6.0
"""Degrees of freedom that the model's own deviations count for."""

LEAST, MOST = 0.7, 2.5
"""Of the noise of a segment, as a factor: frames of one take are too much alike to tell more."""

CERTAIN = 0.9
"""Names that tell of noise; less certain ones are chosen for fitting well."""


@dataclass(frozen=True, eq=False)
class Beliefs:
    """What a take has shown of a model's labels so far.

    Parameters
    ----------
    presence : (M,) in 0..1, share of the frames that show each label
    noise : (S,) factor on the deviations of each segment
    """

    presence: NDArray
    noise: NDArray

    @property
    def odds(self) -> NDArray:
        """(M,) what a label earns more than the usual one if it has a point, as log odds."""
        mean = float(np.median(self.presence))
        return np.log(self.presence / (1 - self.presence)) - np.log(mean / (1 - mean))


def learn_beliefs(model: MarkerModel, frames: Sequence[tuple[NDArray, Identification]]) -> Beliefs:
    """Presence and noise by what some frames were found to be: the M step; `identify` with them is the E step.

    Parameters
    ----------
    frames : points (N, 3) [m] and their names, of each frame that was looked at
    """
    seen = np.zeros(len(model))
    squares, freedom = np.zeros(len(model.segments)), np.zeros(len(model.segments))
    for points, found in frames:
        guess = found.assignment if found.guess is None else found.guess
        seen += np.where(guess >= 0, found.confidence, 0.0)
        sure = np.where(found.confidence >= CERTAIN, found.assignment, -1)
        for t in segment_tables(model, 0):
            here = sure[t.markers] >= 0
            n = int(here.sum())
            if n > 3:
                x, y = t.x[here], points[sure[t.markers[here]]]
                squares[t.index] += least_squares(n, x, y, 1 / t.sigma[here] ** 2, np.empty((3, 3)))
                freedom[t.index] += 3 * n - 6
    presence = np.clip((seen + USUAL * FRAMES) / (len(frames) + FRAMES), 0.02, 0.98)
    per_frame = freedom / max(len(frames), 1)  # one frame is like the next: all of them count as three
    mean = np.where(freedom > 0, squares / np.maximum(freedom, 1), 1.0)
    noise = np.sqrt((FIRM + 3 * per_frame * mean) / (FIRM + 3 * per_frame))
    return Beliefs(presence, np.clip(noise, LEAST, MOST))
