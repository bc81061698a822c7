"""Keypoints that are seen, in front of which a depth camera beside theirs has measured something."""


import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, a_motion, a_rig, a_tracker

from kinefit.bodies.rendering import render_body
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import geman_mcclure
from kinefit.observations import DepthFrame, KeypointFrame
from kinefit.sensors.points.keypoints import KeypointMeasurement, KeypointSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_image import DepthImageSensor
from kinefit.sensors.visibility.occlusion import (
    MIN_OCCLUDED_DEPTH,
    DepthSeen,
    adjacent_cameras,
    depth_behind,
    hidden_points,
)
from kinefit.solving.equations import normal_equations

TRUTH = a_motion().state(0)
CAMERA = a_rig()["depth"]
WRISTS = BODY.landmarks.select(("l_wrist", "r_wrist"))
WRIST = BODY.positions(TRUTH, WRISTS)[1]
SIGMA = 0.01
SURE, FIRST = np.ones(2, bool), np.zeros(2, int)


def drawn():
    """(H, W) [m] the body before nothing."""
    depth = render_body(BODY, TRUTH, CAMERA).depth
    return DepthFrame("depth", 0.0, np.where(np.isfinite(depth), depth, 0.0))


def shown(frame=None):
    """A scene of that one camera, in which it has measured that."""
    scene = Scene(BODY, TRUTH, Rig((CAMERA,)))
    sensor = DepthImageSensor("depth", CAMERA, SIGMA, TrackSettings(), None)
    return scene.at(TRUTH, measurements=(sensor.prepare(frame or drawn(), scene),))


def pushed(distance):
    """The truth, moved away from the camera."""
    T = np.array(TRUTH.T_world_root)
    sight = WRIST - CAMERA.centre_world
    T[:3, 3] += distance * sight / np.linalg.norm(sight)
    return type(TRUTH)(T, TRUTH.angles)


def behind(state, depth=None):
    seen = DepthSeen(drawn().depth if depth is None else depth, CAMERA, SIGMA)
    return depth_behind(BODY.positions(state, WRISTS), seen)


def test_at_the_truth_points_lie_just_below_the_skin():
    deep = behind(TRUTH)
    assert np.isfinite(deep).any()
    assert np.nanmin(deep) > 0.0 and np.nanmax(deep) < 0.10
    assert not list(hidden_points(shown(), WRISTS, FIRST, SURE))


def test_a_body_too_far_back_is_drawn_up_to_what_was_measured():
    away, right = pushed(0.4), np.array([False, True])
    assert abs(behind(away)[1] - behind(TRUTH)[1] - 0.4) < 0.03
    here = shown().at(away)
    (hidden,) = hidden_points(here, WRISTS, FIRST, right)
    rows = hidden.rows(here, WRISTS)
    assert hidden.index.tolist() == hidden.far.tolist() == [1] and len(rows) == 1
    sight = (WRIST - CAMERA.centre_world) / np.linalg.norm(WRIST - CAMERA.centre_world)
    np.testing.assert_allclose(rows.direction[0], sight, atol=1e-6)
    assert rows.residual[0] == pytest.approx(-(behind(away)[1] - 0.05), abs=1e-6)
    gradient = normal_equations(BODY, away, rows).gradient
    assert gradient[:3] @ sight < 0
    (again,) = hidden_points(here, WRISTS, FIRST, right)
    assert again.key == hidden.key
    nearer = here.at(pushed(0.3))  # the same match at another state: the target stays where it is
    assert hidden.rows(nearer, WRISTS).residual[0] == pytest.approx(rows.residual[0] + 0.1, abs=1e-6)


def test_where_nothing_was_measured_nothing_is_said():
    empty = np.zeros(CAMERA.size[::-1])
    away = pushed(1.0)
    assert np.isnan(behind(away, empty)).all()
    assert not list(hidden_points(shown(DepthFrame("depth", 0.0, empty)).at(away), WRISTS, FIRST, SURE))
    assert list(hidden_points(shown().at(away), WRISTS, FIRST, SURE))
    assert not list(hidden_points(shown().at(away, measurements=()), WRISTS, FIRST, SURE))


def test_only_cameras_of_the_same_side_count():
    def at(eye):
        T = np.array(CAMERA.T_world_camera)
        T[:3, 3] = eye
        return type(CAMERA)("other", CAMERA.size, CAMERA.matrix, T_camera_world=np.linalg.inv(T))

    near = CAMERA.centre_world + (0.05, 0.0, 0.0)
    across = 2 * WRIST - CAMERA.centre_world
    assert adjacent_cameras(CAMERA, [at(near), at(across)], WRIST) == [0]
    away = pushed(0.4)
    for eye, count in ((near, 1), (across, 0)):
        here = Scene(BODY, away, Rig((CAMERA, at(eye)))).at(away, measurements=shown().measurements)
        assert len(list(hidden_points(here, WRISTS, FIRST + 1, SURE))) == count


@pytest.mark.parametrize(("confidence", "against"), [(1.0, True), (0.5, False)])
def test_a_wrist_that_is_seen_speaks_against_a_body_that_hides_it(confidence, against):
    away = pushed(0.4)  # along the wrist's ray: its pixel stays
    uv = CAMERA.project(BODY.positions(away, WRISTS))
    frame = KeypointFrame("depth", 0.0, WRISTS.names, uv, np.full(2, confidence))
    here = shown().at(away)
    measurement = KeypointSensor(here.rig, {}, 4.0, geman_mcclure(), 0.03).prepare([frame], here)
    alone, both = (measurement.match(s, 0.03) for s in (here.at(away, measurements=()), here))
    assert np.allclose(alone.squares(here), 0.0)
    assert np.isinf(both.squares(here)[1]) == against
    assert len(both.rows(here)) == 1 + against and (both.key != alone.key) == against
    lost = both.evidence(here).lost[WRISTS.segments[1]]
    assert lost == against and not alone.evidence(here).lost[WRISTS.segments[1]]
    assert MIN_OCCLUDED_DEPTH < 0.4


def test_the_tracker_shows_keypoints_what_depth_images_saw():
    uv = CAMERA.project(BODY.positions(TRUTH, WRISTS))
    keypoints = KeypointFrame("depth", 0.0, WRISTS.names, uv, np.ones(2))
    for frames, count in (([keypoints, drawn()], 1), ([drawn(), keypoints], 1), ([keypoints], 0)):
        tracker = a_tracker(start=None, settings=TrackSettings(search=False))
        scene, measurements = tracker._scene_of(frames, pushed(0.4), 0.0)
        (match,) = (m.match(scene, 0.03) for m in measurements if isinstance(m, KeypointMeasurement))
        assert len(match.hidden) == count
