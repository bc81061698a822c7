"""Quintic splines: through the pixels, as scipy's, and what they make of noise."""

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.images.photogrammetry.matching import _kernels_matching as kernels
from kinefit.images.photogrammetry.spline_image import SplineImage, grey, pixel_noise, template_share


@pytest.fixture
def image():
    return np.random.default_rng(2).uniform(0, 255, (34, 47))


def test_values_are_those_of_scipy(image):
    ndimage = pytest.importorskip("scipy.ndimage")
    uv = np.random.default_rng(3).uniform(4, 28, (200, 2))
    theirs = ndimage.map_coordinates(image, uv[:, ::-1].T, order=5, mode="mirror")
    np.testing.assert_allclose(SplineImage.of(image).values(uv), theirs, atol=1e-3)


def test_it_passes_through_the_pixels_and_has_none_beside_the_image(image):
    spline = SplineImage.of(image)
    inner = np.stack(np.meshgrid(np.arange(3, 43), np.arange(3, 30)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(spline.values(inner), image[inner[:, 1], inner[:, 0]], atol=1e-3)
    assert np.isnan(spline.values([[0.5, 10.0], [46.0, 10.0], [np.nan, 3.0]])).all()


@pytest.mark.parametrize("t", [0.0, 0.1, 0.37, 0.5, 0.99])
def test_weights_sum_to_one_and_slopes_are_their_derivatives(t):
    assert sum(kernels.weights(t)) == pytest.approx(1.0)
    ahead, behind = (np.array(kernels.weights(t + h)) for h in (1e-5, -1e-5))
    np.testing.assert_allclose(kernels.slopes(t), (ahead - behind) / 2e-5, atol=1e-8)
    np.testing.assert_allclose(kernels.weights32(np.float32(t)), kernels.weights(t), atol=1e-6)


@pytest.mark.parametrize("t", [0.0, 0.25, 0.4, 0.5])
def test_noise_that_a_value_and_a_slope_pass_on(t):
    impulse = np.zeros((101, 101))
    impulse[50, 50] = 1.0
    line = SplineImage.of(impulse).coefficients.sum(axis=0)  # along one axis
    rows = np.array([line[i - 2 : i + 4] for i in range(20, 80)])
    assert kernels.value_noise(t) == pytest.approx(((rows @ kernels.weights(t)) ** 2).sum(), abs=1e-4)
    assert kernels.slope_noise(t) == pytest.approx(((rows @ kernels.slopes(t)) ** 2).sum(), abs=2e-3)


def test_window_noise_is_the_mean_over_the_window():
    map_, n = (1.04, 0.13, -0.07, 0.97), 11
    j, i = np.mgrid[-5:6, -5:6]
    u, v = 20.3 + map_[0] * i + map_[1] * j, 18.6 + map_[2] * i + map_[3] * j
    each = [kernels.value_noise(a % 1) * kernels.value_noise(b % 1) for a, b in zip(u.ravel(), v.ravel())]
    assert kernels.window_noise(20.3, 18.6, *map_, n) == pytest.approx(np.mean(each), abs=5e-3)


def test_noise_of_a_picture_is_told_from_smooth_texture():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:200, :200]
    smooth = 100 + 50 * np.sin(x / 5) * np.cos(y / 6)
    assert pixel_noise((smooth + 3 * rng.normal(size=smooth.shape)).astype(np.float32)) == pytest.approx(3, rel=0.1)
    quiet, loud = (SplineImage.of(smooth + s * rng.normal(size=smooth.shape)) for s in (1.0, 3.0))
    assert template_share(quiet, loud) == pytest.approx(0.1, abs=0.03)


def test_colour_becomes_grey_and_what_is_no_image_is_refused():
    np.testing.assert_allclose(grey(np.full((20, 20, 3), 77, np.uint8)), 77, atol=1e-3)
    for wrong in (np.zeros((20, 20, 4)), np.zeros((5, 50)), np.zeros(9), np.full((20, 20), np.nan)):
        with pytest.raises(ObservationError):
            grey(wrong)


def test_smoothing_comes_first_where_it_is_asked_for(image):
    np.testing.assert_array_equal(SplineImage.of(image, smooth=0.0).grey, SplineImage.of(image).grey)
    told = SplineImage.of(image, smooth=1.0)
    weights = np.exp(-0.5 * np.arange(-2, 3) ** 2)
    kernel = np.outer(weights, weights) / weights.sum() ** 2
    window = SplineImage.of(image).grey[28:33, 38:43]
    assert told.grey[30, 40] == pytest.approx((kernel * window).sum(), rel=1e-5)
    with pytest.raises(ObservationError, match="smoothing of -1"):
        SplineImage.of(image, smooth=-1.0)
