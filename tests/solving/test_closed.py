"""Fits under equations that hold exactly: against a general optimiser, at limits, and their covariances."""

import numpy as np
import pytest
from scipy.optimize import minimize

from kinefit.bodies import BodyState, load_body, parse_body
from kinefit.errors import BodyError
from kinefit.solving.closed import CLOSED, closed_fit, closure_forces, load_of, null_space, on_null_space, onto
from kinefit.solving.correspondences import point_rows, prior_rows
from kinefit.solving.correspondences.closures import closed_at, hard_equations
from kinefit.solving.equations import inverse

LEG = """
[body]
name = "pedal"

[[segment]]
name = "ground"
joint = { name = "world", type = "fixed" }

[[segment]]
name = "thigh"
parent = "ground"
joint = { name = "hip", type = "revolute", axes = ["z"] }

[[segment]]
name = "shank"
parent = "thigh"
joint = { name = "knee", type = "revolute", at = [0.0, 0.45, 0.0], axes = ["z"], range = [[-170, 0]] }

[[segment]]
name = "crank"
parent = "ground"
joint = { name = "axis", type = "revolute", at = [0.0, 0.6, 0.0], axes = ["z"] }

[landmarks]
joint = { segment = "shank", at = [0.0, 0.0, 0.0] }
foot = { segment = "shank", at = [0.0, 0.3, 0.0] }
pedal = { segment = "crank", at = [0.0, 0.15, 0.0] }

[[closure]]
name = "foot"
point = "foot"
to = "pedal"
mode = "hard"
"""


@pytest.fixture
def leg():
    return parse_body(LEG)


def at(angles):
    return BodyState(np.eye(4), np.array(angles, float))


@pytest.mark.parametrize("seed", range(3))
def test_a_constrained_fit_is_that_of_a_general_optimiser(leg, seed):
    random, equations = np.random.default_rng(seed), hard_equations(leg)
    points = leg.landmarks.select(("joint", "foot"))
    start, off = onto(leg, at([0.3, -0.9, 0.8 + seed]), equations)
    assert off <= CLOSED
    target = leg.positions(start, points) + random.normal(scale=0.01, size=(2, 3)) * [1.0, 1.0, 0.0]
    rows = lambda state: [point_rows(leg, state, points, target, sigma=0.005)]
    fit = closed_fit(leg, start, rows, equations, tolerance=1e-14)
    assert fit.converged and np.abs(equations(fit.state)[0]).max() <= CLOSED
    cost = lambda q: float(np.sum((leg.positions(at(q), points) - target) ** 2)) * 0.005**-2
    best = minimize(
        cost, start.angles, method="SLSQP", options={"maxiter": 300, "ftol": 1e-14},
        constraints={"type": "eq", "fun": lambda q: equations(at(q))[0][:2]},
    )  # fmt: skip
    assert fit.equations.cost == pytest.approx(best.fun, rel=1e-5)
    np.testing.assert_allclose(fit.state.angles, best.x, atol=1e-4)


def test_a_limit_ends_the_way_along_the_chain(leg):
    """The stretched leg: the knee stops at its limit, and the chain stays closed."""
    equations, points = hard_equations(leg), leg.landmarks.select(("foot",))
    start, _ = onto(leg, at([0.2, -0.5, -0.5]), equations)
    rows = lambda state: [point_rows(leg, state, points, np.array([[0.0, 0.9, 0.0]]), sigma=0.005)]
    fit = closed_fit(leg, start, rows, equations, tolerance=1e-14)
    assert np.abs(equations(fit.state)[0]).max() <= CLOSED and fit.state.angles[1] <= 0.0
    assert leg.positions(fit.state, points)[0, 1] == pytest.approx(0.75, abs=1e-5)
    again = closed_fit(leg, fit.state, rows, equations, tolerance=1e-14)
    assert again.equations.cost > (1.0 - 1e-6) * fit.equations.cost


def test_equations_that_cannot_be_met_end_a_fit(leg):
    far = parse_body(LEG.replace("at = [0.0, 0.6, 0.0]", "at = [0.0, 1.6, 0.0]"))
    equations = hard_equations(far)
    fit = closed_fit(far, at([0.1, -0.3, 0.4]), lambda s: [prior_rows(far, s)], equations)
    assert not fit.converged and np.abs(equations(fit.state)[0]).max() > 0.5


def test_a_covariance_on_the_null_space_is_that_of_endless_weight():
    body = load_body("snowboarder")
    random = np.random.default_rng(1)
    B = random.normal(size=(80, body.tree.n_dofs))
    P = inverse(B.T @ B)
    A = closed_at(body, body.default_state()).jacobian
    exact = on_null_space(P, np.concatenate([A, A[:1]]))  # an equation said twice changes nothing
    np.testing.assert_allclose(exact, inverse(B.T @ B + 1e8 * A.T @ A), atol=1e-6 * P.max())
    assert np.abs(A @ exact).max() < 1e-9 and np.all(np.diag(exact) <= np.diag(P) + 1e-12)
    Z = null_space(A, np.zeros(len(A)), np.zeros(A.shape[1], bool)).free
    np.testing.assert_allclose(exact, Z @ inverse(Z.T @ B.T @ B @ Z) @ Z.T, atol=1e-9)


