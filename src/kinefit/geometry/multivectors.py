"""Multivectors of conformal geometric algebra G(4,1) over arrays, with their products as operators (P1 2).

The basis is e1, e2, e3 (squares 1), e (the point at infinity) and e0 (the origin), both null, e·e0 = −1. A blade is the
outer product of basis vectors in that order, identified by its bits: 1, 2, 4, 8, 16. A multivector holds coefficients
of its blades, arrays of one shape; products broadcast over them as in numpy.

    A * B   geometric product          A ^ B   outer product       ~A   reverse
    A | B   inner product (Hestenes')  commutator(A, B), anticommutator(A, B): ½ (A B ∓ B A)

Python binds ^ and | more loosely than + and *: write (A ^ B) + C.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache, partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import KinefitError
from kinefit.geometry import _kernels_cga

BASIS = ("e1", "e2", "e3", "e", "e0")
# Products of 1, e, e0 and E = e∧e0 (numbered by their bits) as (result, sign): from e² = e0² = 0 and e e0 = −1 + E.
_NULL: dict[tuple[int, int], tuple[tuple[int, int], ...]] = {
    **{(0, k): ((k, 1),) for k in range(4)},
    **{(k, 0): ((k, 1),) for k in range(1, 4)},
    (1, 1): (), (1, 2): ((0, -1), (3, 1)), (1, 3): ((1, 1),),
    (2, 1): ((0, -1), (3, -1)), (2, 2): (), (2, 3): ((2, -1),),
    (3, 1): ((1, -1),), (3, 2): ((2, 1),), (3, 3): ((0, 1),),
}  # fmt: skip


def grade_of(blade: int) -> int:
    """Number of basis vectors in a blade."""
    return blade.bit_count()


@cache
def _blade_product(a: int, b: int) -> tuple[tuple[int, int], ...]:
    """Geometric product of two blades as (blade, sign)."""
    a3, b3, an, bn = a & 7, b & 7, a >> 3, b >> 3
    swaps = grade_of(an) * grade_of(b3)  # the null part of a passes the Euclidean part of b
    swaps += sum(grade_of(a3 >> (i + 1)) for i in range(3) if b3 >> i & 1)
    sign = -1 if swaps & 1 else 1
    return tuple(((a3 ^ b3) | (blade << 3), sign * s) for blade, s in _NULL[an, bn])


def _geometric(a: int, b: int) -> dict[int, float]:
    return {blade: float(s) for blade, s in _blade_product(a, b)}


def _outer(a: int, b: int) -> dict[int, float]:
    return {k: s for k, s in _geometric(a, b).items() if grade_of(k) == grade_of(a) + grade_of(b)}


def _inner(a: int, b: int) -> dict[int, float]:
    grade = abs(grade_of(a) - grade_of(b)) if a and b else -1
    return {k: s for k, s in _geometric(a, b).items() if grade_of(k) == grade}


def _half_sum(a: int, b: int, sign: int) -> dict[int, float]:
    both, other = _geometric(a, b), _geometric(b, a)
    total = {k: 0.5 * (both.get(k, 0.0) + sign * other.get(k, 0.0)) for k in {**both, **other}}
    return {k: s for k, s in total.items() if s}


_commutator, _anticommutator = (partial(_half_sum, sign=sign) for sign in (-1, 1))


Rule = Callable[[int, int], dict[int, float]]


@lru_cache(maxsize=4096)
def _plan(a: tuple[int, ...], b: tuple[int, ...], rule: Rule) -> tuple[tuple[int, ...], NDArray, NDArray]:
    """Blades of a product, and its terms (T, 3) = (i, j, k) with their signs (T,)."""
    parts = [(i, j, k, s) for i, x in enumerate(a) for j, y in enumerate(b) for k, s in rule(x, y).items()]
    blades = tuple(sorted({k for _, _, k, _ in parts}, key=_order)) or (0,)
    terms = np.array([(i, j, blades.index(k)) for i, j, k, _ in parts], np.int64).reshape(-1, 3)
    return blades, terms, np.array([s for *_, s in parts], float)


def _order(blade: int) -> tuple[int, int]:
    return grade_of(blade), blade


@dataclass(frozen=True, eq=False, repr=False)
class Multivector:
    """An array of multivectors that have the same blades.

    Parameters
    ----------
    blades : (K,) bits of each blade: 1 e1, 2 e2, 4 e3, 8 e, 16 e0.
    values : (K, ...) coefficients; the trailing shape is the array's.
    """

    blades: tuple[int, ...]
    values: NDArray

    __array_ufunc__ = None  # so that `array * A` calls this class

    def __post_init__(self) -> None:
        values = np.asarray(self.values, float)
        if len(values) != len(self.blades):
            raise KinefitError(f"{len(values)} rows of coefficients for {len(self.blades)} blades")
        object.__setattr__(self, "values", values)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array of elements."""
        return self.values.shape[1:]

    @property
    def grades(self) -> tuple[int, ...]:
        """Grades of its blades."""
        return tuple(sorted({grade_of(blade) for blade in self.blades}))

    def __getitem__(self, index: object) -> Multivector:
        index = index if isinstance(index, tuple) else (index,)
        return Multivector(self.blades, self.values[(slice(None), *index)])

    def select(self, blades: tuple[int, ...]) -> Multivector:
        """The part with the given blades, zero for missing ones."""
        out = np.zeros((len(blades), *self.shape))
        for row, blade in enumerate(blades):
            if blade in self.blades:
                out[row] = self.values[self.blades.index(blade)]
        return Multivector(blades, out)

    def grade(self, *grades: int) -> Multivector:
        """The part of the given grades."""
        return self.select(tuple(blade for blade in self.blades if grade_of(blade) in grades) or (0,))

    def along(self, blade: Multivector) -> NDArray:
        """Coefficient, of the array's shape (N,), of one basis blade, such as `e1 ^ e2`, with its order and sign."""
        (row,) = np.flatnonzero(blade.values)
        return self.select((blade.blades[row],)).values[0] / blade.values[row]

    @property
    def scalar(self) -> NDArray:
        """Coefficient of 1, of the array's shape (N,)."""
        return self.select((0,)).values[0]

    def dense(self) -> NDArray:
        """Coefficients (N, 32) by the blades' bits."""
        return np.moveaxis(self.select(tuple(range(32))).values, 0, -1)

    def columns(self, shape: tuple[int, ...]) -> NDArray:
        """Contiguous coefficients: (K, 1) for a single element, else (K, N) of the broadcast shape."""
        values, own = self.values, self.shape
        if math.prod(own) == 1:
            return np.ascontiguousarray(values.reshape(-1, 1))
        if own != shape:
            values = np.broadcast_to(_aligned(values, len(shape)), (len(values), *shape))
        return np.ascontiguousarray(values.reshape(len(values), -1))

    def _times(self, other: Multivector | ArrayLike, rule: Rule) -> Multivector:
        other = as_multivector(other)
        blades, terms, signs = _plan(self.blades, other.blades, rule)
        shape = np.broadcast_shapes(self.shape, other.shape)
        out = np.zeros((len(blades), math.prod(shape)))
        _kernels_cga.product(self.columns(shape), other.columns(shape), terms, signs, out)
        return Multivector(blades, out.reshape(len(blades), *shape))

    def __mul__(self, other: Multivector | ArrayLike) -> Multivector:
        if isinstance(other, Multivector):
            return self._times(other, _geometric)
        factor = np.asarray(other, float)
        return Multivector(self.blades, _aligned(self.values, factor.ndim) * factor)

    def __rmul__(self, factor: ArrayLike) -> Multivector:
        return self * factor

    def __truediv__(self, divisor: ArrayLike) -> Multivector:
        divisor = np.asarray(divisor, float)
        return Multivector(self.blades, _aligned(self.values, divisor.ndim) / divisor)

    def __xor__(self, other: Multivector | ArrayLike) -> Multivector:
        return self._times(other, _outer)

    def __or__(self, other: Multivector | ArrayLike) -> Multivector:
        return self._times(other, _inner)

    def __invert__(self) -> Multivector:
        signs = np.array([-1.0 if grade_of(blade) & 2 else 1.0 for blade in self.blades])
        return Multivector(self.blades, self.values * signs.reshape(-1, *[1] * len(self.shape)))

    def __neg__(self) -> Multivector:
        return Multivector(self.blades, -self.values)

    def __add__(self, other: Multivector | ArrayLike) -> Multivector:
        other = as_multivector(other)
        a, b = self, other
        if a.blades != b.blades:
            blades = tuple(sorted({*a.blades, *b.blades}, key=_order))
            a, b = a.select(blades), b.select(blades)
        axes = max(len(a.shape), len(b.shape))
        return Multivector(a.blades, _aligned(a.values, axes) + _aligned(b.values, axes))

    def __radd__(self, other: ArrayLike) -> Multivector:
        return self + other

    def __sub__(self, other: Multivector | ArrayLike) -> Multivector:
        return self + -as_multivector(other)

    def __rsub__(self, other: ArrayLike) -> Multivector:
        return -self + other

    def __repr__(self) -> str:
        names = ["∧".join(name for i, name in enumerate(BASIS) if blade >> i & 1) for blade in self.blades]
        if self.shape:
            return f"<array {self.shape} over {', '.join(name or '1' for name in names)}>"
        # rounding errors are not shown: below 1e-12 of the largest coefficient, or of 1
        least = 1e-12 * max(1.0, float(np.abs(self.values).max(initial=0.0)))
        text = ""
        for name, value in zip(names, self.values):
            if abs(value) > least:
                number = "" if name and f"{abs(value):.6g}" == "1" else f"{abs(value):.6g}"
                text += f"{' - ' if value < 0 else ' + '}{number}{' ' if number and name else ''}{name}"
        return (text[3:] if text[:3] == " + " else f"-{text[3:]}") if text else "0"


