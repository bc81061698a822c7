"""Poses from the constraints of P1, against the row makers and solvers that do the same by twists."""

import numpy as np
import pytest
from tests.oracle import random_body, random_unit

from kinefit.bodies import BodyState
from kinefit.errors import ObservationError
from kinefit.geometry import cga, cga_pose, lines, se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.cga import e, exp, line_of, motor_of, plane_of, point, twist, versor
from kinefit.geometry.cga_pose import Constraint, estimate_pose, line_plane, point_line, point_plane
from kinefit.solving.correspondences import edge_rows, plane_rows, ray_rows
from kinefit.solving.least_squares import gauss_newton
from kinefit.solving.rows import Rows

random = np.random.default_rng(0)
x_a, x_b, x_c, x_d = random.normal(size=(4, 30, 3))
LINES = lines.line_through(x_a, x_b)
PLANES = lines.plane_through(LINES[::-1], x_c)


def test_errors_are_the_numbers_of_lines():
    L, P = line_of(LINES), plane_of(PLANES)
    np.testing.assert_allclose(point_line(point(x_d), L), lines.point_line(x_d, LINES), atol=1e-12)
    np.testing.assert_allclose(point_plane(point(x_d), P), lines.point_plane(x_d, PLANES), atol=1e-12)
    np.testing.assert_allclose(line_plane(L, P), lines.line_plane(LINES, PLANES), atol=1e-12)


def test_they_vanish_exactly_where_elements_meet():
    L, P = line_of(LINES), plane_of(lines.plane_through(LINES, x_c))
    on = point(x_a + 0.3 * (x_b - x_a))
    np.testing.assert_allclose(cga.commutator(on, L).values, 0, atol=1e-12)
    np.testing.assert_allclose(cga.anticommutator(on, P).values, 0, atol=1e-12)
    np.testing.assert_allclose(cga.anticommutator(L, P).values, 0, atol=1e-12)
    assert np.all(np.linalg.norm(point_line(point(x_d), L), axis=1) > 1e-3)


def chain(body, segment):
    """Coordinates that move a segment, from the root."""
    own = []
    while segment >= 0:
        own = [int(d) for d in np.flatnonzero(body.tree.owners == segment)] + own
        segment = body.tree.parents[segment]
    return tuple(own)


def joint_twists(body):
    """Ψ of every coordinate in the root frame at rest: screws without pitch, and shifts."""
    tree = body.tree
    centre, axis, slides = tree.rest[tree.owners], tree.axes, tree.prismatic[:, None]
    v = np.where(slides, axis, np.cross(centre, axis))
    return twist(np.concatenate([v, np.where(slides, 0.0, axis)], 1))


def constraints_of(body, points, kinds, targets, sigma):
    """Constraints of P1 for points of a body: lines or planes of the target points."""
    at_rest, out = point(body.points_rest(points)), []
    for segment in np.unique(points.segments):
        for kind in ("line", "plane"):
            rows = np.flatnonzero((points.segments == segment) & (kinds == kind))
            if len(rows):
                make = line_of if kind == "line" else plane_of
                fixed = make(np.array([targets[k] for k in rows]))
                out.append(Constraint(at_rest[rows], fixed, chain(body, segment), sigma[rows]))
    return out


@pytest.fixture(scope="module")
def scene():
    """A body that branches, noisy rays and planes of its points, and where it starts from."""
    rng = np.random.default_rng(3)
    body = random_body(4, segments=6)
    points = body.landmarks
    truth = BodyState(se3.exp(rng.normal(size=6) * 0.5), rng.uniform(-0.5, 0.5, len(body.tree.coordinates)))
    x = body.positions(truth, points) + 0.01 * rng.normal(size=(len(points), 3))
    kinds = np.where(np.arange(len(points)) % 3 == 2, "plane", "line")
    normals = random_unit(rng, len(points))
    line = lines.line_along(x, random_unit(rng, len(points)))
    plane = np.concatenate([normals, np.sum(normals * x, 1, keepdims=True)], 1)
    targets = [line[k] if kind == "line" else plane[k] for k, kind in enumerate(kinds)]
    sigma = rng.uniform(0.01, 0.03, len(points))

    def rows(state):
        planes = np.where((kinds == "plane")[:, None], x, np.nan)
        rays = np.where((kinds == "line")[:, None], line, np.nan)
        on_rays = ray_rows(body, state, points, rays, sigma=sigma)
        return Rows.concat(on_rays, plane_rows(body, state, points, planes, normals, sigma=sigma))

    return body, truth, rows, constraints_of(body, points, kinds, targets, sigma)


