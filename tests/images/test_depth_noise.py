"""The noise of a depth image is told from the image; the filter takes it away and leaves surfaces and edges."""

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images.depth import denoised, noise_of, without_speckles

CAMERA = Camera("tof", (160, 124), [[181.0, 0, 79.5], [0, 181.0, 61.5], [0, 0, 1]])


def steps(sigma, seed=0):
    """A person's slab 2.5 m away, 0.35 m wide, before a wall at 4 m; the truth, and with noise sigma [m]."""
    truth = np.full((124, 160), 4.0)
    truth[20:110, 65:90] = 2.5
    return truth, (truth + sigma * np.random.default_rng(seed).normal(size=truth.shape)).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.005, 0.02, 0.05])
def test_white_noise_is_told_also_on_a_slant_and_beside_edges(sigma):
    _, depth = steps(sigma)
    told = noise_of(depth)
    assert np.median(told) == pytest.approx(sigma, rel=0.1)
    assert np.percentile(np.abs(told / sigma - 1.0), 90) < 0.35
    b = CAMERA.ray_table[1]
    floor = np.where(b > 0.05, 1.2 / np.maximum(b, 0.05), 0.0)
    floor = np.where((floor > 0) & (floor < 6), floor, 0.0)
    noisy = floor + (floor > 0) * sigma * np.random.default_rng(1).normal(size=floor.shape)
    assert np.median(noise_of(noisy)[floor > 0]) == pytest.approx(sigma, rel=0.3)


def test_noise_grows_where_it_does():
    sigma = np.repeat(np.linspace(0.01, 0.06, 160)[None], 124, axis=0)
    _, depth = steps(sigma)
    depth[20:110, 65:90] += 1.5
    told = noise_of(depth)
    assert told[:, :16].mean() < 0.025 and told[:, -16:].mean() > 0.045


@pytest.mark.parametrize("sigma", [0.005, 0.02, 0.05])
def test_the_filter_takes_noise_away_and_keeps_edges(sigma):
    truth, depth = steps(sigma)
    clear = denoised(depth, CAMERA)
    error = np.abs(clear - truth)[clear > 0]
    assert np.mean(clear > 0) > 0.97
    assert np.sqrt(np.mean(error**2)) < 0.4 * sigma  # 25 pixels, fewer along edges
    assert error.max() < 4.0 * sigma  # nothing between the surfaces


def test_flying_pixels_go_and_thin_limbs_stay():
    _, depth = steps(0.03)
    depth[50:54, 90:125] -= 1.5  # four pixels wide: 5 cm
    flying = np.zeros(depth.shape, bool)
    flying[20:110, [64]] = True
    depth[flying] = np.linspace(2.9, 3.6, 90)
    clear = denoised(depth, CAMERA)
    assert np.mean(clear[flying] > 0) < 0.05
    limb = clear[50:54, 92:123]
    assert np.mean(limb > 0) > 0.95 and np.abs(limb[limb > 0] - 2.5).max() < 0.1


def test_without_noise_nothing_changes():
    truth, _ = steps(0.0)
    np.testing.assert_array_equal(denoised(truth, CAMERA), truth.astype(np.float32))
    np.testing.assert_array_equal(noise_of(truth), 0.0)


def test_scattered_pixels_nothing_and_other_sizes():
    _, depth = steps(0.01)
    scattered = np.where((np.add.outer(np.arange(124), 3 * np.arange(160)) % 7) == 0, depth, 0.0).astype(np.float32)
    np.testing.assert_array_equal(denoised(scattered, CAMERA), scattered)
    assert not denoised(np.zeros((124, 160)), CAMERA).any() and not noise_of(np.full((5, 3), np.nan)).any()
    assert noise_of(np.ones((1, 1))).shape == (1, 1)
    with pytest.raises(ObservationError, match="shape"):
        denoised(np.ones((10, 10)), CAMERA)


def spoiled(depth, share=0.2, seed=0):
    """An image of which a share of the pixels lies anywhere; which ones."""
    random = np.random.default_rng(seed)
    wrong = random.random(depth.shape) < share
    return np.where(wrong, random.uniform(0.5, 5.5, depth.shape), depth).astype(np.float32), wrong


@pytest.mark.parametrize("sigma", [0.005, 0.03])
def test_pixels_that_stand_alone_go_and_surfaces_stay(sigma):
    truth, depth = steps(sigma)
    truth[50:52, 90:125] = depth[50:52, 90:125] = 1.2  # a limb two pixels wide
    image, wrong = spoiled(depth)
    out = without_speckles(image, CAMERA, sigma)
    far = wrong & (np.abs(image - truth) > 0.3)
    assert np.mean(out[far] > 0) < 0.02
    np.testing.assert_array_equal(out[out > 0], image[out > 0])
    assert np.mean(out[~wrong] > 0) > 0.99 and np.mean(out[50:52, 90:125][~wrong[50:52, 90:125]] > 0) > 0.85
    assert np.mean(without_speckles(depth, CAMERA, sigma) == depth) > 0.999


def test_what_went_is_closed_within_surfaces_alone():
    truth, depth = steps(0.005)
    image, wrong = spoiled(depth)
    out = without_speckles(image, CAMERA, closed=True)
    assert np.mean(out[wrong] > 0) > 0.9
    assert np.mean(np.abs(out - truth)[wrong & (out > 0)] < 0.15) > 0.97
    hole = depth.copy()
    hole[60:70, 70:80] = 0.0
    assert not without_speckles(hole, CAMERA, closed=True)[60:70, 70:80].any()


def test_an_image_of_scattered_pixels_and_small_ones_stay():
    _, depth = steps(0.01)
    scattered = np.where((np.add.outer(np.arange(124), 3 * np.arange(160)) % 7) == 0, depth, 0.0).astype(np.float32)
    np.testing.assert_array_equal(without_speckles(scattered, CAMERA), scattered)
    for shape in ((1, 1), (5, 1), (1, 5), (2, 2)):
        small = Camera("small", shape[::-1], [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1]])
        out = without_speckles(np.ones(shape), small)
        assert out.shape == shape and np.isin(out, (0.0, 1.0)).all()
    with pytest.raises(ObservationError, match="shape"):
        without_speckles(np.ones((10, 10)), CAMERA)
