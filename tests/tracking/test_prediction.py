"""The prediction is a Kalman filter: it does what the textbook's matrices do."""

from __future__ import annotations

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body
from kinefit.rows import ParameterRows
from kinefit.solvers.equations import normal_equations
from kinefit.tracking.prediction import Prediction, belief

BODY = load_body("arm")
N = BODY.tree.n_dofs
DT, ACCELERATION = 0.02, 50.0


def a_filter(memory=1e9):
    return Prediction(BODY, DT, angle_acceleration=ACCELERATION, root_acceleration=1.0, memory=memory)


def test_it_agrees_with_the_filter_of_one_angle():
    """Every angle on its own, measured with 3 degrees: pose, velocity and variance of the textbook's filter."""
    angle, noise, random = 7, np.radians(3), np.random.default_rng(0)
    state = BODY.usual_state()
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
    state, there = BODY.usual_state(), BODY.usual_state().retract(0.01 * rng.normal(size=N))
    row = belief(state, there, information)
    assert isinstance(row, ParameterRows)
    equations = normal_equations(BODY, state, row)
    np.testing.assert_allclose(equations.matrix, information, atol=1e-12)
    np.testing.assert_allclose(equations.gradient, information @ state.difference(there), atol=1e-12)
    assert equations.cost == pytest.approx(row.residual @ information @ row.residual)


def test_a_velocity_that_nothing_confirms_fades():
    prediction = a_filter(memory=0.1)
    prediction.start(BODY.usual_state())
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
    prediction.start(BODY.usual_state())
    ahead, information = prediction.ahead()
    prediction.correct(ahead.retract(np.full(N, 0.05)), 0.1 * np.linalg.inv(information))
    prediction.halt()
    stopped = prediction.state
    np.testing.assert_allclose(stopped.difference(prediction.ahead()[0]), 0, atol=1e-12)


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