def test_motors_of_a_chain_move_points_as_the_tree_does(scene):
    body, truth, _, _ = scene
    turns, M = exp(joint_twists(body) * truth.angles), motor_of(truth.T_world_root)
    expected = body.positions(truth, body.landmarks)
    for k, x in enumerate(body.points_rest(body.landmarks)):
        motor = M
        for d in chain(body, body.landmarks.segments[k]):
            motor = motor * turns[d]
        np.testing.assert_allclose(cga.coordinates(motor * point(x) * ~motor), expected[k], atol=1e-12)


def test_joints_move_as_the_screws_of_the_tree(scene):
    body, truth, _, _ = scene
    _, screws = body.tree.forward(truth.T_world_root, truth.angles)
    psi, M = joint_twists(body), motor_of(truth.T_world_root)
    turns, origin = exp(psi * truth.angles), cga.translator(-truth.T_world_root[:3, 3])
    for d in range(len(truth.angles)):
        motor = origin * M
        for c in chain(body, body.tree.owners[d]):
            if c >= d:
                break
            motor = motor * turns[c]
        np.testing.assert_allclose(cga.twist_coordinates(motor * psi[d] * ~motor), screws[d], atol=1e-12)


def test_the_pose_of_a_chain_is_that_of_the_rows(scene):
    body, truth, rows, constraints = scene
    start = truth.retract(0.1 * np.random.default_rng(5).normal(size=body.tree.n_dofs))
    found = estimate_pose(constraints, joint_twists(body), start=motor_of(start.T_world_root), angles=start.angles)
    assert found.step < 1e-12
    state = start
    for _ in range(found.iterations):
        state = gauss_newton(body, state, rows(state), limits=False).state
    np.testing.assert_allclose(cga.matrix(found.M), state.T_world_root, atol=1e-10)
    np.testing.assert_allclose(found.angles, state.angles, atol=1e-10)
    assert 1e-3 < np.abs(found.angles - truth.angles).max() < 0.3  # noise has moved it, a little


def test_each_iteration_is_that_of_the_rows(scene):
    body, truth, rows, constraints = scene
    start = truth.retract(0.1 * np.random.default_rng(6).normal(size=body.tree.n_dofs))
    once = estimate_pose(
        constraints, joint_twists(body), start=motor_of(start.T_world_root), angles=start.angles, iterations=1
    )
    step = gauss_newton(body, start, rows(start), limits=False)
    np.testing.assert_allclose(once.angles, step.state.angles, atol=1e-10)
    turned = se3.exp_so3(step.delta[3:6]) @ start.T_world_root[:3, :3]
    np.testing.assert_allclose(cga.matrix(once.M)[:3, :3], turned, atol=1e-10)
    cost = once.rms**2 * sum(len(c.sigma) * (3 if c.fixed.grades == (3,) else 1) for c in constraints)
    np.testing.assert_allclose(cost, np.sum(rows(start).weight * rows(start).residual ** 2), rtol=1e-10)


