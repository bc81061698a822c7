"""Quadratic costs of the poses of a take, from sensors that are matched once a round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.rows import AnyRows, DofRows, Rows
from kinefit.sensors.base import Matched
from kinefit.solvers.trajectory import _kernels_smoothing
from kinefit.solvers.trajectory.smoothing import Equations, MakeEquations


@dataclass(frozen=True, eq=False)
class Linearised:
    """Quadratic costs of T frames about their states.

    Parameters
    ----------
    H, g, cost : (T, n, n), (T, n), (T,)
    roots, angles : (T, 4, 4), (T, D) states at which the frames were linearised
    matched : T lists of matches; empty if they are not kept
    rows : (T,) number of rows that agree
    unsupported : (T, n, n) part of H without evidence, from segments that a surface sensor does not show, see
        `segments_not_shown`; None if it was not computed
    """

    H: NDArray
    g: NDArray
    cost: NDArray
    roots: NDArray
    angles: NDArray
    matched: Sequence[tuple[Matched, ...]]
    rows: NDArray
    unsupported: NDArray | None = None

    def part(self, frames: slice) -> Linearised:
        """The costs of some frames."""
        names = ("H", "g", "cost", "roots", "angles", "matched", "rows")
        unsupported = None if self.unsupported is None else self.unsupported[frames]
        return replace(self, **{name: getattr(self, name)[frames] for name in names}, unsupported=unsupported)

    def followed_by(self, later: Linearised) -> Linearised:
        """These costs and those of later frames, without matches."""
        names = ("H", "g", "cost", "roots", "angles", "rows")
        both = {name: np.concatenate([getattr(self, name), getattr(later, name)]) for name in names}
        unsupported = None
        if self.unsupported is not None and later.unsupported is not None:
            unsupported = np.concatenate([self.unsupported, later.unsupported])
        return replace(self, **both, matched=(), unsupported=unsupported)


def with_quadratic(body: Body, make: MakeEquations, more: Linearised) -> MakeEquations:
    """Equations of keypoints with the quadratic costs of other sensors added: packed along the tree -> dense."""
    chain, depth = body.tree.chain, body.tree.depth

    def both(roots: NDArray, angles: NDArray) -> Equations:
        packed, g, cost = make(roots, angles)
        delta = np.empty(more.g.shape)
        _kernels_smoothing.differences(more.roots, roots, more.angles, angles, delta)
        moved = np.einsum("tij,tj->ti", more.H, delta)
        C = np.array(more.H)
        _kernels_smoothing.add_packed(packed, chain, depth, C)
        g += more.g - moved
        cost += more.cost - 2.0 * np.einsum("ti,ti->t", more.g, delta) + np.einsum("ti,ti->t", moved, delta)
        return C, g, cost

    return both


def squares_of(rows: AnyRows) -> tuple[NDArray, NDArray]:
    """Squared residuals (R,) of rows, in variances, and robust factors (R,); both empty for other kinds of rows."""
    if not isinstance(rows, Rows | DofRows):
        return np.zeros(0), np.zeros(0)
    square = rows.weight * rows.residual**2
    if rows.loss is None:
        return square, np.ones(len(square))
    data = np.zeros((8, len(square)))
    data[6], data[7] = rows.residual, rows.weight
    return square, rows.loss.of_rows(data, rows.group)[0]
