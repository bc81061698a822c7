"""The prediction is a Kalman filter: it does what the textbook's matrices do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body
from kinefit.fitting.frame.prediction import Prediction, marginal_information, prediction_row
from kinefit.solving.equations import normal_equations
from kinefit.solving.rows import ParameterRows

BODY = load_body("arm")
N = BODY.tree.n_dofs
DT, ACCELERATION = 0.02, 50.0


def a_filter(memory=1e9):
    return Prediction(BODY, DT, angle_acceleration=ACCELERATION, root_acceleration=1.0, memory=memory)


def test_it_agrees_with_the_filter_of_one_angle():
    """Every angle on its own, measured with 3 degrees: pose, velocity and variance of the textbook's filter."""
    angle, noise, random = 7, np.radians(3), np.random.default_rng(0)
    state = BODY.default_state()
    prediction = a_filter()
    prediction.start(state, np.full(N, 0.1))
    x, v = state.angles[angle - 6], 0.0
    P = np.diag([0.1**2, (5 * DT) ** 2])
    Q = (ACCELERATION * DT**2) ** 2 * np.array([[0.25, 0.5], [0.5, 1.0]])
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    for _ in range(20):
        P = F @ P @ F.T + Q
        x, v = x + v, v
        z = state.angles[angle - 6] + 0.1 * random.normal()
        gain = P[:, 0] / (P[0, 0] + noise**2)
        x, v = np.array([x, v]) + gain * (z - x)
        P = P - np.outer(gain, P[0])
        ahead, information = prediction.ahead()
        # a measurement of that one angle: posterior by the normal equations
        posterior = np.linalg.inv(information + np.diag(np.arange(N) == angle) / noise**2)
        step = posterior[:, angle] / noise**2 * (z - ahead.angles[angle - 6])
        prediction.correct(ahead.retract(step), posterior)
        assert prediction.state.angles[angle - 6] == pytest.approx(x, abs=1e-9)
        assert posterior[angle, angle] == pytest.approx(P[0, 0], rel=1e-9)


def test_belief_pulls_all_degrees_of_freedom_together():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(N, N))
    information = A @ A.T
    state, there = BODY.default_state(), BODY.default_state().retract(0.01 * rng.normal(size=N))
    row = prediction_row(state, there, information)
    assert isinstance(row, ParameterRows)
    equations = normal_equations(BODY, state, row)
    np.testing.assert_allclose(equations.matrix, information, atol=1e-12)
    np.testing.assert_allclose(equations.gradient, information @ state.difference(there), atol=1e-12)
    assert equations.cost == pytest.approx(row.residual @ information @ row.residual)


def test_a_velocity_that_nothing_confirms_fades():
    prediction = a_filter(memory=0.1)
    prediction.start(BODY.default_state())
    for _ in range(10):
        ahead, information = prediction.ahead()
        prediction.correct(ahead.retract(np.full(N, 0.01)), 0.1 * np.linalg.inv(information))
    start = prediction.state
    for _ in range(100):
        ahead, information = prediction.ahead()
        prediction.correct(ahead, np.linalg.inv(information))
    far = start.difference(prediction.state)
    before = prediction.state
    for _ in range(100):
        ahead, information = prediction.ahead()
        prediction.correct(ahead, np.linalg.inv(information))
    assert np.abs(far).max() > 0.01
    assert np.abs(before.difference(prediction.state)).max() < 1e-6


def test_halt_stays():
    prediction = a_filter()
    prediction.start(BODY.default_state())
    ahead, information = prediction.ahead()
    prediction.correct(ahead.retract(np.full(N, 0.05)), 0.1 * np.linalg.inv(information))
    prediction.halt()
    stopped = prediction.state
    np.testing.assert_allclose(stopped.difference(prediction.ahead()[0]), 0, atol=1e-12)


def test_what_is_out_of_sight_may_go_on_as_it_went():
    """Halted for a second, a walker who in truth walks on stays within two standard deviations."""
    walker = replace(BODY, tree=replace(BODY.tree, root_free=True))
    prediction, speed = Prediction(walker, DT, angle_acceleration=ACCELERATION, root_acceleration=1.0, memory=0.1), 1.5
    step = np.zeros(N)
    step[0] = speed * DT
    prediction.start(BODY.default_state())
    for _ in range(20):
        ahead, information = prediction.ahead()
        prediction.correct(prediction.state.retract(step), np.linalg.inv(information + 1e6 * np.eye(N)))
    walked = prediction.velocity[0]  # a little less: it fades
    assert 0.7 * step[0] < walked < step[0]
    for f in range(1, 51):
        prediction.halt()
        ahead, information = prediction.ahead()
        prediction.correct(ahead, np.linalg.inv(information))
        assert f * step[0] < 2.0 * prediction.std[0] < 2.0 * (f * step[0] + 0.01)


