"""Find markers that stay fixed in space while the person moves: fallen off, or glued to a chair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.findings import runs_of
from kinefit.observations import Markers

MAX_RESTING_DISTANCE = 0.005
"""[m] a resting marker stays this close to its mean position in a window."""

MIN_NEIGHBOUR_DISTANCE = 0.05
"""[m] from its mean position that each neighbour of a resting marker moves."""

WINDOW_S = 1.0
"""Length of a window: a foot stands for less, and so does a toe after the heel has lifted."""

MIN_NEIGHBOURS = 3
"""Nearest markers that must all move: of a hand on a table or a foot on the floor several rest together."""

_MAX_DISTANCE_FRAMES = 50  # frames in which distances are compared


def resting_markers(markers: Markers) -> list[tuple[str, tuple[int, int], float, str]]:
    """Find markers that rest in space while their neighbours move.

    They may rest in most frames of a take, where a model learnt from the same take would accept them.

    Returns
    -------
    list of (label, (first frame, last frame), median movement of the neighbours [m], sentence)
    """
    positions, length = markers.positions, max(2, round(WINDOW_S * markers.rate))
    starts = np.arange(0, len(positions) - length + 1, max(1, length // 2))  # empty in a shorter take
    reach = np.array([_reach(positions[a : a + length]) for a in starts]).reshape(len(starts), positions.shape[1])
    out = []
    for k in np.flatnonzero((reach < MAX_RESTING_DISTANCE).any(axis=0)).tolist():
        near, label = _nearest(positions, k), markers.names[k]
        if len(near) < MIN_NEIGHBOURS:
            continue
        least = reach[:, near].min(axis=1)  # NaN where one is not visible: no finding
        for a, b in runs_of((reach[:, k] < MAX_RESTING_DISTANCE) & (least > MIN_NEIGHBOUR_DISTANCE)):
            span, moved = (int(starts[a]), int(starts[b - 1]) + length - 1), float(np.median(least[a:b]))
            text = f"{label} stays still in frames {span[0]} to {span[1]} but its neighbours move {100 * moved:.0f} cm"
            out.append((label, span, moved, f"{text}: it is not on their segments"))
    return out


def _reach(x: NDArray) -> NDArray:
    """(K,) [m] largest distance of each marker from its mean; NaN if it is visible in less than half of the frames."""
    visible = np.isfinite(x[..., 0])
    count = visible.sum(axis=0)
    mean = np.where(visible[..., None], x, 0.0).sum(axis=0) / np.maximum(count, 1)[:, None]
    far = np.where(visible, np.linalg.norm(x - mean, axis=2), 0.0).max(axis=0)
    return np.where(2 * count >= len(x), far, np.nan)


def _nearest(positions: NDArray, k: int) -> NDArray:
    """Indices of the markers with the least median distance to marker k over the take."""
    x = positions[:: max(1, len(positions) // _MAX_DISTANCE_FRAMES)]
    gaps = np.linalg.norm(x - x[:, k, None], axis=2)
    is_neighbour = np.isfinite(gaps).mean(axis=0) > 0.5
    is_neighbour[k] = False
    neighbours = np.flatnonzero(is_neighbour)
    return neighbours[np.argsort(np.nanmedian(gaps[:, neighbours], axis=0))[:MIN_NEIGHBOURS]]
