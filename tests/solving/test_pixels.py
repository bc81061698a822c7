"""The compiled fit to pixels: the same minima, in the same steps, as Levenberg-Marquardt with rows."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import posture

from kinefit.bodies import load_body
from kinefit.fitting.frame.prediction import prediction_row
from kinefit.geometry.losses import SQUARED, geman_mcclure, huber
from kinefit.simulation import squat_and_wave, studio_rig
from kinefit.solving.correspondences.points import pixel_rows, prior_rows
from kinefit.solving.least_squares import INITIAL_DAMPING, PixelPoints, fit_pixels, levenberg_marquardt

BODY = load_body("humanoid")
RIG = studio_rig(squat_and_wave())
SIGMA = 4.0  # [px]


def seen(seed, wrong=0):
    """A start, points in all cameras with some far off, and what was predicted; the true pose is near the middle."""
    random = np.random.default_rng(seed)
    middle = squat_and_wave()
    root = middle.Ts_world_root[0]
    truth = posture(BODY, seed, 0.2)
    truth = type(truth)(root, truth.angles)
    count = len(BODY.landmarks)
    camera = np.repeat(np.arange(len(RIG)), count)
    points = BODY.landmarks.select(BODY.landmarks.names * len(RIG))
    uv = RIG.project(BODY.positions(truth, points), camera) + SIGMA * random.normal(size=(len(camera), 2))
    weight = np.full(len(camera), SIGMA**-2)
    weight[random.random(len(camera)) < 0.2] = 0.0
    weight[~np.isfinite(uv).all(axis=1)] = 0.0
    uv[random.choice(len(uv), wrong, replace=False)] += 150.0
    off = 0.05 * random.normal(size=BODY.tree.n_dofs)
    half = random.normal(size=(BODY.tree.n_dofs, BODY.tree.n_dofs))
    information = 20.0 * half @ half.T / len(half) + 50.0 * np.eye(len(half))
    return truth.retract(off, (BODY.tree.lower, BODY.tree.upper)), points, camera, uv, weight, information


@pytest.mark.parametrize("wrong", [0, 8])
@pytest.mark.parametrize("loss", [SQUARED, huber(), geman_mcclure(), geman_mcclure(15.0)])
@pytest.mark.parametrize("most", [3, 40])
def test_it_takes_the_steps_of_levenberg_marquardt(loss, wrong, most):
    for seed in (1, 2):
        state, points, camera, uv, weight, information = seen(seed, wrong)
        given = {"max_iterations": most, "tolerance": 1e-4}

        def rows(at):
            measured = np.where((weight > 0)[:, None], uv, np.nan)  # noqa: B023
            pixels = replace(pixel_rows(BODY, at, points, RIG, camera, measured, sigma=SIGMA), loss=loss)  # noqa: B023
            return [pixels, prediction_row(at, state, information), prior_rows(BODY, at)]  # noqa: B023

        fit = levenberg_marquardt(BODY, state, rows, damping=INITIAL_DAMPING, **given)
        found, H, g, cost, tried = fit_pixels(
            BODY, state, RIG, PixelPoints(points, camera, uv, weight, loss), (state, information), **given
        )
        assert tried == fit.iterations
        assert cost == pytest.approx(fit.equations.cost, rel=1e-9)
        np.testing.assert_allclose(H, fit.equations.matrix, rtol=1e-6, atol=1e-7 * np.abs(H).max())
        np.testing.assert_allclose(g, fit.equations.gradient, atol=1e-6 * np.abs(H).max())
        np.testing.assert_allclose(found.difference(fit.state), 0.0, atol=1e-7)


def test_what_is_not_finite_is_left_to_those_who_tell_why():
    state, points, camera, uv, weight, information = seen(3)
    uv[0], weight[0] = np.nan, 1.0
    assert fit_pixels(
        BODY, state, RIG, PixelPoints(points, camera, uv, weight, SQUARED), (state, information), max_iterations=5,
        tolerance=1e-4,
    ) is None  # fmt: skip
