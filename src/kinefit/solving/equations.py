"""Normal equations of a body's rows at a state, and covariances from them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import ObservationError
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.solving import _kernels, _kernels_linear
from kinefit.solving.rows import AnyRows, DofRows, ParameterRows, Rows, sort_out

_MIN_INFORMATION_RATIO = 1e-14  # to the most informed degree of freedom: information below it is rounding
_MIN_FREE_COMPONENT = 1e-5  # of a free direction, above which a degree of freedom counts as free


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations H δ = g of a body at a state.

    Parameters
    ----------
    body, state : at which the rows are linearised
    rows : N rows of segments
    factor : (N,) robust factor of each row in 0..1
    packed : (n, m) H in the pattern of chain and depth, see `_kernels_linear`
    gradient : (n,) g = Σ Jᵀ W r
    cost : float, Σ ρ(w r²) over all rows
    chain, depth : (n, m), (n,) int: ancestors of each degree of freedom; all earlier ones if rows couple them
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
        """H as a full (n, n) matrix."""
        H = np.zeros((len(self.depth), len(self.depth)))
        _kernels_linear.unpack(self.packed, self.chain, self.depth, H)
        return H

    @property
    def diagonal(self) -> NDArray:
        """(n,) diagonal of H."""
        return self.packed[np.arange(len(self.depth)), self.depth]


def normal_equations(
    body: Body, state: BodyState, parts: AnyRows | Iterable[AnyRows], *, loss: Loss = SQUARED,
    shares: Sequence[float] | None = None,
) -> Equations:  # fmt: skip
    """Normal equations of rows of any kinds at a state.

    Parameters
    ----------
    loss : of rows without their own
    shares : factor on the cost of each part; default: 1

    Raises
    ------
    ObservationError
        Rows on segments or degrees of freedom that the body lacks.
    """
    parts = [parts] if isinstance(parts, AnyRows) else list(parts)
    if shares is None:
        shares = (1.0,) * len(parts)
    else:
        parts = [_counting(p, share) for p, share in zip(parts, shares, strict=True)]
    rows, pairs, parameters, dense = sort_out(parts)
    tree = body.tree
    n = tree.n_dofs
    check_indices("segment", len(tree.segments), body, rows.segment, *(q.segments for q in pairs))
    check_indices("degree of freedom", n, body, *(p.index for p in parameters))
    _, screws = tree.forward(state.T_world_root, state.angles)
    centre = np.ascontiguousarray(state.T_world_root[:3, 3])
    chain, depth = tree.chain, tree.depth
    factor, blocks = np.empty(len(rows)), np.empty((len(tree.segments), 27))
    C, g = np.empty(chain.shape), np.empty(n)
    given = [(p, share) for p, share in zip(parts, shares, strict=True) if isinstance(p, Rows)]
    common_loss = given[0][0].loss or loss if len(given) == 1 else loss
    different = any(share != 1.0 or (p.loss or loss) is not common_loss for p, share in given)
    mixed = np.ndim(common_loss.scale) > 0 or different
    data, kind, scale, cost = rows.data, common_loss.kind, common_loss.scale, 0.0
    if mixed:  # the parts' own losses go into the weights, and the rest of their cost is added
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
    """Rows without a loss, their weight multiplied by a share; rows with a loss unchanged."""
    return rows if share == 1.0 or isinstance(rows, Rows | DofRows) else replace(rows, weight=share * rows.weight)


def residuals(rows: AnyRows) -> NDArray:
    """(N,) whitened residuals √w·r, before any loss; Lᵀ r for a joint weight W = L Lᵀ."""
    if rows.weight.ndim == 2:
        return np.asarray(np.linalg.cholesky(rows.weight).T @ rows.residual)
    return np.asarray(np.sqrt(rows.weight) * rows.residual)


def robust_factors(rows: AnyRows, loss: Loss = SQUARED) -> tuple[NDArray, float]:
    """(N,) robust factors, and the cost Σ ρ (a number); `loss` is for rows without their own."""
    if isinstance(rows, Rows):
        return (rows.loss or loss).of_rows(rows.data, rows.group)
    if isinstance(rows, DofRows):
        data = np.zeros((8, len(rows)))
        data[6], data[7] = rows.residual, rows.weight
        return (rows.loss or loss).of_rows(data, rows.group)
    r = residuals(rows)
    return np.ones(len(rows)), float(r @ r)


def columns(rows: AnyRows, body: Body, state: BodyState) -> NDArray:
    """(N, n) whitened derivatives of rows by the degrees of freedom: a step δ changes residuals by −columns · δ."""
    J = design(body, state, rows)
    if rows.weight.ndim == 2:
        return np.asarray(np.linalg.cholesky(rows.weight).T @ J)
    return np.sqrt(rows.weight)[:, None] * J


def _add_dense(rows: DofRows, share: float, body: Body, loss: Loss, H: NDArray, g: NDArray) -> float:
    """Add rows on all degrees of freedom to H and g, multiplied by a share; returns their cost."""
    J = _jacobian(rows, body)
    factor, cost = robust_factors(rows, loss)
    weighted = J * (share * rows.weight * factor)[:, None]
    H += J.T @ weighted
    g += rows.residual @ weighted
    return share * float(cost)


@lru_cache(maxsize=8)
def dense_pattern(n: int) -> tuple[NDArray, NDArray]:
    """Chain (n, n) and depth (n,) of a dense matrix, in which all degrees of freedom are coupled."""
    chain, depth = np.tile(np.arange(n), (n, 1)), np.arange(n)
    chain.flags.writeable = depth.flags.writeable = False
    return chain, depth


def block_diagonal(first: NDArray, second: NDArray) -> NDArray:
    """Block-diagonal matrix (n + m, n + m) of two square matrices (n, n), (m, m)."""
    n = len(first)
    out = np.zeros((n + len(second),) * 2)
    out[:n, :n], out[n:, n:] = first, second
    return out


def inverse(matrix: NDArray) -> NDArray:
    """Inverse of a small symmetric positive matrix (n, n), without threads."""
    out = np.empty_like(matrix)
    if _kernels_linear.invert(np.array(matrix), *dense_pattern(len(matrix)), out):
        return out
    try:
        out = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:  # singular by rounding: entries of too different size
        out = np.linalg.pinv(matrix, hermitian=True)
    return 0.5 * (out + out.T)


def variances(matrix: NDArray) -> NDArray:
    """(n,) diagonal of the inverse of a symmetric positive matrix (n, n), without computing the rest."""
    out = np.empty(len(matrix))
    if not _kernels_linear.invert_diagonal(np.array(matrix), *dense_pattern(len(matrix)), out):
        return np.diag(inverse(matrix))
    return out


def product(A: NDArray, B: NDArray) -> NDArray:
    """A B (..., m) of small matrices (..., k), (k, m), without threads."""
    lines = np.ascontiguousarray(A, float).reshape(math.prod(A.shape[:-1]), A.shape[-1])
    out = np.empty((len(lines), B.shape[1]))
    _kernels_linear.multiply(lines, np.ascontiguousarray(B, float), out)
    return out.reshape(*A.shape[:-1], B.shape[1])


def design(body: Body, state: BodyState, rows: AnyRows) -> NDArray:
    """(N, n) derivatives of rows by every degree of freedom: a step δ changes residuals by −design · δ.

    Raises
    ------
    ObservationError
        Rows on degrees of freedom or segments that the body lacks.
    """
    tree = body.tree
    if isinstance(rows, DofRows):
        return _jacobian(rows, body)
    if isinstance(rows, ParameterRows):
        check_indices("degree of freedom", tree.n_dofs, body, rows.index)
        return np.eye(tree.n_dofs)[rows.index]
    _, screws = tree.forward(state.T_world_root, state.angles)
    centre = np.ascontiguousarray(state.T_world_root[:3, 3])

    def along(segment: NDArray, data: NDArray) -> NDArray:
        check_indices("segment", len(tree.segments), body, segment)
        out = np.empty((len(segment), tree.n_dofs))
        _kernels_linear.along(data, segment, centre, screws, tree.dof_parent, tree.last_dof, out)
        return out

    if isinstance(rows, Rows):
        return along(rows.segment, rows.data)
    ends = (np.concatenate([x.T, rows.direction.T]) for x in (rows.point_a, rows.point_b))
    a, b = (along(np.ascontiguousarray(s), data) for s, data in zip(rows.segments.T, ends))
    return a - b


def _jacobian(rows: DofRows, body: Body) -> NDArray:
    """(N, n) of rows on all degrees of freedom, checked."""
    if rows.jacobian.shape[1] != body.tree.n_dofs:
        problem = f"rows on {rows.jacobian.shape[1]} degrees of freedom, but body '{body.name}' has {body.tree.n_dofs}"
        raise ObservationError(problem, remedy="Make the rows with the body that is fitted.")
    return rows.jacobian


def check_indices(what: str, count: int, body: Body, *indices: NDArray) -> None:
    """Check indices (N,) or (N, 2) of rows before kernels use them: kernels check no bounds.

    Raises
    ------
    ObservationError
        An index is negative, or `count` or more.
    """
    for index in indices:
        if index.size and not 0 <= index.min() <= index.max() < count:
            raise ObservationError(
                f"rows name {what} {int(index.max())}, but body '{body.name}' has {count}",
                remedy="Make the rows with the body that is fitted.",
            )


def lock(body: Body, locked: NDArray | None) -> NDArray:
    """(6 + D,) bool, degrees of freedom that do not move: those given (6 + D,), and the root of a fixed body."""
    out = np.zeros(body.tree.n_dofs, bool) if locked is None else np.array(locked, bool)
    out[:6] |= not body.tree.root_free
    return out


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of a state, with unobserved directions.

    Parameters
    ----------
    observed : (n, n)
        Covariance of the observed directions: zero along free ones and for known degrees of freedom.
    free : (n, k)
        Directions that no row observes.
    """

    observed: NDArray
    free: NDArray

    @property
    def matrix(self) -> NDArray:
        """Covariance as an (n, n) matrix; free degrees of freedom have inf on the diagonal and 0 off it."""
        is_free = np.abs(self.free).max(axis=1, initial=0.0) > _MIN_FREE_COMPONENT
        out = np.where(is_free[:, None] | is_free[None, :], 0.0, self.observed)
        out[is_free, is_free] = np.inf
        return out

    @property
    def std(self) -> NDArray:
        """(n,) [m, rad] standard deviation of every degree of freedom, inf for free ones."""
        return np.sqrt(np.diag(self.matrix))

    def of(self, moves: NDArray) -> NDArray:
        """Standard deviations (...,) of quantities with derivatives `moves` (..., n); inf for free ones."""
        variance = np.einsum("...i,...i->...", moves @ self.observed, moves)
        is_free = np.abs(moves @ self.free).max(axis=-1, initial=0.0) > _MIN_FREE_COMPONENT
        return np.where(is_free, np.inf, np.sqrt(np.maximum(variance, 0.0)))


