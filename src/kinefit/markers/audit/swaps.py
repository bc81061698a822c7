"""Detect swapped labels of a take from distances between markers and from jumps that a swap would undo."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_SIGMAS = 5.0
"""Errors of distances are truncated here: a larger one carries no more information."""

TAIL_FACTOR = 1.5
"""Factor on the learnt standard deviations, which come from medians and are too small for the tails."""

MAX_GAP = 10
"""[frames] between two spans of the same kind that are reported as one."""


def place_costs(positions: NDArray, mean: NDArray, deviation: NDArray) -> tuple[NDArray, NDArray]:
    """Cost of giving a point another point's label.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled; NaN where not visible
    mean, deviation : (K, K) [m] of distances; NaN where unknown

    Returns
    -------
    (F, K, K), (F, K, K)
        C[f, i, q]: sum over k, without i and q, of min(((|x_q - x_k| - mean_ik) / deviation_ik)², TRUNCATION_SIGMAS²),
        where k keeps its label; t[f, i, j]: the term of i and j. Zero where a point is not visible.
    """
    frames, count = positions.shape[:2]
    d = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1).astype(np.float32)
    cost = np.zeros((frames, count, count), np.float32)
    own = np.zeros((frames, count, count), np.float32)
    for i in range(count):
        z = (d - mean[i].astype(np.float32)) / (TAIL_FACTOR * deviation[i]).astype(np.float32)  # (F, q, k)
        z = np.fmax(np.minimum(z * z, MAX_SIGMAS**2), np.float32(0.0))  # 0 for what is not seen
        z[:, :, i] = 0.0
        z[:, np.arange(count), np.arange(count)] = 0.0
        cost[:, i] = z.sum(-1)
        own[:, i] = z[:, i]
    return cost, own


def swap_gains(positions: NDArray, mean: NDArray, deviation: NDArray) -> NDArray:
    """(F, K, K) by how much the sum of squares falls if two labels are swapped in a frame; symmetric.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled; NaN where not visible
    mean, deviation : (K, K) [m] of distances
    """
    cost, pair_terms = place_costs(positions, mean, deviation)
    current = np.einsum("fii->fi", cost)
    return current[:, :, None] + current[:, None] - 2 * pair_terms - cost - cost.transpose(0, 2, 1)


def pair_gain(positions: NDArray, i: int, j: int, mean: NDArray, deviation: NDArray) -> NDArray:
    """(F,) by how much the sum of squares falls if labels i and j are swapped; see `swap_gains`."""
    gain = np.zeros(len(positions))
    for a, b in ((i, j), (j, i)):
        d = np.linalg.norm(positions - positions[:, a, None], axis=-1)
        for label, sign in ((a, 1), (b, -1)):
            z = np.nan_to_num(np.minimum(((d - mean[label]) / (TAIL_FACTOR * deviation[label])) ** 2, MAX_SIGMAS**2))
            z[:, [i, j]] = 0.0
            gain += sign * z.sum(1)
    return gain


def best_run(gain: NDArray, least: float) -> tuple[int, int, float]:
    """First and last index, and sum, of the run of `gain` (F,) with the largest sum of gain - least.

    A frame counts at most ten times `least`; both are numbers without unit, as `swap_gains` gives them.
    """
    worth = np.clip(gain - least, -10 * least, 10 * least)
    total = np.concatenate([[0.0], np.cumsum(worth)])
    lowest = np.minimum.accumulate(total)
    last = int(np.argmax(total - lowest))
    first = int(np.argmin(total[: last + 1]))
    return first, last - 1, float(total[last] - total[first])


def find_crossings(
    positions: NDArray, least: float = 0.02, better: float = 0.35
) -> tuple[list[tuple[int, int, int]], NDArray]:
    """Frames at which two trajectories continue where the other one was.

    Each position is predicted from the last two visible ones, over gaps of up to ten frames. Two markers cross if both
    miss their predictions by more than `least` [m], and a swap lowers their total error below the share `better` of it.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled; NaN where not visible

    Returns
    -------
    list, (F, K) bool
        Crossings (frame, i, j), the swap lying between this frame and the last; whether a trajectory jumps, begins or
        ends at a frame.
    """
    frames, count = positions.shape[:2]
    found = []
    broken = np.zeros((frames, count), bool)
    at, speed = positions[0].copy(), np.zeros((count, 3))
    age = np.where(np.isfinite(at[:, 0]), 0, 99)
    for f in range(1, frames):
        current = positions[f]
        predicted = at + speed * (age[:, None] + 1)
        off = np.linalg.norm(current - predicted, axis=-1)
        jumped = np.flatnonzero((off > least) & (age <= 10))
        broken[f, jumped] = True
        broken[f] |= np.isfinite(current[:, 0]) != (age == 0)
        if len(jumped) > 1:
            across = np.linalg.norm(current[jumped] - predicted[jumped][:, None], axis=-1)
            both = across + across.T
            np.fill_diagonal(both, np.inf)
            for a in range(len(jumped)):
                b = int(np.argmin(both[a]))
                if a < b and both[a, b] < better * (across[a, a] + across[b, b]):
                    found.append((f, int(jumped[a]), int(jumped[b])))
        visible = np.isfinite(current[:, 0])
        fresh = visible & (age == 0)
        speed = np.where(fresh[:, None], current - at, np.where(visible[:, None], 0.0, speed))
        for _, i, j in (c for c in found if c[0] == f):
            speed[[i, j]] = 0.0
        at = np.where(visible[:, None], current, at)
        age = np.where(visible, 0, age + 1)
    return found, broken


def interpolate_spans(positions: NDArray, length: int) -> tuple[NDArray, NDArray]:
    """Positions in all spans of `length` frames, measured and interpolated between the frames around each span.

    Parameters
    ----------
    positions : (F, K, 3) [m]; NaN where not visible
    length : number of frames

    Returns
    -------
    (n, length, K, 3), (n, length, K, 3) [m]
    """
    before, after = positions[: -length - 1], positions[length + 1 :]
    interpolated = np.stack([before + (after - before) * (i + 1) / (length + 1) for i in range(length)], axis=1)
    measured = np.stack([positions[i + 1 : len(positions) - length + i] for i in range(length)], axis=1)
    return measured, interpolated


def short_swaps(
    positions: NDArray, longest: int = 2, least: float = 0.02, better: float = 0.35
) -> list[tuple[int, int, int, int]]:
    """Swaps of up to `longest` frames (a, b, first, last), found by interpolation from the frames around them.

    One label is where the other one is expected, and the other label is at the first's place or not visible.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled; NaN where not visible
    least, better : [m] and share: see `find_crossings`
    """
    found: list[tuple[int, int, int, int]] = []
    taken = np.zeros(positions.shape[:2], bool)
    for length in range(1, longest + 1):
        measured, expected = interpolate_spans(positions, length)
        off = np.linalg.norm(measured - expected, axis=-1).min(axis=1)  # (F, K), NaN where not seen throughout
        for f, a in np.argwhere(off > least).tolist():
            across = np.linalg.norm(measured[f][:, a, None] - expected[f], axis=-1).max(axis=0)
            across[a] = np.inf
            if not np.isfinite(across).any():
                continue
            b = int(np.nanargmin(across))
            missing = not np.isfinite(measured[f][:, b]).any()
            back_error = np.linalg.norm(measured[f][:, b] - expected[f][:, a], axis=-1).max()
            own_error = np.linalg.norm(measured[f][:, b] - expected[f][:, b], axis=-1).min()
            rows = slice(f + 1, f + 1 + length)
            fits = across[b] < better * off[f, a] and (missing or back_error < better * own_error)
            if fits and not taken[rows][:, [a, b]].any():
                taken[rows, a] = taken[rows, b] = True
                found.append((min(a, b), max(a, b), f + 1, f + length))
    return found


