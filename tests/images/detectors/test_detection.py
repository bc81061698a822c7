"""Following people: each in a column of its own, through gaps, beside others; and their masks."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit.errors import ObservationError
from kinefit.geometry.camera import ImageFrame
from kinefit.images.detectors.detection import detect_people
from kinefit.images.detectors.roi import SIZE, Roi, mask_runs
from kinefit.observations import MEDIAPIPE_33, Detections


def detect(images, models, **options):
    return detect_people(images, models, camera="cam", rate=10.0, **options)


def middles(found):
    """(F, P, 2) of everybody."""
    return found.points.mean(axis=2)


def test_one_person_is_followed_with_points_confidence_and_mask(draw, models):
    found = detect([draw((100 + 2 * f, 120, 30)) for f in range(20)], models)
    assert found.points.shape == (20, 1, 33, 2) and found.seen.all() and found.size == (320, 240)
    assert np.allclose(middles(found)[:, 0], [[100 + 2 * f, 120] for f in range(20)], atol=0.7)
    assert np.allclose(found.confidence, 0.9)
    for f in (0, 7, 19):
        truth = draw((100 + 2 * f, 120, 30))[..., 0] > 0
        mask = found.mask(f, 0)
        assert (mask & truth).sum() / (mask | truth).sum() > 0.93
    assert models.looks < 10, "the whole picture is looked at now and then only"


def test_people_beside_each_other_keep_their_columns(draw, models):
    pictures = [draw((70 + 3 * f, 100, 25), (250 - 3 * f, 170, 22)) for f in range(30)]
    found = detect(pictures, models)
    assert found.points.shape[1] == 2 and found.seen.all()
    assert np.allclose(middles(found)[:, 0], [[70 + 3 * f, 100] for f in range(30)], atol=1)
    assert np.allclose(middles(found)[:, 1], [[250 - 3 * f, 170] for f in range(30)], atol=1)


def test_no_more_are_followed_than_asked_for(draw, models):
    found = detect([draw((70, 100, 25), (250, 170, 22))] * 8, models, people=1)
    assert found.points.shape[1] == 1 and np.allclose(middles(found)[:, 0], [70, 100], atol=1)


def test_a_newcomer_is_found_and_replaces_nobody(draw, models):
    pictures = [draw((80, 100, 25))] * 7 + [draw((80, 100, 25), (240, 120, 40))] * 13
    found = detect(pictures, models)
    assert np.allclose(middles(found)[:, 0], [80, 100], atol=1)
    assert found.seen[:, 1].tolist() == [f >= 10 for f in range(20)], "looked for every half second"


def test_who_was_away_for_a_moment_comes_back_under_the_same_number(draw, models):
    pictures = [draw((80, 100, 25))] * 5 + [draw()] * 6 + [draw((90, 100, 25))] * 5
    found = detect(pictures, models)
    assert found.seen[:, 0].tolist() == [True] * 5 + [False] * 6 + [True] * 5 and found.seen.shape[1] == 1


@pytest.mark.parametrize(("where", "gap"), [((260, 100), 6), ((80, 100), 25)])
def test_who_comes_back_elsewhere_or_late_gets_a_number_of_their_own(draw, models, where, gap):
    found = detect([draw((80, 100, 25))] * 5 + [draw()] * gap + [draw((*where, 25))] * 5, models)
    assert found.seen.sum(axis=0).tolist() == [5, 5]


def test_two_regions_that_meet_on_one_person_become_one(draw, models):
    """Two walk into each other and go on as one: the networks cannot tell them apart any more."""
    pictures = [draw((100 + 3 * f, 120, 25), (220 - 3 * f, 120, 25)) for f in range(16)]
    pictures += [draw((160 + 5, 120, 25))] * 10
    found = detect(pictures, models)
    assert found.seen[:10].all() and (found.seen[-5:].sum(axis=1) == 1).all()


def test_others_are_painted_over_in_the_region_of_one(draw, models):
    """The networks would draw the limbs of one towards another: a person's region shows nobody else."""
    image = draw((100, 120, 25), (154, 120, 25))
    seen, pose = [], models.pose
    models.pose = lambda crop, *, mask: seen.append((crop.min(axis=2) > 200).mean()) or pose(crop, mask=mask)
    found = detect([image] * 8, models)
    assert found.seen[-4:].all() and found.points.shape[1] == 2
    assert np.allclose(seen[-2:], np.pi / 3.0**2, rtol=0.06)  # a disc in a square of three radii


def test_the_same_person_is_not_found_twice(draw, models):
    models.only_one = False
    image = draw((100, 120, 40))
    cv2.line(image, (100, 60), (100, 180), (0, 0, 0), 3)  # two halves, as a network may see them
    found = detect([image] * 12, models)
    assert found.points.shape[1] <= 2
    together = found.seen.all(axis=1)
    assert not together.any() or np.linalg.norm(middles(found)[together][:, 0] - middles(found)[together][:, 1]) > 10


def test_who_is_seen_for_a_moment_only_is_nobody(draw, models):
    found = detect([draw((80, 100, 25), *[(240, 120, 20)] * (5 <= f < 7)) for f in range(20)], models)
    assert found.seen.shape == (20, 1) and len(found.mask_starts) == 21
    alone = detect([draw((80, 100, 25))] * 2 + [draw()] * 10, models)
    assert alone.seen.shape == (12, 0)


