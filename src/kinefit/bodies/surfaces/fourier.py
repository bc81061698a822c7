"""Free-form contours and surfaces as Fourier series (P1 2.2, 2.3): three signals x, y, z, periodic in their parameters.

Parameters u run from 0 to 1 once around (P1's φ is (2N + 1) u). A coefficient p_k of a signal is a complex number. P1
writes it as a phase vector in a plane l_m of its own, with l_m² = −1 as the imaginary unit; `conformal` is that form.
Low-pass approximations are the smooth shapes with which a fit starts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import BodyError
from kinefit.geometry.cga import exp
from kinefit.geometry.multivectors import Multivector

_HALF_THICKNESS = 0.0005  # [m] of the plate that a curve bounds: paper and tin, far below a pixel
# l_1 = e1∧e2, l_2 = e2∧e3, l_3 = e3∧e1: each contains e_m, so that the component along e_m is the signal
PLANES = tuple(Multivector((blade,), np.array([sign])) for blade, sign in ((3, 1.0), (6, 1.0), (5, -1.0)))


def _spectrum(samples: NDArray, axis: int) -> NDArray:
    """Coefficients −N..N of real signals along an axis; with an even count, ±N share the highest frequency."""
    count = samples.shape[axis]
    p = np.fft.fftshift(np.fft.fft(samples, axis=axis), axes=axis) / count
    if count % 2:
        return p
    p = np.moveaxis(p, axis, -1)
    half = 0.5 * p[..., :1]
    return np.moveaxis(np.concatenate([half, p[..., 1:], half], -1), -1, axis)


def _waves(u: NDArray, order: int) -> NDArray:
    """exp(2π i k u) (..., 2N+1) for k = −N..N."""
    return np.exp(2j * math.pi * u[..., None] * np.arange(-order, order + 1))


def _checked(samples: ArrayLike, axes: int) -> NDArray:
    points = np.asarray(samples, float)
    if points.ndim != axes + 1 or points.shape[-1] != 3 or min(points.shape[:-1], default=0) < 3:
        remedy = f"Give {'(M, 3)' if axes == 1 else '(M1, M2, 3)'} with at least three along each parameter."
        raise BodyError(f"points of shape {points.shape} for a Fourier series", remedy=remedy)
    if not np.isfinite(points).all():
        raise BodyError("points of a Fourier series that are not finite", remedy="Remove them and sample again.")
    return points


def _cut(p: NDArray, axis: int, order: int) -> NDArray:
    highest = p.shape[axis] // 2
    if not 0 <= order <= highest:
        problem = f"order {order} of a series that was sampled for {highest}"
        raise BodyError(problem, remedy=f"Take 0 to {highest}, or more samples.")
    index: list[slice] = [slice(None)] * p.ndim
    index[axis] = slice(highest - order, highest + order + 1)
    return p[tuple(index)]


def _phase_vectors(p: NDArray) -> Multivector:
    """Complex p (3, ...) as vectors, each in the plane l_m of its signal."""
    values = np.zeros((3, *p.shape))
    for m in range(3):
        values[m, m], values[(m + 1) % 3, m] = p[m].real, p[m].imag
    return Multivector((1, 2, 4), values)


@dataclass(frozen=True, eq=False)
class FourierCurve:
    """A closed curve as three 1D series: C(u) = Σ_m Σ_k p_k^m exp(2π k u l_m) (P1 2.2).

    Parameters
    ----------
    coefficients : (3, 2N+1) complex [m], k = −N..N.
    """

    coefficients: NDArray

    @classmethod
    def of(cls, points: ArrayLike, order: int | None = None) -> FourierCurve:
        """Curve through points (M, 3) [m], in order and evenly spaced in u; up to an order, at most M/2."""
        p = _spectrum(_checked(points, 1), 0).T
        return cls(p if order is None else _cut(p, 1, order))

    @property
    def order(self) -> int:
        """N, the highest frequency."""
        return self.coefficients.shape[1] // 2

    def low_pass(self, order: int) -> FourierCurve:
        """The curve without frequencies above `order`: 0 gives its centre, 1 an ellipse."""
        return FourierCurve(_cut(self.coefficients, 1, order))

    def at(self, u: ArrayLike, derivative: int = 0) -> NDArray:
        """Points (N, 3) [m] at parameters u (N,), or their derivatives by u; any shape of u."""
        factor = (2j * math.pi * np.arange(-self.order, self.order + 1)) ** derivative
        return (_waves(np.asarray(u, float), self.order) @ (self.coefficients * factor).T).real

    def samples(self, count: int) -> NDArray:
        """Points (N, 3) [m] at u = 0, 1/N, ..., for N = count; by FFT."""
        return _grid(self.coefficients[:, None], (1, count))[0]

    @property
    def phase_vectors(self) -> Multivector:
        """Vectors p_k^m (3, 2N+1) of P1, each in the plane l_m."""
        return _phase_vectors(self.coefficients)

    def triangles(self, count: int) -> tuple[NDArray, NDArray]:
        """Vertices (2 count + 2, 3) [m] and faces (4 count, 3) of a thin plate that the curve bounds.

        Both sides are fans from `count` points of the curve to their centre, half a millimetre to either side of the
        curve. So the plate's occluding contour is the curve, where the fans do not fold over.
        """
        ring = self.samples(count)
        ring = np.concatenate([ring, ring.mean(axis=0, keepdims=True)])
        spokes = ring[:-1] - ring[-1]
        area = np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
        side = _HALF_THICKNESS * area / max(float(np.linalg.norm(area)), 1e-12)
        j, back = np.arange(count), count + 1
        after, middle = (j + 1) % count, np.full(count, count)
        faces = [(j, after, middle), (back + after, back + j, back + middle)]  # front, back, and the edge in two halves
        faces += [(back + j, after, j), (back + j, back + after, after)]
        return np.concatenate([ring + side, ring - side]), np.concatenate([np.stack(f, -1) for f in faces])


@dataclass(frozen=True, eq=False)
class FourierSurface:
    """A surface as three 2D series: F(u1, u2) = Σ_i Σ_k1 Σ_k2 p^i exp(2π k1 u1 l_i) exp(2π k2 u2 l_i) (P1 2.3).

    Parameters
    ----------
    coefficients : (3, 2 N1 + 1, 2 N2 + 1) complex [m], k = −N..N along both.
    closed : whether each parameter is periodic (a ring); an open one runs from end to end for u from 0 to ½.
    """

    coefficients: NDArray
    closed: tuple[bool, bool] = (True, True)

    @classmethod
    def of(
        cls, points: ArrayLike, *, closed: tuple[bool, bool] = (True, True), orders: tuple[int, int] | None = None
    ) -> FourierSurface:
        """Surface through a grid of points (M1, M2, 3) [m].

        Parameters
        ----------
        closed : (bool, bool)
            False for a parameter with two ends, such as the height on a trunk: the samples are continued by their
            mirror image, so that the series has no jump between the ends.
        orders : highest frequencies, at most half of the samples (all samples less one for an open parameter).
        """
        grid = _checked(points, 2)
        for axis in (0, 1):
            if not closed[axis]:
                inner = np.flip(grid.take(range(1, grid.shape[axis] - 1), axis), axis)
                grid = np.concatenate([grid, inner], axis)
        p = np.moveaxis(_spectrum(_spectrum(grid, 0), 1), -1, 0)
        surface = cls(p, (bool(closed[0]), bool(closed[1])))
        return surface if orders is None else surface.low_pass(*orders)

    @property
    def orders(self) -> tuple[int, int]:
        """N1 and N2, the highest frequencies."""
        _, a, b = self.coefficients.shape
        return a // 2, b // 2

    def low_pass(self, first: int, second: int | None = None) -> FourierSurface:
        """The surface without frequencies above `first` along u1, `second` (or the same) along u2."""
        p = _cut(self.coefficients, 1, first)
        return FourierSurface(_cut(p, 2, first if second is None else second), self.closed)

    def at(self, u1: ArrayLike, u2: ArrayLike, derivatives: tuple[int, int] = (0, 0)) -> NDArray:
        """Points (N, 3) [m] at u1 and u2 (N,), or their partial derivatives; any shape of u1 and u2."""
        u1, u2 = np.broadcast_arrays(np.asarray(u1, float), np.asarray(u2, float))
        p = self.coefficients
        for axis, (order, times) in enumerate(zip(self.orders, derivatives)):
            factor = (2j * math.pi * np.arange(-order, order + 1)) ** times
            p = p * (factor[:, None] if axis == 0 else factor)
        first, second = (_waves(u.ravel(), n) for u, n in zip((u1, u2), self.orders))
        out = np.stack([np.sum((first @ signal) * second, 1).real for signal in p], -1)
        return out.reshape(*u1.shape, 3)

    def normals(self, u1: ArrayLike, u2: ArrayLike) -> NDArray:
        """Unit normals ∂F/∂u1 × ∂F/∂u2 (N, 3) at u1 and u2 (N,); zero at poles. Any shape of u1 and u2."""
        cross = np.cross(self.at(u1, u2, (1, 0)), self.at(u1, u2, (0, 1)))
        size = np.linalg.norm(cross, axis=-1, keepdims=True)
        return np.where(size > 1e-12, cross / np.maximum(size, 1e-12), 0.0)

    def parameters(self, counts: tuple[int, int]) -> tuple[NDArray, NDArray]:
        """Parameters u1 (M1,) and u2 (M2,) of a grid: around if closed, else from end to end."""
        first, second = (np.arange(n) / n for n in self._full_period(counts))
        return first[: counts[0]], second[: counts[1]]

    def samples(self, counts: tuple[int, int]) -> NDArray:
        """Points (M1, M2, 3) [m] on the grid `parameters(counts)`; by FFT."""
        return _grid(self.coefficients, self._full_period(counts))[: counts[0], : counts[1]]

    def _full_period(self, counts: tuple[int, int]) -> tuple[int, int]:
        """Numbers of samples of a full period."""
        first, second = (n if ring else 2 * max(n - 1, 1) for n, ring in zip(counts, self.closed))
        return first, second

    @property
    def phase_vectors(self) -> Multivector:
        """Vectors p^i (3, 2 N1 + 1, 2 N2 + 1) of P1, each in the plane l_i."""
        return _phase_vectors(self.coefficients)

    def triangles(self, counts: tuple[int, int]) -> tuple[NDArray, NDArray]:
        """Vertices (V, 3) [m], those of `samples` in order first, and faces (T, 3), outward counter-clockwise.

        If one parameter is closed and the other is open, a fan closes each end.
        """
        grid = self.samples(counts)
        index = np.arange(counts[0] * counts[1]).reshape(counts)
        rings = [np.concatenate([index, index[:1]]) if self.closed[0] else index]
        quads = np.concatenate([rings[0], rings[0][:, :1]], 1) if self.closed[1] else rings[0]
        a, b, c, d = quads[:-1, :-1], quads[1:, :-1], quads[1:, 1:], quads[:-1, 1:]
        faces = [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
        vertices = grid.reshape(-1, 3)
        if self.closed[0] != self.closed[1]:
            ends = (index[:, 0], index[::-1, -1]) if self.closed[0] else (index[0, ::-1], index[-1])
            middles = np.stack([vertices[ring].mean(0) for ring in ends])
            for k, ring in enumerate(ends):
                middle = np.full(len(ring), len(vertices) + k)
                faces.append(np.stack([middle, np.roll(ring, -1), ring], -1))
            vertices = np.concatenate([vertices, middles])
        joined = np.concatenate(faces)
        x = vertices[joined]
        inside_out = np.sum(x[:, 0] * np.cross(x[:, 1], x[:, 2])) < 0
        return vertices, joined[:, ::-1].copy() if inside_out else joined


def levels(shape: FourierCurve | FourierSurface, count: int, lowest: int = 2) -> list:
    """Low-pass approximations from coarse to fine, the last one unchanged, for a coarse-to-fine fit (P1 2.4)."""
    orders = (shape.order,) if isinstance(shape, FourierCurve) else shape.orders
    out = []
    for step in np.linspace(0.0, 1.0, count) if count > 1 else [1.0]:
        at = [min(n, round(lowest * (n / lowest) ** step)) if n > lowest else n for n in orders]
        out.append(shape.low_pass(*at))
    return out


def by_length(points: ArrayLike, count: int) -> NDArray:
    """Resample a closed polygon (M, 3) [m] evenly by arc length: (N, 3) [m], N = count, for `FourierCurve.of`.

    Raises
    ------
    BodyError
        Fewer than three points, points that are not finite, or all in one position.
    """
    x = _checked(points, 1)
    ring = np.concatenate([x, x[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    if along[-1] == 0.0:
        raise BodyError("a contour of one point", remedy="Give points at different positions.")
    at = np.arange(count) * (along[-1] / count)
    return np.stack([np.interp(at, along, ring[:, k]) for k in range(3)], 1)


def conformal(shape: FourierCurve | FourierSurface, *u: ArrayLike) -> Multivector:
    """Points as Euclidean vectors, by P1's sum of phase vectors rotated in planes l_m: slow, but as published."""
    at = np.broadcast_arrays(*(np.asarray(v, float) for v in u))
    axes = len(at)
    total = np.zeros((3, *at[0].shape))
    for m, plane in enumerate(PLANES):
        turned = shape.phase_vectors[m]
        for axis, v in enumerate(at):
            count = shape.coefficients.shape[1 + axis]
            k = np.arange(count) - count // 2
            if axis == 0:
                k = k.reshape(-1, *[1] * (axes - 1))
            angle = 2.0 * math.pi * k * v.reshape(*v.shape, *[1] * axes)
            turned = turned * exp(plane * (-2.0 * angle))
        total += turned.select((1, 2, 4)).values.sum(axis=tuple(range(-axes, 0)))
    return Multivector((1, 2, 4), total)


def _grid(p: NDArray, counts: tuple[int, int]) -> NDArray:
    """Points (M1, M2, 3) at even steps of both parameters; frequencies above those of the steps are aliased."""
    k1, k2 = (np.arange(-(n // 2), n // 2 + 1) for n in p.shape[1:])
    spread = np.zeros((3, *counts), complex)
    for signal, sum_of in zip(p, spread):
        np.add.at(sum_of, ((k1 % counts[0])[:, None], (k2 % counts[1])[None]), signal)
    return np.moveaxis(np.fft.ifft2(spread).real * (counts[0] * counts[1]), 0, -1)
