"""Nodes of a morphed surface along directions: what a morph adds to the derivative included (P1 2.4, 3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit.bodies.morphing import MorphedPose
from kinefit.errors import ObservationError
from kinefit.rows import ParameterRows


def morphed_rows(
    pose: MorphedPose, index: ArrayLike, direction: ArrayLike, residual: ArrayLike, *, sigma: ArrayLike = 0.01
) -> ParameterRows:
    """One row a node, r ≈ n·J δ, gathered into one joint row on all degrees of freedom.

    A morph ties a node to angles that move no segment of it, which `Rows` cannot say; so H = Σ w (nJ)ᵀ(nJ) goes in whole.
    The cost that solvers report for it leaves out what no step can reduce: use it with `gauss_newton`, in a loop that
    renews the rows.

    Parameters
    ----------
    pose : MorphedPose
    index : (K,) int, nodes of the mesh.
    direction : (K, 3) unit, in the world.
    residual : (K,) [m] how much further along it each node should lie; NaN for none.
    sigma : scalar or (K,) [m]
    """
    chosen, n, r = np.asarray(index, np.int64), np.asarray(direction, float), np.asarray(residual, float)
    if n.shape != (len(chosen), 3) or r.shape != (len(chosen),):
        problem = f"{len(chosen)} nodes with directions of shape {n.shape} and residuals of shape {r.shape}"
        raise ObservationError(problem, remedy="Give (K, 3) and (K,).")
    deviation = np.broadcast_to(np.asarray(sigma, float), r.shape)
    if not np.all(deviation > 0):
        raise ObservationError("a standard deviation that is not positive", remedy="Give metres above 0.")
    seen = np.isfinite(r) & np.isfinite(n).all(1)
    J = np.einsum("ki,kij->kj", n[seen], pose.jacobian(chosen[seen])) / deviation[seen, None]
    H, g = J.T @ J, J.T @ (r[seen] / deviation[seen])
    step = np.linalg.lstsq(H, g, rcond=1e-14)[0]  # g lies in the range of H, so H δ = g
    return ParameterRows(np.arange(len(H)), step, H)