def test_nobody_is_no_column_and_a_plain_error_when_keypoints_are_asked_for(draw, models):
    found = detect([draw()] * 4, models)
    assert found.points.shape == (4, 0, 33, 2) and found.seen.shape == (4, 0) and len(found) == 4
    with pytest.raises(ObservationError, match="no person is detected in any of the 4 frames of camera left"):
        found.keypoints("left")


def test_without_masks_there_is_none(draw, models):
    found = detect([draw((100, 120, 30))] * 3, models, masks=False)
    assert found.mask(1, 0) is None and len(found.mask_runs) == 0
    with pytest.raises(IndexError):
        found.mask(3, 0)


def test_keypoints_are_in_the_frame_of_the_calibration(draw, models):
    found = detect([draw((100, 120, 30))] * 3, models)
    frame = ImageFrame.letterboxed((640, 400), (320, 240))
    keypoints = found.keypoints("left", image_frame=frame, time_offset=0.5)
    assert (keypoints.camera, keypoints.names, keypoints.rate) == ("left", MEDIAPIPE_33, 10.0)
    assert np.allclose(frame.from_calibration(keypoints.points), found.points)
    assert keypoints.times[0] == 0.5


def test_lifted_landmarks_turn_with_the_picture(draw, models):
    """Of the network they are along the crop's axes, of the record along the picture's, then the calibration's."""
    found = detect([draw((100, 120, 30))] * 3, models)
    turned = Roi(np.zeros(2), 100.0, np.pi / 2).to_upright(np.array([[0.1, 0.2, 0.3]]))
    assert np.allclose(turned, [[-0.2, 0.1, 0.3]])  # the crop's up is the picture's right: its u runs down the picture
    assert found.lifted.shape == (3, 1, 33, 3) and np.allclose(np.linalg.norm(found.lifted, axis=-1), np.sqrt(0.14))
    assert np.allclose(found.lifted[..., 2], 0.3)
    frame = ImageFrame.rotated((240, 320), 90)
    there = found.keypoints("left", image_frame=frame)
    step = frame.to_calibration(found.points[0, 0, :1] + found.lifted[0, 0, :1, :2]) - there.points[0, 0, :1]
    assert np.allclose(there.lifted[0, 0, 0, :2], step[0]) and np.allclose(there.lifted[..., 2], 0.3)


def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(ObservationError, match="starts of masks"):
        Detections("c", 1.0, (4, 4), np.zeros((2, 1, 33, 2)), np.zeros((2, 1, 33)), np.zeros(0), np.zeros(2))
    with pytest.raises(ObservationError, match="lifted landmarks"):
        some = np.zeros((2, 1, 33, 2)), np.zeros((2, 1, 33)), np.zeros(0), np.zeros(3)
        Detections("c", 1.0, (4, 4), *some, lifted=np.zeros((2, 1, 33, 2)))


@given(
    st.floats(-3.2, 3.2), st.floats(20, 300), st.tuples(st.floats(-40, 200), st.floats(-40, 160)), st.integers(0, 99)
)
def test_runs_are_those_of_the_mask_drawn_into_the_whole_picture(turn, side, centre, seed):
    width, height = 160, 120
    roi = Roi(np.array(centre), side, turn)
    noise = np.random.default_rng(seed).normal(size=(SIZE, SIZE)).astype(np.float32)
    soft = np.clip(0.5 + 8 * cv2.GaussianBlur(noise, (0, 0), 12), 0, 1)
    soft[[0, 1, -2, -1]] = soft[:, [0, 1, -2, -1]] = 0
    runs = mask_runs(soft, roi, (height, width))
    found = Detections(
        "c", 1.0, (width, height), np.zeros((1, 1, 33, 2)), np.zeros((1, 1, 33)), runs, np.array([0, len(runs)])
    )
    whole = cv2.warpAffine(soft, roi.A_image_crop(SIZE), (width, height), flags=cv2.INTER_LINEAR) > 0.5
    assert runs.sum() == width * height
    assert (found.mask(0, 0) != whole).sum() <= 0.002 * width * height  # OpenCV rounds places to 1/32 px


@pytest.mark.parametrize("people", [1, 2, 3])
def test_without_outlines_the_points_are_the_same_and_few_masks_are_made(draw, models, people):
    """Masks are made where they are needed to tell people apart, and nowhere else."""
    crossing = [draw((70 + 6 * f, 100, 25), (250 - 6 * f, 110, 22)) for f in range(30)]
    coming = [draw((80, 100, 25))] * 7 + [draw((80, 100, 25), (240, 120, 40))] * 13 + [draw()] * 3
    pose, asked = models.pose, []
    models.pose = lambda crop, *, mask: asked.append(mask) or pose(crop, mask=mask)
    for pictures in (crossing, coming + coming, coming[:7] * 4):
        asked.clear()
        with_masks = detect(pictures, models, people=people)
        asked.clear()
        without = detect(pictures, models, people=people, masks=False)
        np.testing.assert_array_equal(without.points, with_masks.points)
        np.testing.assert_array_equal(without.confidence, with_masks.confidence)
        assert not len(without.mask_runs) and len(with_masks.mask_runs)
    assert sum(asked) == (0 if people == 1 else 6), "one alone: every half second"
