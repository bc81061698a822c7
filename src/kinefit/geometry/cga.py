"""Points, lines, planes, circles, spheres, twists and motors as conformal multivectors (P1 2), over arrays.

Elements are outer products of their points: L = e∧A∧B, P = e∧A∧B∧C, circle A∧B∧C, sphere A∧B∧C∧D. X lies on an element
K exactly where X∧K = 0. A motion is a versor product M X M̃ for all of them. The library's fast path is `se3` and
`lines`; this module has the formulas of the paper, and agrees with them to 1e-12.

Shapes are given for one leading axis (N,); all functions take any leading axes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry import _kernels_cga, se3
from kinefit.geometry.multivectors import (
    I3,
    E,
    I,
    Multivector,
    anticommutator,
    as_multivector,
    commutator,
    e,
    e0,
    e1,
    e2,
    e3,
    stack,
)

__all__ = [
    "E", "I", "I3", "Multivector", "anticommutator", "between", "circle_parameters", "commutator", "coordinates",
    "distance", "dual", "e", "e0", "e1", "e2", "e3", "exp", "interpolate", "inverse", "line_of", "log", "matrix",
    "motor_of", "operator", "plane_equation", "plane_of", "plucker", "point", "screw", "sphere_of", "sphere_parameters",
    "stack", "translator", "twist", "twist_coordinates", "unit", "vector", "versor",
]  # fmt: skip

_VECTOR = (1, 2, 4)
_POINT = (1, 2, 4, 8, 16)
_TURN = (6, 5, 3)  # e23, e13, e12
_SHIFT = (9, 10, 12)  # e1∧e, e2∧e, e3∧e
_SIGNS = np.array([1.0, -1.0, 1.0])  # I3 ω = ω1 e23 − ω2 e13 + ω3 e12
_MOTOR = (0, 3, 5, 6, 9, 10, 12, 15)
_EPSILON = Multivector((15,), np.ones(1))  # I3 e: commutes with motors and has the square 0


def _first(x: ArrayLike, size: int, what: str) -> NDArray:
    """Coordinates (N, size) with their axis moved to the front."""
    array = np.asarray(x, float)
    if array.shape[-1:] != (size,) or not math.isfinite(array.sum()):
        raise ObservationError(f"{what} of shape {array.shape}, or not finite", remedy=f"Give (..., {size}) numbers.")
    return np.moveaxis(array, -1, 0)


def _length(values: NDArray, what: str) -> NDArray:
    """Lengths (N,) of coefficients (K, N); raises ObservationError for a zero length."""
    length = np.linalg.norm(values, axis=0)
    if not np.all((length > 1e-12) & (length < math.inf)):
        raise ObservationError(what, remedy="Give points at different positions.")
    return length


def _last(values: NDArray) -> NDArray:
    return np.moveaxis(values, 0, -1)


# --- elements -------------------------------------------------------------------------------------------------------


def vector(x: ArrayLike) -> Multivector:
    """Euclidean vectors x1 e1 + x2 e2 + x3 e3 of x (N, 3)."""
    return Multivector(_VECTOR, _first(x, 3, "vectors"))


def point(x: ArrayLike) -> Multivector:
    """Conformal points X = x + ½ x² e + e0 of x (N, 3) [m]: X² = 0, X·Y = −½ |x − y|²."""
    x = _first(x, 3, "points")
    return Multivector(_POINT, np.concatenate([x, 0.5 * np.sum(x * x, 0)[None], np.ones((1, *x.shape[1:]))]))


def coordinates(X: Multivector) -> NDArray:
    """Coordinates (N, 3) [m] of points of any weight."""
    values = X.select(_POINT).values
    return _last(values[:3] / values[4])


def distance(X: Multivector, Y: Multivector) -> NDArray:
    """Distances (N,) [m] between points of weight 1: √(−2 X·Y)."""
    return np.sqrt(np.maximum(-2.0 * (X | Y).scalar, 0.0))


def dual(A: Multivector) -> Multivector:
    """Dual A I⁻¹: for a plane or sphere a vector, for a line or circle a bivector, which annihilate its points."""
    return A * -I


def line_of(line: ArrayLike) -> Multivector:
    """Lines L = e∧A∧B of Plücker lines (N, 6) = (n, m), as in `lines`: E n + e I3 m."""
    line = _first(line, 6, "lines")
    return E * Multivector(_VECTOR, line[:3]) + e * I3 * Multivector(_VECTOR, line[3:])


def plucker(L: Multivector) -> NDArray:
    """Plücker lines (N, 6) = (n, m), with n of length 1, of L = e∧A∧B."""
    return np.roll(twist_coordinates(screw(L)), 3, axis=-1)


def plane_of(plane: ArrayLike) -> Multivector:
    """Planes P = e∧A∧B∧C of (N, 4) = (n, d) with n·x = d [m]: (n + d e) I."""
    plane = _first(plane, 4, "planes")
    return (Multivector(_VECTOR, plane[:3]) + Multivector((8,), plane[3:])) * I


def plane_equation(P: Multivector) -> NDArray:
    """Equations (N, 4) = (n, d) [m] of planes, with n of length 1."""
    values = dual(P).select((*_VECTOR, 8)).values
    return _last(values / _length(values[:3], "a plane through points on one line"))


def sphere_of(centre: ArrayLike, radius: ArrayLike) -> Multivector:
    """Spheres S = A∧B∧C∧D of centres (N, 3) [m] and radii (N,) [m]: (C − ½ r² e) I."""
    return (point(centre) - e * (0.5 * np.asarray(radius, float) ** 2)) * I


def sphere_parameters(S: Multivector) -> tuple[NDArray, NDArray]:
    """Centres (N, 3) [m] and radii (N,) [m] of spheres A∧B∧C∧D."""
    s = dual(S)
    _length(s.select((16,)).values, "a sphere through points of one plane")
    s = s / s.along(e0)
    centre = coordinates(s)
    return centre, np.sqrt((s | s).scalar)


def circle_parameters(C: Multivector) -> tuple[NDArray, NDArray, NDArray]:
    """Centres (N, 3) [m], unit normals (N, 3) and radii (N,) [m] of circles A∧B∧C (right-handed through them)."""
    plane = e ^ C
    n = plane_equation(plane)[..., :3]
    centre = coordinates((C * e * C).grade(1))  # the image of infinity under inversion in the circle
    square = (C * ~C).scalar / (plane * ~plane).scalar
    return centre, n, np.sqrt(np.abs(square))


# --- motions --------------------------------------------------------------------------------------------------------


def translator(t: ArrayLike | Multivector) -> Multivector:
    """Translators T = 1 + ½ e t of t (N, 3) [m] or Euclidean vectors (P1 3.3)."""
    t = t if isinstance(t, Multivector) else vector(t)
    return 1.0 + e * t * 0.5


def twist(xi: ArrayLike) -> Multivector:
    """Bivectors Ψ = I3 ω + v∧e of twists ξ = (v, ω) (N, 6) [m, rad]; `exp` of them moves as `se3.exp(ξ)` does."""
    xi = _first(xi, 6, "twists")
    signs = _SIGNS.reshape(3, *[1] * (xi.ndim - 1))
    return Multivector((*_TURN, *_SHIFT), np.concatenate([xi[3:] * signs, xi[:3]]))


def twist_coordinates(Psi: Multivector) -> NDArray:
    """Twists ξ = (v, ω) (N, 6) [m, rad] of bivectors Ψ."""
    values = _last(Psi.select((*_SHIFT, *_TURN)).values)
    return values * np.concatenate([np.ones(3), _SIGNS])


def screw(L: Multivector, theta: ArrayLike = 1.0) -> Multivector:
    """Twist without pitch of a joint: Ψ = θ L (P1 2.1), theta (N,) [rad], with the line as bivector L I of length 1."""
    psi = (L * I).select((*_TURN, *_SHIFT))
    return psi * (np.asarray(theta, float) / _length(psi.values[:3], "a line through one point alone"))


def exp(Psi: Multivector) -> Multivector:
    """Motor M = exp(−½ Ψ) of twists (P1 2.1), in closed form, also exact near zero.

    −Ψ² = (θ + ε p)² with ε = I3 e, ε² = 0: a dual angle, so M = cos(½(θ + ε p)) − Ψ sin(½(θ + ε p)) / (θ + ε p).
    """
    square = Psi * Psi
    half = 0.5 * np.sqrt(np.maximum(-square.scalar, 0.0))
    pitch = -square.along(_EPSILON)  # 2 θ p
    (a, b), c = se3._coefficients(half), se3._cubic(half)
    cosine = np.cos(half) - _EPSILON * (0.125 * pitch * a)
    sine = 0.5 * a - _EPSILON * (0.0625 * pitch * (b - c))
    return (cosine - Psi * sine).select(_MOTOR)


def log(M: Multivector) -> Multivector:
    """Twist Ψ with M = exp(−½ Ψ) up to the sign of M, with a rotation of at most π."""
    values = M.select(_MOTOR).values
    M = Multivector(_MOTOR, np.where(values[0] < 0.0, -values, values))
    plane = M.grade(2)
    sine = np.linalg.norm(plane.select(_TURN).values, axis=0)
    half = np.arctan2(sine, M.scalar)
    (a, b), c = se3._coefficients(half), se3._cubic(half)
    first, second = 2.0 / a, -2.0 * M.along(_EPSILON) * (b - c) / a**3
    return -(plane * (first + _EPSILON * second)).select((*_TURN, *_SHIFT))


def motor_of(T: ArrayLike) -> Multivector:
    """Motors of rigid motions T (N, 4, 4).

    Raises
    ------
    ObservationError
        Motions of another shape, or not finite.
    """
    T = np.asarray(T, float)
    if T.shape[-2:] != (4, 4) or not math.isfinite(T.sum()):
        raise ObservationError(f"motions of shape {T.shape}, or not finite", remedy="Give (..., 4, 4).")
    q = _first(se3.quaternion(T[..., :3, :3]), 4, "quaternions")
    rotor = Multivector((0, *_TURN), np.stack([q[0], -q[1], q[2], -q[3]]))
    return (translator(T[..., :3, 3]) * rotor).select(_MOTOR)


def matrix(M: Multivector) -> NDArray:
    """Rigid motions (N, 4, 4) of motors of any length."""
    op = operator(M)
    scale = op[..., 4, 4, None]
    return se3.transform(op[..., :3, :3] / scale[..., None], op[..., :3, 4] / scale)


def operator(M: Multivector) -> NDArray:
    """Matrices (N, 5, 5) of the map X -> M X M̃ of vectors over e1, e2, e3, e, e0."""
    values = M.select(_MOTOR).values
    out = np.empty((5, 5, math.prod(M.shape)))
    _kernels_cga.operators(np.ascontiguousarray(values.reshape(8, -1)), out)
    return np.moveaxis(out, -1, 0).reshape(*M.shape, 5, 5)


def versor(M: Multivector, X: Multivector) -> Multivector:
    """Versor product M X M̃, restricted to the grades of X (rounding leaves others); points by their 5×5 operators."""
    if not set(X.blades) <= set(_POINT) or not set(M.blades) <= set(_MOTOR):
        return (M * X * ~M).grade(*X.grades)
    shape = np.broadcast_shapes(M.shape, X.shape)
    x, m = X.select(_POINT) if X.blades != _POINT else X, M.select(_MOTOR)
    motors = m.columns(shape)
    matrices, out = np.empty((5, 5, motors.shape[1])), np.empty((5, math.prod(shape)))
    _kernels_cga.operators(motors, matrices)
    _kernels_cga.moved(matrices, x.columns(shape), out)
    return Multivector(_POINT, out.reshape(5, *shape))


def inverse(A: Multivector) -> Multivector:
    """Inverse A⁻¹ = Ã / (A Ã) of versors and blades that are not null."""
    reverse = ~A
    return reverse / (A * reverse).scalar


def unit(M: Multivector) -> Multivector:
    """Normalise motors: M M̃ = 1 including its ε-part, so that products of many do not drift."""
    square = M * ~M
    s = square.scalar
    return (M * (1.0 - _EPSILON * (0.5 * square.along(_EPSILON) / s))).select(_MOTOR) / np.sqrt(s)


def between(Psi: Multivector, other: Multivector) -> Multivector:
    """Shortest motor M with M Ψ M̃ = Ψ' for two joints (screws without pitch) of one angle (P1 3.1).

    Raises
    ------
    ObservationError
        Twists with pitch or of different angles, between which there is no motion; opposite lines.
    """
    squares = [as_multivector(p * p) for p in (Psi, other)]
    theta2, size = -squares[0].scalar, np.maximum(-squares[1].scalar, 1e-300)
    pitch = max(float(np.abs(s.along(_EPSILON) / size).max()) for s in squares)
    if pitch > 1e-9 or np.any(np.abs(theta2 / size - 1.0) > 1e-9):
        raise ObservationError("joints with pitch or of different angles", remedy="Give lines: screw(L, θ) of one θ.")
    M = 1.0 - (other * Psi / theta2).select(_MOTOR)
    if np.any(M.scalar < 1e-12):
        raise ObservationError(
            "opposite lines, which infinitely many rotations map to each other", remedy="Give a joint between them."
        )
    return unit(M)


def interpolate(M: Multivector, t: ArrayLike) -> Multivector:
    """Interpolate a motor: Mₜ = exp(−½ t Ψ) for M = exp(−½ Ψ), t (N,), from 1 to M along one screw (P1 3.1)."""
    return exp(log(M) * np.asarray(t, float))
