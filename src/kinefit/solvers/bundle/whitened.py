"""Whitened residuals √w·r of rows of any kind, and their derivatives by the degrees of freedom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.losses import Loss
from kinefit.rows import AnyRows, DofRows, PairRows, ParameterRows, Rows
from kinefit.solvers import _kernels_border
from kinefit.solvers.equations import check_indices


@dataclass(frozen=True, eq=False)
class PoseScrews:
    """Screws of a body's coordinates at a state.

    Parameters
    ----------
    body : Body
    state : BodyState
    screws : (D, 6) twist (v, ω) of each coordinate about the root's origin
    """

    body: Body
    state: BodyState
    screws: NDArray

    @classmethod
    def of(cls, body: Body, state: BodyState) -> PoseScrews:
        """The body at a state."""
        return cls(body, state, body.tree.forward(state.T_world_root, state.angles)[1])

    def along(self, segment: NDArray, data: NDArray) -> NDArray:
        """(N, n) [m] derivatives of points data[:3] (3, N) on segments (N,), along directions data[3:6] (3, N)."""
        tree, out = self.body.tree, np.empty((len(segment), self.body.tree.n_dofs))
        centre = np.ascontiguousarray(self.state.T_world_root[:3, 3])
        _kernels_border.along(data, segment, centre, self.screws, tree.dof_parent, tree.last_dof, out)
        return out


def residuals(rows: AnyRows) -> NDArray:
    """(N,) whitened residuals √w·r, before any loss; Lᵀ r for a joint weight W = L Lᵀ."""
    if rows.weight.ndim == 2:
        return np.asarray(np.linalg.cholesky(rows.weight).T @ rows.residual)
    return np.asarray(np.sqrt(rows.weight) * rows.residual)


def softening(rows: AnyRows, loss: Loss) -> tuple[NDArray, float]:
    """(N,) square roots of robust factors, and the cost Σ ρ (a number); `loss` is for rows without their own."""
    if isinstance(rows, Rows):
        factor, cost = (rows.loss or loss).of_rows(rows.data, rows.group)
        return np.sqrt(factor), cost
    if isinstance(rows, DofRows):
        data = np.zeros((8, len(rows)))
        data[6], data[7] = rows.residual, rows.weight
        factor, cost = (rows.loss or loss).of_rows(data, rows.group)
        return np.sqrt(factor), cost
    r = residuals(rows)
    return np.ones(len(rows)), float(r @ r)


def columns(rows: AnyRows, pose: PoseScrews) -> NDArray:
    """(N, n) whitened derivatives of rows by the degrees of freedom: a step δ changes residuals by −columns · δ.

    Raises
    ------
    ObservationError
        Rows on degrees of freedom or segments that the body lacks.
    """
    n, count = pose.body.tree.n_dofs, len(pose.body.tree.segments)
    if isinstance(rows, Rows):
        check_indices("segment", count, pose.body, rows.segment)
        return np.sqrt(rows.weight)[:, None] * pose.along(rows.segment, rows.data)
    if isinstance(rows, PairRows):
        check_indices("segment", count, pose.body, rows.segments)
        a, b = (
            pose.along(np.ascontiguousarray(s), np.concatenate([x.T, rows.direction.T]))
            for s, x in zip(rows.segments.T, (rows.point_a, rows.point_b))
        )
        return np.sqrt(rows.weight)[:, None] * (a - b)
    if isinstance(rows, ParameterRows):
        check_indices("degree of freedom", n, pose.body, rows.index)
        chosen = np.eye(n)[rows.index]
        if rows.weight.ndim == 2:
            return np.asarray(np.linalg.cholesky(rows.weight).T @ chosen)
        return np.sqrt(rows.weight)[:, None] * chosen
    if rows.jacobian.shape[1] != n:
        problem = f"rows on {rows.jacobian.shape[1]} degrees of freedom, but body '{pose.body.name}' has {n}"
        raise ObservationError(problem, remedy="Make the rows with the body that is fitted.")
    return np.sqrt(rows.weight)[:, None] * rows.jacobian
