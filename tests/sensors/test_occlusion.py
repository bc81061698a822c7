"""Keypoints that are seen, before what a depth camera beside theirs has measured."""

import numpy as np
import pytest
from kinefit.sensors.measurements import KeypointMeasurement
from kinefit.tracking.fused_fit import FusedFit
from tests.tracking.movements import BODY, RATE, a_motion, a_rig

from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame, KeypointFrame
from kinefit.rendering import render_body
from kinefit.sensors.occlusion import THICK, InSight, beside
from kinefit.sensors.settings import TrackSettings
from kinefit.solvers.equations import normal_equations

TRUTH = a_motion().state(0)
CAMERA = a_rig()["depth"]
WRISTS = BODY.landmarks.select(("l_wrist", "r_wrist"))
SIGMA = 0.01


def drawn():
    """(H, W) [m] the body before nothing."""
    depth = render_body(BODY, TRUTH, CAMERA).depth
    return DepthFrame("depth", 0.0, np.where(np.isfinite(depth), depth, 0.0))


def pushed(distance):
    """The truth, moved away from the camera."""
    T = np.array(TRUTH.T_world_root)
    sight = WRIST - CAMERA.centre_world
    T[:3, 3] += distance * sight / np.linalg.norm(sight)
    return type(TRUTH)(T, TRUTH.angles)


WRIST = BODY.positions(TRUTH, WRISTS)[1]


def test_at_the_truth_points_lie_just_below_the_skin():
    behind = InSight(BODY, WRISTS, drawn(), CAMERA, SIGMA).behind(TRUTH)
    assert np.isfinite(behind).any()
    assert np.nanmin(behind) > 0.0 and np.nanmax(behind) < 0.10
    assert len(InSight(BODY, WRISTS, drawn(), CAMERA, SIGMA).rows(TRUTH)) == 0


def test_a_body_too_far_back_is_drawn_up_to_what_was_measured():
    one = WRISTS.select(("r_wrist",))
    sight = InSight(BODY, one, drawn(), CAMERA, SIGMA)
    away = pushed(0.4)
    assert abs(sight.behind(away)[0] - sight.behind(TRUTH)[0] - 0.4) < 0.03
    rows = sight.rows(away)
    assert len(rows) == 1
    assert rows.residual[0] == pytest.approx(-(sight.behind(away)[0] - 0.05), abs=1e-6)
    gradient = normal_equations(BODY, away, rows).gradient
    assert gradient[3:6] @ (WRIST - CAMERA.centre_world) < 0 or gradient[:3] @ (WRIST - CAMERA.centre_world) < 0


def test_where_nothing_was_measured_nothing_is_said():
    empty = DepthFrame("depth", 0.0, np.zeros(CAMERA.size[::-1]))
    sight = InSight(BODY, WRISTS, empty, CAMERA, SIGMA)
    assert np.isnan(sight.behind(TRUTH)).all() and len(sight.rows(pushed(1.0))) == 0


def test_only_cameras_of_the_same_side_count():
    def at(eye):
        T = np.array(CAMERA.T_world_camera)
        T[:3, 3] = eye
        return type(CAMERA)("other", CAMERA.size, CAMERA.matrix, T_camera_world=np.linalg.inv(T))

    near = CAMERA.centre_world + (0.05, 0.0, 0.0)
    across = 2 * WRIST - CAMERA.centre_world
    assert beside(CAMERA, [at(near), at(across)], WRIST) == [0]


@pytest.mark.parametrize(("confidence", "against"), [(1.0, True), (0.5, False)])
def test_a_wrist_that_is_seen_speaks_against_a_body_that_hides_it(confidence, against):
    away = pushed(0.4)  # along the wrist's ray: its pixel stays
    uv = CAMERA.project(BODY.positions(away, WRISTS))
    frame = KeypointFrame("depth", 0.0, WRISTS.names, uv, np.full(2, confidence))
    alone = KeypointMeasurement(frame, BODY, Rig((CAMERA,)), 4.0)
    both = KeypointMeasurement(frame, BODY, Rig((CAMERA,)), 4.0, depth=(drawn(), CAMERA, SIGMA))
    assert np.allclose(alone.square(away), 0.0)
    assert np.isinf(both.square(away)[1]) == against
    lost = both.evidence(away).lost[WRISTS.segments[1]]
    assert lost == against and not alone.evidence(away).lost[WRISTS.segments[1]]
    assert THICK < 0.4


def test_the_fit_pairs_them():
    fit = FusedFit(BODY, a_rig(), RATE, {}, TrackSettings(), {})
    uv = CAMERA.project(BODY.positions(TRUTH, WRISTS))
    frames = [KeypointFrame("depth", 0.0, WRISTS.names, uv, np.ones(2)), drawn()]
    made = fit.measurements(frames, TRUTH)
    away = pushed(0.4)
    assert np.isinf(made[0].square(away)).any()
    assert np.isfinite(fit.measurements(frames[:1], TRUTH)[0].square(away)).all()
