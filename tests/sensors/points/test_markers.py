"""A marker system as a sensor of the tracker."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, a_motion, a_rig, marker_frame, turned

from kinefit.bodies import PointSet
from kinefit.errors import BodyError, ObservationError
from kinefit.fitting.frame.routing import Sensors
from kinefit.fitting.tracking.recording import Recording
from kinefit.geometry.losses import geman_mcclure
from kinefit.observations import MarkerFrame
from kinefit.sensors.evidence import MIN_VISIBLE_OUTLINE
from kinefit.sensors.points.markers import MarkerSensor, of_points
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.least_squares import gauss_newton

TRUTH = a_motion().state(0)
SCENE = Scene(BODY, TRUTH, a_rig())
LOSS, NEAR, SIGMA = geman_mcclure(), 0.03, 0.005
NAMES = ("l_wrist", "l_elbow", "l_shoulder", "neck", "r_hip")


def measured(frame):
    return MarkerSensor("mocap", SIGMA, LOSS, NEAR).prepare(frame, SCENE)


def test_a_body_is_drawn_back():
    measurement = measured(marker_frame(0, NAMES, noise=0.0))
    wrong = state = turned(TRUTH, arm_add_l=-12)
    for k in range(12):
        here = SCENE.at(state)
        rows = measurement.match(here, 0.15 if k < 6 else NEAR).rows(here)
        state = gauss_newton(BODY, state, rows, damping=1e-3).state
    points = BODY.landmarks.select(NAMES)
    assert np.linalg.norm(BODY.positions(state, points) - measurement.x_world, axis=1).max() < 1e-3
    gap = measurement.x_world - BODY.positions(wrong, points)
    here = SCENE.at(wrong)
    match = measurement.match(here, NEAR)
    np.testing.assert_allclose(match.squares(here), np.square(gap).sum(axis=1) / SIGMA**2)
    (rest,) = match.leftovers(here)
    assert (rest.label, rest.unit, rest.names) == ("mocap", "m", NAMES)
    np.testing.assert_allclose(rest.values, gap)
    np.testing.assert_allclose(rest.weights, LOSS.factor(match.squares(here)))


def test_hints_are_where_markers_are():
    """Markers show no limb."""
    frame = marker_frame(0, NAMES)
    hints = measured(frame).hints(SCENE)
    assert hints.points.names == NAMES and hints.view is None
    np.testing.assert_array_equal(hints.x_world, frame.positions)


def test_what_was_not_seen_is_left_out():
    x = np.array([[0.0, 1, 2], [np.nan, 1, 2], [0, 1, 2]])
    measurement = measured(MarkerFrame("mocap", 0.0, ("neck", "r_hip", "tail"), x))
    assert measurement.names == measurement.points_of(BODY).names == ("neck",)
    assert len(measurement.match(SCENE, NEAR).rows(SCENE)[0]) == 3


def test_the_loss_is_wide_while_all_is_far_off():
    measurement = measured(marker_frame(0, NAMES))
    near, far = (measurement.match(SCENE, reach).rows(SCENE)[0].loss.scale for reach in (NEAR, 0.15))
    assert near == LOSS.scale and far == pytest.approx(5.0 * LOSS.scale)


def test_a_set_that_is_not_there_is_told():
    with pytest.raises(BodyError, match="marker set"):
        measured(replace(marker_frame(0, ("neck",)), marker_set="plug-in"))


def test_a_point_speaks_for_its_segment_and_at_a_joint_for_both():
    elbow, arm = BODY.tree.segment("forearm_l"), BODY.tree.segment("upperarm_l")
    points = PointSet(("joint", "middle"), np.array([elbow, elbow]), np.array([[0.0, 0, 0], [0, -0.15, 0]]))
    told = of_points(BODY, points, np.array([1.0, 100.0]))
    assert told.agreeing[[elbow, arm]].tolist() == [MIN_VISIBLE_OUTLINE, MIN_VISIBLE_OUTLINE]
    assert told.contrary[[elbow, arm]].tolist() == [MIN_VISIBLE_OUTLINE, 0.0]
    assert told.agreeing.sum() == 2 * MIN_VISIBLE_OUTLINE and told.contrary.sum() == MIN_VISIBLE_OUTLINE
    root = of_points(BODY, PointSet(("root",), np.array([0]), np.zeros((1, 3))), np.array([8.9]))
    assert root.agreeing[0] == root.agreeing.sum() == MIN_VISIBLE_OUTLINE


def test_markers_speak_for_and_against_where_segments_are():
    arm, measurement = BODY.tree.segment("forearm_l"), measured(marker_frame(0, NAMES))
    for state, lost in ((TRUTH, False), (turned(TRUTH, arm_add_l=-60), True)):
        here = SCENE.at(state)
        told = measurement.match(here, NEAR).evidence(here)
        assert told.lost[arm] == lost and not told.hidden[arm]


def test_a_marker_may_have_a_standard_deviation_of_its_own():
    sigma = {"mocap": SIGMA, "mocap neck": 0.02, "other l_wrist": 1.0}
    sensors = Sensors(a_rig(), 30.0, sigma, TrackSettings())
    (measurement,) = sensors.measurements([marker_frame(0, NAMES)], SCENE)
    np.testing.assert_allclose(measurement.weight**-0.5, [0.02 if n == "neck" else SIGMA for n in NAMES])
    steps = [[marker_frame(0, NAMES)]]
    assert Recording.of_frames(steps, a_rig(), rate=30.0, sigma={"mocap neck": 0.02}).sigma == {"mocap neck": 0.02}
    with pytest.raises(ObservationError, match="no sensor 'mocap nose'"):
        Recording.of_frames(steps, a_rig(), rate=30.0, sigma={"mocap nose": 0.02})