def test_a_pedal_under_a_known_load_is_pushed_along_the_line_through_the_hip(leg):
    """A passive hip lets the leg push along the line from hip to foot alone: by the crank's torque over its lever."""
    state, _ = onto(leg, at([0.3, -0.9, 1.2]), hard_equations(leg))
    hip, torque = np.zeros(3), 25.0  # [N m] that brakes the crank
    foot = leg.positions(state, leg.landmarks.select(("foot",)))[0]
    axis, knee = np.array([0.0, 0.6, 0.0]), leg.positions(state, leg.landmarks.select(("joint",)))[0]
    load = np.zeros(leg.tree.n_dofs)
    load[6 + leg.tree.coordinate("axis")] = torque
    found = closure_forces(leg, state, load, active=["knee"])
    along = (foot - hip) / np.linalg.norm(foot - hip)
    lever = np.cross(foot - axis, along)[2]  # the force on the crank is the opposite of that on the foot
    crank = state.angles[2]
    R = np.array([[np.cos(crank), -np.sin(crank)], [np.sin(crank), np.cos(crank)]])
    assert found.undetermined == ("foot along z",)  # a plane's mechanism says nothing across it
    assert "foot along z" not in found.forces and "not determined: foot along z." in str(found)
    on_foot = np.array([*(R @ [found.forces["foot along x"], found.forces["foot along y"]]), 0.0])
    np.testing.assert_allclose(on_foot, torque / lever * along, atol=1e-9)
    needed = -np.cross(foot - knee, on_foot)[2]
    assert found.torques == {"knee": pytest.approx(needed, abs=1e-9)}
    assert np.abs(found.unbalanced).max() < 1e-9
    weight = load_of(leg, state, leg.landmarks.select(("joint",)), [[0.0, -80.0, 0.0]])
    assert weight[6 + leg.tree.coordinate("hip")] == pytest.approx(-80.0 * knee[0], abs=1e-9)
    assert not weight[[6 + leg.tree.coordinate("knee"), 6 + leg.tree.coordinate("axis")]].any()
    pushed = closure_forces(leg, state, load, active=["hip", "knee"])  # then the crank alone says something
    assert pushed.undetermined == ("foot along y", "foot along z", "hip", "knee") and not pushed.torques
    assert pushed.forces == {"foot along x": pytest.approx(-torque / 0.15, abs=1e-9)}
    assert np.abs(pushed.unbalanced).max() < 1e-9


def test_forces_of_closures_of_a_body_with_gear():
    """Half of a bar's weight hangs in the left hand where the lifter's arms are alike, and the pelvis carries all."""
    body = load_body("weight_lifter")
    state, off = onto(body, body.default_state(), hard_equations(body))
    assert off <= CLOSED
    load = load_of(body, state, body.landmarks.select(("bar_middle",)), [[0.0, -200.0, 0.0]])
    found = closure_forces(body, state, load)
    assert np.linalg.norm(found.unbalanced[:3] - [0.0, -200.0, 0.0]) < 1e-6  # nothing holds the root
    assert not found.forces and {f"left hand along {axis}" for axis in "xyz"} <= set(found.undetermined)
    assert "lumbar_extension" in found.torques  # both arms can press the bar together, which no trunk takes part in
    of_left_arm = [n for n in body.tree.coordinates if n.endswith("_l")]
    loose = closure_forces(body, state, load, active=of_left_arm)
    assert not loose.forces and "no equilibrium: nothing balances the load on lumbar_extension" in str(loose)
    with pytest.raises(BodyError, match="no closures"):
        closure_forces(load_body("humanoid"), load_body("humanoid").default_state(), np.zeros(47))
    with pytest.raises(BodyError, match="wing"):
        closure_forces(body, state, load, active=["wing"])


@pytest.mark.parametrize(("name", "closure"), [("cyclist", "left cleat"), ("snowboarder", "left boot")])
def test_what_two_legs_can_press_together_has_no_force(name, closure):
    """A crank that is braked, or a board that is loaded: one leg alone bears it, of two nobody knows which."""
    body = load_body(name)
    state, _ = onto(body, body.default_state(), lambda s: (closed_at(body, s).value, closed_at(body, s).jacobian))
    load = np.zeros(body.tree.n_dofs)
    if name == "cyclist":
        load[6 + body.tree.coordinate("crank_angle")] = 25.0
    found = closure_forces(body, state, load)
    along = [f"{closure} along {axis}" for axis in "xyz"]
    assert set(along) <= set(found.undetermined) and not set(along) & set(found.forces)
    assert all(np.isfinite([*found.forces.values(), *found.torques.values()]))
    assert "Active joints can press these against each other" in str(found)
    left = closure_forces(body, state, load, active=[n for n in body.tree.coordinates if n.endswith("_l")])
    if name == "cyclist":  # its left leg alone
        across = np.array([left.forces[a] for a in along[:2]])
        assert np.linalg.norm(across) > 25.0 / 0.17 - 1e-6 and along[2] in left.undetermined
