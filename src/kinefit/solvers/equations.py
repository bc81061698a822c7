"""Normal equations: rows of a body at a state -> H, g and the cost; damped steps; covariance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.losses import SQUARED, Loss
from kinefit.rows import AnyRows, DofRows, Rows, sort_out
from kinefit.solvers import _kernels, _kernels_border, _kernels_linear

_ROUNDING = 1e-14  # share of the most informed degree of freedom's information that is none
_LOOSE = 1e-5  # share of a free direction from which a degree of freedom takes part in it


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
    chain, depth : (n, m), (n,) int: what stands above each degree of freedom; all before it where rows couple them.
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
    body: Body, state: BodyState, parts: AnyRows | Iterable[AnyRows], *, loss: Loss = SQUARED,
    shares: Sequence[float] | None = None,
) -> Equations:  # fmt: skip
    """Gather rows of any kinds at a state into H and g.

    Parameters
    ----------
    loss : of rows without their own
    shares : how much each of several parts counts, beyond its loss; default: in full
    """
    parts = [parts] if isinstance(parts, AnyRows) else list(parts)
    if shares is None:
        shares = (1.0,) * len(parts)
    else:
        parts = [_counting(p, share) for p, share in zip(parts, shares, strict=True)]
    rows, pairs, parameters, dense = sort_out(parts)
    tree = body.tree
    n = tree.n_dofs
    _within("segment", len(tree.segments), body, rows.segment, *(q.segments for q in pairs))
    _within("degree of freedom", n, body, *(p.index for p in parameters))
    _, screws = tree.forward(state.T_world_root, state.angles)
    centre = np.ascontiguousarray(state.T_world_root[:3, 3])
    chain, depth = tree.chain, tree.depth
    factor, blocks = np.empty(len(rows)), np.empty((len(tree.segments), 27))
    C, g = np.empty(chain.shape), np.empty(n)
    given = [(p, share) for p, share in zip(parts, shares, strict=True) if isinstance(p, Rows)]
    one = given[0][0].loss or loss if len(given) == 1 else loss
    mixed = np.ndim(one.scale) > 0 or any(share != 1.0 or (p.loss or loss) is not one for p, share in given)
    data, kind, scale, cost = rows.data, one.kind, one.scale, 0.0
    if mixed:  # each part by its own loss: in the weights already, with what that leaves of the cost
        weighed = [((p.loss or loss).of_rows(p.data, p.group), share) for p, share in given]
        robust = np.concatenate([share * f for (f, _), share in weighed])
        data, kind, scale = np.array(rows.data), SQUARED.kind, 1.0
        data[7] *= robust
        cost = sum(share * c for (_, c), share in weighed) - float(data[7] @ np.square(data[6]))
    cost += _kernels.assemble(
        data, rows.segment, rows.group, len(rows), kind, scale, centre,
        tree.parents, tree.dof_start, chain, depth, screws, factor, blocks, C, g,
    )  # fmt: skip
    if mixed:
        factor = robust
    joint = [p for p in parameters if p.weight.ndim == 2]
    for p in parameters:
        if p.weight.ndim == 1:
            cost += _kernels.add_parameters(p.index, p.residual, p.weight, depth, C, g)
    if pairs or joint or dense:
        H = np.zeros((n, n))
        _kernels_linear.unpack(C, chain, depth, H)
        for p in joint:
            pull = p.weight @ p.residual
            if len(p) and (p.index[1:] - p.index[:-1] == 1).all():
                own = slice(int(p.index[0]), int(p.index[-1]) + 1)
                H[own, own] += p.weight
                g[own] += pull
            else:
                H[np.ix_(p.index, p.index)] += p.weight
                g[p.index] += pull
            cost += float(p.residual @ pull)
        for q in pairs:
            cost += _kernels.add_pairs(
                q.segments, q.point_a, q.point_b, q.direction, q.residual, q.weight,
                centre, screws, tree.dof_parent, tree.last_dof, H, g,
            )  # fmt: skip
        for d, share in zip(dense, (s for p, s in zip(parts, shares) if isinstance(p, DofRows))):
            cost += _add_dense(d, share, body, loss, H, g)
        return Equations(body, state, rows, factor, H, g, float(cost), *dense_pattern(n))
    return Equations(body, state, rows, factor, C, g, float(cost), chain, depth)


def _counting(rows: AnyRows, share: float) -> AnyRows:
    """Rows without a loss, counting by a share; those with one as they are."""
    return rows if share == 1.0 or isinstance(rows, Rows | DofRows) else replace(rows, weight=share * rows.weight)


def _add_dense(rows: DofRows, share: float, body: Body, loss: Loss, H: NDArray, g: NDArray) -> float:
    """Add a share of rows on all degrees of freedom; their cost."""
    if rows.jacobian.shape[1] != len(g):
        problem = f"rows on {rows.jacobian.shape[1]} degrees of freedom, but body '{body.name}' has {len(g)}"
        raise ObservationError(problem, remedy="Make the rows with the body that is fitted.")
    data = np.zeros((8, len(rows)))
    data[6], data[7] = rows.residual, rows.weight
    factor, cost = (rows.loss or loss).of_rows(data, rows.group)
    weighted = rows.jacobian * (share * rows.weight * factor)[:, None]
    H += rows.jacobian.T @ weighted
    g += rows.residual @ weighted
    return share * float(cost)


@lru_cache(maxsize=8)
def dense_pattern(n: int) -> tuple[NDArray, NDArray]:
    """Chain and depth of a matrix in which all degrees of freedom meet."""
    chain, depth = np.tile(np.arange(n), (n, 1)), np.arange(n)
    chain.flags.writeable = depth.flags.writeable = False
    return chain, depth


def block_diagonal(first: NDArray, second: NDArray) -> NDArray:
    """Two square matrices as the blocks of a larger one, zeros elsewhere."""
    n = len(first)
    out = np.zeros((n + len(second),) * 2)
    out[:n, :n], out[n:, n:] = first, second
    return out


def inverse(matrix: NDArray) -> NDArray:
    """Inverse of a symmetric positive matrix, small enough that threads would only get in each other's way."""
    out = np.empty_like(matrix)
    if _kernels_linear.invert(np.array(matrix), *dense_pattern(len(matrix)), out):
        return out
    try:
        out = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:  # numbers so far apart that some count for nothing beside others
        out = np.linalg.pinv(matrix, hermitian=True)
    return 0.5 * (out + out.T)