def _aligned(values: NDArray, axes: int) -> NDArray:
    """Coefficients (K, N) with axes of length 1 inserted, so that the elements have `axes` axes."""
    own = values.shape[1:]
    return values if len(own) >= axes else values.reshape(len(values), *[1] * (axes - len(own)), *own)


def as_multivector(value: Multivector | ArrayLike) -> Multivector:
    """Convert numbers (N,) to scalars; multivectors are returned unchanged."""
    return value if isinstance(value, Multivector) else Multivector((0,), np.asarray(value, float)[None])


def commutator(a: Multivector, b: Multivector) -> Multivector:
    """½ (A B − B A), P1's underlined ×: zero exactly where a point lies on a line (P1 2.1)."""
    return a._times(b, _commutator)


def anticommutator(a: Multivector, b: Multivector) -> Multivector:
    """½ (A B + B A), P1's overlined ×: zero exactly where a point, or a line, lies in a plane."""
    return a._times(b, _anticommutator)


def stack(elements: list[Multivector] | tuple[Multivector, ...]) -> Multivector:
    """Stack elements of one shape along a new last axis."""
    blades = tuple(sorted({blade for a in elements for blade in a.blades}, key=_order))
    return Multivector(blades, np.stack([a.select(blades).values for a in elements], -1))


e1, e2, e3, e, e0 = (Multivector((1 << i,), np.ones(1)) for i in range(5))
I3, E, I = (Multivector((blade,), np.ones(1)) for blade in (7, 24, 31))  # e1∧e2∧e3, e∧e0 and their product
