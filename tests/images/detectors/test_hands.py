"""Hands: the regions they are looked for in, sides that are not exchanged, and true images of an arm and a person."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.errors import AssetError
from kinefit.images.detectors.box_detector import Models
from kinefit.images.detectors.detection import detect_people
from kinefit.images.detectors.faces import (
    HANDS_ONLY_COLUMN,
    HandFollower,
    HandLandmarks,
    HandModels,
    around_hand,
    around_wrist,
)
from kinefit.images.detectors.following import PersonDetection
from kinefit.images.detectors.layouts import BLAZEPOSE
from kinefit.images.detectors.roi import Roi
from kinefit.readers import assets
from kinefit.readers.videos.video import Video

RNG = np.random.default_rng(3)
FINGERS = np.column_stack([RNG.uniform(-10, 10, 21), RNG.uniform(-40, 0, 21)])  # upwards from the wrist [px]
FINGERS[0], FINGERS[9] = (0, 0), (0, -20)
IMAGE = np.zeros((480, 640, 3), np.uint8)


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5, -2.0])
def test_a_hand_s_region_turns_with_it_and_holds_all_of_it(turn):
    c, s = np.cos(turn), np.sin(turn)
    points = FINGERS @ np.array([[c, -s], [s, c]]).T + [300, 200]
    roi = around_hand(points)
    assert np.isclose((roi.turn - turn + np.pi) % (2 * np.pi), np.pi)
    inside = (points - roi.centre) @ np.array([[c, -s], [s, c]])
    assert np.abs(inside).max() < roi.side / 2


def person(left, right, column=0):
    """Somebody whose arms hang down, wrists at given places."""
    points = np.zeros((33, 2))
    for side, wrist in enumerate((left, right)):
        points[[13 + side, 15 + side, 17 + side, 19 + side]] = np.add(wrist, [(0, -60), (0, 0), (-5, 20), (5, 20)])
    return PersonDetection(column, points, np.ones(33), np.zeros(0, np.uint32), np.zeros((33, 3)))


def test_a_wrist_s_region_reaches_beyond_the_fingers_also_where_they_point_to_the_camera():
    roi = around_wrist(person((200, 300), (400, 300)).points, 0)
    assert np.allclose(roi.centre, [200, 324]) and np.isclose(abs(roi.turn), np.pi) and roi.side >= 80
    short = person((200, 300), (400, 300)).points
    short[[17, 19]] = short[15]
    assert around_wrist(short, 0).side == pytest.approx(0.9 * 60)


class Seen(HandModels):
    """Networks in whose world hands hang at given places: {(u, v) of the wrist: probability of a left one}."""

    def __init__(self, hands):
        self.hands, self.palms = hands, 0

    def find_palms(self, image):
        self.palms += 1
        return [around_hand(np.add(wrist, -FINGERS)) for wrist in self.hands]

    def landmarks(self, image, roi):
        near = min(self.hands, key=lambda wrist: np.linalg.norm(roi.centre - np.add(wrist, (0, 20))), default=None)
        if near is None or np.linalg.norm(roi.centre - np.add(near, (0, 20))) > roi.side / 2:
            return HandLandmarks(FINGERS, 0.1, 0.5, Roi(np.zeros(2), 1.0, 0.0))
        points = np.add(near, -FINGERS)
        return HandLandmarks(points, 0.9, self.hands[near], around_hand(points))


def test_the_pose_says_which_hand_is_left_and_the_network_how_sure_that_is():
    who = person((200, 300), (400, 300))
    (seen,) = HandFollower(Seen({(200, 300): 0.9, (400, 300): 0.8}))(IMAGE, [who])
    points, confidence = seen.hands
    assert np.allclose(points[:, 0], [[200, 300], [400, 300]])
    assert np.allclose(confidence[0], 0.81) and np.allclose(confidence[1], 0.9 * 0.2)


@pytest.mark.parametrize(("left", "side"), [(0.9, 0), (0.1, 1)])
def test_one_hand_before_both_wrists_is_one_hand(left, side):
    (seen,) = HandFollower(Seen({(200, 300): left}))(IMAGE, [person((200, 300), (206, 300))])
    assert np.isfinite(seen.hands[0]).all(axis=(1, 2)).tolist() == [side == 0, side == 1]
    assert (seen.hands[1] > 0).any(axis=1).tolist() == [side == 0, side == 1]


def test_a_hand_that_is_hidden_is_not_seen_and_one_beyond_the_image_has_no_confidence():
    (seen,) = HandFollower(Seen({(200, 470): 0.9}))(IMAGE, [person((200, 470), (500, 300))])
    assert np.isnan(seen.hands[0][1]).all() and (seen.hands[1][1] == 0).all()
    outside = seen.hands[0][0][:, 1] > 479.5
    assert outside.any() and (seen.hands[1][0][outside] == 0).all() and (seen.hands[1][0][~outside] > 0.8).all()


def test_hands_alone_are_found_by_their_palms_and_followed_without():
    models = Seen({(200, 300): 0.9, (400, 300): 0.1, (300, 100): 0.2})
    follow = HandFollower(models)
    (seen,) = follow(IMAGE, [])
    assert seen.column == HANDS_ONLY_COLUMN and np.isnan(seen.points).all()
    assert np.allclose(seen.hands[0][:, 0], [[200, 300], [400, 300]])  # of three hands the surest left and right one
    (again,) = follow(IMAGE, [])
    assert models.palms == 1 and np.allclose(again.hands[0], seen.hands[0])
    models.hands = {}
    assert follow(IMAGE, []) == []


class Nobody:
    layout = BLAZEPOSE

    def find_people(self, image):
        return []

    def search(self, image):
        return []


def test_hands_alone_have_a_column_of_their_own_in_detections():
    follower = HandFollower(Seen({(200, 300): 0.9}))
    found = detect_people([IMAGE] * 4, Nobody(), camera="c", rate=10.0, masks=False, adders={"hands": follower})
    assert found.hands.shape == (4, 1, 2, 21, 2) and found.seen.all() and found.mask(0, 0) is None
    keypoints = found.keypoints()
    assert keypoints.keypoint_set == "MEDIAPIPE_75" and len(keypoints.names) == 75
    at = keypoints.names.index("left_hand_wrist")
    assert np.allclose(keypoints.points[:, 0, at], [200, 300]) and np.isnan(keypoints.points[:, 0, 0]).all()
    longer = found.within(2, 10)
    assert longer.seen[:, 0].tolist() == [False] * 2 + [True] * 4 + [False] * 4
    assert replace(found, hands=None, hand_confidence=None).seen.any() == np.False_


@pytest.fixture(scope="module")
def networks():
    pytest.importorskip("ai_edge_litert", reason="needs the extra detect")
    try:
        return assets.detector_models()
    except AssetError as error:
        if "could not fetch" in str(error):
            pytest.skip(f"the package index cannot be reached: {error}")
        raise


@pytest.mark.network
def test_a_bare_arm_s_hand_is_the_right_one(networks, data_dir):
    with Video(data_dir("stereo_arm_handpose3d") / "cam0_test.mp4") as video:
        images = list(video.frames(20, 26))
    follower = HandFollower(HandModels(networks))
    found = detect_people(
        images, Models(networks), camera="c", rate=30.0, people=0, masks=False, adders={"hands": follower}
    )  # fmt: skip
    assert (found.hand_confidence[:, 0, 1] > 0.5).all() and (found.hand_confidence[:, 0, 0] == 0).all()
    assert np.linalg.norm(found.hands[0, 0, 1, 0] - [494, 188]) < 25


@pytest.mark.network
def test_both_hands_of_a_seated_person_keep_their_sides(networks, data_dir):
    with Video(data_dir("mv4_upperbody_caliscope") / "port_2.mp4") as video:
        images = list(video.frames(20, 26))
    follower = HandFollower(HandModels(networks))
    found = detect_people(
        images, Models(networks), camera="c", rate=6.0, people=1, masks=False, adders={"hands": follower}
    )  # fmt: skip
    assert (found.hand_confidence[:, 0].max(axis=2) > 0.5).mean() > 0.7
    wrists = found.points[:, 0, [15, 16]]
    seen = np.isfinite(found.hands[:, 0, :, 0]).all(axis=-1)
    off = np.linalg.norm(found.hands[:, 0, :, 0] - wrists, axis=-1)[seen]
    apart = np.linalg.norm(wrists[:, 0] - wrists[:, 1], axis=-1).min()
    assert np.median(off) < 0.3 * apart
