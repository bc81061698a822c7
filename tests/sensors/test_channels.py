"""Channels: every keypoint of every camera as one flat list."""

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import load_body
from kinefit.errors import KinefitError, ObservationError
from kinefit.fitting.multiview.association import person_records
from kinefit.observations import Keypoints
from kinefit.observations.recordings import mirror_name
from kinefit.sensors.channels import exchange, fitted_pixels, joined, make_channels

BODY = load_body("humanoid")
RIG = rig_around((0.0, 0.0, 0.0), cameras=3)


def record(camera="cam1", keypoint_set="COCO_17", frames=3, people=2, extra=("halo",), seed=0):
    """A detector's random points, with one that the body does not have."""
    random = np.random.default_rng(seed)
    names = (*BODY.keypoints(keypoint_set).names, *extra)
    points = random.uniform(0, 900, (frames, people, len(names), 2))
    return Keypoints(camera, keypoint_set, names, 25.0, points, random.uniform(0.2, 1, points.shape[:3]))


@pytest.mark.parametrize(
    ("name", "other"),
    [("LKnee", "RKnee"), ("RBigToe", "LBigToe"), ("left_eye_inner", "right_eye_inner"), ("right_hip", "left_hip"),
     ("Nose", "Nose"), ("UpperNeck", "UpperNeck"), ("Root", "Root"), ("Lip", "Lip"), ("mouth_left", "mouth_right")],
)  # fmt: skip
def test_names_of_the_other_side(name, other):
    assert mirror_name(name) == other and mirror_name(other) == name


def test_every_catalogue_point_has_its_partner_in_the_set():
    for points in BODY.keypoint_sets.values():
        for name in points.names:
            assert mirror_name(name) in points.names and mirror_name(mirror_name(name)) == name


def test_every_measurement_becomes_a_channel():
    a, b = record("cam1"), record("cam3", "BODY_25B", seed=1)
    people = [np.array([0, 1, -1]), np.array([1, 1, 0])]
    channels = make_channels(BODY, RIG, person_records([a, b], people), [3.0, 7.0])
    k, m = len(BODY.keypoints("COCO_17")), len(BODY.keypoints("BODY_25B"))
    assert channels.uv.shape == (3, k + m, 2) and channels.sources == ("cam1", "cam3")
    assert channels.sets == {"COCO_17": slice(0, k), "BODY_25B": slice(k, k + m)}
    np.testing.assert_array_equal(channels.source, np.repeat([0, 1], [k, m]))
    np.testing.assert_array_equal(channels.camera, np.repeat([0, 2], [k, m]))
    np.testing.assert_array_equal(channels.sigma, np.repeat([3.0, 7.0], [k, m]))
    np.testing.assert_array_equal(channels.column, np.arange(k + m))
    assert "halo" not in channels.points.names
    for n in range(k):
        assert channels.points.names[channels.column[n]] == a.names[n]
        np.testing.assert_array_equal(channels.uv[:2, n], [a.points[0, 0, n], a.points[1, 1, n]])
        assert np.all(np.isnan(channels.uv[2, n])) and channels.confidence[2, n] == 0  # nobody chosen
    np.testing.assert_array_equal(channels.uv[:, k:], b.points[[0, 1, 2], [1, 1, 0], :m])


def test_partners_are_the_other_side_of_the_same_source():
    channels = make_channels(BODY, RIG, [record("cam1"), record("cam2")], [8.0, 8.0])
    partner = channels.partner
    np.testing.assert_array_equal(partner[partner], np.arange(len(partner)))
    np.testing.assert_array_equal(channels.source[partner], channels.source)
    names = [channels.points.names[c] for c in channels.column]
    assert [names[p] for p in partner] == [mirror_name(n) for n in names]


def test_two_cameras_share_the_points_of_one_set():
    channels = make_channels(BODY, RIG, [record("cam1"), record("cam2")], [8.0, 8.0])
    assert len(channels.points) == 17 and len(channels.column) == 34
    np.testing.assert_array_equal(channels.column[:17], channels.column[17:])


def test_two_detectors_on_one_camera_are_told_apart():
    channels = make_channels(BODY, RIG, [record("cam1"), record("cam1", "BODY_25B")], [8.0, 8.0])
    assert channels.sources == ("cam1 COCO_17", "cam1 BODY_25B")


def test_weights():
    source = record()
    confidence = np.array(source.confidence)
    points = np.array(source.points)
    points[1, 0, 4] = np.nan
    confidence[0, 0, 2] = np.nan
    spoilt = Keypoints("cam1", "COCO_17", source.names, 25.0, points, confidence)
    channels = make_channels(BODY, RIG, [spoilt], [4.0])
    assert channels.weight[1, 4] == 0 and channels.weight[0, 2] == 0
    assert channels.weight[0, 5] == pytest.approx(confidence[0, 0, 5] / 16.0)
    assert np.all(np.isfinite(channels.weight))


