"""Compiled projection, its derivatives and inverse. Arrays in, arrays out; no allocation in loops.

Layout of a packed camera (1-D float64, length `PACKED`)
    0 MODEL     0 radtan, 1 fisheye
    1-5         fx, fy, cx, cy, skew [px]
    6-13 DIST   radtan: k1 k2 p1 p2 k3 k4 k5 k6 (OpenCV's rational order); fisheye: k1 k2 k3 k4 0 0 0 0
    14-22 ROT   rotation of T_camera_world, row-major
    23-25 TRANS translation of T_camera_world [m]
    26, 27      width, height [px]
    28 LIMIT    up to where distortion is monotonic: squared tangent r^2 (radtan) or angle theta [rad] (fisheye)
"""

from __future__ import annotations

import math

from kinefit._jit import jit

MODEL, FX, FY, CX, CY, SKEW = 0, 1, 2, 3, 4, 5
DIST, ROT, TRANS, WIDTH, HEIGHT, LIMIT, PACKED = 6, 14, 23, 26, 27, 28, 29
MIN_DEPTH = 1e-9  # [m] a point closer to the image plane counts as behind it
_NAN = math.nan


@jit
def _distort_radtan(camera, a, b):
    """Distorted normalised point of (a, b) and its derivatives: a', b', a'_a, a'_b (= b'_a), b'_b."""
    k1, k2, p1, p2 = camera[DIST], camera[DIST + 1], camera[DIST + 2], camera[DIST + 3]
    k3, k4, k5, k6 = camera[DIST + 4], camera[DIST + 5], camera[DIST + 6], camera[DIST + 7]
    q = a * a + b * b
    inverse = 1.0 / (1.0 + q * (k4 + q * (k5 + q * k6)))
    radial = (1.0 + q * (k1 + q * (k2 + q * k3))) * inverse
    slope = 2.0 * inverse * (k1 + q * (2.0 * k2 + 3.0 * q * k3) - radial * (k4 + q * (2.0 * k5 + 3.0 * q * k6)))
    cross = slope * a * b + 2.0 * (p1 * a + p2 * b)
    return (
        a * radial + 2.0 * p1 * a * b + p2 * (q + 2.0 * a * a),
        b * radial + p1 * (q + 2.0 * b * b) + 2.0 * p2 * a * b,
        radial + slope * a * a + 2.0 * p1 * b + 6.0 * p2 * a,
        cross,
        radial + slope * b * b + 6.0 * p1 * b + 2.0 * p2 * a,
    )


@jit
def _fisheye_angle(camera, theta):
    """Distorted angle of theta and its derivative."""
    k1, k2, k3, k4 = camera[DIST], camera[DIST + 1], camera[DIST + 2], camera[DIST + 3]
    q = theta * theta
    return (
        theta * (1.0 + q * (k1 + q * (k2 + q * (k3 + q * k4)))),
        1.0 + q * (3.0 * k1 + q * (5.0 * k2 + q * (7.0 * k3 + q * 9.0 * k4))),
    )


@jit
def project_jacobian(camera, x, y, z):
    """Project a world point, with derivatives by it.

    Returns (ok, u, v, ux, uy, uz, vx, vy, vz), [px] and [px/m]. Not ok (all NaN) behind the camera or where the
    distortion is not monotonic; points outside the image are ok.
    """
    r00, r01, r02 = camera[ROT], camera[ROT + 1], camera[ROT + 2]
    r10, r11, r12 = camera[ROT + 3], camera[ROT + 4], camera[ROT + 5]
    r20, r21, r22 = camera[ROT + 6], camera[ROT + 7], camera[ROT + 8]
    xc = r00 * x + r01 * y + r02 * z + camera[TRANS]
    yc = r10 * x + r11 * y + r12 * z + camera[TRANS + 1]
    zc = r20 * x + r21 * y + r22 * z + camera[TRANS + 2]
    if camera[MODEL] == 0.0:
        if not zc > MIN_DEPTH:
            return False, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN
        inverse = 1.0 / zc
        a, b = xc * inverse, yc * inverse
        if not a * a + b * b <= camera[LIMIT]:
            return False, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN
        p, q, p_a, p_b, q_b = _distort_radtan(camera, a, b)
        px, py, pz = p_a * inverse, p_b * inverse, -(p_a * a + p_b * b) * inverse
        qx, qy, qz = p_b * inverse, q_b * inverse, -(p_b * a + q_b * b) * inverse
    else:
        rho2 = xc * xc + yc * yc
        rho = math.sqrt(rho2)
        theta = math.atan2(rho, zc)
        if not (theta <= camera[LIMIT] and rho + abs(zc) > MIN_DEPTH):
            return False, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN
        if rho < 1e-8 * zc:
            scale, slope, along = 1.0 / zc, 0.0, -1.0 / (zc * zc)
        else:
            angle, rate = _fisheye_angle(camera, theta)
            scale = angle / rho
            rate /= rho2 + zc * zc
            slope = (rate * zc - scale) / rho2
            along = -rate
        p, q = xc * scale, yc * scale
        px, py, pz = scale + slope * xc * xc, slope * xc * yc, along * xc
        qx, qy, qz = slope * xc * yc, scale + slope * yc * yc, along * yc
    fx, fy, skew = camera[FX], camera[FY], camera[SKEW]
    px, py, pz = fx * px + skew * qx, fx * py + skew * qy, fx * pz + skew * qz
    qx, qy, qz = fy * qx, fy * qy, fy * qz
    return (
        True,
        fx * p + skew * q + camera[CX],
        fy * q + camera[CY],
        px * r00 + py * r10 + pz * r20,
        px * r01 + py * r11 + pz * r21,
        px * r02 + py * r12 + pz * r22,
        qx * r00 + qy * r10 + qz * r20,
        qx * r01 + qy * r11 + qz * r21,
        qx * r02 + qy * r12 + qz * r22,
    )


