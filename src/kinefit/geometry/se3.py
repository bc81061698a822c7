"""Rigid motions and twists: exp, log, adjoint, left Jacobian; batched, exact near identity and near π.

A twist is ξ = (v, ω), spatial, in metres and radians: a point x moves by v + ω × x (P3, eqs. 1-4). Shapes are given for
one leading axis (N,); all functions but `aligned` take any leading axes. The coefficients are series where closed forms
cancel, so that small angles keep full precision.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_MAX_SERIES_ANGLE = 0.5  # [rad] below it the series are exact to machine precision
_FACTORIALS = np.cumprod(np.concatenate([[1.0], np.arange(1.0, 25.0)]))


def _series(theta2: NDArray, first: int) -> NDArray:
    """Σ_k (−θ²)^k / (first + 2k)! — the tail of sine or cosine divided by its leading power."""
    total = np.zeros_like(theta2)
    for k in range(7, -1, -1):
        total = total * -theta2 + 1.0 / _FACTORIALS[first + 2 * k]
    return total


def _coefficients(theta: NDArray) -> tuple[NDArray, NDArray]:
    """sin θ / θ and (1 − cos θ) / θ²."""
    return np.sinc(theta / np.pi), 0.5 * np.sinc(theta / (2.0 * np.pi)) ** 2


def _cubic(theta: NDArray) -> NDArray:
    """(θ − sin θ) / θ³."""
    small = theta < _MAX_SERIES_ANGLE
    t = np.where(small, 1.0, theta)
    return np.where(small, _series(theta * theta, 3), (t - np.sin(t)) / t**3)


def hat(omega: NDArray) -> NDArray:
    """Cross-product matrices (N, 3, 3) of ω (N, 3): hat(ω) x = ω × x."""
    omega = np.asarray(omega, float)
    out = np.zeros((*omega.shape[:-1], 3, 3))
    x, y, z = omega[..., 0], omega[..., 1], omega[..., 2]
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def exp_so3(omega: NDArray) -> NDArray:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3) [rad], by Rodrigues' formula."""
    omega = np.asarray(omega, float)
    a, b = _coefficients(np.linalg.norm(omega, axis=-1))
    w = hat(omega)
    return np.eye(3) + a[..., None, None] * w + b[..., None, None] * (w @ w)


def quaternion(rotation: NDArray) -> NDArray:
    """Unit quaternions (N, 4) as (w, x, y, z), w ≥ 0, of rotation matrices (N, 3, 3); always stable (Shepperd)."""
    r = np.asarray(rotation, float)
    m00, m11, m22 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    table = np.empty((*r.shape[:-2], 4, 4))
    table[..., 0, 0] = 1 + m00 + m11 + m22
    table[..., 1, 1] = 1 + m00 - m11 - m22
    table[..., 2, 2] = 1 - m00 + m11 - m22
    table[..., 3, 3] = 1 - m00 - m11 + m22
    table[..., 0, 1] = table[..., 1, 0] = r[..., 2, 1] - r[..., 1, 2]
    table[..., 0, 2] = table[..., 2, 0] = r[..., 0, 2] - r[..., 2, 0]
    table[..., 0, 3] = table[..., 3, 0] = r[..., 1, 0] - r[..., 0, 1]
    table[..., 1, 2] = table[..., 2, 1] = r[..., 0, 1] + r[..., 1, 0]
    table[..., 1, 3] = table[..., 3, 1] = r[..., 0, 2] + r[..., 2, 0]
    table[..., 2, 3] = table[..., 3, 2] = r[..., 1, 2] + r[..., 2, 1]
    squares = np.diagonal(table, axis1=-2, axis2=-1)
    best = np.argmax(squares, axis=-1)
    q = np.take_along_axis(table, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def rotation_from_quaternion(q: NDArray) -> NDArray:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) as (w, x, y, z), which are normalised first."""
    q = np.asarray(q, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, v = hat(q[..., 1:]), q[..., 0]
    return np.eye(3) + 2.0 * v[..., None, None] * w + 2.0 * (w @ w)


def log_so3(rotation: NDArray) -> NDArray:
    """Rotation vectors (N, 3) [rad], norm ≤ π, of rotation matrices (N, 3, 3)."""
    q = quaternion(rotation)
    sine = np.linalg.norm(q[..., 1:], axis=-1)
    half = np.arctan2(sine, q[..., 0])
    factor = np.where(sine > 1e-8, 2.0 * half / np.where(sine > 1e-8, sine, 1.0), 2.0)
    return factor[..., None] * q[..., 1:]


def transform(rotation: NDArray, translation: NDArray) -> NDArray:
    """Homogeneous matrices (N, 4, 4) of rotations (N, 3, 3) and translations (N, 3) [m]."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    out = np.zeros((*shape, 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, translation, 1.0
    return out


