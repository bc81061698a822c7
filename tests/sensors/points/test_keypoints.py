"""Detectors of all cameras as one sensor of the tracker."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, SET, a_motion, a_rig, keypoint_frame, marker_frame, turned
from tests.oracle import central_differences, design

from kinefit.errors import BodyError, CalibrationError
from kinefit.geometry.losses import geman_mcclure
from kinefit.observations import KeypointFrame
from kinefit.sensors.points.keypoints import KeypointSensor
from kinefit.sensors.points.markers import MarkerSensor
from kinefit.sensors.scene import Scene
from kinefit.solving.equations import normal_equations
from kinefit.solving.least_squares import gauss_newton, levenberg_marquardt

TRUTH = a_motion().state(0)
WRONG = turned(TRUTH, arm_add_l=-12)
LOSS, NEAR = geman_mcclure(), 0.03
SCENE = Scene(BODY, TRUTH, a_rig())


def measured(*frames, sigma=2.0):
    return KeypointSensor(a_rig(), {"left": sigma}, sigma, LOSS, NEAR).prepare(frames, SCENE)


def both(noise=0.0):
    return measured(*(keypoint_frame(0, c, noise=noise) for c in ("left", "right")))


def squares(measurement, state):
    here = SCENE.at(state)
    return measurement.match(here, NEAR).squares(here)


def apart(a, b, names):
    points = BODY.landmarks.select(names)
    return np.linalg.norm(BODY.positions(a, points) - BODY.positions(b, points), axis=1)


def test_a_body_is_drawn_back():
    measurement, state = both(), WRONG
    for k in range(12):
        here = SCENE.at(state)
        rows = measurement.match(here, 0.15 if k < 6 else NEAR).rows(here)
        state = gauss_newton(BODY, state, rows, damping=1e-3).state
    assert apart(state, TRUTH, ("l_wrist",)) < 1e-3 < 0.05 < apart(WRONG, TRUTH, ("l_wrist",))
    assert squares(measurement, TRUTH).max() < 1e-9 and squares(measurement, WRONG).max() > 9.0


def test_hints_are_points_on_which_two_cameras_agree():
    """Keypoints show no limb; one camera tells of no place."""
    hints = both().hints(SCENE)
    assert hints.view is None and len(hints.points) == len(BODY.keypoints(SET))
    np.testing.assert_allclose(hints.x_world, BODY.positions(TRUTH, hints.points), atol=1e-4)
    alone = measured(keypoint_frame(0, "left")).hints(SCENE)
    assert np.isnan(alone.x_world).all()


def test_rows_are_a_pure_function_whose_derivative_is_that_of_the_rows():
    """Residuals along image lines, in metres at the point's depth: exact where pixels are."""
    match = both().match(SCENE.at(WRONG), 0.15)
    (rows,) = match.rows(SCENE)
    slope = central_differences(lambda s: match.rows(SCENE.at(s))[0].residual, BODY, TRUTH, 1e-6)
    np.testing.assert_allclose(-design(rows, BODY, TRUTH), slope, atol=1e-6)
    np.testing.assert_array_equal(match.rows(SCENE)[0].data, rows.data)


def test_a_keypoint_counts_by_its_confidence():
    frame = keypoint_frame(0, "left")
    half = replace(frame, confidence=0.5 * frame.confidence)
    told = [squares(measured(f), TRUTH) for f in (frame, half)]
    np.testing.assert_allclose(told[1], 0.5 * told[0])
    np.testing.assert_allclose(squares(measured(frame, sigma=4.0), TRUTH), 0.25 * told[0])


