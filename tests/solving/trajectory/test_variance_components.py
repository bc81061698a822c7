"""Variance components against truth: bias, drift with its time constant, jitter, shared bias; gaps, outliers, fits."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.sensors.channels import make_channels
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig
from kinefit.solving.trajectory.variance_components import variance_components

RATE, FRAMES = 60.0, 360
TIMES = np.arange(FRAMES) / RATE


def errors(*, unit=1.0, shape=(90, 3), bias=0.0, drift=0.0, jitter=0.0, shared=0.0, time=0.3, seed=0):
    """Residuals (F, C, A) with components of known standard deviations."""
    random = np.random.default_rng(seed)
    kept, x = np.exp(-1.0 / (RATE * time)), random.normal(size=shape)
    d = np.empty((FRAMES, *shape))
    for t in range(FRAMES):
        d[t] = x
        x = kept * x + np.sqrt(1.0 - kept**2) * random.normal(size=shape)
    white = random.normal(size=d.shape)
    return unit * (bias * random.normal(size=shape) + drift * d + jitter * white + shared)


CASES = [(0.0, 0.0, 3.0), (10.0, 0.0, 1.0), (0.0, 3.0, 3.0), (3.0, 0.0, 0.0), (4.0, 2.0, 2.0), (0.0, 5.0, 1.0)]


@pytest.mark.parametrize(("unit", "shape"), [(1.0, (90, 2)), (1e-3, (90, 3)), (0.01, (200, 1))], ids=["px", "m", "rad"])
@pytest.mark.parametrize(("bias", "drift", "jitter"), CASES)
def test_components_are_those_of_the_truth(unit, shape, bias, drift, jitter):
    found = variance_components(errors(unit=unit, shape=shape, bias=bias, drift=drift, jitter=jitter), TIMES)
    whole = np.hypot(np.hypot(bias, drift), jitter) * unit
    for estimate, truth in ((found.bias, bias), (found.drift, drift), (found.jitter, jitter)):
        assert np.median(estimate) == pytest.approx(truth * unit, abs=0.25 * whole)
    assert np.median(found.systematic) == pytest.approx(np.hypot(bias, drift) * unit, abs=0.2 * whole)
    assert found.outlier.mean() < 0.01
    if drift:
        assert 0.2 < found.drift_time < 0.45


def test_gaps_change_no_component():
    residuals = errors(bias=10.0, drift=3.0, jitter=3.0)
    whole = variance_components(residuals, TIMES)
    residuals[np.random.default_rng(1).random(residuals.shape[:2]) < 0.3] = np.nan
    gaps = variance_components(residuals, TIMES)
    for name in ("bias", "drift", "jitter"):
        assert np.median(getattr(gaps, name)) == pytest.approx(np.median(getattr(whole, name)), rel=0.15)


@pytest.mark.parametrize("half", [0, 3, 9])
def test_a_smoothing_fit_follows_the_mean_of_an_error(half):
    """Half of all directions follow the mean over a window; the components are those before the fit."""
    window, e = 2 * half + 1, errors(shape=(90, 3), drift=4.0, jitter=2.0)
    mean = np.apply_along_axis(np.convolve, 0, e, np.full(window, 1.0 / window), "same")
    basis = np.linalg.qr(np.random.default_rng(4).normal(size=(90, 45)))[0]
    left = (e - np.einsum("ck,dk,fda->fca", basis, basis, mean))[half : len(e) - half]
    found = variance_components(left, TIMES[: len(left)], leverage=np.full(90, 0.5), window=window)
    assert np.median(found.jitter) == pytest.approx(2.0, rel=0.3)
    assert np.median(found.drift) == pytest.approx(4.0, rel=0.25)
    drift = errors(shape=(90, 3), drift=1.0)
    smoothed = np.apply_along_axis(np.convolve, 0, drift, np.full(window, 1.0 / window), "valid")
    assert found.smoothed_drift[0] / found.drift[0] == pytest.approx(smoothed.std(), rel=0.15)


@pytest.mark.parametrize("always", [False, True])
def test_outliers_are_neither_drift_nor_bias(always):
    residuals, random = errors(jitter=3.0), np.random.default_rng(2)
    wrong = random.random(residuals.shape[1] if always else residuals.shape[:2]) < 0.05
    away = random.normal(size=(*wrong.shape, 3))
    residuals += np.where(wrong[..., None], 50.0 * away / np.linalg.norm(away, axis=-1, keepdims=True), 0.0)
    found = variance_components(residuals, TIMES)
    assert np.median(found.systematic) < 0.5
    assert np.median(found.jitter) == pytest.approx(3.0, rel=0.05)
    if always:  # channels that are always wrong have a bias of their own
        assert found.bias[wrong].min() > 15.0 and found.bias[~wrong].max() < 1.0
    else:
        assert np.mean(found.outlier[wrong]) > 0.99


def test_a_bias_that_jitter_explains_is_none_and_grows_without_a_jump():
    found = [variance_components(errors(bias=b, jitter=3.0), TIMES).bias[0] for b in np.linspace(0.0, 2.0, 21)]
    assert found[0] < 0.2 and found[-1] == pytest.approx(2.0, rel=0.2)
    assert np.diff(np.square(found)).max() < 0.6  # of 0.39 in the truth


def test_what_a_fit_follows_is_counted_back_by_each_channel():
    """A mean that is fitted to three channels in every frame, and to hundred others: their residuals lack its share."""
    few, many = errors(shape=(30, 3), bias=4.0, jitter=1.0), errors(shape=(99, 3), bias=4.0, jitter=1.0, seed=1)
    left = [e - e.reshape(FRAMES, -1, size, 3).mean(axis=2).repeat(size, axis=1) for e, size in ((few, 3), (many, 33))]
    residuals = np.concatenate(left, axis=1)
    leverage = np.repeat([1 / 3, 1 / 33], [30, 99])
    pool = np.repeat([0, 1], [30, 99])
    found = variance_components(residuals, TIMES, leverage=leverage, pool=pool)
    for channels in (slice(0, 30), slice(30, 129)):
        assert np.median(found.bias[channels]) == pytest.approx(4.0, rel=0.12)
        assert np.median(found.jitter[channels]) == pytest.approx(1.0, rel=0.05)
    without = variance_components(residuals, TIMES, pool=pool)
    assert np.median(without.bias[:30]) < 3.6


def test_what_the_fit_follows_whole_is_not_made_up():
    found = variance_components(errors(shape=(1, 1), jitter=3.0, drift=0.1), TIMES, leverage=np.ones(1))
    assert found.bias[0] == found.drift[0] == 0.0


def test_frames_far_apart_have_bias_and_jitter():
    found = variance_components(errors(bias=2.0, jitter=1.0)[::20])
    assert np.median(found.bias) == pytest.approx(2.0, rel=0.15) and found.drift.max() == 0.0
    assert np.median(found.jitter) == pytest.approx(1.0, rel=0.1)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("residuals", [np.full((60, 4, 2), np.nan), np.zeros((60, 4, 2)), np.ones((1, 4, 2))])
def test_nothing_seen_and_nothing_that_changes_give_numbers(residuals):
    found = variance_components(residuals, TIMES[: len(residuals)])
    for value in (found.bias, found.drift, found.jitter, found.shared, found.bias_error, found.drift_time):
        assert np.isfinite(value).all()


MOTION = squat_and_wave(rate=RATE, duration=FRAMES / RATE)
RIG = studio_rig(MOTION)


def pixels(**wrong):
    """Channels of a detector, and measured minus true pixels (F, N, 2)."""
    seen = simulate_keypoints(MOTION, RIG, **{"outliers": 0.0, "missing": 0.1, **wrong})
    body = load_body("humanoid")
    channels = make_channels(body, RIG, seen, [3.0] * 4)
    true = simulate_keypoints(MOTION, RIG, noise_px=0.0, outliers=0.0, missing=0.0)
    return channels, channels.uv - make_channels(body, RIG, true, [3.0] * 4).uv


def of_detector(channels, values):
    times = np.arange(len(values)) / RATE
    pool = np.minimum(channels.column, channels.column[channels.partner])
    return variance_components(values, times, pool=pool, group=channels.source)


@pytest.mark.parametrize(("white", "drift"), [(3.0, 0.0), (3.0, 3.0), (1.0, 5.0), (0.0, 4.0)])
def test_jitter_and_drift_of_a_detector_are_distinguished(white, drift):
    found = of_detector(*pixels(noise_px=white, drift_px=drift, drift_time=0.3))
    assert np.median(found.jitter) == pytest.approx(white, abs=0.2 * max(white, drift))
    assert np.median(found.systematic) == pytest.approx(drift, abs=0.25 * max(white, drift))
    np.testing.assert_allclose(np.hypot(found.jitter, found.systematic), np.hypot(white, drift), rtol=0.5)
    if drift:
        assert 0.1 < found.drift_time < 0.6


def test_the_bias_that_a_camera_shares_is_no_noise_of_its_points():
    channels, values = pixels(noise_px=2.0)
    values[:, channels.source == 1] += (6.0, -9.0)
    found = of_detector(channels, values)
    np.testing.assert_allclose(found.shared[1], (6.0, 9.0), atol=0.3)
    assert found.shared[[0, 2, 3]].max() < 0.3
    assert np.median(np.hypot(found.jitter, found.systematic)) == pytest.approx(2.0, rel=0.15)


def test_a_detectors_outliers_are_not_noise():
    found = of_detector(*pixels(noise_px=2.0, outliers=0.2))
    assert np.median(np.hypot(found.jitter, found.systematic)) == pytest.approx(2.0, rel=0.2)


def test_points_that_are_hardly_seen_are_as_noisy_as_the_others():
    channels, values = pixels(noise_px=3.0)
    values[:, channels.column == 0] = np.nan
    found = of_detector(channels, values)
    assert np.isfinite(found.jitter).all() and found.jitter[channels.column == 0].min() > 2.0


def test_nothing_seen_is_no_error():
    none = variance_components(np.zeros((5, 0, 2)), TIMES[:5])
    assert none.bias.shape == (0,) and none.outlier.shape == (5, 0)
    unseen = variance_components(np.full((5, 3, 2), np.nan), TIMES[:5])
    assert np.all(unseen.bias == 0.0) and np.all(unseen.jitter == 0.0) and not unseen.outlier.any()
