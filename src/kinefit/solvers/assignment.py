"""Linear assignment: the pairs of rows and columns with the least total cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit.errors import ObservationError


def assign(cost: ArrayLike, most: float = np.inf) -> list[tuple[int, int]]:
    """Assign rows to columns: pairs (row, column) that maximise Σ (most − cost), each with a cost below `most`.

    Every row and every column is in one pair at most. With `most` infinite, there are as many pairs as finite costs
    allow. Solved by `scipy.optimize.linear_sum_assignment` (Crouse 2016), in O(n³).

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
    from scipy.optimize import linear_sum_assignment  # half a second, for those who follow several people

    allowed = np.isfinite(cost) & (cost < most)
    if not allowed.any():
        return []
    spread = float(np.ptp(cost[allowed])) + 1.0
    unassigned = most if np.isfinite(most) else float(cost[allowed].max()) + (min(cost.shape) + 1) * spread
    pairs = zip(*linear_sum_assignment(np.where(allowed, cost - unassigned, 0.0)))
    return [(int(r), int(c)) for r, c in pairs if allowed[r, c]]
