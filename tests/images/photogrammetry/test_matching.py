"""Least-squares matching: shifts, deformations and grey values that are known, and standard deviations that hold."""

import numpy as np
import pytest
from tests.images.photogrammetry import scenes

from kinefit.errors import ObservationError
from kinefit.images.photogrammetry.least_squares_matching import match, variance_factor, windows_by_texture
from kinefit.images.photogrammetry.matching import _kernels_matching as kernels
from kinefit.images.photogrammetry.spline_image import SplineImage

AT = np.stack(np.meshgrid(np.arange(30, 130, 12.0), np.arange(30, 90, 12.0)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("move", [(0.3, -0.2), (0.5, 0.5), (-0.05, 0.45)])
def test_a_shift_is_found_to_thousandths_without_noise(move):
    first, second = scenes.pair(move=move)
    found = match(first, second, AT)
    assert found.found.all()
    np.testing.assert_allclose(found.uv - AT, np.broadcast_to(move, AT.shape), atol=2e-3)
    np.testing.assert_allclose(found.gain, 1.0, atol=5e-3)


def test_an_affine_map_and_grey_values_are_found():
    deform = np.array([[1.06, 0.05], [-0.04, 0.95]])
    first, second = scenes.pair(deform=deform)
    second = SplineImage.of(0.7 * second.grey + 40)
    middle = np.array([80.0, 60.0])
    goal = (AT - middle) @ deform.T + middle
    found = match(first, second, AT, np.rint(goal))
    assert found.found.mean() > 0.95
    good = found.found
    np.testing.assert_allclose(found.uv[good], goal[good], atol=0.01)
    np.testing.assert_allclose(np.median(found.deformation[good], axis=0), deform, atol=5e-3)
    np.testing.assert_allclose(np.median(found.gain[good]), 0.7, atol=5e-3)
    np.testing.assert_allclose(np.median(found.offset[good]), 40, atol=1.0)
    assert np.median(found.correlation[good]) > 0.999


def test_windows_between_pixels_and_of_their_own_size():
    first, second = scenes.pair(move=(0.3, -0.2))
    sides = np.where(np.arange(len(AT)) % 2, 11, 21)
    found = match(first, second, AT + 0.37, window=sides)
    np.testing.assert_allclose(found.uv - AT - 0.37, np.broadcast_to((0.3, -0.2), AT.shape), atol=3e-3)


def test_the_normal_matrix_is_that_of_its_columns():
    first, _ = scenes.pair()
    half, n = 4, 9
    f, fx, fy = (np.empty((n, n), np.float32) for _ in range(3))
    mean = kernels.template(first.coefficients, 50.4, 40.7, half, f, fx, fy, np.empty((2, n + 5)))
    m = np.empty((8, 8))
    kernels.normal_matrix(f, fx, fy, half, mean, m)
    y, x = np.mgrid[-half : half + 1, -half : half + 1] / half
    columns = [x * fx, y * fx, x * fy, y * fy, np.ones((n, n)), f - mean, fx, fy]
    J = np.stack([c.ravel() for c in columns], axis=1).astype(float)
    np.testing.assert_allclose(np.tril(m), np.tril(J.T @ J), rtol=1e-5, atol=1e-2)
    assert kernels.factor(m, 8)
    b = np.arange(8.0)
    kernels.solve(m, b, 8)
    np.testing.assert_allclose(J.T @ J @ b, np.arange(8.0), atol=1e-3)
    around = first.values(np.array([50.4, 40.7]) + half * np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(n, n)
    np.testing.assert_allclose(f, around, atol=1e-3)
    inner = np.array([50.4, 40.7]) + half * np.stack([x, y], axis=-1).reshape(-1, 2)
    step = [first.values(inner + (h, 0.0)) for h in (0.01, -0.01)]
    np.testing.assert_allclose(fx.ravel(), (step[0] - step[1]) / 0.02, atol=0.1)


def test_standard_deviations_hold_whichever_image_is_the_noisy_one():
    rng = np.random.default_rng(9)
    clean = scenes.pair(size=(300, 300), move=(0.3, 0.2), grain=1.3)
    grid = np.stack(np.meshgrid(*[np.arange(15, 286, 15.0)] * 2), axis=-1).reshape(-1, 2)
    for levels in ((5.0, 5.0), (8.0, 1.0), (1.0, 8.0)):
        pair = [SplineImage.of(c.grey + s * rng.normal(size=c.grey.shape)) for c, s in zip(clean, levels)]
        found = match(*pair, grid)
        z = ((found.uv - grid - (0.3, 0.2)) / found.std)[found.found]
        assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1
        assert np.median(found.noise[found.found]) == pytest.approx(np.hypot(*levels), rel=0.1)


def test_noise_of_neighbours_that_goes_together_widens_the_intervals():
    import cv2

    rng, clean = np.random.default_rng(3), scenes.pair(size=(240, 240), move=(0.3, 0.2), grain=2.0)
    noisy = [
        SplineImage.of(c.grey + cv2.GaussianBlur(12 * rng.normal(size=c.grey.shape), (0, 0), 1.0)) for c in clean
    ]
    grid = np.stack(np.meshgrid(*[np.arange(15, 226, 15.0)] * 2), axis=-1).reshape(-1, 2)
    found = match(*noisy, grid)
    z = ((found.uv - grid - (0.3, 0.2)) / found.std)[found.found]
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.7  # 2.9 where every pixel's noise is taken for new
    rows = np.zeros((len(grid), 8))
    assert variance_factor(*noisy, grid[:5], rows, np.full(5, 6)) == 1.0  # too few to tell


def test_a_pyramid_finds_what_is_far_away():
    first, second = scenes.pair(size=(320, 240), move=(9.3, -6.8), grain=4.0)
    grid = np.stack(np.meshgrid(np.arange(60, 260, 25.0), np.arange(60, 180, 25.0)), axis=-1).reshape(-1, 2)
    assert not (np.abs(match(first, second, grid, window=21).uv - grid - (9.3, -6.8)).max(axis=1) < 0.1).any()
    found = match(first, second, grid, window=21, levels=2)
    np.testing.assert_allclose(found.uv - grid, np.broadcast_to((9.3, -6.8), grid.shape), atol=0.02)


def test_what_cannot_be_matched_says_why():
    first, second = scenes.pair()
    flat = SplineImage.of(np.full((120, 160), 90.0))
    assert (match(flat, second, AT).status == kernels.FLAT).all()
    noise = np.random.default_rng(1).normal(size=(2, 120, 160))
    told = match(SplineImage.of(90 + noise[0]), SplineImage.of(90 + noise[1]), AT)
    assert not (told.found & (told.correlation > 0.8)).any()
    assert match(first, second, [[3.0, 3.0], [np.nan, 50.0]]).status.tolist() == [kernels.OUTSIDE_IMAGE] * 2
    gone = match(first, second, [[80.0, 60.0]], [[400.0, 60.0]])
    assert gone.status[0] == kernels.OUTSIDE_IMAGE and np.isnan(gone.uv).all()


@pytest.mark.parametrize("window", [12, 3, 999, [13, 13]])
def test_windows_that_are_none(window):
    first, second = scenes.pair()
    with pytest.raises(ObservationError):
        match(first, second, AT, window=window)


def test_shapes_that_do_not_fit():
    first, second = scenes.pair()
    for wrong in ({"starts": AT[:3]}, {"deformation": np.eye(3)}, {"levels": 4}):
        with pytest.raises(ObservationError):
            match(first, second, AT, **wrong)
    with pytest.raises(ObservationError):
        match(first, second, np.zeros((4, 3)))


def test_smaller_windows_where_there_is_more_texture():
    first, second = scenes.pair(size=(240, 160), noise=3.0)
    grey = first.grey.copy()
    grey[:, 120:] = 100 + 0.25 * (grey[:, 120:] - 100)
    y = np.arange(40, 120, 10.0)
    strong, weak = (windows_by_texture(SplineImage.of(grey), second, np.c_[np.full(len(y), x), y]) for x in (60, 180))
    assert np.median(strong) < np.median(weak)
    assert match(SplineImage.of(grey), second, np.c_[np.full(len(y), 60), y], window=strong).std.max() < 0.06
