"""Damped Gauss-Newton over a whole sequence, for peers that give kinematics and Jacobians but no solver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv

THRESHOLDS = (3e-1, 1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6, 1e-8, 1e-12)


def solve_sequence(
    linearise: Callable[[Any], tuple[np.ndarray, np.ndarray]],
    integrate: Callable[[Any, np.ndarray], Any],
    start: Any,
    targets: np.ndarray,
    threshold: float,
    max_iterations: int = 50,
) -> tuple[list[Any], int]:
    """Fit every frame from the solution of the one before.

    Parameters
    ----------
    linearise
        `linearise(q) -> (points, jacobian)`, points (3M,), jacobian (3M, n); may be overwritten by the next call.
    integrate
        `integrate(q, step) -> q`, a new configuration.
    targets
        (F, 3M) [m].
    threshold
        A step whose predicted decrease is below `threshold` times the cost is the last one; it is taken on trust.

    Returns
    -------
    configurations of all frames, and the number of all linearisations.
    """
    q, solutions, iterations = start, [], 0
    for target in targets:
        damping, best, fallback = 1e-9, np.inf, q
        for _ in range(max_iterations):
            iterations += 1
            points, jacobian = linearise(q)
            residual = points - target
            cost = residual @ residual
            if cost <= best:
                best, fallback, damping = cost, q, max(damping * 0.1, 1e-9)
                normal, gradient = jacobian.T @ jacobian, residual @ jacobian
            else:
                damping = max(damping * 30, 1e-4)
            damped = normal.copy()
            damped.flat[:: len(gradient) + 1] += damping
            step = dposv(damped, gradient)[1]
            q = integrate(fallback, -step)
            if gradient @ step < threshold * best:
                break
        solutions.append(q)
    return solutions, iterations
