"""Where a body may be when nothing tells from before; where a limb may be that was lost."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.fitting.tracking.movements import (
    BODY,
    RATE,
    a_motion,
    a_rig,
    cloud_frame,
    keypoint_frame,
    marker_frame,
    off,
    turned,
)

from kinefit.bodies.rendering import render_body
from kinefit.errors import CalibrationError
from kinefit.fitting.frame.routing import Sensors
from kinefit.fitting.initialization.candidates import (
    LEAP,
    MIN_GAIN,
    MIN_LOST_GAIN,
    dofs_of_limbs,
    find_limbs,
    starts_from_points,
    starts_from_views,
)
from kinefit.fitting.initialization.depth_search import PostureSearch
from kinefit.observations import DepthFrame, PointCloud
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_view import camera_at, view_of

UP = np.array([0.0, 1.0, 0.0])
TRUTH = a_motion().state(0)
TEN = ("neck", "r_wrist", "l_ankle", "r_hip", "l_hip", "r_elbow", "l_knee", "l_shoulder", "l_wrist", "r_ankle")
FEW = ("neck", "r_wrist", "l_ankle", "r_hip", "l_hip")


def starts(*frames, count=3):
    scene = Scene(BODY, BODY.default_state(np.eye(4)), a_rig())
    known = Sensors(a_rig(), RATE, {}, TrackSettings()).measurements(frames, scene, points=True)
    found = starts_from_points(BODY, known, scene, np.array([0.0, 1.0, 0.0]))
    return found or [[], *starts_from_views(scene, frames, UP, known, count)][-1]


def test_markers_tell_by_themselves():
    (state,) = starts(marker_frame(0, TEN))
    at = [BODY.landmarks.names.index(name) for name in TEN]
    assert off(state, 0)[at].max() < 0.02


def test_keypoints_of_two_cameras_tell_by_themselves():
    (state,) = starts(keypoint_frame(0, "left"), keypoint_frame(0, "right"))
    assert np.median(off(state, 0)) < 0.03


def test_markers_and_keypoints_of_two_cameras_count_together():
    def few(camera):
        frame = keypoint_frame(0, camera)
        keep = [frame.names.index(n) for n in ("LWrist", "LElbow", "LShoulder")]
        names = tuple(frame.names[k] for k in keep)
        return replace(frame, names=names, uv=frame.uv[keep], confidence=frame.confidence[keep])

    assert starts(marker_frame(0, FEW)) == [] and starts(few("left"), few("right")) == []
    (state,) = starts(marker_frame(0, FEW), few("left"), few("right"))
    assert off(state, 0)[BODY.landmarks.names.index("l_wrist")] < 0.05


@pytest.mark.parametrize("camera", ["left", "right"])
def test_keypoints_of_one_camera_do_not_tell(camera):
    assert starts(keypoint_frame(0, camera)) == []


def test_nothing_of_a_persons_size_is_no_start():
    wall = DepthFrame("depth", 0.0, np.full((120, 160), 4.0))
    for frame in (
        wall,
        DepthFrame("depth", 0.0, np.zeros((120, 160))),
        PointCloud("scan", 0.0, np.zeros((0, 3)), on_body=True),
        PointCloud("scan", 0.0, np.zeros((3, 3)), on_body=True),
        PointCloud("scan", 0.0, cloud_frame(0).points),  # of whatever is there
        cloud_frame(0, "forearm_l"),
    ):
        assert starts(frame) == []


def test_a_cloud_of_the_body_is_searched():
    found = starts(cloud_frame(0, every=1), count=1)
    assert len(found) == 1 and np.median(off(found[0], 0)) < 0.06


def test_a_camera_that_is_not_there_is_told():
    with pytest.raises(CalibrationError, match="depth2"):
        starts(DepthFrame("depth2", 0.0, np.zeros((120, 160))))


# Limbs


@pytest.fixture(scope="module")
def search():
    camera = a_rig()["depth"]
    depth = render_body(BODY, TRUTH, camera).depth
    person = np.isfinite(depth)
    return PostureSearch(BODY, view_of(np.where(person, depth, 0.0), person, camera), UP, np.random.default_rng(0))


def segments(*names):
    return np.isin(BODY.tree.segments, names)


def test_the_dofs_of_a_limb_are_those_of_all_of_it():
    free = dofs_of_limbs(BODY, segments("forearm_r"))
    names = np.array(BODY.dof_names)[free]
    assert set(names) == {"arm_flex_r", "arm_add_r", "arm_rot_r", "elbow_flex_r"}
    assert not dofs_of_limbs(BODY, segments()).any() and not dofs_of_limbs(BODY, segments("torso"))[:6].any()


def test_a_limb_that_is_somewhere_else_is_found(search):
    wrong, wrist = turned(TRUTH, arm_add_l=-80, elbow_flex_l=60), BODY.landmarks.names.index("l_wrist")
    found = find_limbs(search, wrong, segments("forearm_l", "upperarm_l"), segments())
    assert off(wrong, 0)[wrist] > 0.4 and min(off(state, 0)[wrist] for state, _ in found) < 0.08
    now = search.score.of(wrong)
    for state, least in found:
        assert least in (MIN_GAIN, LEAP) and search.score.of(state) > now + least
        assert (state.angles >= BODY.tree.lower - 1e-9).all() and (state.angles <= BODY.tree.upper + 1e-9).all()


def test_the_same_is_found_again(search):
    wrong, seek = turned(TRUTH, arm_add_l=-80), segments("forearm_l")
    one, other = (
        find_limbs(PostureSearch(BODY, search.view, UP, np.random.default_rng(0)), wrong, seek, seek, tries=40)
        for _ in range(2)
    )
    assert [s.angles.tolist() for s, _ in one] == [s.angles.tolist() for s, _ in other]


def test_a_limb_that_is_where_it_is_does_not_leap(search):
    for state, least in find_limbs(search, TRUTH, segments("forearm_l"), segments(), tries=60):
        assert least == MIN_GAIN and off(state, 0).max() < 0.1


@pytest.mark.parametrize("side", ["l", "r"])
def test_an_arm_stretched_at_the_camera_is_found(side):
    hanging, camera = BODY.default_state(TRUTH.T_world_root), a_rig()["depth"]
    truth = turned(hanging, **{f"arm_flex_{side}": 85, f"elbow_flex_{side}": 10})
    depth, wrist = render_body(BODY, truth, camera).depth, BODY.landmarks.names.index(f"{side}_wrist")
    person = np.isfinite(depth)
    view = view_of(np.where(person, depth, 0.0), person, camera)
    for seed in (0, 1):
        search = PostureSearch(BODY, view, UP, np.random.default_rng(seed))
        limb = next(limb for limb in search.limbs if BODY.tree.segment(f"forearm_{side}") in limb)
        found, _ = search.limb(hanging, limb, None, search.ends(hanging), 200)[0]
        one, other = (BODY.positions(state, BODY.landmarks)[wrist] for state in (found, truth))
        assert np.linalg.norm(one - other) < 0.05


def test_a_lost_limb_needs_less(search):
    wrong = turned(TRUTH, arm_add_l=-80, elbow_flex_l=60)
    for lost, least in ((segments("forearm_l"), MIN_LOST_GAIN), (segments("forearm_r"), LEAP)):
        found = find_limbs(search, wrong, segments("forearm_l", "upperarm_l"), lost)
        assert least in {one for _, one in found}
        assert {one for _, one in found} <= {MIN_GAIN, least}


def test_a_trunk_that_is_sought_is_no_limb(search):
    for state, least in find_limbs(search, TRUTH, segments("thorax"), segments(), tries=10):
        assert search.score.of(state) > search.score.of(TRUTH) + least


# Cameras made up for a cloud


@given(arrays(float, (2, 3), elements=st.floats(-5, 5)), st.booleans())
def test_a_made_up_camera_looks_at_its_points(places, told):
    middle, eye = places
    x = middle + 0.2 * np.random.default_rng(0).normal(size=(31, 3))
    camera = camera_at(x, eye if told else None)
    T = camera.T_camera_world
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    if not told:
        eye = np.median(x, axis=0) - [0, 0, 3]
    np.testing.assert_allclose(camera.centre_world, eye, atol=1e-9)
    if np.linalg.norm(eye - np.median(x, axis=0)) > 0.01:
        assert np.linalg.det(T[:3, :3]) > 0
        np.testing.assert_allclose(camera.project(np.median(x, axis=0)[None])[0], 319.5, atol=1e-6)
