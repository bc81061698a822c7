"""What each kind of sensor turns into: rows, evidence, views; and how evidence adds up."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from kinefit.sensors.measurements import KeypointMeasurement, MarkerMeasurement, of_points
from tests.tracking.movements import (
    BODY,
    SENSOR,
    SET,
    a_motion,
    a_rig,
    cloud_frame,
    images,
    keypoint_frame,
    marker_frame,
    turned,
)

from kinefit.bodies import PointSet
from kinefit.errors import BodyError, ObservationError
from kinefit.observations import DepthFrame, KeypointFrame, MarkerFrame, PointCloud
from kinefit.rendering import render_body
from kinefit.sensors.background import Background
from kinefit.sensors.depth_image import DepthMeasurement
from kinefit.sensors.evidence import BELIEVED, SHOWN, Evidence
from kinefit.sensors.point_cloud import CloudMeasurement
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surface import Surface
from kinefit.solvers.equations import normal_equations
from kinefit.solvers.least_squares import gauss_newton, levenberg_marquardt

TRUTH, SETTINGS = a_motion().state(0), TrackSettings()
S = len(BODY.tree.segments)
WALL = 4.0


@pytest.fixture(scope="module")
def surface():
    return Surface(BODY, SETTINGS.samples)


def on_depth(surface, depth=None, state=TRUTH, sigma=0.01, settings=SETTINGS, background=None):
    depth = images()[0] if depth is None else depth
    frame = DepthFrame("depth", 0.0, depth)
    return DepthMeasurement(frame, a_rig()["depth"], surface, surface.posed(state), sigma, settings, background)


def clean():
    """(H, W) [m] the body before a wall, without error."""
    depth = render_body(BODY, TRUTH, a_rig()["depth"]).depth
    return np.where(np.isfinite(depth), depth, WALL)


def cost(rows, state):
    return sum(normal_equations(BODY, state, r).cost for r in rows)


def solved(make, state, count=12):
    for k in range(count):
        state = gauss_newton(BODY, state, make(state, 0.15 if k < count // 2 else 0.03), damping=1e-3).state
    return state


def apart(a, b, names=None):
    points = BODY.landmarks if names is None else BODY.landmarks.select(names)
    return np.linalg.norm(BODY.positions(a, points) - BODY.positions(b, points), axis=1)


# Depth


def test_depth_rows_pull_a_body_back(surface):
    wrong = turned(TRUTH, arm_add_l=-12, hip_flexion_r=8).retract(np.array([0.03, 0.02, -0.03] + [0.0] * 22))
    measured = on_depth(surface, clean(), wrong)
    found = solved(measured.rows, wrong)
    assert apart(wrong, TRUTH).mean() > 0.03 and apart(found, TRUTH).mean() < 0.01


def test_depth_counts_as_many_patches_as_there_are_not_pixels(surface):
    """Four times the pixels tell what the few told: their errors are alike within a patch."""
    camera = a_rig()["depth"]
    fine = replace(SENSOR, size=(320, 240), focal=288.0).camera(camera.T_camera_world, name="depth")
    depth = np.where(np.isfinite(d := render_body(BODY, TRUTH, fine).depth), d, WALL)
    few = on_depth(surface, clean())
    many = DepthMeasurement(DepthFrame("depth", 0.0, depth), fine, surface, surface.posed(TRUTH), 0.01, SETTINGS)
    told = [sum(normal_equations(BODY, TRUTH, r).matrix.trace() for r in m.rows(TRUTH, 0.03)) for m in (few, many)]
    assert told[1] == pytest.approx(told[0], rel=0.25)


def test_a_sensor_of_half_the_accuracy_counts_a_quarter(surface):
    rows = [on_depth(surface, clean(), sigma=s).rows(TRUTH, 0.1)[0] for s in (0.004, 0.008)]
    told = [normal_equations(BODY, TRUTH, r).matrix.trace() for r in rows]
    assert told[0] == pytest.approx(4.0 * told[1], rel=0.05)


def test_depth_evidence_is_for_what_is_there_and_against_what_is_not(surface):
    measured = on_depth(surface, clean())
    there, gone = measured.evidence(TRUTH), measured.evidence(turned(TRUTH, arm_add_l=-70, elbow_flex_l=60))
    arm = BODY.tree.segment("forearm_l")
    assert not there.lost.any() and there.quality[arm] > 0.9
    assert gone.lost[arm] and not gone.lost[0]


def test_background_is_neither_drawn_to_nor_searched(surface):
    table = clean()
    table[60:80] = np.minimum(table[60:80], 2.6)
    background = Background(a_rig()["depth"], 0.01, 5)
    background.know(np.where(np.arange(120)[:, None] // 20 == 3, 2.6, np.full((120, 160), WALL)))
    bare, known = on_depth(surface, table), on_depth(surface, table, background=background)
    assert known._points.shape[1] < bare._points.shape[1]
    assert (known._depth[60:80] < 0).mean() > 0.3 and (known._depth[:, :] != 0).all()
    seen = render_body(BODY, TRUTH, a_rig()["depth"]).depth
    front = np.isfinite(seen) & (seen < 2.5)
    assert (known._depth[front] > 0).all()
    assert known.view() is not None


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_an_image_of_nothing_makes_no_rows_that_pull(surface, nothing):
    measured = on_depth(surface, np.full((120, 160), nothing))
    rows = measured.rows(TRUTH, 0.1)
    assert cost(rows, TRUTH) == 0.0 and measured.view() is None
    told = measured.evidence(TRUTH)
    assert told.hidden.all() and not told.lost.any() and not told.quality.any()


def test_a_body_at_or_behind_the_camera_does_no_harm(surface):
    camera = a_rig()["depth"]
    for behind in (0.0, 3.0):
        T = np.array(TRUTH.T_world_root)
        T[:3, 3] = camera.centre_world - behind * camera.T_camera_world[2, :3]
        state = replace(TRUTH, T_world_root=T)
        measured = on_depth(surface, clean(), state)
        assert all(np.isfinite(r.data).all() for r in measured.rows(state, 0.1))
        assert np.isfinite(measured.evidence(state).quality).all()


def test_an_image_of_another_size_is_told(surface):
    with pytest.raises(ObservationError, match=r"\(80, 60\) px, its camera has \(160, 120\)"):
        on_depth(surface, np.ones((60, 80)))


# Clouds


def on_cloud(surface, frame, state=TRUTH):
    return CloudMeasurement(frame, surface, surface.posed(state), 0.01, SETTINGS)


def test_a_cloud_pulls_a_body_back(surface):
    wrong = turned(TRUTH, arm_add_l=-12)
    found = solved(on_cloud(surface, cloud_frame(0), wrong).rows, wrong)
    assert apart(found, TRUTH, ("l_wrist",)) < 0.01 < 0.05 < apart(wrong, TRUTH, ("l_wrist",))


def test_a_cloud_of_one_segment_makes_rows_of_that_one(surface):
    measured = on_cloud(surface, cloud_frame(0, "forearm_l"))
    (rows,) = measured.rows(TRUTH, 0.1)
    assert len(rows) > 5 and (rows.segment == BODY.tree.segment("forearm_l")).all()
    told = measured.evidence(TRUTH)
    assert np.flatnonzero(~told.hidden).tolist() == [BODY.tree.segment("forearm_l")]
    assert measured.evidence(turned(TRUTH, arm_add_l=-60)).lost[BODY.tree.segment("forearm_l")]


def test_only_a_cloud_of_something_is_gated(surface):
    x = np.vstack([cloud_frame(0).points, np.tile([0.0, 1.0, 30.0], (50, 1))])
    some, body = (on_cloud(surface, PointCloud("scan", 0.0, x, on_body=known)) for known in (False, True))
    assert len(body._points) == len(some._points) + 50 == len(x)


def test_an_empty_cloud_tells_nothing(surface):
    for frame in (PointCloud("scan", 0.0, np.zeros((0, 3))), PointCloud("scan", 0.0, np.zeros((0, 3)), segment="head")):
        measured = on_cloud(surface, frame)
        assert len(measured.rows(TRUTH, 0.1)[0]) == 0 and measured.view() is None
        assert measured.evidence(TRUTH).hidden.all()


def test_a_view_of_a_cloud_shows_it(surface):
    view = on_cloud(surface, cloud_frame(0)).view()
    assert view is not None and on_depth(surface).view() is not None


# Keypoints and markers


def test_keypoints_pull_a_body_back():
    wrong = turned(TRUTH, arm_add_l=-12)
    both = [KeypointMeasurement(keypoint_frame(0, c, noise=0.0), BODY, a_rig(), 2.0) for c in ("left", "right")]
    found = solved(lambda s, bound: [r for m in both for r in m.rows(s, bound)], wrong)
    assert apart(found, TRUTH, ("l_wrist",)) < 1e-3 and both[0].square(TRUTH).max() < 1e-9
    assert both[0].square(wrong).max() > 9.0 and both[0].view() is None


def test_a_keypoint_counts_by_its_confidence():
    frame = keypoint_frame(0, "left")
    half = replace(frame, confidence=0.5 * frame.confidence)
    told = [KeypointMeasurement(f, BODY, a_rig(), 2.0).square(TRUTH) for f in (frame, half)]
    np.testing.assert_allclose(told[1], 0.5 * told[0])


def test_what_was_not_seen_is_left_out():
    frame = keypoint_frame(0, "left")
    uv, trust = np.array(frame.uv), np.array(frame.confidence)
    uv[0], trust[1], trust[2], trust[3] = np.nan, 0.0, np.nan, np.inf
    names = (*frame.names[:-1], "tail")
    measured = KeypointMeasurement(KeypointFrame("left", 0.0, names, uv, trust, SET), BODY, a_rig(), 2.0)
    assert measured.points.names == frame.names[4:-1] and len(measured.rows(TRUTH, 0.0)[0]) == 2 * len(frame.names) - 10
    x = np.array([[0.0, 1, 2], [np.nan, 1, 2], [0, 1, 2]])
    markers = MarkerFrame("mocap", 0.0, ("neck", "r_hip", "tail"), x)
    assert MarkerMeasurement(markers, BODY, 0.01).points.names == ("neck",)


def test_markers_pull_a_body_back():
    names = ("l_wrist", "l_elbow", "l_shoulder", "neck", "r_hip")
    measured = MarkerMeasurement(marker_frame(0, names, noise=0.0), BODY, 0.005)
    wrong = turned(TRUTH, arm_add_l=-12)
    found = solved(measured.rows, wrong)
    assert apart(found, TRUTH, names).max() < 1e-3 and measured.view() is None
    gap = np.linalg.norm(measured.x_world - BODY.positions(wrong, measured.points), axis=1)
    np.testing.assert_allclose(measured.square(wrong), (gap / 0.005) ** 2)


def test_sets_that_are_not_there_are_told():
    with pytest.raises(BodyError, match="marker set"):
        MarkerMeasurement(replace(marker_frame(0, ("neck",)), marker_set="plug-in"), BODY, 0.01)
    with pytest.raises(BodyError, match="COCO_17"):
        KeypointMeasurement(replace(keypoint_frame(0, "left"), keypoint_set="COCO"), BODY, a_rig(), 2.0)


def test_both_solvers_find_the_same_from_all_sensors(surface):
    measured = [KeypointMeasurement(keypoint_frame(0, c), BODY, a_rig(), 2.0) for c in ("left", "right")]
    measured.append(MarkerMeasurement(marker_frame(0, ("neck", "r_hip", "l_hip")), BODY, 0.005))

    def rows(state):
        return [r for m in measured for r in m.rows(state, 0.03)]

    start = turned(TRUTH, arm_add_l=-5)
    one = start
    for _ in range(30):
        one = gauss_newton(BODY, one, rows(one), damping=1e-6).state
    other = levenberg_marquardt(BODY, start, rows).state
    assert cost(rows(one), one) == pytest.approx(cost(rows(other), other), rel=1e-4)
    assert apart(one, other).max() < 2e-3


# Evidence


def test_a_point_speaks_for_its_segment_and_at_a_joint_for_both():
    elbow, arm = BODY.tree.segment("forearm_l"), BODY.tree.segment("upperarm_l")
    points = PointSet(("joint", "middle"), np.array([elbow, elbow]), np.array([[0.0, 0, 0], [0, -0.15, 0]]))
    told = of_points(BODY, points, np.array([1.0, 100.0]))
    assert told.agreeing[[elbow, arm]].tolist() == [SHOWN, SHOWN]
    assert told.contrary[[elbow, arm]].tolist() == [SHOWN, 0.0]
    assert told.agreeing.sum() == 2 * SHOWN and told.contrary.sum() == SHOWN
    root = of_points(BODY, PointSet(("root",), np.array([0]), np.zeros((1, 3))), np.array([8.9]))
    assert root.agreeing[0] == root.agreeing.sum() == SHOWN


def test_evidence_at_its_bounds():
    told = Evidence(np.array([0.0, SHOWN, 0.1, 0.5, 0.49, 3.0]), np.array([0.0, 0.0, 0.1, 0.5, 0.51, 1.0]))
    assert told.hidden.tolist() == [True, False, True, False, False, False]
    assert told.lost.tolist() == [False, False, False, False, True, False]
    np.testing.assert_allclose(told.quality, [0.0, 1.0, 0.5, 0.5, 0.49, 0.75])


AMOUNTS = arrays(float, (2, S), elements=st.floats(0, 10))


@given(AMOUNTS, AMOUNTS, AMOUNTS)
def test_evidence_adds_up(a, b, c):
    a, b, c = (Evidence(*x) for x in (a, b, c))
    one, other = (a + b) + c, c + (b + a)
    np.testing.assert_allclose(one.agreeing, other.agreeing)
    np.testing.assert_allclose(one.contrary, other.contrary)
    same = a + Evidence.none(S)
    assert np.array_equal(same.agreeing, a.agreeing) and np.array_equal(same.contrary, a.contrary)
    assert not (one.hidden & ~a.hidden).any() and not (one.hidden & one.lost).any()
    assert ((one.quality >= 0) & (one.quality <= 1)).all()
    assert np.array_equal(one.lost, ~one.hidden & (one.quality < BELIEVED))