def variances(matrix: NDArray) -> NDArray:
    """(n,) diagonal of the inverse of a symmetric positive matrix (n, n), without the rest of it."""
    out = np.empty(len(matrix))
    if not _kernels_linear.invert_diagonal(np.array(matrix), *dense_pattern(len(matrix)), out):
        return np.diag(inverse(matrix))
    return out


def product(A: NDArray, B: NDArray) -> NDArray:
    """A B of small matrices (..., k), (k, m), without threads that would only get in each other's way."""
    lines = np.ascontiguousarray(A, float).reshape(math.prod(A.shape[:-1]), A.shape[-1])
    out = np.empty((len(lines), B.shape[1]))
    _kernels_linear.multiply(lines, np.ascontiguousarray(B, float), out)
    return out.reshape(*A.shape[:-1], B.shape[1])


def design(body: Body, state: BodyState, rows: Rows | DofRows) -> NDArray:
    """(N, n) how far each row's point moves along its direction with every degree of freedom."""
    if isinstance(rows, DofRows):
        return rows.jacobian
    tree, out = body.tree, np.empty((len(rows), body.tree.n_dofs))
    _, screws = tree.forward(state.T_world_root, state.angles)
    centre = np.ascontiguousarray(state.T_world_root[:3, 3])
    _kernels_border.along(rows.data, rows.segment, centre, screws, tree.dof_parent, tree.last_dof, out)
    return out