def test_another_chart_goes_on_the_same_way():
    body = load_body("humanoid")
    prediction = Prediction(body, DT, angle_acceleration=ACCELERATION, root_acceleration=1.0, memory=1e9)
    start = BodyState(np.eye(4), np.zeros(len(body.tree.coordinates)))
    prediction.start(start)
    ahead, information = prediction.ahead()
    prediction.correct(ahead.retract(np.full(body.tree.n_dofs, 0.02)), 0.1 * np.linalg.inv(information))
    signs = np.where(np.arange(len(start.angles)) == 1, -1.0, 1.0)
    velocity = prediction._velocity.copy()
    prediction.change_chart(prediction.state.angles, signs)
    np.testing.assert_allclose(prediction._velocity[7], -velocity[7])
    _, other = prediction.ahead()
    assert np.all(np.linalg.eigvalsh(other) > 0)


def carried(*steps, memory=1e9):
    """State, covariance and velocity after some steps that nothing is measured in."""
    prediction = a_filter(memory)
    prediction.start(BODY.default_state(), np.full(N, 0.1))
    for _ in range(3):
        ahead, information = prediction.ahead()
        prediction.correct(ahead.retract(np.full(N, 0.01)), 0.1 * np.linalg.inv(information))
    for step in steps:
        ahead, information = prediction.ahead(step)
        prediction.correct(ahead, np.linalg.inv(information))
    return prediction.state, np.linalg.inv(information), prediction.velocity


@pytest.mark.parametrize("memory", [1e9, 0.1])
def test_frames_that_were_dropped_are_gone_over_at_once(memory):
    (at_once, P, v), (one_by_one, Q, w) = carried(3, memory=memory), carried(1, 1, 1, memory=memory)
    np.testing.assert_allclose(one_by_one.difference(at_once), 0, atol=1e-12)
    np.testing.assert_allclose(P, Q, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(v, w, rtol=1e-9)


@pytest.mark.parametrize("parts", [(0.5, 0.5), (0.25, 0.75), (0.4, 0.6)])
def test_parts_of_a_step_make_a_step(parts):
    (whole, P, v), (pieces, Q, w) = carried(1), carried(*parts)
    np.testing.assert_allclose(pieces.difference(whole), 0, atol=1e-12)
    np.testing.assert_allclose(v, w, rtol=1e-9)
    # The random acceleration holds for a step, so that a step in parts is a little more uncertain.
    jolt = (np.where(np.arange(N) < 3, 1.0, ACCELERATION) * DT**2) ** 2
    more = np.diag(Q - P) / jolt
    assert (more > -1e-9).all() and (more < 1 / 12).all()


def test_a_velocity_fades_alike_in_whole_steps_and_in_parts():
    assert carried(0.5, 0.5, memory=0.05)[2] == pytest.approx(carried(1, memory=0.05)[2])


def test_forgetting_is_marginalising():
    rng = np.random.default_rng(4)
    A = rng.normal(size=(N, N + 3))
    information, lost = A @ A.T, rng.random(N) < 0.4
    out, kept = marginal_information(information, lost), ~lost
    schur = information[np.ix_(kept, kept)] - information[np.ix_(kept, lost)] @ np.linalg.solve(
        information[np.ix_(lost, lost)], information[np.ix_(lost, kept)]
    )
    np.testing.assert_allclose(out[np.ix_(kept, kept)], schur, rtol=1e-6, atol=1e-8)
    assert not out[lost].any() and not out[:, lost].any()
    np.testing.assert_allclose(marginal_information(information, np.zeros(N, bool)), information, rtol=1e-6, atol=1e-8)
    assert not marginal_information(information, np.ones(N, bool)).any()


def test_a_crank_goes_on_where_a_knee_fades():
    """Of gear that closes a chain the speed lasts, of limbs it does not; without the closure neither does."""
    body = load_body("cyclist")
    names = ("crank_angle", "left_pedal_angle", "knee_angle_l", "arm_flex_r")
    chosen = np.array([6 + body.tree.coordinates.index(name) for name in names])
    for rider, lasts in ((body, [1.0, 1.0, np.exp(-1.0), np.exp(-1.0)]), (replace(body, closures=()), np.exp(-1.0))):
        prediction = Prediction(rider, DT, angle_acceleration=1.0, root_acceleration=1.0, memory=0.1)
        speed = np.zeros(body.tree.n_dofs)
        speed[chosen] = 0.01
        prediction.go_on(body.default_state(), np.full(body.tree.n_dofs, 0.1), speed)
        prediction.ahead(0.1 / DT)
        np.testing.assert_allclose(prediction.velocity[chosen], 0.01 * np.array(lasts), rtol=1e-9)
