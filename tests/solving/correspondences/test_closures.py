"""What closes a body's chains, against plain numpy and scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.oracle import central_differences, design, slow_positions
from tests.solving.test_closed import LEG

from kinefit.bodies import BodyState, load_body, parse_body
from kinefit.bodies.parts import known_gear
from kinefit.errors import BodyError
from kinefit.geometry import se3
from kinefit.solving.closed import onto
from kinefit.solving.correspondences import _kernels as kernels
from kinefit.solving.correspondences import point_rows
from kinefit.solving.correspondences.closures import (
    HARD_SIGMA,
    closed_at,
    closure_rows,
    closure_targets,
    closure_values,
    hard_equations,
    owners,
)
from kinefit.solving.equations import normal_equations


def turned(body, state, segment):
    """(3, 3) rotation of a segment, from three of its points."""
    marks = body.landmarks
    axes = type(marks)(("o", "x", "y", "z"), np.full(4, segment), np.concatenate([np.zeros((1, 3)), np.eye(3)]))
    x = slow_positions(body, state, axes)
    return (x[1:] - x[0]).T


@pytest.mark.parametrize("name", ["cyclist", "snowboarder", "rower"])
@pytest.mark.parametrize("seed", range(2))
def test_values_in_numpy(name, seed):
    body, random = load_body(name), np.random.default_rng(seed)
    state = body.default_state().retract(random.normal(scale=0.7, size=body.tree.n_dofs))
    closed, owner = closed_at(body, state), owners(body)
    marks = body.landmarks
    for k, c in enumerate(body.closures):
        own = closed.value[owner == k]
        x = slow_positions(body, state, marks.select((c.point,)))[0]
        R, at = np.eye(3), np.array(c.place)
        if c.to:
            at = slow_positions(body, state, marks.select((c.to,)))[0]
            R = turned(body, state, int(marks.select((c.to,)).segments[0]))
        np.testing.assert_allclose(own[: len(c.directions)], c.directions @ R.T @ (x - at), atol=1e-12)
        if c.kind == "rigid":
            mine = turned(body, state, int(marks.select((c.point,)).segments[0]))
            relative = Rotation.from_rotvec(c.turn).inv() * Rotation.from_matrix(R.T @ mine)
            np.testing.assert_allclose(own[3:], relative.as_rotvec(), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 1.5, 3.0, np.pi - 1e-4, np.pi - 1e-9])
def test_turns_of_any_size(angle):
    random = np.random.default_rng(2)
    for _ in range(5):
        axis = random.normal(size=3)
        e = angle * axis / np.linalg.norm(axis)
        found, rows = np.empty(3), np.empty((3, 3))
        kernels.rotation_vector(se3.exp_so3(e), found)
        np.testing.assert_allclose(found, e, atol=1e-9)
        M = Rotation.random(random_state=3).as_matrix()
        kernels.turn_rows(e, M, rows)
        np.testing.assert_allclose(rows, np.linalg.solve(se3.left_jacobian_so3(e), M.T), atol=1e-8)


def test_weights_are_those_of_the_deviations():
    body = load_body("cyclist")
    rows, owner = closure_rows(body, BodyState(np.eye(4), body.tree.usual)), owners(body)
    for k, c in enumerate(body.closures):
        std = 1.0 / np.sqrt(rows.weight[owner == k])
        wanted = [np.hypot(HARD_SIGMA if c.hard and not c.place_std else 0.0 if c.hard else c.sigma, c.place_std)] * 3
        wanted += [np.hypot(HARD_SIGMA if not c.turn_std else 0.0, c.turn_std)] * (c.rows - 3)
        np.testing.assert_allclose(std, wanted, rtol=1e-9)
    assert np.all(rows.group == -1)  # no closure is ever an outlier


def paper_rows(body, state):
    """Equations (18) and (19), weighted as hard closures are."""
    return point_rows(body, state, *closure_targets(body, state), sigma=HARD_SIGMA)


TO_THE_WORLD = LEG.replace('to = "pedal"', "at = [0.1, 0.7, 0.0]")


@pytest.mark.parametrize("text", [LEG, TO_THE_WORLD])
def test_the_papers_equations_have_the_gradient_of_the_closures(text):
    body = parse_body(text)
    state = BodyState(np.eye(4), np.array([0.3, -0.9, 0.8]))
    printed, joint = (normal_equations(body, state, make(body, state)) for make in (paper_rows, closure_rows))
    assert np.linalg.norm(closure_values(body, state)) > 0.05
    np.testing.assert_allclose(printed.gradient, joint.gradient, rtol=1e-9, atol=1e-4)
    if "to =" in text.split("[[closure]]")[1]:  # each of the two equations has the whole distance
        assert printed.cost == pytest.approx(2.0 * joint.cost)
    else:
        np.testing.assert_allclose(printed.matrix, joint.matrix, rtol=1e-9, atol=1e-4)


def test_the_papers_equations_hold_a_closed_pair_in_place():
    """The closures have rank 2 of the pedal's 3 freedoms and leave its crank; (18) and (19) have rank 3."""
    body = parse_body(LEG)
    state, _ = onto(body, BodyState(np.eye(4), np.array([0.5, -0.8, 1.0])), hard_equations(body))
    rows = paper_rows(body, state)
    np.testing.assert_allclose(rows.residual, 0.0, atol=1e-9)
    joint, printed = closed_at(body, state).jacobian, design(rows, body, state)
    assert [np.linalg.matrix_rank(J[:, 6:], tol=1e-6) for J in (joint, printed)] == [2, 3]


@pytest.mark.parametrize("name", ["snowboarder", "cyclist"])
def test_derivatives_of_the_papers_equations(name):
    body, random = known_gear(load_body(name)), np.random.default_rng(5)
    state = body.default_state().retract(random.normal(scale=0.3, size=body.tree.n_dofs))
    points, x_world = closure_targets(body, state)
    rows = point_rows(body, state, points, x_world)
    expected = central_differences(lambda s: point_rows(body, s, points, x_world).residual, body, state)
    np.testing.assert_allclose(-design(rows, body, state), expected, atol=1e-7)


def test_four_pairs_of_points_are_a_rigid_closure():
    body = known_gear(load_body("snowboarder"))
    closed, off = onto(body, body.default_state(), hard_equations(body))
    assert off < 1e-9
    np.testing.assert_allclose(paper_rows(body, closed).residual, 0.0, atol=1e-9)
    J = design(paper_rows(body, closed), body, closed)
    ranks = [np.linalg.matrix_rank(A, tol=1e-6) for A in (J[:12] - J[12:], closed_at(body, closed).jacobian)]
    assert ranks == [6, 6]


def test_what_the_paper_has_no_equation_for_is_named():
    line = parse_body(LEG.replace('mode = "hard"', 'kind = "line"\naxis = "x"'))
    with pytest.raises(BodyError, match="closure 'foot' is a line"):
        closure_targets(line, line.default_state())
    rider = load_body("cyclist")
    with pytest.raises(BodyError, match="'cyclist' has gear to estimate"):
        closure_targets(rider, rider.default_state())