def _within(what: str, count: int, body: Body, *indices: NDArray) -> None:
    """Kernels look nowhere else: an index of another body must not reach them."""
    for index in indices:
        if index.size and not 0 <= index.min() <= index.max() < count:
            raise ObservationError(
                f"rows name {what} {int(index.max())}, but body '{body.name}' has {count}",
                remedy="Make the rows with the body that is fitted.",
            )


def lock(body: Body, locked: NDArray | None) -> NDArray:
    """(6 + D,) bool, degrees of freedom that may not move: those given, and the root of a body that is fixed."""
    out = np.zeros(body.tree.n_dofs, bool) if locked is None else np.array(locked, bool)
    out[:6] |= not body.tree.root_free
    return out


@dataclass(frozen=True, eq=False)
class Covariance:
    """Uncertainty of a state.

    Parameters
    ----------
    observed : (n, n)
        Covariance of what was observed: zero along free directions and for known degrees of freedom.
    free : (n, k)
        Directions in which nothing holds the state.
    """

    observed: NDArray
    free: NDArray

    @property
    def matrix(self) -> NDArray:
        """(n, n) covariance, infinite on the diagonal (and zero beside it) where a free direction takes part."""
        lost = np.abs(self.free).max(axis=1, initial=0.0) > _LOOSE
        out = np.where(lost[:, None] | lost[None, :], 0.0, self.observed)
        out[lost, lost] = np.inf
        return out

    @property
    def std(self) -> NDArray:
        """(n,) [m, rad] standard deviation of every degree of freedom, inf where it is free."""
        return np.sqrt(np.diag(self.matrix))

    def of(self, moves: NDArray) -> NDArray:
        """Standard deviation (...) of quantities with derivatives `moves` (..., n); inf where they are free."""
        variance = np.einsum("...i,...i->...", moves @ self.observed, moves)
        blind = np.abs(moves @ self.free).max(axis=-1, initial=0.0) > _LOOSE
        return np.where(blind, np.inf, np.sqrt(np.maximum(variance, 0.0)))


@checked
def covariance(equations: Equations, *, locked: NDArray | None = None) -> Covariance:
    """Inverse of the undamped normal matrix.

    A direction is free where its information is below 1e-10 of what its degrees of freedom have each on their own.

    Parameters
    ----------
    locked : (n,) bool, degrees of freedom that are known: their variance is zero. A fixed root always is.
    """
    n = len(equations.depth)
    known, out = lock(equations.body, locked), np.empty((n, n))
    C = np.array(equations.packed)
    whole = not known.any() and equations.diagonal.min() > _ROUNDING * equations.diagonal.max()
    if whole and _kernels_linear.invert(C, equations.chain, equations.depth, out):
        return Covariance(out, np.empty((n, 0)))
    H = equations.matrix
    own = np.where(known, 0.0, np.diag(H))
    some = own > _ROUNDING * own.max()
    scale = 1.0 / np.sqrt(own[some])
    values, vectors = np.linalg.eigh(H[np.ix_(some, some)] * scale[:, None] * scale[None, :])
    weak = values < 1e-10
    directions = np.zeros((n, len(values)))
    directions[some] = vectors * scale[:, None]
    held = directions[:, ~weak] / np.sqrt(values[~weak])
    loose, _ = np.linalg.qr(directions[:, weak])
    return Covariance(held @ held.T, np.concatenate([loose, np.eye(n)[:, ~some & ~known]], axis=1))


@checked
def joint_std(body: Body, state: BodyState, cov: Covariance) -> NDArray:
    """(S, 3) [m] standard deviation of every joint centre along the world's axes; inf where that is free."""
    return cov.of(joint_moves(body, state))


def joint_moves(body: Body, state: BodyState) -> NDArray:
    """(S, 3, n) how far every joint centre moves along the world's axes with every degree of freedom."""
    tree = body.tree
    frames, screws = tree.forward(state.T_world_root, state.angles)
    moves = np.empty((len(tree.segments), 3, tree.n_dofs))
    _kernels.joint_moves(frames, screws, tree.rest, state.T_world_root, tree.dof_parent, tree.last_dof, moves)
    return moves