def test_exchange_of_sides_in_one_source():
    channels = make_channels(BODY, RIG, [record("cam1"), record("cam2")], [8.0, 8.0])
    uv = channels.uv[0]
    turned = exchange(channels, uv, np.array([False, True]))
    np.testing.assert_array_equal(turned[:17], uv[:17])
    np.testing.assert_array_equal(turned[17:], uv[channels.partner[17:]])
    np.testing.assert_array_equal(exchange(channels, turned, np.array([False, True])), uv)


def test_points_of_another_body():
    channels = make_channels(BODY, RIG, [record()], [8.0])
    larger = channels.with_points(BODY.scaled(np.full(len(BODY.scale_groups), 1.2)))
    np.testing.assert_allclose(larger.points.points, 1.2 * channels.points.points)
    assert larger.points.names == channels.points.names


def test_fitted_pixels_are_the_projections():
    channels = make_channels(BODY, RIG, [record("cam3"), record("cam1")], [8.0, 8.0])
    state = posture(BODY, 0, 0.3)
    x = BODY.positions(state, channels.points)
    expected = np.concatenate([RIG["cam3"].project(x), RIG["cam1"].project(x)])
    np.testing.assert_allclose(fitted_pixels(BODY, channels, state), expected, atol=1e-9)


def test_joined_points():
    a, b = BODY.keypoints("COCO_17"), BODY.keypoints("BODY_25B")
    both = joined([a, b])
    assert both.names == a.names + b.names
    np.testing.assert_array_equal(both.points[17:], b.points)


def test_what_cannot_be_used_is_told():
    with pytest.raises(ObservationError, match="no keypoints"):
        make_channels(BODY, RIG, [], [])
    with pytest.raises(ObservationError, match=r"no camera 'cam9'; there are: cam1, cam2, cam3"):
        make_channels(BODY, RIG, [record("cam9")], [8.0])
    strange = Keypoints("cam1", "COCO_17", ("a", "b"), 25.0, np.zeros((3, 1, 2, 2)), np.ones((3, 1, 2)))
    with pytest.raises(ObservationError, match="none of the points of COCO_17"):
        make_channels(BODY, RIG, [strange], [8.0])
    unknown = Keypoints("cam1", "COCO_18", ("a", "b"), 25.0, np.zeros((3, 1, 2, 2)), np.ones((3, 1, 2)))
    with pytest.raises(KinefitError, match="COCO_18"):
        make_channels(BODY, RIG, [unknown], [8.0])


def test_a_camera_that_saw_nobody_at_all():
    """Its record has room for no person: a camera more, but no measurement."""
    empty = record("cam2", people=0)
    alone = person_records([record("cam1"), empty], [np.zeros(3, int), np.full(3, -1)])
    channels = make_channels(BODY, RIG, alone, [8.0, 8.0])
    assert np.all(np.isnan(channels.uv[:, 17:])) and not channels.confidence[:, 17:].any()


@pytest.mark.parametrize("late", [0.3, -0.45])
def test_a_camera_that_is_late_by_part_of_a_frame_is_brought_into_step(late):
    """Points that move evenly: seen at t_j = (j + late) / rate, wanted at j / rate."""
    frames = np.arange(6.0)
    speed = np.array([3.0, -2.0])
    records = []
    for camera, offset in (("cam1", 0.0), ("cam2", late), ("cam3", 0.0)):
        one = record(camera, frames=6, people=1, extra=())
        points = 100.0 + (frames + offset)[:, None, None, None] * speed + np.zeros_like(one.points)
        points[2, 0, 4] = np.nan
        records.append(Keypoints(camera, one.keypoint_set, one.names, 25.0, points, one.confidence, offset / 25.0))
    channels = make_channels(BODY, RIG, person_records(records, [np.zeros(6, int)] * 3), [8.0] * 3)
    inner = channels.uv[1:-1]
    expected = 100.0 + frames[1:-1, None, None] * speed + np.zeros_like(inner)
    seen = np.isfinite(inner)
    np.testing.assert_allclose(inner[seen], expected[seen])
    unseen = ~seen.all(axis=2)
    assert unseen[:, channels.source == 1].sum() == 2  # both steps beside the frame in which the point was not seen
    assert unseen[:, channels.source == 0].sum() == 1
    assert np.all((channels.confidence > 0) & (channels.confidence <= 1))