def test_edges_in_planes_of_image_lines_give_the_pose_of_the_rows():
    """3D line - 2D line: each edge's plane goes through the camera; the rows take the edges' two ends."""
    rng = np.random.default_rng(8)
    body = random_body(0, segments=1)
    K = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
    camera = Camera("cam", (1280, 720), K, T_camera_world=se3.exp([0, 0, 4, 0.1, 0.2, 0]))
    rig = Rig((camera,))
    points = body.landmarks
    truth = BodyState(se3.exp(0.3 * rng.normal(size=6)), np.zeros(len(body.tree.coordinates)))
    starts = type(points)(tuple("abcdefgh"), np.zeros(8, int), rng.normal(size=(8, 3)) * 0.3)
    ends = type(points)(tuple("abcdefgh"), np.zeros(8, int), rng.normal(size=(8, 3)) * 0.3)
    u, v = (camera.project(body.positions(truth, p)) for p in (starts, ends))
    image_lines = np.cross(np.c_[u, np.ones(8)], np.c_[v, np.ones(8)])
    start = truth.retract(0.05 * rng.normal(size=body.tree.n_dofs))
    state = start
    for _ in range(12):
        rows = edge_rows(body, state, starts, ends, rig, 0, image_lines)
        state = gauss_newton(body, state, rows, limits=False, locked=np.arange(body.tree.n_dofs) >= 6).state
    O = point(camera.centre_world)
    normals = image_lines @ camera.matrix @ camera.T_camera_world[:3, :3]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = plane_of(np.concatenate([normals, normals @ camera.centre_world[:, None]], 1))
    np.testing.assert_allclose((planes ^ O).values, 0, atol=1e-12)
    edges = e ^ point(body.points_rest(starts)) ^ point(body.points_rest(ends))
    found = estimate_pose([Constraint(edges, planes)], start=motor_of(start.T_world_root))
    np.testing.assert_allclose(cga.matrix(found.M), state.T_world_root, atol=1e-10)
    np.testing.assert_allclose(cga.matrix(found.M), truth.T_world_root, atol=1e-10)


def test_all_three_forms_together_from_far_off():
    M = exp(twist([0.2, -0.3, 0.5, 0.8, -0.6, 0.9]))
    X, L = point(x_d), line_of(LINES)
    y = cga.coordinates(versor(M, X[:10]))
    ends = (cga.coordinates(versor(M, point(x))) for x in (x_a[:6], x_b[:6]))
    constraints = [
        Constraint(X[:10], e ^ (point([0.0, 0.0, -4.0]) ^ point(y)), sigma=0.01),
        Constraint(X[10:16], plane_of(_planes_through(cga.coordinates(versor(M, X[10:16])))), sigma=0.02),
        Constraint(L[:6], plane_of(lines.plane_through(lines.line_through(*ends), x_c[:6]))),
    ]
    found = estimate_pose(constraints)
    np.testing.assert_allclose(cga.matrix(found.M), cga.matrix(M), atol=1e-12)
    assert found.rms < 1e-12


def _planes_through(x):
    normals = random_unit(np.random.default_rng(9), len(x))
    return np.concatenate([normals, np.sum(normals * x, 1, keepdims=True)], 1)


@pytest.mark.parametrize("kind", ["point-line", "point-plane", "line-plane"])
def test_derivatives_by_differences(kind):
    element = line_of(LINES) if kind == "line-plane" else point(x_d)
    fixed = line_of(LINES[::-1]) if kind == "point-line" else plane_of(PLANES)
    axis = twist(random.normal(size=(1, 6)))
    c = cga_pose._prepared(Constraint(element, fixed, (0,), 0.5), 1)
    M, angle = exp(twist(random.normal(size=6))), 0.4

    def error(delta):
        motor = exp(twist(delta[:6])) * M * exp(axis[0] * (angle + delta[6]))
        return cga_pose._error((motor * c.moved * ~motor).grade(*c.moved.grades), c.fixed).ravel() / 0.5

    residual, jacobian = cga_pose._linearised(c, M, axis, exp(axis * angle), 1)
    np.testing.assert_allclose(residual, error(np.zeros(7)), atol=1e-12)
    h = 1e-6
    for k, d in enumerate(h * np.eye(7)):
        np.testing.assert_allclose(jacobian[:, k], (error(d) - error(-d)) / (2 * h), atol=2e-7, rtol=1e-6)


def test_what_cannot_be_settled_or_understood_is_told():
    X, L, P = point(x_d), line_of(LINES), plane_of(PLANES)
    with pytest.raises(ObservationError, match=r"determine [0-5] of 6 unknowns"):
        estimate_pose([Constraint(X[:2], L[:2])])
    with pytest.raises(ObservationError, match="determine 0 of 6"):
        estimate_pose([])
    with pytest.raises(ObservationError, match="no constraint for elements of grades"):
        estimate_pose([Constraint(P, L)])
    with pytest.raises(ObservationError, match="of a body that has 0"):
        estimate_pose([Constraint(X, L, (0,))])
    with pytest.raises(ObservationError, match="shapes"):
        estimate_pose([Constraint(X, L[:5])])
    with pytest.raises(ObservationError, match="without a direction"):
        estimate_pose([Constraint(X, e ^ X ^ X)])
