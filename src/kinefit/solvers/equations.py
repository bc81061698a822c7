"""Normal equations: rows of a body at a state -> H, g and the cost; damped steps; covariance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.rows import AnyRows, Rows, sort_out
from kinefit.solvers import _kernels, _kernels_linear
from kinefit.solvers.losses import SQUARED, Loss


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations H δ = g of a body at a state.

    Parameters
    ----------
    body, state : what they are about.
    rows : Rows that went in.
    factor : (N,) robust factor of each row in 0..1.
    packed : (n, m) H in the pattern of chain and depth, see `_kernels_linear`.
    gradient : (n,) g = Σ Jᵀ W r.
    cost : float, Σ ρ(w r²) over all rows.
    chain, depth : (n, m), (n,) int: what stands above each degree of freedom; all before it with pair rows.
    """

    body: Body
    state: BodyState
    rows: Rows
    factor: NDArray
    packed: NDArray
    gradient: NDArray
    cost: float
    chain: NDArray
    depth: NDArray

    @property
    def matrix(self) -> NDArray:
        """(n, n) H in full."""
        H = np.zeros((len(self.depth), len(self.depth)))
        _kernels_linear.unpack(self.packed, self.chain, self.depth, H)
        return H

    @property
    def diagonal(self) -> NDArray:
        """(n,) of H."""
        return self.packed[np.arange(len(self.depth)), self.depth]


def normal_equations(
    body: Body, state: BodyState, parts: AnyRows | Iterable[AnyRows], *, loss: Loss = SQUARED
) -> Equations:
    """Gather rows of any kinds at a state into H and g; the loss applies to every `Rows` with a measurement id."""
    rows, pairs, parameters = sort_out(parts)
    tree = body.tree
    n = tree.n_dofs
    _, screws = tree.forward(state.T_world_root, state.angles)
    centre = np.ascontiguousarray(state.T_world_root[:3, 3])
    chain, depth = tree.chain, tree.depth
    factor, blocks = np.empty(len(rows)), np.empty((len(tree.segments), 27))
    C, g = np.empty(chain.shape), np.empty(n)
    cost = _kernels.assemble(
        rows.data, rows.segment, rows.group, len(rows), loss.kind, loss.scale, centre,
        tree.parents, tree.dof_start, chain, depth, screws, factor, blocks, C, g,
    )  # fmt: skip
    for p in parameters:
        cost += _kernels.add_parameters(p.index, p.residual, p.weight, depth, C, g)
    if pairs:
        H = np.zeros((n, n))
        _kernels_linear.unpack(C, chain, depth, H)
        for q in pairs:
            cost += _kernels.add_pairs(
                q.segments, q.point_a, q.point_b, q.direction, q.residual, q.weight,
                centre, screws, tree.dof_parent, tree.last_dof, H, g,
            )  # fmt: skip
        chain, depth = np.tile(np.arange(n), (n, 1)), np.arange(n)
        return Equations(body, state, rows, factor, H, g, float(cost), chain, depth)
    return Equations(body, state, rows, factor, C, g, float(cost), chain, depth)


def lock(body: Body, locked: NDArray | None) -> NDArray:
    """(6 + D,) bool, degrees of freedom that may not move: those given, and the root of a body that is fixed."""
    out = np.zeros(body.tree.n_dofs, bool) if locked is None else np.array(locked, bool)
    out[:6] |= not body.tree.root_free
    return out


def covariance(equations: Equations, *, locked: NDArray | None = None) -> NDArray:
    """(n, n) inverse of the undamped normal matrix; what nothing observes has infinite variance and no covariance.

    A degree of freedom counts as unobserved where its information, given all others, is below 1e-10 of its own.

    Parameters
    ----------
    locked : (n,) bool, degrees of freedom that are known: their variance is zero. A fixed root always is.
    """
    n = len(equations.depth)
    known, lost = lock(equations.body, locked), np.zeros(n, bool)
    out, C = np.empty((n, n)), np.array(equations.packed)
    while True:  # a free direction is found at one of its degrees of freedom, then all that take part are taken out
        without = known | lost
        if without.any():
            H = np.where(without[:, None] | without[None, :], np.eye(n), equations.matrix)
            _kernels_linear.pack(H, equations.chain, equations.depth, C)
        found = _kernels_linear.invert(C, equations.chain, equations.depth, out)
        if found < 0:
            break
        lost |= _free_direction(equations.matrix, without, found)
    out[without, :] = out[:, without] = 0.0
    out[lost, lost] = np.inf
    return out


def _free_direction(H: NDArray, lost: NDArray, found: int) -> NDArray:
    """(n,) degrees of freedom that take part in directions without information, by eigenvalues of the scaled H."""
    scale = 1.0 / np.sqrt(np.where(np.diag(H) > 0, np.diag(H), 1.0))
    kept = np.where(lost[:, None] | lost[None, :], np.eye(len(H)), H * scale[:, None] * scale[None, :])
    values, vectors = np.linalg.eigh(kept)
    weak = values < 1e-10
    out = np.sum(np.square(vectors[:, weak]), axis=1) > 1e-8
    out[found] = True
    return out


def joint_std(body: Body, state: BodyState, cov: NDArray) -> NDArray:
    """(S, 3) [m] standard deviation of every joint centre along the world's axes; inf where that is unobserved."""
    tree = body.tree
    frames, screws = tree.forward(state.T_world_root, state.angles)
    lost = ~np.isfinite(np.diag(cov))
    moves = np.empty((len(tree.segments), 3, tree.n_dofs))
    _kernels.joint_moves(frames, screws, tree.rest, state.T_world_root, tree.dof_parent, tree.last_dof, moves)
    variance = np.einsum("sin,sin->si", moves @ np.where(np.isfinite(cov), cov, 0.0), moves)
    blind = np.abs(moves[:, :, lost]).max(axis=2, initial=0.0) > 1e-9
    return np.where(blind, np.inf, np.sqrt(np.maximum(variance, 0.0)))
