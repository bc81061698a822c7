"""Rows: the narrow waist between sensors and solvers.

A segment moves by a twist δξ = (δv, δω). That a point x of it should lie further along the unit direction n by r reads

    r ≈ n·δv + (x × n)·δω        with weight w

Every measurement of every sensor is one or more such rows. Twists are taken about the root's origin, so that the far
world origin costs no digits; row makers need not care, they give points in the world.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.losses import Loss


def _check(what: str, *arrays: NDArray) -> None:
    if not all(math.isfinite(a.sum()) for a in arrays):
        raise ObservationError(f"{what} hold values that are not finite", remedy="Leave out what was not measured.")


def _as_kernels_take_them(record: object, **shapes: tuple[type, tuple[int | None, ...]]) -> None:
    """Make the named arrays contiguous and of one type, and check their shapes (None: the number of rows)."""
    count = len(getattr(record, next(iter(shapes))))
    for name, (dtype, shape) in shapes.items():
        array: NDArray = np.ascontiguousarray(getattr(record, name), dtype)
        wanted = tuple(count if n is None else n for n in shape)
        if array.shape != wanted:
            problem = f"{name} of {type(record).__name__} has shape {array.shape}"
            raise ObservationError(problem, remedy=f"Give {wanted}.")
        object.__setattr__(record, name, array)


@dataclass(frozen=True, eq=False)
class Rows:
    """Linearised measurements, N rows; make them with `Rows.of`.

    Parameters
    ----------
    data : (8, N)
        x (3) [m] and n (3) in the world, r [m], w [1/m²]: one contiguous line each, as kernels like it.
    segment : (N,) int, the segment that each point belongs to.
    group : (N,) int
        Measurement id: adjacent rows with one id share one robust weight; -1 for a row that is never an outlier.
    loss : Loss, optional
        Of these rows; without it the solver's.
    """

    data: NDArray
    segment: NDArray
    group: NDArray
    loss: Loss | None = None

    @classmethod
    def of(
        cls,
        segment: NDArray,
        point: NDArray,
        direction: NDArray,
        residual: NDArray,
        weight: NDArray,
        group: NDArray | None = None,
        loss: Loss | None = None,
    ) -> Rows:
        """Rows from segment (N,), point (N, 3) [m], direction (N, 3), residual (N,) [m], weight (N,) [1/m²].

        Raises ObservationError for arrays of other shapes.
        """
        n = len(segment)
        given = {"point": (n, 3), "direction": (n, 3), "residual": (n,), "weight": (n,)}
        for (name, shape), values in zip(given.items(), (point, direction, residual, weight)):
            if np.shape(values) not in (shape, ()):
                problem = f"{name} of {n} rows has shape {np.shape(values)}"
                raise ObservationError(problem, remedy=f"Give {shape}, or one for all.")
        data = np.empty((8, n))
        data[0:3], data[3:6] = np.asarray(point).T, np.asarray(direction).T
        data[6], data[7] = residual, weight
        _check("rows", data)
        ids = np.arange(n) if group is None else np.asarray(group)
        return cls(data, np.ascontiguousarray(segment, np.int64), np.ascontiguousarray(ids, np.int64), loss)

    @classmethod
    def concat(cls, *parts: Rows) -> Rows:
        """All rows of several makers, without their losses; measurement ids are renumbered so that none clash."""
        groups, first = [], 0
        for part in parts:
            groups.append(np.where(part.group < 0, -1, part.group + first))
            first += int(part.group.max(initial=-1)) + 1
        return cls(
            np.ascontiguousarray(np.concatenate([p.data for p in parts], axis=1)) if parts else np.empty((8, 0)),
            np.concatenate([p.segment for p in parts]) if parts else np.empty(0, np.int64),
            np.concatenate(groups) if parts else np.empty(0, np.int64),
        )

    def __len__(self) -> int:
        return self.data.shape[1]

    @property
    def point(self) -> NDArray:
        """(N, 3) [m] in the world."""
        return self.data[0:3].T

    @property
    def direction(self) -> NDArray:
        """(N, 3) unit directions in the world."""
        return self.data[3:6].T

    @property
    def residual(self) -> NDArray:
        """(N,) [m] how much further along its direction each point should lie."""
        return self.data[6]

    @property
    def weight(self) -> NDArray:
        """(N,) [1/m²] inverse variance."""
        return self.data[7]


@dataclass(frozen=True, eq=False)
class PairRows:
    """Rows between two segments: point x_b of segment b should lie at x_a of segment a, along n.

    r ≈ (n, x_a × n)·δξ_a − (n, x_b × n)·δξ_b with r = n·(x_b − x_a): closed chains, contacts, elastic bands.

    Parameters
    ----------
    segments : (N, 2) int, a and b.
    point_a, point_b : (N, 3) [m] in the world, each on its own segment.
    direction : (N, 3) unit
    residual : (N,) [m]
    weight : (N,) [1/m²]
    """

    segments: NDArray
    point_a: NDArray
    point_b: NDArray
    direction: NDArray
    residual: NDArray
    weight: NDArray

    def __post_init__(self) -> None:
        point, number = (float, (None, 3)), (float, (None,))
        _as_kernels_take_them(
            self,
            segments=(np.int64, (None, 2)),
            point_a=point,
            point_b=point,
            direction=point,
            residual=number,
            weight=number,
        )
        _check("pair rows", self.point_a, self.point_b, self.direction, self.residual, self.weight)

    def __len__(self) -> int:
        return len(self.residual)


@dataclass(frozen=True, eq=False)
class ParameterRows:
    """Rows on degrees of freedom themselves: limits, priors, prediction. r ≈ δ[index].

    Parameters
    ----------
    index : (N,) int, degree of freedom: 0-2 the root's shift, 3-5 its turn, 6.. the angles.
    residual : (N,) [rad or m] how much further it should be.
    weight : (N,) [1/rad² or 1/m²], or (N, N)
        Inverse variances, or the inverse covariance of all of them together.
    """

    index: NDArray
    residual: NDArray
    weight: NDArray

    def __post_init__(self) -> None:
        shape = (None,) * max(np.ndim(self.weight), 1)
        _as_kernels_take_them(self, index=(np.int64, (None,)), residual=(float, (None,)), weight=(float, shape))
        _check("parameter rows", self.residual, self.weight)

    def __len__(self) -> int:
        return len(self.residual)


@dataclass(frozen=True, eq=False)
class DofRows:
    """Rows whose point moves with any degrees of freedom: skinned between segments, shifted by a morph. r ≈ J δ.

    Parameters
    ----------
    by_dof : (N, 6 + D), or a function that returns it
        `jacobian`: how far each point moves along its direction, by every degree of freedom. A function is called when
        that is first needed: residuals alone do not need it.
    residual : (N,) [m] how much further along it each point should lie.
    weight : (N,) [1/m²]
    group : (N,) int
        As of `Rows`.
    loss : Loss, optional
        As of `Rows`.
    segment : (N,) int, optional
        The segment that each point belongs to, for evidence and residuals; None where it is of several.
    """

    by_dof: NDArray | Callable[[], NDArray]
    residual: NDArray
    weight: NDArray
    group: NDArray
    loss: Loss | None = None
    segment: NDArray | None = None

    def __post_init__(self) -> None:
        number = float, (None,)
        _as_kernels_take_them(self, residual=number, weight=number, group=(np.int64, (None,)))
        _check("rows", self.residual, self.weight, *(() if callable(self.by_dof) else [self.jacobian]))

    @cached_property
    def jacobian(self) -> NDArray:
        """(N, 6 + D) how far each point moves along its direction, by every degree of freedom."""
        J = np.ascontiguousarray(self.by_dof() if callable(self.by_dof) else self.by_dof, float)
        if J.ndim != 2 or len(J) != len(self):
            wanted = (len(self), *J.shape[1:])
            raise ObservationError(f"jacobian of DofRows has shape {J.shape}", remedy=f"Give {wanted}.")
        _check("rows", J)
        return J

    def __len__(self) -> int:
        return len(self.residual)


AnyRows = Rows | PairRows | ParameterRows | DofRows
_Same = TypeVar("_Same", bound=AnyRows)


def weaker(rows: _Same, factor: float) -> _Same:
    """Rows with standard deviations multiplied by a factor (a number above 0)."""
    return rows if factor == 1.0 else weighted(rows, rows.weight / factor**2)


def less_sure(rows: AnyRows, variance: NDArray) -> AnyRows:
    """Rows with (N,) [m²] added to the variance of each."""
    W = rows.weight
    if W.ndim == 1:
        return weighted(rows, W / (1.0 + W * variance))
    return weighted(rows, np.linalg.solve(np.eye(len(W)) + W * variance, W))


def weighted(rows: _Same, weight: NDArray) -> _Same:
    """Rows with other weights (N,), or (N, N) if they are weighed together."""
    if isinstance(rows, Rows):
        return replace(rows, data=np.concatenate([rows.data[:7], weight[None]]))
    return replace(rows, weight=weight)


def sort_out(
    parts: AnyRows | Iterable[AnyRows],
) -> tuple[Rows, list[PairRows], list[ParameterRows], list[DofRows]]:
    """What row makers gave, by kind."""
    given: Sequence[AnyRows] = [parts] if isinstance(parts, AnyRows) else list(parts)
    rows = [p for p in given if isinstance(p, Rows)]
    return (
        rows[0] if len(rows) == 1 else Rows.concat(*rows),
        [p for p in given if isinstance(p, PairRows)],
        [p for p in given if isinstance(p, ParameterRows)],
        [p for p in given if isinstance(p, DofRows)],
    )
