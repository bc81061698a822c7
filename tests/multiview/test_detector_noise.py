"""Jitter, drift and shifts of a detector, told apart by how residuals change from frame to frame."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.multiview.detector_noise import estimate_noise
from kinefit.sensors.channels import make_channels
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

MOTION = squat_and_wave(rate=60.0, duration=6.0)
RIG = studio_rig(MOTION)


def residuals(**errors):
    """Channels, and measured minus true pixels (F, N, 2)."""
    seen = simulate_keypoints(MOTION, RIG, **{"outliers": 0.0, "missing": 0.1, **errors})
    body = load_body("humanoid")
    channels = make_channels(body, RIG, seen, [3.0] * 4)
    true = simulate_keypoints(MOTION, RIG, noise_px=0.0, outliers=0.0, missing=0.0)
    exact = make_channels(body, RIG, true, [3.0] * 4)
    return channels, channels.uv - exact.uv


def factors(values):
    return np.isfinite(values).all(axis=2).astype(float)


@pytest.mark.parametrize(("white", "drift"), [(3.0, 0.0), (3.0, 3.0), (1.0, 5.0), (0.0, 4.0)])
def test_jitter_and_drift_are_told_apart(white, drift):
    channels, values = residuals(noise_px=white, drift_px=drift, drift_time=0.3)
    noise = estimate_noise(channels, values, factors(values), MOTION.rate)
    assert np.median(noise.white) == pytest.approx(white, abs=0.2 * max(white, drift))
    assert np.median(noise.drift) == pytest.approx(drift, abs=0.25 * max(white, drift))
    np.testing.assert_allclose(np.hypot(noise.white, noise.drift), np.hypot(white, drift), rtol=0.5)
    if drift:
        assert 0.1 < noise.memory < 0.6


def test_the_shift_of_a_camera_is_no_noise_of_its_points():
    channels, values = residuals(noise_px=2.0)
    values[:, channels.source == 1] += (6.0, -9.0)
    noise = estimate_noise(channels, values, factors(values), MOTION.rate)
    np.testing.assert_allclose(noise.shift[1], (6.0, 9.0), atol=0.3)
    assert noise.shift[[0, 2, 3]].max() < 0.3
    assert np.median(np.hypot(noise.white, noise.drift)) == pytest.approx(2.0, rel=0.15)


def test_outliers_are_not_noise():
    channels, values = residuals(noise_px=2.0, outliers=0.2)
    factor = (np.linalg.norm(np.nan_to_num(values, nan=1e6), axis=2) < 10.0).astype(float)
    noise = estimate_noise(channels, values, factor, MOTION.rate)
    assert np.median(np.hypot(noise.white, noise.drift)) == pytest.approx(2.0, rel=0.2)


def test_what_the_fit_follows_is_counted_back():
    channels, values = residuals(noise_px=3.0)
    hidden = np.full(values.shape[1], 0.5)
    half = estimate_noise(channels, values * np.sqrt(0.5), factors(values), MOTION.rate, leverage=hidden)
    assert np.median(half.white) == pytest.approx(3.0, rel=0.1)


def test_points_that_are_hardly_seen_are_taken_for_as_noisy_as_the_others():
    channels, values = residuals(noise_px=3.0)
    factor = factors(values)
    factor[:, channels.column == 0] = 0.0
    noise = estimate_noise(channels, values, factor, MOTION.rate)
    assert np.all(np.isfinite(noise.white)) and noise.white[channels.column == 0].min() > 2.0


def test_nothing_seen_gives_no_noise_and_no_nan():
    channels, values = residuals()
    noise = estimate_noise(channels, np.full_like(values, np.nan), np.zeros(values.shape[:2]), MOTION.rate)
    assert not np.isnan(noise.white).any() and not np.isnan(noise.drift).any() and noise.memory > 0


@pytest.mark.filterwarnings("error")
def test_residuals_that_never_change_have_no_memory_of_their_own():
    channels, values = residuals()
    noise = estimate_noise(channels, np.zeros_like(values), factors(np.zeros_like(values)), MOTION.rate)
    assert np.isfinite(noise.memory) and noise.memory > 0 and not np.isnan(noise.drift).any()