@jit
def project_points(camera, points, uv):
    """Project points (N, 3) [m] into uv (N, 2) [px]; NaN where not visible."""
    for i in range(points.shape[0]):
        result = project_jacobian(camera, points[i, 0], points[i, 1], points[i, 2])
        uv[i, 0], uv[i, 1] = result[1], result[2]


@jit
def project_each(cameras, camera, points, uv):
    """Project points (N, 3) [m], each by its camera of a rig, into uv (N, 2) [px]; NaN where not visible."""
    for i in range(points.shape[0]):
        result = project_jacobian(cameras[camera[i]], points[i, 0], points[i, 1], points[i, 2])
        uv[i, 0], uv[i, 1] = result[1], result[2]


@jit
def project_points_jacobian(camera, points, uv, jacobian):
    """As `project_points`, with the derivatives by the world point in jacobian (N, 2, 3)."""
    for i in range(points.shape[0]):
        _, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(camera, points[i, 0], points[i, 1], points[i, 2])
        uv[i, 0], uv[i, 1] = u, v
        jacobian[i, 0, 0], jacobian[i, 0, 1], jacobian[i, 0, 2] = ux, uy, uz
        jacobian[i, 1, 0], jacobian[i, 1, 1], jacobian[i, 1, 2] = vx, vy, vz


@jit
def _radial(camera, r):
    """Distorted radius of r (tangent or angle) without the tangential part, and its derivative."""
    if camera[MODEL] != 0.0:
        return _fisheye_angle(camera, r)
    k1, k2, k3 = camera[DIST], camera[DIST + 1], camera[DIST + 4]
    k4, k5, k6 = camera[DIST + 5], camera[DIST + 6], camera[DIST + 7]
    q = r * r
    inverse = 1.0 / (1.0 + q * (k4 + q * (k5 + q * k6)))
    radial = (1.0 + q * (k1 + q * (k2 + q * k3))) * inverse
    slope = 2.0 * inverse * (k1 + q * (2.0 * k2 + 3.0 * q * k3) - radial * (k4 + q * (2.0 * k5 + 3.0 * q * k6)))
    return r * radial, radial + slope * q


@jit
def _inverse_radial(camera, distorted):
    """Radius with a given distorted radius (bracketed Newton); the largest valid one if there is none."""
    high = camera[LIMIT] if camera[MODEL] != 0.0 else math.sqrt(camera[LIMIT])
    if high > 1e6:  # unlimited: search a bracket
        high = distorted
        for _ in range(40):
            if _radial(camera, high)[0] >= distorted:
                break
            high *= 2.0
    if _radial(camera, high)[0] < distorted:
        return high
    low, r = 0.0, min(distorted, high)
    for _ in range(100):
        value, slope = _radial(camera, r)
        if value < distorted:
            low = r
        else:
            high = r
        step = (value - distorted) / slope
        following = r - step
        if not (low <= following <= high):
            following = 0.5 * (low + high)
        if abs(following - r) <= 1e-16 * following:
            break
        r = following
    return r


@jit
def ray(camera, u, v):
    """Unit direction in the world of the ray through a pixel: (ok, x, y, z); not ok (NaN) where there is none."""
    q = (v - camera[CY]) / camera[FY]
    p = (u - camera[CX] - camera[SKEW] * q) / camera[FX]
    radius = math.sqrt(p * p + q * q)
    if not radius < math.inf:
        return False, _NAN, _NAN, _NAN
    r = _inverse_radial(camera, radius)
    scale = r / radius if radius > 0.0 else 1.0
    if camera[MODEL] == 0.0:
        a, b, c = p * scale, q * scale, 1.0
        for _ in range(30):
            p_now, q_now, p_a, p_b, q_b = _distort_radtan(camera, a, b)
            p_error, q_error = p_now - p, q_now - q
            determinant = p_a * q_b - p_b * p_b
            da = (q_b * p_error - p_b * q_error) / determinant
            db = (p_a * q_error - p_b * p_error) / determinant
            a, b = a - da, b - db
            if not abs(da) + abs(db) > 1e-16 * (1.0 + abs(a) + abs(b)):
                break
        p_now, q_now, _, _, _ = _distort_radtan(camera, a, b)
        error = abs(p_now - p) + abs(q_now - q)
        ok = error <= 1e-13 * (1.0 + radius) and a * a + b * b <= camera[LIMIT]
    else:
        ok = abs(_fisheye_angle(camera, r)[0] - radius) <= 1e-13 * (1.0 + radius)
        sine = math.sin(r) / radius if radius > 0.0 else 1.0
        a, b, c = p * sine, q * sine, math.cos(r)
    if not ok:
        return False, _NAN, _NAN, _NAN
    norm = 1.0 / math.sqrt(a * a + b * b + c * c)
    a, b, c = a * norm, b * norm, c * norm
    return (
        True,
        camera[ROT] * a + camera[ROT + 3] * b + camera[ROT + 6] * c,
        camera[ROT + 1] * a + camera[ROT + 4] * b + camera[ROT + 7] * c,
        camera[ROT + 2] * a + camera[ROT + 5] * b + camera[ROT + 8] * c,
    )


@jit
def rays(camera, uv, directions):
    """Rays of pixels uv (N, 2) into directions (N, 3), unit vectors in the world; NaN where there is none."""
    for i in range(uv.shape[0]):
        _, directions[i, 0], directions[i, 1], directions[i, 2] = ray(camera, uv[i, 0], uv[i, 1])
