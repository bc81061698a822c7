"""Normal equations: rows of a body at a state -> H, g and the cost; damped steps; covariance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.rows import AnyRows, Rows, sort_out
from kinefit.solvers import _kernels
from kinefit.solvers.losses import SQUARED, Loss


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations H δ = g of a body at a state.

    Parameters
    ----------
    body, state : what they are about.
    rows : Rows that went in.
    factor : (N,) robust factor of each row in 0..1.
    lower : (n, n) lower triangle of H, in the pattern of `pattern`.
    gradient : (n,) g = Σ Jᵀ W r.
    cost : float, Σ ρ(w r²) over all rows.
    pattern : (n,) the next degree of freedom that each one meets in H.
    """

    body: Body
    state: BodyState
    rows: Rows
    factor: NDArray
    lower: NDArray
    gradient: NDArray
    cost: float
    pattern: NDArray

    @property
    def matrix(self) -> NDArray:
        """(n, n) H in full."""
        return self.lower + np.tril(self.lower, -1).T


def normal_equations(
    body: Body, state: BodyState, parts: AnyRows | Iterable[AnyRows], *, loss: Loss = SQUARED
) -> Equations:
    """Gather rows of any kinds at a state into H and g; the loss applies to every `Rows` with a measurement id."""
    rows, pairs, parameters = sort_out(parts)
    tree = body.tree
    n = tree.n_dofs
    _, screws = tree.forward(state.T_world_root, state.angles)
    centre = np.ascontiguousarray(state.T_world_root[:3, 3])
    factor, blocks = np.empty(len(rows)), np.empty((len(tree.segments), 27))
    H, g = np.zeros((n, n)), np.empty(n)
    cost = _kernels.assemble(
        rows.data, rows.segment, rows.group, len(rows), loss.kind, loss.scale, centre,
        tree.parents, tree.dof_start, tree.dof_parent, screws, factor, blocks, H, g,
    )  # fmt: skip
    for p in parameters:
        cost += _kernels.add_parameters(p.index, p.residual, p.weight, H, g)
    for q in pairs:
        cost += _kernels.add_pairs(
            q.segments, q.point_a, q.point_b, q.direction, q.residual, q.weight,
            centre, screws, tree.dof_parent, tree.last_dof, H, g,
        )  # fmt: skip
    pattern = np.arange(-1, n - 1) if pairs else tree.dof_parent
    return Equations(body, state, rows, factor, H, g, float(cost), pattern)


def covariance(H: NDArray, *, tolerance: float = 1e-10) -> NDArray:
    """(n, n) inverse of an undamped normal matrix; what nothing observes has infinite variance (and no covariance).

    A degree of freedom counts as unobserved when it takes part in a direction whose information is below `tolerance` of
    the largest, each degree of freedom measured in units of its own information.
    """
    n = len(H)
    diagonal = np.diag(H).copy()
    seen = diagonal > tolerance * max(float(diagonal.max(initial=0.0)), 1e-300)
    scale = np.where(seen, 1.0 / np.sqrt(np.where(seen, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(H * scale[:, None] * scale[None, :])
    strong = values > tolerance * max(float(values[-1]), 1e-300)
    inverse = (vectors[:, strong] / values[strong]) @ vectors[:, strong].T
    out = inverse * scale[:, None] * scale[None, :]
    lost = ~seen | (np.sum(vectors[:, ~strong] ** 2, axis=1) > 1e-6)
    out[lost, :] = out[:, lost] = 0.0
    out[np.arange(n)[lost], np.arange(n)[lost]] = np.inf
    return out


def joint_covariance(body: Body, state: BodyState, cov: NDArray) -> NDArray:
    """(S, 3, 3) [m²] covariance of every joint centre in the world; infinite where a needed angle is unobserved."""
    tree = body.tree
    frames, screws = tree.forward(state.T_world_root, state.angles)
    rotations = frames[:, :9].reshape(-1, 3, 3)
    x = (rotations @ tree.rest[:, :, None])[..., 0] + frames[:, 9:] - state.T_world_root[:3, 3]
    lost = ~np.isfinite(np.diag(cov))
    finite = np.where(np.isfinite(cov), cov, 0.0)
    out = np.empty((len(x), 3, 3))
    for s in range(len(x)):
        J = tree.segment_jacobian(screws, s)
        moves = J[:3] + np.cross(J[3:].T, x[s]).T
        out[s] = moves @ finite @ moves.T
        blind = np.abs(moves[:, lost]).max(axis=1, initial=0.0) > 1e-9
        out[s][blind, blind] = np.inf
    return out
