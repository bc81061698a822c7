"""Linear assignment: the pairs of rows and columns with the least total cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError


def assign(cost: ArrayLike, most: float = np.inf) -> list[tuple[int, int]]:
    """Assign rows to columns: pairs (row, column) that maximise Σ (most − cost), each with a cost below `most`.

    Every row and every column is in one pair at most. With `most` infinite, there are as many pairs as finite costs
    allow. Shortest augmenting paths (Jonker and Volgenant 1987), in O(n³).

    Parameters
    ----------
    cost : (R, C), infinite where a pair is impossible
    most : cost of leaving a row and a column unassigned, in the unit of `cost`

    Raises
    ------
    ObservationError
        NaN among the costs, or no matrix.
    """
    cost = np.asarray(cost, float)
    if cost.ndim != 2 or np.isnan(cost).any():
        problem = f"costs of shape {cost.shape}" + (", some NaN" if np.isnan(cost).any() else "")
        raise ObservationError(problem, remedy="Give a matrix; infinity where a pair is impossible.")
    allowed = np.isfinite(cost) & (cost < most)
    if not allowed.any():
        return []
    if 1 in cost.shape:
        best = int(np.argmin(np.where(allowed, cost, np.inf)))
        return [divmod(best, cost.shape[1])]
    rows = np.flatnonzero(allowed.any(axis=1))
    nearest = np.where(allowed, cost, np.inf)[rows].argmin(axis=1)
    if len(set(nearest.tolist())) == len(rows):  # the best columns of all rows differ: no total is smaller
        return list(zip(rows.tolist(), nearest.tolist()))
    spread = float(np.ptp(cost[allowed])) + 1.0
    unassigned = most if np.isfinite(most) else float(cost[allowed].max()) + (min(cost.shape) + 1) * spread
    n = sum(cost.shape)  # every row and column may stay unassigned, at half of `most` each
    square = np.full((n, n), unassigned)
    square[: cost.shape[0], : cost.shape[1]] = np.where(allowed, cost, 3.0 * abs(unassigned) + 3.0 * spread)
    square[cost.shape[0] :, cost.shape[1] :] = 0.0
    square[: cost.shape[0], cost.shape[1] :] *= 0.5
    square[cost.shape[0] :, : cost.shape[1]] *= 0.5
    chosen = _assign_square(square)[: cost.shape[0]]
    return [(r, int(c)) for r, c in enumerate(chosen) if c < cost.shape[1] and allowed[r, c]]


def _assign_square(cost: NDArray) -> NDArray:
    """(n,) column assigned to each row of a square matrix (n, n), with the least total."""
    n = len(cost)
    u, v = np.zeros(n + 1), np.zeros(n + 1)
    owner = np.full(n + 1, -1)  # row of each column; every path starts at the last column
    for row in range(n):
        owner[n], column = row, n
        least, before, used = np.full(n, np.inf), np.full(n, n), np.zeros(n + 1, bool)
        while owner[column] >= 0:
            used[column] = True
            free = ~used[:n]
            reduced = cost[owner[column]] - u[owner[column]] - v[:n]
            better = free & (reduced < least)
            least[better], before[better] = reduced[better], column
            following = int(np.flatnonzero(free)[np.argmin(least[free])])
            delta = least[following]
            u[owner[used]] += delta
            v[used] -= delta
            least[free] -= delta
            column = following
        while column != n:
            owner[column] = owner[before[column]]
            column = int(before[column])
        owner[n] = -1
    out = np.empty(n, int)
    out[owner[:n]] = np.arange(n)
    return out
