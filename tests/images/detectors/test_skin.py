"""Face and hands by colour: drawn pictures of which all is known, and a real one with things of the same colour."""

import cv2
import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.images.detectors.skin import WRISTS, SkinTracker
from kinefit.readers.videos.video import Video
from kinefit.sensors.visibility.occlusion import MIN_VISIBLE_CONFIDENCE

SKIN, WOOD, WALL, SHIRT = (205, 150, 125), (190, 140, 110), (130, 150, 140), (40, 60, 120)
FACE = (285.0, 80.0, 70.0, 100.0)


def drawn(left=None, right=None, *, light=1.0, wood=True, face=(320, 130), seed=0):
    """A person in a long-sleeved shirt (640 x 480): face, hands at given pixels, and a wooden box that never moves."""
    image = np.full((480, 640, 3), WALL, np.uint8)
    cv2.rectangle(image, (230, 190), (410, 480), SHIRT, -1)
    if wood:
        cv2.rectangle(image, (20, 380), (90, 440), WOOD, -1)
    cv2.ellipse(image, face, (35, 50), 0, 0, 360, SKIN, -1)
    for hand in (left, right):
        if hand is not None:
            cv2.ellipse(image, tuple(int(v) for v in hand), (22, 32), 20, 0, 360, SKIN, -1)
    noise = np.random.default_rng(seed).normal(scale=4.0, size=image.shape)
    return np.clip(light * image + noise, 0, 255).astype(np.uint8)


def path(frames):
    """(F, 2), (F, 2): both hands on circles beside the trunk; the person's left is on the right of the picture."""
    t = np.arange(frames) * 0.15
    circle = 45 * np.stack([np.cos(t), np.sin(t)], axis=1)
    return np.array([470, 300]) + circle, np.array([170, 300]) - circle


def run(frames, pictures):
    tracker = SkinTracker(pictures(0), FACE)
    return tracker, [tracker.update(pictures(k)) for k in range(frames)]


def test_hands_are_found_followed_and_told_apart():
    left, right = path(50)
    tracker, seen = run(50, lambda k: drawn(left[k], right[k], seed=k))
    for k in range(10, 50):
        face, l_hand, r_hand = seen[k]
        assert np.linalg.norm(face.centre - (320, 130)) < 6
        assert np.linalg.norm(l_hand.centre - left[k]) < 10 and np.linalg.norm(r_hand.centre - right[k]) < 10
        assert min(l_hand.confidence, r_hand.confidence) >= MIN_VISIBLE_CONFIDENCE  # what has been followed is no guess
    frame = tracker.frame("cam", 1.5, WRISTS)
    assert frame.names == WRISTS and frame.confidence.min() > 0.3
    np.testing.assert_array_equal(frame.uv[1], seen[-1][1].centre)


def test_hanging_hands_are_within_reach():
    """As far below the face as an arm reaches, of a face that is found a fifth too small."""
    left, right = path(30)
    tracker = SkinTracker(drawn(), (292.0, 94.0, 56.0, 72.0))  # the hands are up to 4.7 of these heights away
    off = np.array([0.0, 100.0])
    assert np.linalg.norm(left + off - (320, 130), axis=1).max() > 4.5 * 72.0
    seen = [tracker.update(drawn(left[k] + off, right[k] + off, seed=k)) for k in range(30)]
    for k in range(10, 30):
        assert np.linalg.norm(seen[k][1].centre - left[k] - off) < 12


def test_light_may_fade():
    """To 60 % and back in four seconds: the colour is learnt on the way."""
    left, right = path(120)
    _, seen = run(120, lambda k: drawn(left[k], right[k], light=1.0 - 0.4 * np.sin(np.pi * k / 120), seed=k))
    off = [np.linalg.norm(s[1].centre - left[k]) for k, s in enumerate(seen) if k > 10 and s[1] is not None]
    assert len(off) > 100 and np.percentile(off, 95) < 12