def nearest_rotation(M: NDArray) -> NDArray:
    """Rotations (N, 3, 3) nearest to matrices (N, 3, 3) by least squares (W. Kabsch, 1978)."""
    u, _, vt = np.linalg.svd(M)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)


def shortest_turn(a: NDArray, b: NDArray) -> NDArray:
    """Smallest rotations (N, 3, 3) from directions a (N, 3) to b (N, 3); by π for opposite ones."""
    a, b = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12) for v in np.broadcast_arrays(a, b))
    axis, cosine = np.cross(a, b), np.sum(a * b, axis=-1, keepdims=True)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    perpendicular = np.eye(3)[np.argmin(np.abs(a), axis=-1)]
    perpendicular = perpendicular - np.sum(perpendicular * a, axis=-1, keepdims=True) * a
    perpendicular = perpendicular / np.linalg.norm(perpendicular, axis=-1, keepdims=True)
    axis = np.where(sine > 1e-12, axis / np.maximum(sine, 1e-12), perpendicular)
    return exp_so3(axis * np.arctan2(sine, cosine))


def aligned(x: NDArray, y: NDArray, weight: NDArray | None = None) -> NDArray:
    """Rigid motion T_y_x (4, 4) that aligns points x (K, 3) with y (K, 3), by weighted least squares (Kabsch).

    weight (K,): default equal.
    """
    w = np.full(len(x), 1.0 / len(x)) if weight is None else weight / weight.sum()
    middle, aim = w @ x, w @ y
    R = nearest_rotation((w[:, None] * (y - aim)).T @ (x - middle))
    return transform(R, aim - R @ middle)


def inverse(T: NDArray) -> NDArray:
    """Inverses (N, 4, 4) of rigid motions (N, 4, 4)."""
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def apply(T: NDArray, x: NDArray) -> NDArray:
    """Move points x (N, 3) [m] by T (N, 4, 4): (N, 3) [m]."""
    return (T[..., :3, :3] @ np.asarray(x, float)[..., None])[..., 0] + T[..., :3, 3]


def exp(xi: NDArray) -> NDArray:
    """Screw motions T (N, 4, 4) of twists ξ = (v, ω) (N, 6) [m, rad] (P3, eq. 3)."""
    xi = np.asarray(xi, float)
    v, omega = xi[..., :3], xi[..., 3:]
    return transform(exp_so3(omega), (left_jacobian_so3(omega) @ v[..., None])[..., 0])


def log(T: NDArray) -> NDArray:
    """Twists ξ = (v, ω) (N, 6) [m, rad], |ω| ≤ π, of rigid motions (N, 4, 4)."""
    T = np.asarray(T, float)
    omega = log_so3(T[..., :3, :3])
    v = (_left_so3_inverse(omega) @ T[..., :3, 3:])[..., 0]
    return np.concatenate([v, omega], -1)


def left_jacobian_so3(omega: NDArray) -> NDArray:
    """Left Jacobians of SO(3) (N, 3, 3) at ω (N, 3) [rad]: exp(ω + δ) ≈ exp(J δ) exp(ω)."""
    omega = np.asarray(omega, float)
    theta = np.linalg.norm(omega, axis=-1)
    b, c, w = _coefficients(theta)[1], _cubic(theta), hat(omega)
    return np.eye(3) + b[..., None, None] * w + c[..., None, None] * (w @ w)


def _left_so3_inverse(omega: NDArray) -> NDArray:
    theta = np.linalg.norm(omega, axis=-1)
    b, c = _coefficients(theta)[1], _cubic(theta)
    # 1/θ² − A/(2Bθ²) = (2B − A) / (2Bθ²), and 2B − A = θ² (c − 2e) with e = (½ − B) / θ²
    small = theta < _MAX_SERIES_ANGLE
    e = np.where(small, _series(theta**2, 4), (0.5 - b) / np.where(small, 1.0, theta) ** 2)
    d = (c - 2.0 * e) / (2.0 * b)
    w = hat(omega)
    return np.eye(3) - 0.5 * w + d[..., None, None] * (w @ w)


def adjoint(T: NDArray) -> NDArray:
    """Adjoints (N, 6, 6) of T (N, 4, 4): exp(Ad ξ) = T exp(ξ) T⁻¹, twists ordered (v, ω)."""
    T = np.asarray(T, float)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    return out
