"""Conformal elements and motors: the same geometry as `lines` and `se3`, and as clifford and kingdon."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit.errors import ObservationError
from kinefit.geometry import cga, lines, se3
from kinefit.geometry.cga import I3, E, I, commutator, e, e0, e1, e2, e3, exp, log, point, screw, twist, versor

random = np.random.default_rng(0)
x_a, x_b, x_c, x_d = random.normal(size=(4, 40, 3))
A, B, C, D = (point(x) for x in (x_a, x_b, x_c, x_d))
LINES = lines.line_through(x_a, x_b)
KINDS = {"random": 1.0, "small": 1e-4, "near identity": 1e-7, "identity": 0.0, "far": 30.0}


def twists_of(kind, count=40):
    """ξ (count, 6); near π: turns just below and above a half."""
    rng = np.random.default_rng(7)
    if kind == "near pi":
        axis = rng.normal(size=(count, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        return np.concatenate([rng.normal(size=(count, 3)), axis * (np.pi + 1e-7 * rng.normal(size=(count, 1)))], 1)
    if kind == "shift":
        return np.concatenate([rng.normal(size=(count, 3)), np.zeros((count, 3))], 1)
    return KINDS[kind] * rng.normal(size=(count, 6)) * ([1, 1, 1, 0.03, 0.03, 0.03] if kind == "far" else 1.0)


every_twist = pytest.mark.parametrize("kind", [*KINDS, "near pi", "shift"])


def test_points_are_null_and_tell_their_distance():
    np.testing.assert_allclose((A * A).values, 0, atol=1e-14)
    np.testing.assert_allclose(cga.distance(A, B), np.linalg.norm(x_a - x_b, axis=1), atol=1e-13)
    np.testing.assert_allclose(cga.coordinates(3 * A), x_a, atol=1e-14)
    assert str(point([0.0, 0.0, 0.0])) == "e0"


def test_lines_are_those_of_plucker():
    np.testing.assert_allclose(cga.plucker(e ^ (A ^ B)), LINES, atol=1e-13)
    length = np.linalg.norm(x_b - x_a, axis=1)
    np.testing.assert_allclose(((e ^ A ^ B) - cga.line_of(LINES) * length).values, 0, atol=1e-13)
    # the paper's form E n + e m: direction and moment
    ours = (e ^ A ^ B)[0]
    o, r = cga.vector(x_a[0]), cga.vector(x_b[0] - x_a[0])
    np.testing.assert_allclose((ours - (E * r + (e ^ (o ^ r)))).values, 0, atol=1e-13)


def test_planes_are_those_of_lines():
    plane = lines.plane_through(LINES, x_c)
    np.testing.assert_allclose(cga.plane_equation(e ^ A ^ B ^ C), plane, atol=1e-12)
    np.testing.assert_allclose(cga.plane_equation(cga.plane_of(plane)), plane, atol=1e-13)
    np.testing.assert_allclose((cga.plane_of(plane) ^ A).values, 0, atol=1e-12)


def test_spheres_and_circles_go_through_their_points():
    centre, radius = cga.sphere_parameters(A ^ B ^ C ^ D)
    for x in (x_a, x_b, x_c, x_d):
        np.testing.assert_allclose(np.linalg.norm(x - centre, axis=1) / radius, 1, atol=1e-9)
    again = cga.sphere_parameters(cga.sphere_of(centre, radius))
    np.testing.assert_allclose(again[0], centre, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again[1], radius, rtol=1e-7)
    centre, normal, radius = cga.circle_parameters(A ^ B ^ C)
    for x in (x_a, x_b, x_c):
        np.testing.assert_allclose(np.linalg.norm(x - centre, axis=1) / radius, 1, atol=1e-10)
        np.testing.assert_allclose(np.sum((x - centre) * normal, 1), 0, atol=1e-11)
    assert np.all(np.sum(np.cross(x_b - x_a, x_c - x_a) * normal, 1) > 0)


@every_twist
def test_motors_move_as_matrices_do(kind):
    xi = twists_of(kind)
    T, M = se3.exp(xi), exp(twist(xi))
    scale = 1 + np.abs(xi).max()
    np.testing.assert_allclose(cga.matrix(M), T, atol=1e-12 * scale)
    np.testing.assert_allclose(cga.coordinates(M * A * ~M), se3.apply(T, x_a), atol=1e-12 * scale)
    np.testing.assert_allclose(cga.coordinates(versor(M, A)), se3.apply(T, x_a), atol=1e-12 * scale)
    np.testing.assert_allclose(cga.plucker(M * (e ^ A ^ B) * ~M), lines.move_line(T, LINES), atol=1e-12 * scale**2)
    np.testing.assert_allclose(cga.matrix(cga.motor_of(T)), T, atol=1e-12 * scale)
    np.testing.assert_allclose(((M * ~M) - 1).values, 0, atol=1e-12 * scale)


@every_twist
def test_log_is_the_inverse_of_exp(kind):
    xi = twists_of(kind)
    T, M = se3.exp(xi), exp(twist(xi))
    scale = 1 + np.abs(xi).max()
    np.testing.assert_allclose(cga.matrix(exp(log(M))), T, atol=1e-12 * scale)
    np.testing.assert_allclose(cga.twist_coordinates(log(-M)), cga.twist_coordinates(log(M)), atol=1e-12 * scale)
    if kind != "near pi":  # there both signs of the axis are right
        np.testing.assert_allclose(cga.twist_coordinates(log(M)), se3.log(T), atol=1e-12 * scale)


@every_twist
def test_exp_is_the_power_series(kind):
    half = twist(twists_of(kind)) * (-0.5 / 1024)
    M = 1.0 + half * (1.0 + half * (1.0 / 2 + half * (1.0 / 6 + half / 24.0)))
    for _ in range(10):
        M = M * M
    assert np.abs((M - exp(twist(twists_of(kind)))).values).max() < 1e-10


@given(st.integers(0, 2**32 - 1), st.floats(-9, 0.4))
def test_motors_of_any_size(seed, size):
    xi = 10.0**size * np.random.default_rng(seed).normal(size=(5, 6))
    M = exp(twist(xi))
    np.testing.assert_allclose(cga.matrix(M), se3.exp(xi), atol=2e-12)
    np.testing.assert_allclose(cga.matrix(exp(log(M))), se3.exp(xi), atol=2e-12)


def test_translators_are_those_of_the_paper():
    t = x_d[0]
    T = cga.translator(t)
    np.testing.assert_allclose((T - (1 + (e * cga.vector(t)) / 2)).values, 0, atol=0)
    np.testing.assert_allclose((T - exp(twist([*t, 0, 0, 0]))).values, 0, atol=1e-15)
    np.testing.assert_allclose(cga.coordinates(T * A * ~T), x_a + t, atol=1e-13)


def test_a_joint_is_a_screw_without_pitch():
    theta = np.linspace(-3, 3, 40)
    psi = screw(e ^ A ^ B, theta)
    np.testing.assert_allclose((psi * psi).scalar, -(theta**2), atol=1e-12)
    np.testing.assert_allclose((psi * psi).along(I3 * e), 0, atol=1e-12)
    M = exp(psi)
    for x in (x_a, x_b):
        np.testing.assert_allclose(cga.coordinates(versor(M, point(x))), x, atol=1e-12)
    turned = cga.matrix(M)[:, :3, :3]
    np.testing.assert_allclose(turned, se3.exp_so3(theta[:, None] * LINES[:, :3]), atol=1e-12)


def test_a_joint_moves_as_a_point_does():
    M = exp(twist(twists_of("random")))
    theta = np.linspace(-3, 3, 40)
    psi = screw(e ^ A ^ B, theta)
    moved = M * psi * ~M
    A2, B2 = versor(M, A), versor(M, B)
    np.testing.assert_allclose((moved - screw(e ^ A2 ^ B2, theta)).values, 0, atol=1e-12)
    adjoint = (se3.adjoint(cga.matrix(M)) @ cga.twist_coordinates(psi)[..., None])[..., 0]
    np.testing.assert_allclose(cga.twist_coordinates(moved), adjoint, atol=1e-12)


def test_a_motor_between_two_joints():
    psi, other = screw(e ^ A ^ B, 0.7), screw(e ^ C ^ D, 0.7)
    M = cga.between(psi, other)
    np.testing.assert_allclose((M * psi * ~M - other).values, 0, atol=1e-11)
    np.testing.assert_allclose(cga.matrix(cga.interpolate(M, 0.0)), np.broadcast_to(np.eye(4), (40, 4, 4)), atol=1e-15)
    np.testing.assert_allclose(cga.matrix(cga.interpolate(M, 1.0)), cga.matrix(M), atol=1e-11)
    half = cga.interpolate(M, 0.5)
    np.testing.assert_allclose(cga.matrix(half * half), cga.matrix(M), atol=1e-11)
    same = cga.between(psi, psi)
    np.testing.assert_allclose(cga.matrix(same), np.broadcast_to(np.eye(4), (40, 4, 4)), atol=1e-13)


def test_the_operator_is_the_versor_product():
    M, S = exp(twist(twists_of("random"))), 1.7 * exp(twist(twists_of("small")))
    for motor in (M, S):
        X = cga.Multivector((1, 2, 4, 8, 16), random.normal(size=(5, 40)))
        by_matrix = (cga.operator(motor) @ X.values.T[..., None])[..., 0].T
        np.testing.assert_allclose(by_matrix, (motor * X * ~motor).select(X.blades).values, atol=1e-12)
        np.testing.assert_allclose(versor(motor, X).values, by_matrix, atol=1e-12)
        np.testing.assert_allclose((motor * X * ~motor).grade(3, 5).values, 0, atol=1e-12)
    assert versor(M[:3, None], A).shape == (3, 40)
    np.testing.assert_allclose(versor(M[:3, None], A)[2, 5].values, versor(M[2], A[5]).values, atol=1e-13)
    np.testing.assert_allclose(versor(M[0], A).values, versor(M[:1], A).values, atol=1e-13)
    sphere = A ^ B ^ C ^ D
    np.testing.assert_allclose(versor(M, sphere).values, (M * sphere * ~M).grade(4).values, atol=0)


def test_inverse_and_length():
    M = exp(twist(twists_of("random")))
    np.testing.assert_allclose((cga.inverse(2 * M) * (2 * M) - 1).values, 0, atol=1e-13)
    crooked = M * (1.3 + 0.2 * (I3 * e))
    np.testing.assert_allclose((cga.unit(crooked) * ~cga.unit(crooked) - 1).values, 0, atol=1e-13)
    np.testing.assert_allclose(cga.matrix(cga.unit(crooked)), cga.matrix(M), atol=1e-12)
    np.testing.assert_allclose((cga.dual(cga.dual(A)) + A).values, 0, atol=1e-14)
    assert str(I * I) == "-1"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: point([0.0, 1.0]), "points of shape"), (lambda: point([0.0, np.nan, 1.0]), "not finite"),
        (lambda: screw(e ^ A ^ A), "a line through one point"),
        (lambda: cga.plane_equation(e ^ A ^ B ^ A), "points on one line"),
        (lambda: cga.sphere_parameters(A ^ B ^ C ^ B), "points of one plane"),
        (lambda: cga.motor_of(np.eye(3)), "motions of shape"),
        (lambda: cga.between(screw(e ^ A ^ B), screw(e ^ C ^ D, 2.0)), "different angles"),
        (lambda: cga.between(twist(np.ones(6)), twist(np.ones(6))), "pitch"),
        (lambda: cga.between(screw(e ^ A ^ B), screw(e ^ B ^ A)), "opposite lines"),
    ],
)  # fmt: skip
def test_bad_input_says_what_is_wrong(make, message):
    with pytest.raises(ObservationError, match=message):
        make()


def test_points_lines_and_motors_are_those_of_clifford(clifford):
    to_theirs, layout = clifford
    theirs = lambda a: layout.MultiVector(to_theirs @ a.dense())
    xi = twists_of("random")
    for k in range(5):
        psi = theirs(twist(xi[k]))
        motor, term = 1.0 + 0.0 * psi, 1.0 + 0.0 * psi
        for n in range(1, 30):  # the power series; clifford's own exp compiles for seconds
            term = term * (-0.5 / n * psi)
            motor = motor + term
        X = motor * theirs(A[k]) * ~motor
        ours = versor(exp(twist(xi[k])), A[k])
        np.testing.assert_allclose(X.value, theirs(ours).value, atol=1e-12)
        L = theirs(e) ^ theirs(B[k]) ^ theirs(C[k])
        mine = commutator(ours, e ^ B[k] ^ C[k])
        np.testing.assert_allclose((0.5 * (X * L - L * X)).value, theirs(mine).value, atol=1e-11)


def test_motors_are_those_of_kingdon():
    kingdon = pytest.importorskip("kingdon", reason="the package kingdon is not installed")
    algebra = kingdon.Algebra(4, 1)
    v1, v2, v3, p, m = (algebra.blades[f"e{i}"] for i in range(1, 6))
    infinity, origin = p + m, 0.5 * (m - p)
    xi = twists_of("random")[0]
    M = exp(twist(xi))
    theirs = M.scalar * algebra.scalar([1.0])
    for blade, value in zip(M.blades[1:], M.values[1:]):
        term = algebra.scalar([float(value)])
        for i, b in enumerate((v1, v2, v3, infinity)):
            term = term ^ b if blade >> i & 1 else term
        theirs = theirs + term
    x = x_a[0]
    X = x[0] * v1 + x[1] * v2 + x[2] * v3 + 0.5 * (x @ x) * infinity + origin
    moved = theirs * X * ~theirs
    found = [float(getattr(moved, f"e{i}")) for i in (1, 2, 3)]
    np.testing.assert_allclose(found, se3.apply(se3.exp(xi), x), atol=1e-12)


def test_basis_vectors_span_what_they_should():
    assert str(e1 * e2 * e3) == str(I3)
    assert str(e ^ e0) == str(E)
