"""Markers that rest in space while the person moves: fallen off, or glued to a chair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.findings import runs_of
from kinefit.observations import Markers

STILL, MOVES = 0.005, 0.05
"""[m] from the mean of a window: within the first a marker rests; its neighbours go beyond the second."""

WINDOW = 1.0
"""[s] of a window: a foot stands, and a toe longer than the heel beside it, for less."""

NEIGHBOURS = 3
"""That must all move: of a hand on a table or a foot on the floor others rest, too."""

_TRIED = 50  # frames in which distances are compared


def resting(markers: Markers) -> list[tuple[str, tuple[int, int], float, str]]:
    """Labels, first and last frames, how far the neighbours move [m], and sentences, of markers that rest.

    Most frames of a take may say so: a model that is learnt from it holds that for right.
    """
    positions, length = markers.positions, max(2, round(WINDOW * markers.rate))
    starts = np.arange(0, len(positions) - length + 1, max(1, length // 2))  # none in a shorter take
    reach = np.array([_reach(positions[a : a + length]) for a in starts]).reshape(len(starts), positions.shape[1])
    out = []
    for k in np.flatnonzero((reach < STILL).any(axis=0)).tolist():
        near, label = _nearest(positions, k), markers.names[k]
        if len(near) < NEIGHBOURS:
            continue
        least = reach[:, near].min(axis=1)  # of unseen ones NaN, and so nothing is said
        for a, b in runs_of((reach[:, k] < STILL) & (least > MOVES)):
            span, moved = (int(starts[a]), int(starts[b - 1]) + length - 1), float(np.median(least[a:b]))
            text = f"{label} rests in frames {span[0]} to {span[1]} while its neighbours move by {100 * moved:.0f} cm"
            out.append((label, span, moved, f"{text}: it is on none of their segments"))
    return out


def _reach(x: NDArray) -> NDArray:
    """(K,) [m] the farthest from its mean that each gets; NaN where one is not seen in half of the frames."""
    seen = np.isfinite(x[..., 0])
    count = seen.sum(axis=0)
    mean = np.where(seen[..., None], x, 0.0).sum(axis=0) / np.maximum(count, 1)[:, None]
    far = np.where(seen, np.linalg.norm(x - mean, axis=2), 0.0).max(axis=0)
    return np.where(2 * count >= len(x), far, np.nan)


def _nearest(positions: NDArray, k: int) -> NDArray:
    """Indices of the markers that are nearest to one, by the median over the take."""
    x = positions[:: max(1, len(positions) // _TRIED)]
    apart = np.linalg.norm(x - x[:, k, None], axis=2)
    seen = np.isfinite(apart).mean(axis=0) > 0.5
    seen[k] = False
    others = np.flatnonzero(seen)
    return others[np.argsort(np.nanmedian(apart[:, others], axis=0))[:NEIGHBOURS]]
