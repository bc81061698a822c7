"""Pose estimation in conformal geometric algebra (P1 2.1, 2.4): points on rays, points and lines in planes.

Each constraint is linear in the moving element: X×L, X×P or L×P (commutator and anticommutators, zero for incidence). A
motor M = exp(−½ Ψ) near 1 moves X by X×Ψ (the commutator), so the derivatives are nested products. Steps use the closed
form of the motor (Rodrigues' formula) and are iterated. The library's fast path is `correspondences` and `solvers`,
with the same results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.cga import dual, exp, screw, twist, twist_coordinates, unit
from kinefit.geometry.multivectors import I3, E, I, Multivector, anticommutator, commutator, e, e0, e1, e2, e3

_BASIS = twist(np.eye(6))  # the six twists of a motion


def point_line(X: Multivector, L: Multivector) -> NDArray:
    """Error vectors x × n − m (N, 3) [m] of points and lines of length 1, from X×L; as `lines.point_line`."""
    error = commutator(X, L)
    return np.stack([error.along(I3 * axis * E) for axis in (e1, e2, e3)], -1)


def point_plane(X: Multivector, P: Multivector) -> NDArray:
    """Signed distances n·x − d (N,) [m] of points and planes of length 1, from X×P; as `lines.point_plane`."""
    return anticommutator(X, P).along(I)


def line_plane(L: Multivector, P: Multivector) -> NDArray:
    """Tilt and offset (N, 4) [rad, m] of lines and planes of length 1, from L×P; as `lines.line_plane`."""
    tilt, offset = _tilt_offset(L, P)
    normal = dual(P).select((1, 2, 4)).values
    return np.concatenate([tilt[..., None], np.moveaxis(normal * offset, 0, -1)], -1)


def _tilt_offset(L: Multivector, P: Multivector, along: Multivector | None = None) -> tuple[NDArray, NDArray]:
    """Sine of the angle, and offset [m] of the line's foot point, from L×P along the line's direction."""
    error = anticommutator(L, P)
    tilt = error.along(I3)
    shift = np.stack([error.along(I3 * axis * e) for axis in (e1, e2, e3)])
    direction = (L if along is None else along) * I
    return tilt, -np.sum(shift * np.moveaxis(twist_coordinates(direction), -1, 0)[3:], 0)


@dataclass(frozen=True, eq=False)
class Constraint:
    """Incidence of a body's elements with fixed elements.

    Parameters
    ----------
    moved : (N,) points X, or lines L = e∧A∧B, at rest.
    fixed : (N,) lines e∧(O∧x) for points; planes for points or lines. Of any length: they are normalised.
    joints : indices of the joints that move them, in order from the root (P1's list 𝒥).
    sigma : scalar or (N,) standard deviation [m].
    """

    moved: Multivector
    fixed: Multivector
    joints: tuple[int, ...] = ()
    sigma: ArrayLike = 1.0


@dataclass(frozen=True, eq=False)
class CgaPose:
    """Result of `estimate_pose`.

    Parameters
    ----------
    M : motor of the body.
    angles : (J,) [rad]
    rms : root mean square of all weighted errors.
    iterations : int
    step : [m, rad] norm of the last step; above the tolerance if not converged.
    """

    M: Multivector
    angles: NDArray
    rms: float
    iterations: int
    step: float


def estimate_pose(
    constraints: Sequence[Constraint],
    joints: Multivector | None = None,
    *,
    start: Multivector | None = None,
    angles: ArrayLike | None = None,
    iterations: int = 50,
    tolerance: float = 1e-12,
) -> CgaPose:
    """Estimate motor M and angles θ: (M (M1 … Mn X M̃n … M̃1) M̃) × (e∧(O∧x)) = 0 in least squares (P1 2.1, 2.4).

    Parameters
    ----------
    constraints : incidences of elements.
    joints : (J,) lines e∧A∧B of the joints at rest, or any twists Ψ_i there: each moves by M_i = exp(−½ θ_i Ψ_i).
    start, angles : initial motor and angles (J,) [rad]; default 1 and zero.
    iterations : int, largest number.
    tolerance : float [m, rad], norm of the last step.

    Raises
    ------
    ObservationError
        Elements without a known constraint, or a pose that the constraints do not determine.
    """
    axes = screw(joints) if joints is not None and joints.grades == (3,) else joints
    count = 0 if axes is None else axes.shape[0]
    M = exp(twist(np.zeros(6))) if start is None else start
    theta = np.zeros(count) if angles is None else np.array(angles, float)
    prepared = [_prepared(c, count) for c in constraints]
    steps, size, residual = 0, np.inf, np.empty(0)
    while steps < iterations and size >= tolerance:
        turns = exp(axes * theta) if axes is not None else M
        parts = [_linearised(c, M, axes, turns, count) for c in prepared]
        residual = np.concatenate([np.empty(0), *(part[0] for part in parts)])
        jacobian = np.concatenate([np.empty((0, 6 + count)), *(part[1] for part in parts)])
        step, _, rank, _ = np.linalg.lstsq(jacobian, -residual, rcond=1e-10)
        if rank < 6 + count:
            raise ObservationError(
                f"the constraints determine {rank} of {6 + count} unknowns", remedy="Give more points, or other rays."
            )
        M, theta = unit(exp(twist(step[:6])) * M), theta + step[6:]
        steps, size = steps + 1, float(np.linalg.norm(step))
    return CgaPose(M, theta, float(np.sqrt(np.mean(residual**2))), steps, size)


def _prepared(c: Constraint, joints: int) -> Constraint:
    moved, fixed = _of_one_grade(c.moved), _of_one_grade(c.fixed)
    kinds = moved.grades, fixed.grades
    if kinds not in (((1,), (3,)), ((1,), (4,)), ((3,), (4,))):
        raise ObservationError(
            f"no constraint for elements of grades {kinds[0]} and {kinds[1]}",
            remedy="Give points and lines, points and planes, or lines and planes.",
        )
    if any(not 0 <= j < joints for j in c.joints):
        raise ObservationError(f"joints {c.joints} of a body that has {joints}", remedy="Count from 0.")
    shape = moved.shape, fixed.shape, np.shape(c.sigma)
    if len(shape[0]) != 1 or shape[1] not in ((), shape[0]) or shape[2] not in ((), shape[0]):
        raise ObservationError(f"elements, what they lie on and sigma of shapes {shape}", remedy="Give (N,) of each.")
    return Constraint(_unit(moved), _unit(fixed), c.joints, c.sigma)


def _of_one_grade(A: Multivector) -> Multivector:
    """Drop the grades that rounding left in a versor product (M X M̃ of a point has zeros of grades 3 and 5)."""
    sizes = {grade: float(np.abs(A.grade(grade).values).max(initial=0.0)) for grade in A.grades}
    return A.grade(*(grade for grade, size in sizes.items() if not size < 1e-9 * max(sizes.values())))


def _unit(A: Multivector) -> Multivector:
    """Points of weight 1, lines and planes of length 1."""
    size = A.along(e0) if A.grades == (1,) else np.sqrt(np.abs((A * ~A).scalar))
    if not np.all((np.abs(size) > 1e-12) & (np.abs(size) < np.inf)):
        raise ObservationError("elements without a direction or not finite", remedy="Give points that differ.")
    return A / size


def _linearised(
    c: Constraint, M: Multivector, axes: Multivector | None, turns: Multivector, joints: int
) -> tuple[NDArray, NDArray]:
    """Weighted errors and their derivatives by the six of the body's twist and the joints' angles."""
    chain, twists = M, {}
    for j in c.joints:
        assert axes is not None  # checked by `_prepared`
        twists[j] = (chain * axes[j] * ~chain).grade(2)  # Ψ' = M Ψ M̃ (P1 2.1)
        chain = chain * turns[j]
    element = (chain * c.moved * ~chain).grade(*c.moved.grades)
    w = 1.0 / np.broadcast_to(np.asarray(c.sigma, float), element.shape)
    columns = [commutator(element[..., None], _BASIS)]
    error = _error(element, c.fixed) * w[:, None]
    jacobian = np.zeros((*error.shape, 6 + joints))
    jacobian[..., :6] = np.moveaxis(_derivative(element[..., None], columns[0], c.fixed[..., None]), 1, 2)
    for j, psi in twists.items():
        jacobian[..., 6 + j] = _derivative(element, commutator(element, psi), c.fixed)
    jacobian *= w[:, None, None]
    return error.reshape(-1), jacobian.reshape(-1, 6 + joints)


def _error(element: Multivector, fixed: Multivector) -> NDArray:
    if fixed.grades == (3,):
        return point_line(element, fixed)
    if element.grades == (1,):
        return point_plane(element, fixed)[..., None]
    return np.stack(_tilt_offset(element, fixed), -1)


def _derivative(element: Multivector, change: Multivector, fixed: Multivector) -> NDArray:
    """Derivative of `_error` along `change` of the element."""
    if element.grades == (1,):
        return _error(change.grade(1), fixed)
    tilt, offset = _tilt_offset(change.grade(3), fixed, element)
    return np.stack([tilt, offset + _tilt_offset(element, fixed, change.grade(3))[1]], -1)

