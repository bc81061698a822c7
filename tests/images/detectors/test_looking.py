"""Which images are looked at: few where people move on, more where they do not, and nobody is lost by it."""

import numpy as np
import pytest

from kinefit.images.detectors.detection import detect_people
from kinefit.images.detectors.roi import Steady

RATE, STEP = 60.0, 4


@pytest.fixture
def looks(models, monkeypatch):
    """Counts how often the landmark network runs."""
    pose, count = models.pose, []
    monkeypatch.setattr(models, "pose", lambda crop, *, mask: count.append(mask) or pose(crop, mask=mask))
    return count


def detect(images, models, looks=None, **options):
    return detect_people(images, models, camera="cam", rate=RATE, masks=False, people=1, looks=looks, **options)


def middles(found):
    return found.points.mean(axis=2)


def walking(count):
    return [(60 + f, 120, 30) for f in range(count)]


def test_who_moves_on_is_looked_at_in_every_fourth_image_and_the_last(draw, models, looks):
    pictures = [draw(disc) for disc in walking(63)]
    every = detect(pictures, models)
    cost = len(looks)
    found = detect(pictures, models, range(0, 1000, STEP))
    assert np.flatnonzero(found.looked).tolist() == [*range(0, 61, STEP), 62]
    np.testing.assert_array_equal(found.seen[:, 0], found.looked)
    assert every.looked is None and not found.confidence[~found.looked].any()
    assert 3 * (len(looks) - cost) < cost
    np.testing.assert_allclose(middles(found)[found.looked], middles(every)[found.looked], atol=0.7)


def test_the_first_image_of_the_grid_may_be_any(draw, models):
    found = detect([draw(disc) for disc in walking(20)], models, range(3, 1000, STEP))
    assert np.flatnonzero(found.looked).tolist() == [0, 3, 7, 11, 15, 19]


def test_who_turns_back_is_looked_at_in_between(draw, models):
    """Where three looks lead is not where the fourth is: the middle, and all if it is off a parabola."""
    to_and_fro = [(160 + round(24 * np.sin(2 * np.pi * f / 11)), 120, 30) for f in range(60)]
    found = detect([draw(disc) for disc in [(160, 120, 30)] * 24 + to_and_fro], models, range(0, 1000, STEP))
    assert found.looked[:24].sum() == 6 and found.looked[40:].mean() > 0.7
    assert found.seen[found.looked].all()


def test_in_between_is_a_look_at_that_image(draw, models):
    jump = [(100, 120, 30)] * 18 + [(112, 120, 30)] * 30
    found = detect([draw(disc) for disc in jump], models, range(0, 1000, STEP))
    between = [f for f in np.flatnonzero(found.looked) if f % STEP and f < 47]
    assert between
    np.testing.assert_allclose(middles(found)[between, 0], [jump[f][:2] for f in between], atol=0.7)


def test_who_leaves_or_comes_is_seen_in_as_many_images_as_with_every_look(draw, models):
    pictures = [draw((100, 120, 30))] * 30 + [draw()] * 7 + [draw((104, 120, 30))] * 30
    every, found = detect(pictures, models), detect(pictures, models, range(0, 1000, STEP))
    assert found.looked[29] and found.looked[30], "the gap in which somebody was lost is looked at image by image"
    lost, back = np.flatnonzero(np.diff(every.seen[:, 0].astype(int)) != 0)
    assert found.seen[lost, 0] and not found.seen[lost + 1, 0]
    assert found.points.shape[1] == every.points.shape[1] == 1
    assert found.seen[back + 1 :][found.looked[back + 1 :], 0].all()


def test_a_skipped_image_is_not_one_without_the_person(draw, models):
    """A person is kept who is seen for a fifth of a second, whatever the number of looks in it."""
    pictures = [draw()] * 30 + [draw((100, 120, 30))] * 14 + [draw()] * 40
    for looks in (None, range(0, 1000, STEP)):
        assert detect(pictures, models, looks).points.shape[1] == 1


def test_two_people_stay_in_their_columns(draw, models):
    pictures = [draw((70 + f, 100, 25), (250 - f, 170, 22)) for f in range(60)]
    found = detect_people(pictures, models, camera="cam", rate=RATE, looks=range(0, 1000, STEP))
    assert found.points.shape[1] == 2 and found.seen[found.looked][8:].all() and found.looked.sum() < 40
    at = np.flatnonzero(found.looked)[8:]
    np.testing.assert_allclose(middles(found)[at, 0], [[70 + f, 100] for f in at], atol=1)
    assert found.mask(int(at[-1]), 0) is not None and found.mask(57, 0) is None


def test_a_region_goes_on_over_skipped_images_as_it_would_through_them():
    start = np.array([[100.0, 100.0], [100.0, 40.0]])
    steady = Steady.at(start)
    for k in range(1, 9):
        steady = steady.follow(start + [2.0 * k, 0.0])
    through = steady
    for k in range(9, 13):
        through = through.follow(start + [2.0 * k, 0.0])
    over, still = steady.over(start + [24.0, 0.0], 4), steady.follow(start + [24.0, 0.0])
    np.testing.assert_allclose(over.value, through.value, atol=1e-9)
    assert abs(still.value - through.value).max() > 0.5
    assert abs(steady.ahead(4).value - through.value).max() < abs(steady.value - through.value).max() / 3
    assert steady.ahead(0) is steady
