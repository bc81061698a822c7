"""Which labels of a take changed places, and when: by distances over time, and by jumps that an exchange undoes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MOST = 5.0
"""Deviations beyond which a distance says no more: it is wrong, by whatever."""

TAIL = 1.5
"""A distance strays this much more than its deviation tells: it is learnt from the middle of what was seen."""

JOIN = 10
"""Frames between two spans of one thing that are told as one span."""


def place_costs(positions: NDArray, mean: NDArray, deviation: NDArray) -> tuple[NDArray, NDArray]:
    """What it costs to call a point by another's label.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled, NaN where not seen
    mean, deviation : (K, K) [m] of distances; NaN where nothing is known

    Returns
    -------
    (F, K, K), (F, K, K)
        C[f, i, q]: sum over all k but i and q of min(((|x_q - x_k| - mean_ik) / deviation_ik)², MOST²), the points of k
        being labelled as they are; t[f, i, j]: the term of i and j themselves. Zero where a point is not seen.
    """
    frames, count = positions.shape[:2]
    d = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1).astype(np.float32)
    cost = np.zeros((frames, count, count), np.float32)
    own = np.zeros((frames, count, count), np.float32)
    for i in range(count):
        z = (d - mean[i].astype(np.float32)) / (TAIL * deviation[i]).astype(np.float32)  # (F, q, k)
        z = np.fmax(np.minimum(z * z, MOST**2), np.float32(0.0))  # 0 for what is not seen
        z[:, :, i] = 0.0
        z[:, np.arange(count), np.arange(count)] = 0.0
        cost[:, i] = z.sum(-1)
        own[:, i] = z[:, i]
    return cost, own


def swap_gains(positions: NDArray, mean: NDArray, deviation: NDArray) -> NDArray:
    """(F, K, K) by how much the sum of squares falls when two labels are exchanged in a frame; symmetric."""
    cost, own = place_costs(positions, mean, deviation)
    here = np.einsum("fii->fi", cost)
    return here[:, :, None] + here[:, None] - 2 * own - cost - cost.transpose(0, 2, 1)


def pair_gain(positions: NDArray, i: int, j: int, mean: NDArray, deviation: NDArray) -> NDArray:
    """(F,) the same for one pair."""
    gain = np.zeros(len(positions))
    for a, b in ((i, j), (j, i)):
        d = np.linalg.norm(positions - positions[:, a, None], axis=-1)
        for label, sign in ((a, 1), (b, -1)):
            z = np.nan_to_num(np.minimum(((d - mean[label]) / (TAIL * deviation[label])) ** 2, MOST**2))
            z[:, [i, j]] = 0.0
            gain += sign * z.sum(1)
    return gain


def best_run(gain: NDArray, least: float) -> tuple[int, int, float]:
    """First, last and sum of the run of largest sum of gain - least; a frame counts at most ten times `least`."""
    worth = np.clip(gain - least, -10 * least, 10 * least)
    total = np.concatenate([[0.0], np.cumsum(worth)])
    lowest = np.minimum.accumulate(total)
    last = int(np.argmax(total - lowest))
    first = int(np.argmin(total[: last + 1]))
    return first, last - 1, float(total[last] - total[first])


def crossings(
    positions: NDArray, least: float = 0.02, better: float = 0.35
) -> tuple[list[tuple[int, int, int]], NDArray]:
    """Frames at which two markers go on where the other was: (frame, i, j), the exchange being between it and the last.

    Each place is foretold from the last two, over up to ten frames not seen. Two that both miss theirs by more than
    `least` [m], and would miss them by less than `better` of that if they were exchanged, have crossed.

    Returns
    -------
    list, (F, K) bool
        The crossings; whether a trajectory is broken at a frame: a jump, or it begins or ends there.
    """
    frames, count = positions.shape[:2]
    found = []
    broken = np.zeros((frames, count), bool)
    at, speed = positions[0].copy(), np.zeros((count, 3))
    age = np.where(np.isfinite(at[:, 0]), 0, 99)
    for f in range(1, frames):
        now = positions[f]
        foretold = at + speed * (age[:, None] + 1)
        off = np.linalg.norm(now - foretold, axis=-1)
        jumped = np.flatnonzero((off > least) & (age <= 10))
        broken[f, jumped] = True
        broken[f] |= np.isfinite(now[:, 0]) != (age == 0)
        if len(jumped) > 1:
            across = np.linalg.norm(now[jumped] - foretold[jumped][:, None], axis=-1)
            both = across + across.T
            np.fill_diagonal(both, np.inf)
            for a in range(len(jumped)):
                b = int(np.argmin(both[a]))
                if a < b and both[a, b] < better * (across[a, a] + across[b, b]):
                    found.append((f, int(jumped[a]), int(jumped[b])))
        seen = np.isfinite(now[:, 0])
        fresh = seen & (age == 0)
        speed = np.where(fresh[:, None], now - at, np.where(seen[:, None], 0.0, speed))
        for _, i, j in (c for c in found if c[0] == f):
            speed[[i, j]] = 0.0
        at = np.where(seen[:, None], now, at)
        age = np.where(seen, 0, age + 1)
    return found, broken


def passing(positions: NDArray, length: int) -> tuple[NDArray, NDArray]:
    """(n, length, K, 3) [m] where labels are in spans of so many frames, and where they pass from before to after."""
    before, after = positions[: -length - 1], positions[length + 1 :]
    usual = np.stack([before + (after - before) * (i + 1) / (length + 1) for i in range(length)], axis=1)
    here = np.stack([positions[i + 1 : len(positions) - length + i] for i in range(length)], axis=1)
    return here, usual


def glitches(
    positions: NDArray, longest: int = 2, least: float = 0.02, better: float = 0.35
) -> list[tuple[int, int, int, int]]:
    """Exchanges of a frame or two (a, b, first, last): one label is where the other passes; the other there, or hidden.

    Where each passes is told by the frames just before and after, in which both are seen; see `crossings` for `least`
    and `better`.
    """
    found: list[tuple[int, int, int, int]] = []
    taken = np.zeros(positions.shape[:2], bool)
    for length in range(1, longest + 1):
        here, usual = passing(positions, length)
        off = np.linalg.norm(here - usual, axis=-1).min(axis=1)  # (F, K), NaN where not seen throughout
        for f, a in np.argwhere(off > least).tolist():
            across = np.linalg.norm(here[f][:, a, None] - usual[f], axis=-1).max(axis=0)
            across[a] = np.inf
            if not np.isfinite(across).any():
                continue
            b = int(np.nanargmin(across))
            hidden = not np.isfinite(here[f][:, b]).any()
            back = np.linalg.norm(here[f][:, b] - usual[f][:, a], axis=-1).max()
            own = np.linalg.norm(here[f][:, b] - usual[f][:, b], axis=-1).min()
            rows = slice(f + 1, f + 1 + length)
            if across[b] < better * off[f, a] and (hidden or back < better * own) and not taken[rows][:, [a, b]].any():
                taken[rows, a] = taken[rows, b] = True
                found.append((min(a, b), max(a, b), f + 1, f + length))
    return found


