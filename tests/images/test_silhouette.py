"""Silhouettes in pictures: outlines to parts of a pixel, blobs, colours, and what is before a background."""

import cv2
import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.images.silhouette import BackgroundPlate, choose_person, cleaned, colour_silhouette, outline


def disc(centre, radius, size=(90, 120), finer=8):
    """Mask (H, W) of a disc, with each pixel's share of it."""
    v, u = np.mgrid[: size[0] * finer, : size[1] * finer]
    inside = ((u + 0.5) / finer - 0.5 - centre[0]) ** 2 + ((v + 0.5) / finer - 0.5 - centre[1]) ** 2 < radius**2
    return np.rint(255 * inside.reshape(size[0], finer, size[1], finer).mean(axis=(1, 3))).astype(np.uint8)


def test_an_outline_lies_within_pixels():
    u, v, a, b = outline(disc((50.3, 40.7), 25.4))
    radius = np.hypot(u - 50.3, v - 40.7)
    assert len(u) > 150
    assert np.abs(radius - 25.4).max() < 0.12
    np.testing.assert_allclose(np.hypot(a, b), 1.0)
    assert (a * (u - 50.3) + b * (v - 40.7) > 0.9 * radius).all(), "normals point away from the body"


def test_of_a_mask_of_two_values_outlines_run_between_pixels():
    mask = np.zeros((20, 30), np.uint8)
    mask[5:15, 8:20] = 255
    u, v, _, _ = outline(mask)
    assert {u.min(), u.max(), v.min(), v.max()} == {7.5, 19.5, 4.5, 14.5}


def test_there_is_no_outline_at_the_image_border_or_in_an_empty_mask():
    mask = np.zeros((20, 30), np.uint8)
    assert outline(mask).shape == (4, 0)
    mask[:] = 255
    assert outline(mask).shape == (4, 0)
    mask[:, 10:] = 0
    assert set(outline(mask)[0]) == {9.5}


def test_only_the_person_is_left_of_several_blobs():
    mask = np.maximum(disc((25, 40), 12), disc((85, 40), 20))
    mask[70:72, 20:24] = 200  # a piece that is the person's too
    near = np.zeros(mask.shape, bool)
    near[20:80, 5:50] = True
    kept = choose_person(mask, near)
    assert kept[40, 25] and kept[71, 21] and not kept[40, 85]
    np.testing.assert_array_equal(kept[:, :50], mask[:, :50])
    assert choose_person(mask)[40, 85] and not choose_person(mask)[40, 25], "the largest, where nothing is known"
    assert choose_person(np.zeros_like(mask), near).max() == 0


def test_colour_and_the_laplace_operator():
    picture = np.full((90, 120, 3), (30, 90, 40), np.uint8)
    picture[disc((60, 45), 20) > 127] = (200, 60, 50)
    picture[5, 5] = (200, 60, 50)  # a speck
    mask, contour = colour_silhouette(picture, (150, 20, 20), (255, 100, 100))
    assert mask[45, 60] and not mask[5, 5]
    v, u = np.nonzero(contour)
    assert len(u) > 80
    assert np.abs(np.hypot(u - 60, v - 45) - 19.5).max() < 1.6


def scene(seed=0):
    """An empty room with texture, noisy."""
    random = np.random.default_rng(seed)
    room = cv2.resize(np.random.default_rng(7).integers(60, 200, (9, 12, 3), np.uint8), (240, 180))
    return np.clip(room + random.normal(scale=3, size=room.shape), 0, 255).astype(np.uint8)


def with_person(seed=1):
    """A person of another colour, and a shadow beside."""
    picture, person = scene(seed).astype(float), disc((80, 90), 40, (180, 240)) > 127
    shadow = (disc((170, 120), 35, (180, 240)) > 127) & ~person
    picture[shadow] *= 0.7
    picture[person] = np.array((40, 40, 180)) + np.random.default_rng(seed).normal(scale=3, size=(person.sum(), 3))
    return np.clip(picture, 0, 255).astype(np.uint8), person, shadow


def test_what_is_before_the_background_without_its_shadow():
    picture, person, shadow = with_person()
    mask = BackgroundPlate(scene()).mask(picture) > 0
    assert (mask & person).sum() / (mask | person).sum() > 0.93
    assert mask[shadow].mean() < 0.02
    as_dark = BackgroundPlate(scene(), shadow=0.9).mask(picture) > 0
    assert as_dark[shadow].mean() > 0.5, "without shadows that dark it is a thing"


def test_a_camera_that_changes_its_exposure_shows_nobody():
    brighter = np.clip(1.15 * scene(3).astype(float), 0, 255).astype(np.uint8)
    assert BackgroundPlate(scene()).mask(brighter).max() == 0
    assert BackgroundPlate(scene(), noise=3.0).mask(brighter).mean() < 1.0  # of 255


def test_a_person_is_found_as_well_at_another_exposure():
    picture, person, _ = with_person()
    darker = np.rint(0.7 * picture.astype(float)).astype(np.uint8)
    for noise in (None, 3.0):
        mask = BackgroundPlate(scene(), noise=noise).mask(darker) > 0
        assert (mask & person).sum() / (mask | person).sum() > 0.9


def test_a_background_learnt_from_pictures_with_somebody_in_them():
    pictures = []
    for k in range(9):
        picture, person = scene(k), disc((20 + 24 * k, 90), 20, (180, 240)) > 127
        picture[person] = (40, 40, 180)
        pictures.append(picture)
    picture, person, _ = with_person()
    mask = BackgroundPlate.of(pictures).mask(picture) > 0
    assert (mask & person).sum() / (mask | person).sum() > 0.93


def test_small_holes_and_specks_go():
    mask = np.zeros((100, 100), np.uint8)
    mask[20:80, 20:80] = 255
    mask[40:43, 40:43] = 0
    mask[90:93, 90:93] = 255
    out = cleaned(mask)
    assert out[41, 41] == 255 and out[91, 91] == 0 and out[50, 50] == 255


@pytest.mark.parametrize(
    "call",
    [
        lambda: outline(np.zeros((4, 4, 3), np.uint8)),
        lambda: outline(np.zeros((4, 4))),
        lambda: choose_person(np.zeros((0, 4), np.uint8)),
        lambda: colour_silhouette(np.zeros((4, 4), np.uint8), (0, 0, 0), (1, 1, 1)),
        lambda: colour_silhouette(np.zeros((4, 4, 3), np.uint8), (9, 0, 0), (1, 1, 1)),
        lambda: BackgroundPlate(np.zeros((4, 4), np.uint8)),
        lambda: BackgroundPlate(scene()).mask(scene()[:50]),
        lambda: BackgroundPlate.of([]),
    ],
)
def test_what_cannot_be_is_told(call):
    with pytest.raises(ObservationError):
        call()
