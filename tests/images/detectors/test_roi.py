"""Regions: where they lie, and that what is cut out is where it is said to be."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit.images.detectors.roi import Roi, Steady

UPRIGHT = np.array([[100.0, 200.0], [100.0, 120.0]])


def test_a_person_upright_has_an_upright_square():
    roi = Roi.around_person(*UPRIGHT)
    assert (roi.side, roi.turn) == (pytest.approx(2 * 1.25 * 80), 0)
    assert np.allclose(roi.to_image(np.array([[0, 0], [256, 256]]), 256), [[0, 100], [200, 300]])


@pytest.mark.parametrize(("rim", "turn"), [((180, 200), np.pi / 2), ((20, 200), -np.pi / 2), ((100, 280), np.pi)])
def test_the_square_turns_with_the_person(rim, turn):
    roi = Roi.around_person(UPRIGHT[0], rim)
    assert abs(roi.turn) == pytest.approx(abs(turn)) and np.sign(roi.turn) == np.sign(turn)
    above = roi.to_image(np.array([128.0, 128 - 256 / 2.5]), 256)
    assert np.allclose(above, rim), "the rim of the body lies above its middle in the crop"


@given(
    st.floats(-3, 3), st.floats(60, 200), st.tuples(st.floats(80, 220), st.floats(60, 160)),
    st.tuples(st.floats(40, 210), st.floats(40, 210)),
)
def test_a_point_of_the_crop_is_where_it_is_said_to_be(turn, side, centre, at):
    """A dot drawn where the map says appears in the crop at the place that was mapped."""
    roi = Roi(np.array(centre), side, turn)
    u, v = roi.to_image(np.array(at), 256)
    rows, columns = np.mgrid[:240, :320]
    dot = 255 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 8)
    crop = roi.crop(np.repeat(dot[..., None], 3, axis=2).astype(np.uint8), 256)[..., 0].astype(float)
    inside = 10 < u < 310 and 10 < v < 230
    v_crop, u_crop = np.mgrid[:256, :256]
    if inside and crop.sum() > 0:
        found = [(u_crop * crop).sum() / crop.sum(), (v_crop * crop).sum() / crop.sum()]
        margin = 4 * 256 / side * 3 > min(*at, 256 - at[0], 256 - at[1])
        assert margin or np.allclose(found, at, atol=0.5)


def test_beyond_the_rim_the_outermost_pixels_are_repeated():
    image = np.full((50, 50, 3), 77, np.uint8)
    assert np.all(Roi(np.array([0.0, 0.0]), 100, 0.3).crop(image, 64) == 77)


def test_a_region_that_trembles_is_held_and_one_that_moves_is_followed():
    rng = np.random.default_rng(0)
    still = Steady.at(UPRIGHT)
    trembling = []
    for _ in range(100):
        still = still.follow(UPRIGHT + rng.normal(scale=1.0, size=(2, 2)))
        trembling.append(still.value)
    assert np.std(trembling[20:], axis=0).max() < 0.5
    moving, where = Steady.at(UPRIGHT), UPRIGHT
    for _ in range(60):
        where = where + [4.0, 0.0]
        moving = moving.follow(where)
    assert np.abs(moving.value - where).max() < 0.1 * moving.roi.side


def test_the_filter_does_not_depend_on_the_size_of_the_picture():
    steps = UPRIGHT + np.cumsum(np.random.default_rng(1).normal(size=(30, 2, 2)), axis=0)
    small, large = Steady.at(UPRIGHT), Steady.at(UPRIGHT * 3)
    for step in steps:
        small, large = small.follow(step), large.follow(step * 3)
    assert np.allclose(small.value * 3, large.value)


def test_the_crop_is_that_of_opencv():
    image = np.random.default_rng(2).integers(0, 255, (100, 120, 3), dtype=np.uint8)
    roi = Roi(np.array([50.0, 50.0]), 64.0, 0.0)
    assert np.array_equal(roi.crop(image, 64), image[18:82, 18:82])
    assert np.allclose(cv2.invertAffineTransform(roi.A_image_crop(64))[:, 2], [-18, -18])
