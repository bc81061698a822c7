"""The noise of a depth image is told from the image; the filter takes it away and leaves surfaces and edges."""

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images.depth_noise import denoised, noise_of

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
