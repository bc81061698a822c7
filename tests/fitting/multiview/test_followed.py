"""People before one camera: each column of the detector is one of them."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.fitting.multiview.followed import follow, only_lifted
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import MEDIAPIPE_33, Keypoints

T = np.eye(4)
T[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # z is up, the camera looks along y
RIG = Rig((Camera("cam", (1280, 720), [[900, 0, 639.5], [0, 900, 359.5], [0, 0, 1]], T_camera_world=T),))
RATE, FRAMES = 30.0, 60


def record(*paths, unseen=()):
    """People who walk along `paths` (F, 3), each a cloud of 33 points in the shape of a person."""
    rng = np.random.default_rng(0)
    shape = rng.uniform((-0.25, -0.15, -0.9), (0.25, 0.15, 0.8), (33, 3))
    x = np.stack([path[:, None] + shape for path in paths], axis=1)
    lifted = (x - x.mean(axis=2, keepdims=True)) @ T[:3, :3].T
    uv = RIG.cameras[0].project(x)
    for person, frames in unseen:
        uv[frames, person], lifted[frames, person] = np.nan, np.nan
    confidence = np.where(np.isfinite(uv).all(axis=-1), 0.9, 0.0)
    return Keypoints("cam", "MEDIAPIPE_33", MEDIAPIPE_33, RATE, uv, confidence, lifted=lifted)


def path(start, end):
    return np.linspace(start, end, FRAMES)


STANDS, WALKS = path((-0.8, 4.0, 0.0), (-0.8, 4.0, 0.0)), path((0.5, 3.0, 0.0), (2.0, 3.0, 0.0))


def test_everybody_is_told_with_place_and_speed():
    found = follow(RIG, [record(STANDS, WALKS, unseen=[(1, slice(0, 10))])])
    assert len(found.people) == 2 and found.number == 1
    stands, walks = found.people
    assert np.linalg.norm(stands.place - STANDS[0]) < 0.15 and stands.speed < 0.02
    assert walks.speed == pytest.approx(1.5 * RATE / (FRAMES - 1), abs=0.1) and walks.views.sum() == FRAMES - 10


def test_a_point_that_is_never_seen_changes_neither_size_nor_speed_nor_place():
    whole = record(STANDS, WALKS)
    points, lifted, confidence = (np.array(v) for v in (whole.points, whole.lifted, whole.confidence))
    points[:, :, 7], lifted[:, :, 7], confidence[:, :, 7] = np.nan, np.nan, 0.0
    part = replace(whole, points=points, lifted=lifted, confidence=confidence)
    for one, other in zip(follow(RIG, [part]).people, follow(RIG, [whole]).people, strict=True):
        assert one.speed == pytest.approx(other.speed, abs=0.02) and one.size == pytest.approx(other.size, rel=0.1)
        assert np.linalg.norm(one.place - other.place) < 0.05


@pytest.mark.parametrize(
    ("wanted", "column"), [("moving", 1), ("largest", 1), (2, 1), ("nearest -1 4 0", 0), ("first", 0)]
)
def test_who_is_wanted_is_followed(wanted, column):
    one = record(STANDS, WALKS, unseen=[(1, slice(0, 10))])
    (kept,) = follow(RIG, [one], wanted).keypoints
    assert kept.points.shape == (FRAMES, 1, 33, 2) and kept.lifted.shape == (FRAMES, 1, 33, 3)
    assert np.array_equal(kept.points[:, 0], one.points[:, column], equal_nan=True)
    assert np.array_equal(kept.lifted[:, 0], one.lifted[:, column], equal_nan=True)


def test_who_is_seen_for_a_moment_is_nobody():
    found = follow(RIG, [record(STANDS, WALKS, unseen=[(1, slice(20, FRAMES))])])
    assert len(found.people) < 2


def test_one_camera_is_alone_where_no_other_has_keypoints():
    one = record(STANDS)
    other = Keypoints("cam2", "MEDIAPIPE_33", MEDIAPIPE_33, RATE, one.points, one.confidence)
    assert only_lifted([one]) is one and only_lifted([one, other]) is None and only_lifted([]) is None