def test_a_hand_that_leaves_is_lost_and_found_again():
    left, right = path(70)
    _, seen = run(70, lambda k: drawn(None if 20 <= k < 45 else left[k], right[k], seed=k))
    assert all(s[1] is None or np.linalg.norm(s[1].centre - left[k]) > 1 for k, s in enumerate(seen[22:45], 22))
    assert sum(s[1] is None for s in seen[25:45]) >= 18
    assert all(np.linalg.norm(s[1].centre - left[k]) < 12 for k, s in enumerate(seen[52:], 52))
    assert all(np.linalg.norm(s[2].centre - right[k]) < 12 for k, s in enumerate(seen[10:], 10))


def test_hands_that_cross_keep_their_names():
    """They pass each other at two heights, so that their patches come close without being one."""
    t, wave = np.linspace(-1, 1, 60), 20 * np.sin(np.arange(60) * 0.9)
    left, right = np.stack([320 - 150 * t, 250 + wave], axis=1), np.stack([320 + 150 * t, 350 + wave], axis=1)
    _, seen = run(60, lambda k: drawn(left[k], right[k], seed=k))
    assert np.linalg.norm(seen[12][1].centre - left[12]) < 15
    assert np.linalg.norm(seen[-1][1].centre - left[-1]) < 15 and np.linalg.norm(seen[-1][2].centre - right[-1]) < 15


def test_a_hand_before_the_face_does_not_take_it_along():
    left, right = path(60)
    left[25:40] = (320 + 25, 160)
    _, seen = run(60, lambda k: drawn(left[k], right[k], seed=k))
    assert all(s[0] is not None and np.linalg.norm(s[0].centre - (320, 130)) < 35 for s in seen)
    assert np.linalg.norm(seen[-1][0].centre - (320, 130)) < 8
    assert np.linalg.norm(seen[-1][1].centre - left[-1]) < 15


def test_wood_is_no_hand():
    _, seen = run(30, lambda k: drawn(seed=k))
    assert all(s[1] is None and s[2] is None for s in seen)


def test_an_empty_picture_gives_nothing_and_no_nan():
    tracker = SkinTracker(drawn(), FACE)
    for k in range(40):
        seen = tracker.update(np.full((480, 640, 3), 20 if k % 2 else 250, np.uint8))
    assert seen[1] is None and seen[2] is None
    frame = tracker.frame("cam", 0.0)
    assert frame.confidence[1:].max() == 0.0
    back = [tracker.update(drawn(seed=k)) for k in range(3)][-1]
    assert back[0] is not None and np.linalg.norm(back[0].centre - (320, 130)) < 10


def test_what_is_no_picture_is_refused():
    with pytest.raises(ObservationError, match="RGB"):
        SkinTracker(np.zeros((480, 640), np.uint8), FACE)
    with pytest.raises(ObservationError, match="no face"):
        SkinTracker(drawn(), (700.0, 80.0, 70.0, 100.0))
    with pytest.raises(ObservationError, match="no face"):
        SkinTracker(drawn(), (10.0, 10.0, 3.0, 3.0))
    with pytest.raises(ObservationError, match="no face"):
        SkinTracker(drawn(), (np.nan, 10.0, 30.0, 30.0))
    with pytest.raises(ObservationError, match="Hz"):
        SkinTracker(drawn(), FACE, rate=0.0)
    with pytest.raises(ObservationError, match="new tracker"):
        SkinTracker(drawn(), FACE).update(drawn()[:100])


def test_a_face_and_hands_in_a_real_room(data_dir):
    """A person who gestures before a red carpet, forearms bare; places read by eye in one picture, to 15 px."""
    with Video(data_dir("mv4_upperbody_caliscope") / "port_2.mp4") as video:
        tracker = SkinTracker(video.read(0), (747.0, 276.0, 100.0, 152.0), rate=6.0)
        for k in range(41):
            seen = tracker.update(video.read(k))
    face, left, right = seen
    assert np.linalg.norm(face.centre - (790, 350)) < 30  # a face is 150 px high
    assert np.linalg.norm(left.centre - (895, 505)) < 60 and np.linalg.norm(right.centre - (518, 480)) < 60
