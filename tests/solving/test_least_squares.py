"""Fits find known poses, hold limits and locks, close chains, and do not depend on where the world's origin is."""

from itertools import pairwise

import numpy as np
import pytest
from benchmarks.robustness.faults_solver import beyond_limits
from scipy.optimize import minimize
from tests.oracle import look_at, posture, random_body, random_unit, rig_around

from kinefit.bodies import Body, BodyState, KinematicTree, PointSet, load_body
from kinefit.geometry import lines, se3
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import geman_mcclure, huber, tukey
from kinefit.solving.correspondences import (
    coincidence_rows,
    edge_rows,
    image_line_rows,
    limit_rows,
    pixel_rows,
    plane_rows,
    point_rows,
    prediction_rows,
    prior_rows,
    ray_rows,
)
from kinefit.solving.equations import normal_equations
from kinefit.solving.least_squares import _step, gauss_newton, levenberg_marquardt

HUMANOID = load_body("humanoid")
POINTS = HUMANOID.landmarks


def measured(kind, truth, seed=0):
    """state -> rows, of a body at a known state."""
    random, x = np.random.default_rng(seed), HUMANOID.positions(truth, POINTS)
    rig = rig_around(truth.T_world_root[:3, 3])
    if kind == "points":
        return lambda s: point_rows(HUMANOID, s, POINTS, x)
    if kind == "pixels":
        points, camera = POINTS.select(POINTS.names * 4), np.repeat(np.arange(4), len(x))
        uv = np.concatenate([c.project(x) for c in rig])
        return lambda s: pixel_rows(HUMANOID, s, points, rig, camera, uv, sigma=2.0)
    if kind == "rays":
        points = POINTS.select(POINTS.names * 2)
        rays = [lines.line_along(np.broadcast_to(c.centre_world, x.shape), x - c.centre_world) for c in rig.cameras[:2]]
        return lambda s: ray_rows(HUMANOID, s, points, np.concatenate(rays))
    points, normals = POINTS.select(POINTS.names * 3), random_unit(random, 3 * len(x))
    return lambda s: plane_rows(HUMANOID, s, points, np.tile(x, (3, 1)), normals)


@pytest.mark.parametrize("kind", ["points", "pixels", "rays", "planes"])
@pytest.mark.parametrize("seed", range(8))
def test_a_posture_is_found_from_the_usual_one(kind, seed):
    truth = posture(HUMANOID, seed, 0.35)
    start = HUMANOID.default_state() if kind == "points" else HUMANOID.default_state(truth.T_world_root)
    fit = levenberg_marquardt(HUMANOID, start, measured(kind, truth))
    assert fit.converged and fit.iterations < 40
    np.testing.assert_allclose(HUMANOID.positions(fit.state, POINTS), HUMANOID.positions(truth, POINTS), atol=1e-5)


@pytest.mark.parametrize("kind", ["points", "pixels", "rays", "planes"])
def test_no_residual_means_no_step(kind):
    truth = posture(HUMANOID, 1, 0.35)
    step = gauss_newton(HUMANOID, truth, measured(kind, truth)(truth))
    assert step.norm < 1e-9 and step.cost < 1e-15
    np.testing.assert_allclose(step.state.angles, truth.angles, atol=1e-9)


def test_a_gauss_newton_step_solves_the_normal_equations():
    body = random_body(0)
    state = BodyState(se3.exp(np.arange(6.0) / 5), np.linspace(-1, 1, len(body.tree.coordinates)))
    target = body.positions(state, body.landmarks) + 0.01
    rows = [point_rows(body, state, body.landmarks, target), prior_rows(body, state, sigma=3.0)]
    eq = normal_equations(body, state, rows)
    for damping in (0.0, 7.0):
        step = gauss_newton(body, state, rows, damping=damping)
        expected = np.linalg.solve(eq.matrix + damping * np.eye(body.tree.n_dofs), eq.gradient)
        np.testing.assert_allclose(step.delta, expected, rtol=1e-6, atol=1e-9)
        assert step.norm == pytest.approx(np.linalg.norm(expected)) and step.cost == pytest.approx(eq.cost)
        np.testing.assert_allclose(state.retract(step.delta).T_world_root, step.state.T_world_root, atol=1e-12)
        np.testing.assert_allclose(state.retract(step.delta).angles, step.state.angles, atol=1e-12)


