"""Strain of deformations that are known."""

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.images.photogrammetry.strain import scatter, strain

I, J = (a.ravel().astype(float) for a in np.meshgrid(np.arange(24), np.arange(18)))
FLAT = np.column_stack([I, J]) * 0.5


def test_a_homogeneous_deformation_and_a_turn():
    F = np.array([[1.02, 0.03], [-0.01, 0.97]])
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    E = 0.5 * (F.T @ F - np.eye(2))
    for A in (F, turn @ F):
        told = strain(FLAT, FLAT @ (A - np.eye(2)).T, 24, gauge=3.0, unit="px")
        good = np.isfinite(told.xx)
        assert good[(I > 2) & (I < 21)].all() and not good[0]  # at a corner less than half of the gauge is there
        np.testing.assert_allclose(told.xx[good], E[0, 0], atol=1e-9)
        np.testing.assert_allclose(told.xy[good], E[0, 1], atol=1e-9)
        np.testing.assert_allclose(told.yy[good], E[1, 1], atol=1e-9)
        np.testing.assert_allclose([told.first[200], told.second[200]], np.linalg.eigvalsh(E)[::-1], atol=1e-9)
    assert told.rotation[200] == pytest.approx(0.4 + np.arctan2(F[1, 0] - F[0, 1], F.trace()), abs=0.03)
    assert told.gauge == pytest.approx(3.0) and told.unit == "px"


def test_a_cylinder_that_grows_strains_around_and_one_that_turns_does_not():
    angle, radius = I * 0.03, 0.05
    x = np.column_stack([radius * np.sin(angle), 0.002 * J, -radius * np.cos(angle)])
    T = se3.exp(np.array([0.1, 0.2, -0.1, 0.3, 0.5, -0.2]))
    told = strain(x, se3.apply(T, x) - x, 24, gauge=0.01)
    np.testing.assert_allclose([np.nanmax(np.abs(a)) for a in (told.xx, told.yy, told.xy)], 0.0, atol=1e-9)
    told = strain(x, x * (0.01, 0.0, 0.01), 24, gauge=0.01)
    middle = 9 * 24 + 12
    assert told.xx[middle] == pytest.approx(0.5 * (1.01**2 - 1), rel=1e-6)
    assert told.yy[middle] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("shared", [1, 4], ids=["windows apart", "windows that share pixels"])
def test_standard_deviations_are_those_of_repeated_noise(shared):
    """Means over `shared` x `shared` values correlate as windows of so many steps do; three times as much along z."""
    rng, strains, stated, moved, scattered = np.random.default_rng(0), [], [], [], []
    flat, middle = np.column_stack([FLAT, np.zeros(len(FLAT))]), 9 * 24 + 12
    for _ in range(150):
        noise = rng.normal(size=(18 + shared - 1, 24 + shared - 1, 3)) * (0.01, 0.01, 0.03)
        d = sliding_window_view(noise, (shared, shared), axis=(0, 1)).mean(axis=(3, 4)).reshape(-1, 3)
        told = strain(flat, d, 24, gauge=4.0, window=0.5 * shared)
        strains.append((told.xx[middle], told.yy[middle], told.xy[middle]))
        stated.append((told.std_xx[middle], told.std_yy[middle], told.std_xy[middle]))
        moved.append(d[middle])
        scattered.append(scatter(flat, d, 24, window=0.5 * shared)[middle])
    np.testing.assert_allclose(np.std(strains, axis=0), np.sqrt(np.mean(np.square(stated), axis=0)), rtol=0.25)
    np.testing.assert_allclose(np.std(moved, axis=0), np.sqrt(np.mean(np.square(scattered), axis=0)), rtol=0.25)
    floor = told.rms()
    assert floor["xx"] == pytest.approx(np.sqrt(np.nanmean(told.xx**2))) and set(floor) == {"xx", "yy", "xy"}


def test_a_gauge_that_is_half_empty_tells_nothing():
    moved = np.zeros_like(FLAT)
    moved[I < 12] = np.nan
    told = strain(FLAT, moved, 24, gauge=3.0, unit="px")
    assert np.isnan(told.xx[I < 12]).all() and np.isfinite(told.xx[(I > 15) & (J > 2) & (J < 15)]).all()


@pytest.mark.parametrize("wrong", [{"gauge": 0.6}, {"columns": 23}, {"columns": 1}])
def test_grids_and_gauges_that_are_none(wrong):
    arguments = {"gauge": 3.0, "columns": 24} | wrong
    with pytest.raises(ObservationError):
        strain(FLAT, np.zeros_like(FLAT), arguments["columns"], gauge=arguments["gauge"])