def test_what_was_not_seen_is_left_out():
    frame = keypoint_frame(0, "left")
    uv, trust = np.array(frame.uv), np.array(frame.confidence)
    uv[0], trust[1], trust[2], trust[3] = np.nan, 0.0, np.nan, np.inf
    names = (*frame.names[:-1], "tail")
    measurement = measured(KeypointFrame("left", 0.0, names, uv, trust, SET))
    assert measurement.layout.points.names == frame.names[:-1]
    seen = [n for n, w in zip(frame.names, measurement.weight) if w > 0]
    assert seen == list(frame.names[4:-1])
    match = measurement.match(SCENE, NEAR)
    assert sum(len(r) for r in match.rows(SCENE)) == 2 * len(frame.names) - 10
    (rest,) = match.leftovers(SCENE)
    assert (rest.label, rest.unit, rest.names) == ("left", "px", frame.names[:-1])
    assert np.isnan(rest.values[:4]).all() and np.isfinite(rest.values[4:]).all()
    assert (rest.weights[:4] == 0).all() and (rest.weights[4:] > 0).all()


def test_sides_that_a_detector_exchanged_are_put_right():
    frame = keypoint_frame(0, "left", noise=0.0)
    partner = [frame.names.index(_other_side(n)) for n in frame.names]
    turned_round = replace(frame, uv=frame.uv[partner])
    right = keypoint_frame(0, "right", noise=0.0)
    as_is, put_right = (measured(f, right).match(SCENE, NEAR) for f in (frame, turned_round))
    swapped = put_right.swapped[: len(frame.names)]
    pairs = np.array([n != _other_side(n) for n in frame.names])
    assert swapped[pairs].mean() > 0.5 and not put_right.swapped[len(frame.names) :].any()
    assert not as_is.swapped.any() and as_is.key != put_right.key
    np.testing.assert_allclose(put_right.squares(SCENE), 0.0, atol=1e-9)
    assert [rest.swapped for rest in put_right.leftovers(SCENE)] == [True, False]


def _other_side(name):
    return {"L": "R", "R": "L"}.get(name[0], name[0]) + name[1:]


def test_the_loss_is_wide_while_all_is_far_off():
    near, far = (both().match(SCENE, reach).rows(SCENE)[0].loss.scale for reach in (NEAR, 0.15))
    assert near == LOSS.scale and far == pytest.approx(5.0 * LOSS.scale)


def test_a_segment_is_told_of_by_its_points_and_those_at_its_childrens_joints():
    arm = BODY.tree.segment("forearm_l")
    frame = keypoint_frame(0, "left", noise=0.0)
    for state, lost in ((TRUTH, False), (turned(TRUTH, arm_add_l=-60), True)):
        here = SCENE.at(state)
        told = measured(frame).match(here, NEAR).evidence(here)
        assert told.lost[arm] == lost and not told.hidden[arm]
        assert not told.lost[BODY.tree.segment("shank_r")]
    only = replace(frame, confidence=np.where([n == "LWrist" for n in frame.names], 1.0, 0.0))
    told = measured(only).match(SCENE, NEAR).evidence(SCENE)
    assert not told.hidden[arm] and told.hidden[BODY.tree.segment("shank_l")]


def test_what_is_not_there_is_told():
    with pytest.raises(BodyError, match="COCO_17"):
        measured(replace(keypoint_frame(0, "left"), keypoint_set="COCO"))
    with pytest.raises(CalibrationError, match="left"):
        measured(replace(keypoint_frame(0, "left"), sensor="other"))


def test_both_solvers_find_the_same_from_keypoints_and_markers():
    markers = MarkerSensor("mocap", 0.005, LOSS, NEAR).prepare(marker_frame(0, ("neck", "r_hip", "l_hip")), SCENE)
    start = turned(TRUTH, arm_add_l=-5)
    matched = [m.match(SCENE.at(start), NEAR) for m in (both(noise=2.0), markers)]

    def rows(state):
        return [r for m in matched for r in m.rows(SCENE.at(state))]

    one = start
    for _ in range(30):
        one = gauss_newton(BODY, one, rows(one), damping=1e-6).state
    other = levenberg_marquardt(BODY, start, rows).state
    costs = [sum(normal_equations(BODY, s, r).cost for r in rows(s)) for s in (one, other)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-4)
    assert apart(one, other, BODY.landmarks.names).max() < 2e-3
