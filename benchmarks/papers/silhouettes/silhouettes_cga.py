"""Conformal geometric algebra: time for points moved by motors, and how far its numbers are from those of twists."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from benchmarks.figures import figure
from benchmarks.timing import fastest
from kinefit.bodies.surfaces.fourier import FourierCurve, FourierSurface, conformal
from kinefit.geometry import cga, lines, se3
from kinefit.geometry.cga import e, exp, point, twist, versor
from kinefit.geometry.cga_pose import point_line

COUNT, REPEATS = 10_000, 50


def run() -> None:
    """Print every figure of the algebra."""
    random = np.random.default_rng(0)
    x, xi = random.normal(size=(COUNT, 3)), random.normal(size=(COUNT, 6))
    X, motors = point(x), exp(twist(xi))
    motor = motors[0]
    figure("cga_points_one_motor_ms", least_ms(lambda: versor(motor, X)), "ms/10,000 points", "<= 0.2")
    figure("cga_points_many_motors_ms", least_ms(lambda: versor(motors, X)), "ms/10,000 points", "<= 4")
    figure("cga_as_printed_many_motors_ms", least_ms(lambda: motors * X * ~motors), "ms/10,000 points", "<= 4")
    T = se3.exp(xi)
    figure("cga_motor_matrix", float(np.abs(cga.matrix(motors) - T).max()), "m", "<= 1e-12")
    moved = cga.coordinates(versor(motors, X))
    figure("cga_versor_matrix", float(np.abs(moved - se3.apply(T, x)).max()), "m", "<= 1e-12")
    a, b = random.normal(size=(2, COUNT, 3))
    rays = lines.line_through(a, b)
    error = point_line(X, cga.line_of(rays)) - lines.point_line(x, rays)
    figure("cga_commutator_row", float(np.abs(error).max()), "m", "<= 1e-12")
    joint = cga.screw(e ^ point(a) ^ point(b), 0.7)
    apart = cga.twist_coordinates(motors * joint * ~motors)
    apart -= (se3.adjoint(T) @ cga.twist_coordinates(joint)[..., None])[..., 0]
    figure("cga_joint_moved", float(np.abs(apart).max()), "m, rad", "<= 1e-12")
    curve, surface = FourierCurve.of(random.normal(size=(51, 3))), FourierSurface.of(random.normal(size=(21, 17, 3)))
    u, v = random.random((2, 200))
    for name, fast, printed in (
        ("curve", curve.at(u), conformal(curve, u)),
        ("surface", surface.at(u, v), conformal(surface, u, v)),
    ):
        gap = np.moveaxis(printed.values, 0, -1) - fast
        figure(f"cga_fourier_{name}", float(np.abs(gap).max()), "m", "<= 1e-10")


def least_ms(work: Callable[[], object]) -> float:
    """Least wall time [ms] of many calls, after one to compile."""
    work()
    return 1e3 * fastest(work, REPEATS, clock=time.perf_counter)[1]
