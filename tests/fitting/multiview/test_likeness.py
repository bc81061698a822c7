"""How like two people are: lengths of bones from what cameras saw, colours from pictures, odds that count both."""

import numpy as np
import pytest
from tests.fitting.multiview.test_people import RIG, records
from tests.fitting.multiview.test_returns import BODY, RATE, sized, stay

from kinefit.fitting.multiview.likeness import (
    Appearance,
    bones_of,
    clothes_colours,
    colour_log_ratio,
    joints_of,
    same_log_ratio,
    size_log_ratio,
)
from kinefit.observations import Keypoints

NOTHING = np.full(7, np.nan)
GREY = np.full((2, 6), np.nan)


def looks(bones=NOTHING, colours=GREY, std=0.01):
    return Appearance(np.asarray(bones, float), np.full(7, std), np.asarray(colours, float))


@pytest.mark.parametrize("name", BODY.keypoint_sets)
def test_joints_are_found_in_every_set_of_the_catalogue(name):
    names = BODY.keypoints(name).names
    joints = joints_of(names)
    assert len(joints) == 12 and len(set(joints.values())) == 12
    for (side, part), k in joints.items():
        assert part in names[k].lower() and names[k].lower().startswith(side)


def test_nothing_known_says_nothing():
    assert same_log_ratio(looks(), looks(np.zeros(7))) == 0.0 and not looks().is_known


def test_the_same_size_speaks_for_and_another_against():
    same, other = looks(np.zeros(7)), looks(np.full(7, 0.12))
    assert size_log_ratio(same, same) > 1.5 and size_log_ratio(same, other) < -1.5
    assert size_log_ratio(same, other) == pytest.approx(size_log_ratio(other, same))
    vague = looks(np.full(7, 0.12), std=0.5)  # who knows no length says nothing
    assert abs(size_log_ratio(same, vague)) < 0.1


def test_no_size_speaks_louder_than_that_lengths_may_be_wrong():
    assert size_log_ratio(looks(np.zeros(7)), looks(np.full(7, 5.0))) == pytest.approx(np.log(0.02), abs=0.01)


def test_clothes_speak_less_than_that_people_change_and_wear_the_same():
    red = np.tile([50.0, 40.0, 20.0, 5.0, 2.0, 2.0], (2, 1))
    blue = np.tile([30.0, 5.0, -40.0, 5.0, 2.0, 2.0], (2, 1))
    same, other = (colour_log_ratio(looks(colours=red), looks(colours=c)) for c in (red, blue))
    assert 1.5 < same <= np.log(1 / 0.1) and np.log(0.05) - 0.1 < other < -2.0
    one_part = red.copy()
    one_part[1] = np.nan
    assert 0.5 < colour_log_ratio(looks(colours=one_part), looks(colours=red)) < same + 0.01


def test_bones_are_those_of_the_body():
    small, large = sized(0.9), sized(1.1)
    keypoints, truth = records([stay([(0.6, 0, 0)] * 2, 3, small), stay([(-0.6, 0, 0)] * 2, 3, large)], outliers=0.1)
    found = []
    for k in (0, 1):
        views = {f: [(q, int(t[f, k])) for q, t in enumerate(truth)] for f in range(60)}
        found.append(bones_of(RIG, keypoints, views))
    np.testing.assert_allclose(found[1].bones - found[0].bones, np.log(1.1 / 0.9), atol=0.05)
    assert (found[0].bones_std < 0.08).all()
    assert size_log_ratio(*found) < 0.0 < size_log_ratio(found[0], found[0])


def test_colours_are_those_of_trunk_and_legs_where_nobody_is_in_the_way():
    names = ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_knee", "right_knee")
    uv = np.array([[60, 20], [20, 20], [55, 90], [25, 90], [55, 160], [25, 160]], float)
    image = np.zeros((200, 200, 3), np.uint8)
    image[:95], image[95:] = (200, 30, 30), (30, 30, 200)
    points = np.stack([uv, uv + [500.0, 0.0]])[None]
    record = Keypoints("cam1", "", names, RATE, points, np.ones((1, 2, 6)))
    found = clothes_colours([record], {0: [(0, 0)]}, lambda camera, frame: (image, None))
    assert found[0, 1] > 40 and found[1, 2] < -40  # red above, blue below
    assert np.isnan(clothes_colours([record], {0: [(0, 0)]}, lambda camera, frame: None)).all()
    near = Keypoints("cam1", "", names, RATE, np.stack([uv, uv + [20.0, 10.0]])[None], np.ones((1, 2, 6)))
    hidden = clothes_colours([near], {0: [(0, 0)]}, lambda camera, frame: (image, None))
    assert np.isnan(hidden[0]).all() and hidden[1, 2] < -40  # one leg stands free
