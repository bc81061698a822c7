"""A displaced sensor: its rows are those of the sensor in its own frame, brought into the world."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import ObservationError
from kinefit.fitting.subject.fit import fit_subject
from kinefit.fitting.subject.subject import SensorFrames
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import SQUARED
from kinefit.observations import MarkerFrame
from kinefit.sensors.base import matched_by, rows_at
from kinefit.sensors.displaced import CLOCK, Displaced, displacement
from kinefit.sensors.points.markers import MarkerSensor
from kinefit.sensors.scene import Scene

BODY = load_body("humanoid")
CENTRE = np.array([0.2, 1.0, -0.1])
VALUES = {"tx": 0.03, "ty": -0.02, "tz": 0.01, "rx": 0.02, "ry": -0.04, "rz": 0.03}


def posture(seed=0):
    random = np.random.default_rng(seed)
    T = se3.transform(se3.exp_so3(random.normal(scale=0.5, size=3)), random.normal(scale=0.5, size=3))
    state = BODY.default_state(T)
    return state.retract(random.normal(scale=0.05, size=BODY.tree.n_dofs))


def seen(state, T, time=0.0):
    """Landmarks as a system says them whose frame T (4, 4) puts into the world."""
    x = se3.apply(se3.inverse(T), BODY.positions(state, BODY.landmarks))
    frame = MarkerFrame("markers", time, BODY.landmarks.names, x, "")
    return MarkerSensor("markers", 0.005, SQUARED, 0.03).prepare(frame, Scene(BODY, state, Rig(())))


def rows(state, values, measurement, **moving):
    scene = Scene(BODY, state, Rig(()), values={"markers": values}, **moving)
    return rows_at(matched_by(Displaced(measurement, CENTRE), scene, 0.03), scene)[0]


def test_in_its_frame_nothing_is_left():
    state = posture()
    left = rows(state, VALUES, seen(state, displacement(VALUES, CENTRE))).residual
    np.testing.assert_allclose(left, 0.0, atol=1e-12)
    assert np.abs(rows(state, {}, seen(state, displacement(VALUES, CENTRE))).residual).max() > 0.02


def test_its_centre_is_shifted_and_not_turned():
    np.testing.assert_allclose(se3.apply(displacement(VALUES, CENTRE), CENTRE), CENTRE + [0.03, -0.02, 0.01])


def test_its_rows_are_derivatives_in_the_world():
    state, other, step = posture(1), posture(2), 1e-6
    measurement = seen(other, np.eye(4))
    made = rows(state, VALUES, measurement)
    T = state.T_world_root
    for axis in range(6):
        delta = np.zeros(BODY.tree.n_dofs)
        delta[axis] = step
        ahead, back = (rows(state.retract(sign * delta), VALUES, measurement) for sign in (1.0, -1.0))
        slope = (back.residual - ahead.residual) / (2.0 * step)
        about = np.cross(made.point - T[:3, 3], made.direction)
        expected = made.direction[:, axis] if axis < 3 else about[:, axis - 3]
        np.testing.assert_allclose(slope, expected, atol=1e-7)


def test_a_late_clock_is_made_up_for_by_the_velocity():
    state, velocity = posture(), np.zeros(BODY.tree.n_dofs)
    velocity[0] = 2.0
    later = seen(state.retract(0.01 * velocity), np.eye(4))
    left = rows(state, {CLOCK: 0.01}, later, velocity=velocity).residual
    np.testing.assert_allclose(left, 0.0, atol=1e-12)


def test_a_fit_finds_the_frame_where_another_sensor_holds_the_world():
    states = [posture(k) for k in range(4)]
    true = displacement(VALUES, CENTRE)
    steps = []
    for state in states:
        world = seen(state, np.eye(4))
        world.sensor = "world"
        steps.append([world, Displaced(seen(state, true), CENTRE)])
    still = [np.zeros(BODY.tree.n_dofs)] * 4
    found = fit_subject(BODY, Rig(()), steps, states, [SensorFrames(("markers",))], velocities=still)
    np.testing.assert_allclose(displacement(found.values["markers"], CENTRE), true, atol=1e-4)
    assert found.value("markers clock")[1] == pytest.approx(0.02, rel=1e-3)  # nobody moves: the prior


def test_standard_deviations_above_zero_are_asked_for():
    with pytest.raises(ObservationError, match="above 0"):
        SensorFrames(("markers",), std=(0.3, 0.0, 0.02))


def test_a_prior_about_the_origin_holds_what_lies_far_away_less_firmly():
    arm = np.array([0.0, 0.0, 3.0])
    place = SensorFrames(("markers",), std=(0.1, 0.087, 0.02), arms={"markers": arm})
    C = np.linalg.inv(place.information)
    np.testing.assert_allclose(np.sqrt(np.diag(C)[:3]), [np.hypot(0.1, 3.0 * 0.087)] * 2 + [0.1])
    turn = np.array([0.02, 0.0, 0.0])
    twist = np.concatenate([-np.cross(turn, arm), turn, [0.0]])  # the origin stays
    assert twist @ place.information @ twist == pytest.approx((0.02 / 0.087) ** 2)