@checked
def covariance(equations: Equations, *, locked: NDArray | None = None) -> Covariance:
    """Covariance of a state: the inverse of the undamped normal matrix.

    A direction is free if its information is below 1e-10 of that of its degrees of freedom on their own.

    Parameters
    ----------
    locked : (n,) bool, known degrees of freedom: their variance is zero. A fixed root is always known.
    """
    n = len(equations.depth)
    known, out = lock(equations.body, locked), np.empty((n, n))
    C = np.array(equations.packed)
    whole = not known.any() and equations.diagonal.min() > _MIN_INFORMATION_RATIO * equations.diagonal.max()
    if whole and _kernels_linear.invert(C, equations.chain, equations.depth, out):
        return Covariance(out, np.empty((n, 0)))
    H = equations.matrix
    own = np.where(known, 0.0, np.diag(H))
    some = own > _MIN_INFORMATION_RATIO * own.max()
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
    """(S, 3) [m] standard deviation of every joint centre along the world's axes; inf if it is free."""
    return cov.of(joint_moves(body, state))


def square_root(covariance: NDArray) -> NDArray:
    """(p, p) of which the product with its own transpose is a covariance (p, p)."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def joint_moves(body: Body, state: BodyState) -> NDArray:
    """(S, 3, n) derivatives of every joint centre, along the world's axes, by every degree of freedom."""
    return _moves(body, state, np.arange(len(body.tree.segments)), body.tree.rest)


def point_derivatives(body: Body, state: BodyState, points: PointSet) -> NDArray:
    """(K, 3, n) derivatives of points of the body, along the world's axes, by every degree of freedom."""
    return _moves(body, state, points.segments, body.points_rest(points))


def _moves(body: Body, state: BodyState, segments: NDArray, rest: NDArray) -> NDArray:
    """(K, 3, n) derivatives of points (K, 3) [m] of the rest pose, on segments (K,)."""
    tree = body.tree
    frames, screws = tree.forward(state.T_world_root, state.angles)
    moves = np.empty((len(segments), 3, tree.n_dofs))
    _kernels.joint_moves(
        frames[segments], screws, rest, state.T_world_root, tree.dof_parent, tree.last_dof[segments], moves
    )
    return moves
