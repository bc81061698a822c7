"""The tracker of any mix of sensors: what it follows, what it finds, what it flags, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.fitting.tracking.movements import (
    BODY,
    RATE,
    SET,
    STILL,
    a_motion,
    a_rig,
    a_tracker,
    cloud_frame,
    depth_frame,
    images,
    is_finite,
    keypoint_frame,
    marker_frame,
    off,
    turned,
)

import kinefit
from kinefit.bodies import load_body
from kinefit.bodies.parts import PartJoint, box, with_part, with_surfaces, without_part
from kinefit.bodies.rendering import render_body
from kinefit.errors import BodyError, CalibrationError, KinefitError, ObservationError
from kinefit.fitting.tracking import recovery
from kinefit.fitting.tracking.tracker import FrameResult, Tracker
from kinefit.observations import DepthFrame, KeypointFrame, MarkerFrame, PointCloud
from kinefit.sensors.settings import TrackSettings

FEW = ("neck", "r_wrist", "l_ankle")
KINDS = {
    "depth": depth_frame,
    "keypoints": lambda i: keypoint_frame(i, "left"),
    "markers": lambda i: marker_frame(i, FEW),
}
S, D, N = len(BODY.tree.segments), len(BODY.tree.coordinates), BODY.tree.n_dofs


def followed(makers, count=24, every=1, **more):
    """Results and errors (F, L) [m] of a tracker that sees some frames of a recording."""
    tracker = a_tracker(**more)
    results = [tracker.update([make(i) for make in makers]) for i in range(0, count, every)]
    return results, np.array([off(r.state, i) for r, i in zip(results, range(0, count, every))])


@pytest.fixture(scope="module")
def alone():
    """Each kind of sensor by itself."""
    return {kind: followed([make]) for kind, make in KINDS.items()}


@pytest.fixture(scope="module")
def together():
    return followed(KINDS.values())


# What is followed


def test_depth_alone_is_followed(alone):
    results, error = alone["depth"]
    assert error.mean() < 0.03 and np.quantile(error, 0.95) < 0.05
    assert not any(r.lost.any() for r in results) and min(r.quality for r in results) > 0.8


def test_a_result_has_the_shapes_that_it_says(alone):
    for i, result in enumerate(alone["depth"][0]):
        assert isinstance(result, FrameResult) and result.time == i / RATE and result.iterations >= 1
        assert result.state.T_world_root.shape == (4, 4) and result.state.angles.shape == (D,)
        assert result.dof_std.shape == (N,) and result.joint_std.shape == (S, 3)
        for name, kind in (("segment_quality", float), ("lost", bool), ("hidden", bool)):
            value = getattr(result, name)
            assert value.shape == (S,) and value.dtype == kind
        assert is_finite(result) and (result.dof_std > 0).all()
        assert 0.0 <= result.segment_quality.min() <= result.quality <= result.segment_quality.max() <= 1.0


def test_sensors_of_all_kinds_together_are_better_than_each_alone(alone, together):
    mean = {kind: error.mean() for kind, (_, error) in alone.items()}
    assert together[1].mean() < 0.7 * min(mean.values())
    surest = min(r[-1].dof_std.sum() for r, _ in alone.values())
    assert together[0][-1].dof_std.sum() < surest and not together[0][-1].lost.any()


@pytest.mark.parametrize("ignored", KINDS)
def test_no_sensor_is_ignored(ignored, together):
    results, error = followed([make for kind, make in KINDS.items() if kind != ignored])
    assert error.mean() > together[1].mean()
    assert results[-1].dof_std.sum() > together[0][-1].dof_std.sum()


def test_the_order_of_sensors_does_not_matter(together):
    results, _ = followed(list(KINDS.values())[::-1], count=4)
    np.testing.assert_allclose(results[-1].state.angles, together[0][3].state.angles, atol=1e-6)


def test_a_sensor_that_is_inaccurate_hardly_pulls(alone):
    names = ("r_wrist", "l_wrist", "neck", "r_knee", "l_knee")
    wrong = [depth_frame, lambda i: marker_frame(i, names, shift=0.03)]
    told, _ = followed(wrong, count=9, sigma={"mocap": 0.5})
    trusted, _ = followed(wrong, count=9, sigma={"mocap": 0.005})
    points = BODY.landmarks

    def pulled(result):  # before the ninth frame, in which depth alone has an arm in two places
        before = BODY.positions(alone["depth"][0][8].state, points)
        return np.linalg.norm(BODY.positions(result.state, points) - before, axis=1).mean()

    assert pulled(told[-1]) < 0.005 and pulled(trusted[-1]) > 0.01


@pytest.mark.parametrize("on_body", [True, False])
def test_a_cloud_is_followed(on_body):
    results, error = followed([lambda i: replace(cloud_frame(i), on_body=on_body)], count=12)
    assert error.mean() < 0.01 and not results[-1].lost.any()


def test_a_cloud_of_one_segment_pulls_that_segment():
    tracker = a_tracker(start=None)
    tracker.start_at(turned(a_motion().state(8), elbow_flex_l=-25))
    wrist = BODY.landmarks.names.index("l_wrist")
    before = off(tracker.state, 8)[wrist]
    four = marker_frame(8, ("neck", "hip_centre", "r_hip", "l_shoulder"))
    result = tracker.update([cloud_frame(8, "forearm_l"), four])
    assert before > 0.08 and off(result.state, 8)[wrist] < 0.3 * before
    hidden = {name for name, h in zip(BODY.tree.segments, result.hidden) if h}
    assert "forearm_l" not in hidden and "shank_l" in hidden


# Starts


def test_nothing_is_told_before_a_start():
    tracker = a_tracker(start=None)
    assert tracker.update([depth_frame(0)]) is None and tracker.state is None


@pytest.mark.parametrize("kind", ["markers", "keypoints of two cameras", "depth"])
def test_a_start_with_no_pose(kind):
    names = ("neck", "r_wrist", "l_ankle", "r_hip", "l_hip", "r_elbow", "l_knee", "l_shoulder", "l_wrist", "r_ankle")
    frames = {
        "markers": [marker_frame(5, names)],
        "keypoints of two cameras": [keypoint_frame(5, "left"), keypoint_frame(5, "right")],
        "depth": [depth_frame(5)],
    }[kind]
    tracker = a_tracker(start=None, settings=TrackSettings())
    result = tracker.update(frames)
    assert result is not None and tracker.state is result.state
    assert np.median(off(result.state, 5)) < 0.05 and is_finite(result)


def test_too_few_markers_are_no_start():
    tracker = a_tracker(start=None, settings=TrackSettings())
    assert tracker.update([marker_frame(0, FEW)]) is None


# What is lost, hidden, found again


def behind_a_board(i, rows=slice(None)):
    depth = np.array(images()[i])
    depth[rows] = 0.8
    return DepthFrame("depth", i / RATE, depth)


def test_behind_a_board_a_body_is_hidden_and_not_lost_and_found_again():
    tracker = a_tracker()
    for i in range(6):
        tracker.update([depth_frame(i)])
    for i in range(6, 14):
        result = tracker.update([behind_a_board(i)])
        assert result.hidden.all() and not result.lost.any() and result.quality == 0.0 and is_finite(result)
    unsure = result.dof_std
    for i in range(14, 24):
        result = tracker.update([depth_frame(i)])
    assert not result.hidden.any() and not result.lost.any()
    assert off(result.state, 23).mean() < 0.03 and (unsure > result.dof_std).mean() > 0.8


def test_behind_a_counter_the_legs_are_hidden_and_the_rest_is_followed():
    tracker = a_tracker()
    lower = slice(68, None)  # rows of the image, from below the hips on
    for i in range(16):
        result = tracker.update([behind_a_board(i, lower)])
    hidden = {name for name, h in zip(BODY.tree.segments, result.hidden) if h}
    assert {"shank_l", "shank_r"} <= hidden and not {"head", "forearm_l", "forearm_r", "torso"} & hidden
    assert not result.lost.any()
    assert off(result.state, 15)[BODY.landmarks.names.index("r_wrist")] < 0.06


def test_a_limb_that_is_somewhere_else_is_sought_and_found():
    wrong = turned(a_motion().state(0), arm_add_l=-80, elbow_flex_l=60)
    wrist = BODY.landmarks.names.index("l_wrist")
    assert off(wrong, 0)[wrist] > 0.4
    found = {}
    for search in (True, False):
        tracker = a_tracker(start=None, settings=TrackSettings(search=search))
        tracker.start_at(wrong)
        tracker._prediction.start(wrong, np.full(N, 0.02))  # a tracker that has been sure for long
        for i in range(8):
            result = tracker.update([depth_frame(i)])
            if i == 0 and not search:
                assert result.lost[BODY.tree.segment("forearm_l")]
        found[search] = off(result.state, 7)[wrist]
    assert found[True] < 0.05 < 0.15 < found[False]


def test_a_track_backwards_seeks_as_often_as_one_forwards(monkeypatch):
    wrong, sought = turned(a_motion().state(9), arm_add_l=-80, elbow_flex_l=60), []
    monkeypatch.setattr(recovery.candidates, "find_limbs", lambda *_: sought.append(1) or [])
    tracker = a_tracker(start=None, settings=TrackSettings()).backwards(wrong)
    tracker._prediction.start(wrong, np.full(N, 0.02))
    for i in (9, 5, 1):
        tracker.update([depth_frame(i)])
    assert len(sought) == 3


def test_a_body_that_has_gone_is_lost():
    tracker = a_tracker(on_body=("depth",))
    empty = DepthFrame("depth", 0.0, np.full((120, 160), 4.0))
    result = tracker.update([empty])
    assert result.lost[0] and result.quality < 0.2 and (result.lost | result.hidden).all()


# Time


def test_dropped_frames_are_counted_and_gone_without():
    tracker = a_tracker()
    for i in (0, 1, 2, 5, 6, 10, 12):
        result = tracker.update([depth_frame(i)])
    assert tracker.dropped == 2 + 3 + 1 and tracker.late == 0
    assert off(result.state, 12).mean() < 0.03


def test_late_frames_are_left_out():
    tracker = a_tracker()
    for i in (0, 1, 2):
        result = tracker.update([depth_frame(i)])
    before = tracker.state
    for i in (1, 2):
        assert tracker.update([depth_frame(i)]) is result
    assert tracker.late == 2 and tracker.dropped == 0 and tracker.state is before
    assert tracker.update([depth_frame(3)]).time == 3 / RATE and tracker.late == 2


@pytest.mark.parametrize("jump", [-1000.0, 1000.0])
def test_a_clock_that_is_set_anew_does_no_harm(jump):
    tracker = a_tracker()
    for i in range(4):
        tracker.update([depth_frame(i)])
    for i in range(4, 8):
        frame = depth_frame(i)
        result = tracker.update([DepthFrame("depth", frame.time + jump, frame.depth)])
    assert off(result.state, 7).mean() < 0.03 and tracker.late == 0 and not result.lost.any()
    assert (tracker.dropped > 0) == (jump > 0)


def test_sensors_may_take_turns():
    tracker = a_tracker()
    for i in range(16):
        tracker.update([depth_frame(i)])
        other = keypoint_frame(i, "left")
        result = tracker.update([replace(other, time=other.time + 0.4 / RATE)])
        assert is_finite(result)
    assert tracker.dropped == tracker.late == 0
    assert off(result.state, 15).mean() < 0.03


def test_a_time_without_frames_goes_on_by_itself():
    tracker = a_tracker()
    for i in range(3):
        tracker.update([depth_frame(i)])
    result = tracker.update([], time=3 / RATE)
    assert result.hidden.all() and off(result.state, 3).mean() < 0.04


# Bodies that change


def crate(body):
    """A body that holds a box in its right hand, on a joint."""
    joint = PartJoint(at=(0.0, -0.25, 0.0), coordinates=("swing",), axes=((0.0, 0.0, 1.0),), spread=(0.5,))
    return with_part(body, "crate", parent="forearm_r", surfaces=box((0.3, 0.2, 0.2)), joint=joint)


def drawn(body, state, i):
    depth = render_body(body, state, a_rig()["depth"]).depth
    return DepthFrame("depth", i / RATE, np.where(np.isfinite(depth), depth, 4.0))


def test_a_box_is_taken_and_put_down():
    tracker, more = a_tracker(on_body=("depth",)), crate(BODY)
    truth = a_motion().state(0)
    with_box = kinefit.BodyState(truth.T_world_root, np.append(truth.angles, 0.3))
    tracker.update([drawn(BODY, truth, 0)])
    tracker.change_body(more)
    assert off(tracker.state, 0, body=more).mean() < 0.02
    for i in range(1, 8):
        result = tracker.update([drawn(more, with_box, i)])
    assert result.dof_std.shape == (N + 1,) and result.lost.shape == (S + 1,)
    assert abs(result.state.angles[-1] - 0.3) < 0.1 and not result.lost.any()
    tracker.change_body(BODY)  # while the box is in the image
    result = tracker.update([drawn(more, with_box, 8)])
    assert result.dof_std.shape == (N,) and off(result.state, 0).mean() < 0.03


def test_a_segment_goes_while_it_is_observed():
    tracker, less = a_tracker(on_body=("depth",)), without_part(BODY, "forearm_l")
    truth = a_motion().state(0)
    tracker.update([drawn(BODY, truth, 0)])
    tracker.change_body(less)
    points = less.landmarks
    assert "l_wrist" not in points.names
    for i in range(1, 4):
        result = tracker.update([drawn(BODY, truth, i), replace(marker_frame(0, FEW + ("l_wrist",)), time=i / RATE)])
    there = BODY.positions(truth, BODY.landmarks.select(points.names))
    assert np.linalg.norm(less.positions(result.state, points) - there, axis=1).mean() < 0.03


def test_a_size_and_a_surface_may_change():
    tracker = a_tracker(on_body=("depth",))
    truth, larger = a_motion().state(0), BODY.scaled(np.full(len(BODY.scale_groups), 1.04))
    tracker.update([drawn(BODY, truth, 0)])
    for changed in (larger, with_surfaces(BODY, "head", box((0.2, 0.25, 0.2), (0.0, 0.1, 0.0)))):
        tracker.change_body(changed)
        first = tracker._time * RATE
        for i in range(1, 5):
            result = tracker.update([drawn(changed, truth, first + i)])
        error = changed.positions(result.state, changed.landmarks) - changed.positions(truth, changed.landmarks)
        assert np.linalg.norm(error, axis=1).mean() < 0.02 and not result.lost.any()


def test_a_body_may_change_before_a_start():
    tracker = a_tracker(start=None)
    tracker.change_body(crate(BODY))
    assert tracker.state is None and tracker.body.tree.segments[-1] == "crate"


# Nothing seen, nonsense seen, wrong use


def nothing(kind):
    names = BODY.keypoints(SET).names
    return {
        "zeros": DepthFrame("depth", 0.1, np.zeros((120, 160))),
        "nan": DepthFrame("depth", 0.1, np.full((120, 160), np.nan)),
        "cloud": PointCloud("scan", 0.1, np.zeros((0, 3)), on_body=True),
        "cloud of a segment": PointCloud("scan", 0.1, np.full((5, 3), np.nan), segment="head"),
        "keypoints": KeypointFrame("left", 0.1, names, np.full((len(names), 2), np.nan), np.ones(len(names)), SET),
        "unknown names": KeypointFrame("left", 0.1, ("tail",), np.ones((1, 2)), np.ones(1), SET),
        "markers": MarkerFrame("mocap", 0.1, FEW, np.full((3, 3), np.nan)),
    }[kind]


@pytest.mark.parametrize(
    "kind", ["zeros", "nan", "cloud", "cloud of a segment", "keypoints", "unknown names", "markers"]
)
@pytest.mark.parametrize("search", [False, True])
def test_nothing_measured_is_nothing_known(kind, search):
    tracker = a_tracker(settings=TrackSettings(search=search))
    result = tracker.update([nothing(kind)])
    assert is_finite(result) and result.quality == 0.0 and result.hidden.all() and not result.lost.any()
    assert off(result.state, 0).mean() < 0.02
    assert a_tracker(start=None, settings=TrackSettings(search=search)).update([nothing(kind)]) is None


WRONG = [
    ("millimetres", ObservationError, lambda: [DepthFrame("depth", 0.0, 1000.0 * images()[0])]),
    ("have \\(80, 60\\)", ObservationError, lambda: [DepthFrame("depth", 0.0, np.ones((60, 80)))]),
    ("depth2", CalibrationError, lambda: [DepthFrame("depth2", 0.0, np.ones((120, 160)))]),
    ("middle", CalibrationError, lambda: [replace(keypoint_frame(0, "left"), sensor="middle")]),
    ("COCO_99", BodyError, lambda: [replace(keypoint_frame(0, "left"), keypoint_set="COCO_99")]),
    ("marker set", BodyError, lambda: [replace(marker_frame(0, FEW), marker_set="plug-in")]),
    ("tail", BodyError, lambda: [PointCloud("scan", 0.0, np.zeros((1, 3)), segment="tail")]),
    ("viewpoint", ObservationError, lambda: [PointCloud("scan", 0.0, np.zeros((1, 3)), viewpoint=(0, np.nan, 0))]),
    ("no frame", ObservationError, list),
    ("not finite", ObservationError, lambda: [replace(marker_frame(0, FEW), time=np.nan)]),
    ("not finite", ObservationError, lambda: [replace(marker_frame(0, FEW), time=np.inf), depth_frame(0)]),
    ("a ndarray is not a frame", ObservationError, lambda: [images()[0]]),
]


@pytest.mark.parametrize(("says", "kind", "frames"), WRONG, ids=[f"{w[0]}-{k}" for k, w in enumerate(WRONG)])
def test_wrong_frames_are_told_and_do_no_harm(says, kind, frames):
    tracker = a_tracker()
    with pytest.raises(kind, match=says):
        tracker.update(frames())
    result = tracker.update([depth_frame(0)])
    assert tracker.late == 0 and off(result.state, 0).mean() < 0.03


@pytest.mark.parametrize("accuracy", [0.0, -0.01, np.nan, np.inf])
def test_an_accuracy_that_is_none_is_told(accuracy):
    with pytest.raises(ObservationError, match="sigma is not positive: depth"):
        Tracker(BODY, a_rig(), sigma={"depth": accuracy}, up="y")


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf])
def test_a_rate_that_is_none_is_told(rate):
    with pytest.raises(ObservationError, match="Hz"):
        Tracker(BODY, a_rig(), rate=rate, up="y")


def test_depth_needs_surfaces_and_markers_do_not():
    bare = replace(BODY, surfaces=())
    tracker = Tracker(bare, a_rig(), settings=STILL, up="y")
    tracker.start_at(a_motion().state(0))
    for frame in (depth_frame(0), cloud_frame(0)):
        with pytest.raises(BodyError, match="no surfaces"):
            tracker.update([frame])
    tracker = Tracker(bare, a_rig(), settings=STILL, up="y")
    tracker.start_at(a_motion().state(0))
    assert off(tracker.update([marker_frame(0, FEW)]).state, 0).mean() < 0.01


def test_a_state_of_another_body_is_told():
    with pytest.raises(BodyError, match="angles"):
        a_tracker(start=None).start_at(load_body("arm").default_state())


NUMBERS = st.sampled_from((0.0, 1.0, -1.0, 2.7, 1e-30, 1e6, -1e6, 1e30, np.nan, np.inf, -np.inf))


@st.composite
def garbage(draw, time):
    kind = draw(st.sampled_from(("depth", "cloud", "on_body", "segment", "keypoints", "markers")))
    count = draw(st.integers(0, 12))
    x = draw(arrays(float, (count, 3), elements=NUMBERS | st.floats(-5, 5)))
    if kind == "depth":
        depths = st.sampled_from((0.0, 0.3, 2.5, 3.0, 50.0, -1.0, np.nan, np.inf))
        few = draw(arrays(np.float32, (12, 16), elements=depths))
        return DepthFrame("depth", time, np.kron(few, np.ones((10, 10))))
    if kind == "keypoints":
        names = BODY.keypoints(SET).names[:count]
        trust = draw(arrays(float, count, elements=st.sampled_from((0.0, 0.5, 1.0, np.nan, -1.0, np.inf))))
        return KeypointFrame("left", time, names, x[:, :2] * 100, trust, SET)
    if kind == "markers":
        return MarkerFrame("mocap", time, BODY.landmarks.names[:count], x)
    eye = draw(st.none() | st.just((0.0, 1.0, 0.0)))
    return PointCloud("scan", time, x, eye, on_body=kind == "on_body", segment="head" if kind == "segment" else None)


@settings(max_examples=25)
@given(st.data())
def test_no_garbage_makes_a_result_that_is_not_finite(data):
    tracker = a_tracker()
    for i in range(3):
        drawn = [data.draw(garbage(i / RATE)) for _ in range(data.draw(st.integers(1, 3)))]
        result = tracker.update(list({f.sensor: f for f in drawn}.values()))  # two of one sensor are refused
        assert is_finite(result)
        assert (result.dof_std > 0).all() and ((result.segment_quality >= 0) & (result.segment_quality <= 1)).all()
    R = result.state.T_world_root[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)


@settings(max_examples=2)
@given(st.data())
def test_no_garbage_stops_a_search(data):
    tracker = a_tracker(start=None, settings=TrackSettings())
    try:
        result = tracker.update(list({f.sensor: f for f in (data.draw(garbage(0.0)) for _ in range(2))}.values()))
    except KinefitError:
        raise AssertionError("a search that finds nothing is no error") from None
    assert result is None or is_finite(result)


def test_public_names():
    assert kinefit.Tracker is Tracker and kinefit.FrameResult is FrameResult
    assert kinefit.TrackSettings is TrackSettings