def test_gauss_newton_converges_quadratically_near_the_truth():
    truth = posture(HUMANOID, 3, 0.35)
    make, state, norms = measured("pixels", truth), truth.retract(0.03 * np.ones(47)), []
    for _ in range(6):
        step = gauss_newton(HUMANOID, state, make(state))
        state, norms = step.state, [*norms, step.norm]
    assert norms[-1] < 1e-9
    assert all(b < a for a, b in pairwise(norms) if a > 1e-9)


@pytest.mark.parametrize("loss", [huber(), tukey(), geman_mcclure()], ids=["huber", "tukey", "geman-mcclure"])
def test_outliers_are_told_by_robust_losses(loss):
    truth = posture(HUMANOID, 2, 0.35)
    x, random = HUMANOID.positions(truth, POINTS), np.random.default_rng(0)
    wrong = random.permutation(len(x))[: len(x) // 8]
    target = x + 0.002 * random.normal(size=x.shape)
    target[wrong] += 0.5 * random_unit(random, len(wrong))
    make = lambda s: point_rows(HUMANOID, s, POINTS, target, sigma=0.005)
    plain = levenberg_marquardt(HUMANOID, HUMANOID.rest_state(truth.T_world_root), make)
    fit = levenberg_marquardt(HUMANOID, plain.state, make, loss=loss, max_iterations=100)
    off = np.linalg.norm(HUMANOID.positions(fit.state, POINTS) - x, axis=1)
    before = np.linalg.norm(HUMANOID.positions(plain.state, POINTS) - x, axis=1)
    right = np.setdiff1d(np.arange(len(x)), wrong)
    assert np.median(off[right]) < 0.004 < np.median(before[right])
    factor = fit.equations.factor.reshape(-1, 3)
    assert np.all(factor == factor[:, :1])  # a measurement has one weight
    assert np.median(factor[right, 0]) > 0.9 and np.median(factor[wrong, 0]) < 0.1


def test_limits_hold_exactly():
    truth = posture(HUMANOID, 4, 0.35)
    angles = np.array(truth.angles)
    names = {"knee_angle_r": -0.6, "elbow_flex_l": 3.0, "ankle_angle_r": 1.2}  # beyond what they can do
    for name, value in names.items():
        angles[HUMANOID.tree.coordinate(name)] = value
    make = measured("points", BodyState(truth.T_world_root, angles))
    fit = levenberg_marquardt(HUMANOID, HUMANOID.rest_state(), make, max_iterations=100)
    assert np.all(fit.state.angles >= HUMANOID.tree.lower) and np.all(fit.state.angles <= HUMANOID.tree.upper)
    for name, value in names.items():
        d = HUMANOID.tree.coordinate(name)
        assert fit.state.angles[d] == (HUMANOID.tree.lower if value < 0 else HUMANOID.tree.upper)[d]
    free = levenberg_marquardt(HUMANOID, fit.state, make, limits=False, max_iterations=100)
    assert free.equations.cost < 1e-12 < fit.equations.cost
    # at the best place within the limits no free angle can better it, and those at a limit are pushed against it
    g, q = fit.equations.gradient, fit.state.angles
    low, high = q <= HUMANOID.tree.lower, q >= HUMANOID.tree.upper
    assert np.all(g[6:][low] <= 0) and np.all(g[6:][high] >= 0) and low.any() and high.any()
    inner = np.r_[np.ones(6, bool), ~(low | high)]
    np.testing.assert_allclose(g[inner], 0, atol=1e-4 * np.abs(g).max())


def test_solving_again_wins_nothing_where_limits_hold():
    body, points, x = beyond_limits(10)
    state = body.default_state()
    for target in x:
        make = lambda s: point_rows(body, s, points, target, sigma=0.005)  # noqa: B023
        fit = levenberg_marquardt(body, state, make)
        again = levenberg_marquardt(body, fit.state, make)
        assert fit.converged and again.equations.cost > (1.0 - 1e-6) * fit.equations.cost
        state = fit.state


@pytest.mark.parametrize("seed", range(3))
def test_a_step_that_limits_stop_is_solved_anew_for_the_others(seed):
    """Against a general optimiser with bounds: near its least value, far below that of a step which is only clipped."""
    body, points, x = beyond_limits(1, seed)
    state, n = body.rest_state(), body.tree.n_dofs
    eq = normal_equations(body, state, point_rows(body, state, points, x[0] + 0.1, sigma=0.1))
    delta, fall = _step(eq, 1.0, (body.tree.lower, body.tree.upper), np.zeros(n, bool))
    assert fall == pytest.approx(2.0 * eq.gradient @ delta - delta @ eq.matrix @ delta, rel=1e-9)
    H = eq.matrix + np.eye(n)
    low = np.r_[np.full(6, -np.inf), body.tree.lower - state.angles]
    high = np.r_[np.full(6, np.inf), body.tree.upper - state.angles]
    clipped = np.clip(np.linalg.solve(H, eq.gradient), low, high)
    cost = lambda d: d @ H @ d - 2.0 * eq.gradient @ d
    best = minimize(cost, clipped, jac=lambda d: 2.0 * (H @ d - eq.gradient), bounds=list(zip(low, high))).fun
    assert cost(clipped) - cost(delta) > 0.8 * (cost(clipped) - best) > 0.0


def test_a_start_beyond_the_limits_is_brought_back():
    beyond = BodyState(np.eye(4), HUMANOID.tree.upper + 0.5)
    fit = levenberg_marquardt(HUMANOID, beyond, measured("points", HUMANOID.rest_state()), max_iterations=1)
    assert np.all(fit.state.angles <= HUMANOID.tree.upper)


def test_a_limit_is_left_again_when_the_measurements_say_so():
    truth, d = posture(HUMANOID, 5, 0.35), HUMANOID.tree.coordinate("knee_angle_l")
    angles = np.array(truth.angles)
    angles[d] = 0.9
    truth = BodyState(truth.T_world_root, angles)
    start = np.array(angles)
    start[d] = HUMANOID.tree.lower[d]
    fit = levenberg_marquardt(HUMANOID, BodyState(truth.T_world_root, start), measured("points", truth))
    assert fit.state.angles[d] == pytest.approx(0.9, abs=1e-6)
    np.testing.assert_allclose(HUMANOID.positions(fit.state, POINTS), HUMANOID.positions(truth, POINTS), atol=1e-5)


def test_soft_limits_pull_back():
    d = HUMANOID.tree.coordinate("knee_angle_r")
    angles = np.zeros(41)
    angles[d] = HUMANOID.tree.lower[d] - 0.3
    state = BodyState(np.eye(4), angles)
    fit = levenberg_marquardt(HUMANOID, state, lambda s: limit_rows(HUMANOID, s), limits=False)
    assert fit.state.angles[d] == pytest.approx(HUMANOID.tree.lower[d], abs=1e-3)


@pytest.mark.parametrize(
    "names", [("root_tx", "root_ry"), ("hip_flexion_r", "elbow_flex_l"), ("root_tz", "knee_angle_l")]
)
def test_what_is_locked_stays(names):
    truth, start = posture(HUMANOID, 6, 0.35), posture(HUMANOID, 7, 0.1)
    locked = np.isin(HUMANOID.dof_names, names)
    fit = levenberg_marquardt(HUMANOID, start, measured("points", truth), locked=locked)
    step = gauss_newton(HUMANOID, start, measured("points", truth)(start), locked=locked)
    assert np.all(step.delta[locked] == 0) and np.all(step.delta[~locked] != 0)
    for name in names:
        if name.startswith("root_t"):
            axis = "xyz".index(name[-1])
            assert fit.state.T_world_root[axis, 3] == start.T_world_root[axis, 3]
        elif not name.startswith("root"):
            d = HUMANOID.tree.coordinate(name)
            assert fit.state.angles[d] == start.angles[d]


def test_the_root_of_a_fixed_body_stays():
    arm = load_body("arm")
    truth = posture(arm, 1, 0.3)
    x = arm.positions(truth, arm.landmarks)
    start = arm.rest_state(truth.T_world_root)
    fit = levenberg_marquardt(arm, start, lambda s: point_rows(arm, s, arm.landmarks, x))
    np.testing.assert_array_equal(fit.state.T_world_root, truth.T_world_root)
    np.testing.assert_allclose(fit.state.angles, truth.angles, atol=1e-6)


@pytest.mark.parametrize("kind", ["points", "planes"])
def test_a_moved_world_gives_the_same_angles(kind):
    """Everything measured is turned and shifted: the angles stay, the root moves along."""
    truth, T = posture(HUMANOID, 8, 0.35), se3.exp([0.4, -2.0, 1.0, 0.3, 1.9, -0.8])
    start = truth.retract(np.random.default_rng(0).normal(scale=0.1, size=47))
    x = HUMANOID.positions(truth, POINTS) + np.random.default_rng(1).normal(scale=0.01, size=(len(POINTS), 3))
    normals = random_unit(np.random.default_rng(2), len(POINTS))
    fits = []
    for M in (np.eye(4), T):
        targets, n = se3.apply(M, x), normals @ M[:3, :3].T
        make = {
            "points": lambda s: [point_rows(HUMANOID, s, POINTS, targets), prior_rows(HUMANOID, s)],  # noqa: B023
            "planes": lambda s: [plane_rows(HUMANOID, s, POINTS, targets, n), prior_rows(HUMANOID, s)],  # noqa: B023
        }[kind]
        start_there = BodyState(M @ start.T_world_root, start.angles)
        fits.append(levenberg_marquardt(HUMANOID, start_there, make, loss=huber(), tolerance=1e-14, max_iterations=200))
    here, there = (f.state for f in fits)
    np.testing.assert_allclose(there.angles, here.angles, atol=1e-5)
    np.testing.assert_allclose(there.T_world_root, T @ here.T_world_root, atol=1e-5)
    assert fits[0].equations.cost == pytest.approx(fits[1].equations.cost, rel=1e-7)


def gap(body, state, a, b):
    return float(np.linalg.norm(body.positions(state, a) - body.positions(state, b), axis=1).max())


def test_a_closed_chain_closes_the_better_the_stronger_it_is():
    """Both hands hold one bar: points at the palms meet, although the measurements say 2 cm apart."""
    hands = [HUMANOID.tree.segment(n) for n in ("hand_r", "hand_l")]
    palm = np.array([[0.0, -0.08, 0.0]])
    a, b = PointSet(("palm_r",), hands[:1], palm), PointSet(("palm_l",), hands[1:], palm)
    angles = np.zeros(41)
    for side in "rl":
        for name, degrees in (("arm_flex", 60), ("elbow_flex", 40), ("arm_rot", 40)):
            angles[HUMANOID.tree.coordinate(f"{name}_{side}")] = np.radians(degrees)
    make_chain = lambda s: coincidence_rows(HUMANOID, s, a, b, sigma=1e-4)
    closed = levenberg_marquardt(
        HUMANOID, BodyState(np.eye(4), angles), lambda s: [make_chain(s), prior_rows(HUMANOID, s, mean=angles)]
    ).state
    assert gap(HUMANOID, closed, a, b) < 1e-3
    x = HUMANOID.positions(closed, POINTS)
    for segment, shift in zip(hands, (0.01, -0.01), strict=True):
        x[POINTS.segments == segment, 2] += shift
    left = []
    for sigma in (1e-1, 1e-2, 1e-3, 1e-4):
        fit = levenberg_marquardt(
            HUMANOID, closed,
            lambda s: [point_rows(HUMANOID, s, POINTS, x), coincidence_rows(HUMANOID, s, a, b, sigma=sigma)],  # noqa: B023
        )  # fmt: skip
        left.append(gap(HUMANOID, fit.state, a, b))
    assert left[0] > 0.01 and left[2] < 1e-3 and left[3] < 1e-4
    assert all(strong < weak for weak, strong in pairwise(left))


def test_a_planar_chain_of_two_closes_as_its_formula_says():
    """P3-6 in small: two links from one pivot to a point; the triangle's angles by the law of cosines."""
    l1, l2, reach = 0.4, 0.3, 0.5
    tree = KinematicTree(
        ("ground", "crank", "rod"), [-1, 0, 1], [[0, 0, 0], [0, 0, 0], [l1, 0, 0]], ("a", "b"), [1, 2], [[0, 0, 1]] * 2,
        [False] * 2, [-3.0] * 2, [3.0] * 2, [0.0] * 2, [np.inf] * 2, root_free=False,
    )  # fmt: skip
    nothing = PointSet((), np.empty(0), np.empty((0, 3)))
    body = Body("crank", tree, ("p", "q", "r"), ("all",), np.zeros(3, int), nothing)
    end, pivot = PointSet(("end",), [2], [[l2, 0, 0]]), PointSet(("pivot",), [0], [[reach, 0, 0]])
    fit = levenberg_marquardt(
        body, BodyState(np.eye(4), [0.3, -0.5]), lambda s: coincidence_rows(body, s, end, pivot), tolerance=1e-14
    )
    first = np.arccos((l1**2 + reach**2 - l2**2) / (2 * l1 * reach))
    second = -(np.pi - np.arccos((l1**2 + l2**2 - reach**2) / (2 * l1 * l2)))
    np.testing.assert_allclose(fit.state.angles, [first, second], atol=1e-8)


def test_prediction_and_measurement_share_by_their_variances():
    truth = posture(HUMANOID, 9, 0.35)
    predicted = truth.retract(np.r_[0.3, np.zeros(46)])
    sigma = np.full(47, 0.1)
    rows = lambda s: [
        prediction_rows(HUMANOID, s, predicted, sigma=sigma),
        prediction_rows(HUMANOID, s, truth, sigma=2 * sigma),
    ]
    fit = levenberg_marquardt(HUMANOID, truth, rows)
    np.testing.assert_allclose(truth.difference(fit.state)[:3], [0.3 * 0.8, 0, 0], atol=1e-6)


# P1-2: the pose of a rigid body in all three forms


def rigid_body():
    random = np.random.default_rng(4)
    points = PointSet(tuple("abcdefghij"), np.zeros(10, int), random.uniform(-0.4, 0.4, (10, 3)))
    tree = KinematicTree(("car",), [-1], np.zeros((1, 3)), (), *[np.empty(0)] * 7)
    return Body("car", tree, ("root",), ("car",), [0], points)


@pytest.mark.parametrize("form", ["3D point - 2D point", "3D point - ray", "3D point - 2D line", "3D line - 2D line"])
@pytest.mark.parametrize("seed", range(4))
def test_pose_of_a_rigid_body_from_one_camera(form, seed):
    """P1 2.3: a known pose comes back from pixels, from their rays, from image lines through points, and from edges."""
    body, random = rigid_body(), np.random.default_rng(seed)
    points, cam = body.landmarks, look_at("cam", (0.0, 0.5, 3.0), (0.0, 0.0, 0.0), distortion=())
    rig = Rig((cam,))
    truth = BodyState(se3.exp(np.r_[0.15 * random.normal(size=3), 0.5 * random.normal(size=3)]), [])
    x = body.positions(truth, points)
    uv = cam.project(x)
    across = random_unit(random, len(uv))[:, :2]
    ends = np.roll(np.arange(10), 1)
    starts_uv, ends_uv = uv, uv[ends]
    edge = np.cross(np.c_[starts_uv, np.ones(10)], np.c_[ends_uv, np.ones(10)])
    other = points.select(tuple(points.names[i] for i in ends))
    make = {
        "3D point - 2D point": lambda s: pixel_rows(body, s, points, rig, 0, uv),
        "3D point - ray": lambda s: ray_rows(
            body, s, points, lines.line_along(np.broadcast_to(cam.centre_world, x.shape), cam.ray(uv))
        ),
        "3D point - 2D line": lambda s: image_line_rows(
            body, s, points, rig, 0, np.c_[across, -np.sum(across * uv, axis=1)]
        ),
        "3D line - 2D line": lambda s: edge_rows(body, s, points, other, rig, 0, edge),
    }[form]
    fit = levenberg_marquardt(body, BodyState(np.eye(4), []), make, tolerance=1e-14)
    np.testing.assert_allclose(fit.state.T_world_root, truth.T_world_root, atol=1e-6)
    assert fit.converged and fit.iterations < 30


def test_what_cannot_be_fitted_ends_all_the_same():
    nothing = lambda s: point_rows(HUMANOID, s, POINTS, np.full((len(POINTS), 3), np.nan))
    start = posture(HUMANOID, 1, 0.35)
    fit = levenberg_marquardt(HUMANOID, start, nothing)
    np.testing.assert_array_equal(fit.state.angles, start.angles)
    step = gauss_newton(HUMANOID, start, nothing(start))
    assert step.norm == 0


def test_iterations_used_up_are_told():
    truth = posture(HUMANOID, 1, 0.35)
    fit = levenberg_marquardt(HUMANOID, HUMANOID.rest_state(), measured("points", truth), max_iterations=2)
    assert not fit.converged and fit.iterations == 2


def test_every_joint_type_is_fitted():
    body = random_body(1, 12)
    random = np.random.default_rng(0)
    truth = BodyState(se3.exp(0.3 * random.normal(size=6)), 0.3 * random.normal(size=len(body.tree.coordinates)))
    x = body.positions(truth, body.landmarks)
    fit = levenberg_marquardt(
        body, body.rest_state(), lambda s: point_rows(body, s, body.landmarks, x), tolerance=1e-14
    )
    np.testing.assert_allclose(body.positions(fit.state, body.landmarks), x, atol=1e-7)
