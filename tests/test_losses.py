"""Robust losses against their formulas."""

import numpy as np
import pytest

from kinefit.geometry.losses import SQUARED, Loss, geman_mcclure, huber, tukey
from kinefit.geometry.losses import _kernels as kernels

S = np.array([0.0, 0.3, 1.0, 1.9, 2.1, 4.0, 30.0])  # none on a seam

FORMULAS = {
    "squared": (SQUARED, lambda s: s**2),
    "huber": (huber(2.0), lambda s: np.where(s <= 2, s**2, 4 * s - 4)),
    "tukey": (tukey(2.0), lambda s: np.where(s <= 2, 4 / 3 * (1 - (1 - np.minimum(s / 2, 1) ** 2) ** 3), 4 / 3)),
    "geman-mcclure": (geman_mcclure(2.0), lambda s: s**2 / (1 + s**2 / 4)),
}
losses = pytest.mark.parametrize(("loss", "rho"), FORMULAS.values(), ids=FORMULAS)


def kernel(loss, s2):
    return np.array([kernels.robust(loss.kind, loss.scale, v) for v in np.asarray(s2, float)]).T


@losses
def test_formula(loss, rho):
    np.testing.assert_allclose(kernel(loss, S**2)[0], rho(S), rtol=1e-14, atol=1e-15)


@losses
def test_the_weight_is_the_derivative(loss, rho):
    h = 1e-6
    slope = (kernel(loss, S**2 + h)[0] - kernel(loss, np.maximum(S**2 - h, 0))[0]) / (h + np.minimum(h, S**2))
    np.testing.assert_allclose(kernel(loss, S**2)[1], slope, atol=1e-6)


@losses
def test_small_residuals_count_in_full(loss, rho):
    value, weight = kernel(loss, [0.0, 1e-8])
    np.testing.assert_allclose(weight, 1, atol=1e-8)
    np.testing.assert_allclose(value, [0, 1e-8], rtol=1e-8)


@losses
def test_weights_never_rise(loss, rho):
    weight = kernel(loss, np.linspace(0, 20, 500) ** 2)[1]
    assert np.all(np.diff(weight) <= 1e-15) and weight.min() >= 0


def test_scales():
    assert (huber().scale, tukey().scale, geman_mcclure().scale) == (1.345, 4.685, 3.0)
    for bad in (0.0, -1.0, np.nan):
        with pytest.raises(Exception, match="scale of a loss must be positive"):
            Loss(kernels.HUBER, bad)
