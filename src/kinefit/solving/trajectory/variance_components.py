"""Estimate variance components of a sensor's errors: bias, drift and jitter of channels, and the bias of a group.

With e the error of channel c in frame t along one axis, in the sensor's own unit,

    e_c(t) = s + b_c + d_c(t) + j_c(t)

the shared bias s and the bias b_c are constant over the take, the drift d_c has the covariance σ_d² exp(−|Δt| / τ), and
the jitter j_c is white. The components are estimated by moments: half the mean squared change over a time lag (the
variogram; Matheron, *Principles of geostatistics*, 1963) is σ_j² + σ_d² (1 − exp(−Δt / τ)), and the mean square is the
sum of all components.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NORMAL_MAD = 0.6745  # median |x| of a standard normal variable
_OUTLIER_QUANTILE = 3.72  # standard normal quantile of probability 0.9999
_PRIOR_SAMPLES = 10.0  # samples of a channel that the scale of its pool counts as
_MIN_PAIRS = 30  # pairs of frames of a pool; a pool with fewer gets the median jitter and drift of the others
_MAX_LAG_S = 2.0
_LAGS = 12
_MIN_LAGS = 3  # with fewer, drift cannot be distinguished
_TIME_CONSTANTS = 40  # that are tried
_MIN_RESIDUAL_SHARE = 0.1  # of an error's variance: with less in the residuals its size cannot be estimated


@dataclass(frozen=True, eq=False)
class VarianceComponents:
    """Standard deviations of the errors of C channels along A axes, in the unit of the residuals.

    Parameters
    ----------
    bias : (C,) of the constant part of each channel
    drift : (C,) of the part that is correlated in time
    jitter : (C,) of the white part
    shared : (G, A) constant part that all channels of a group share
    drift_time : [s] time constant of the drift, in which its correlation falls to 1/e
    bias_error : (C,) square root of the standard error of bias², from jitter and drift
    outlier : (F, C) bool, residuals that were excluded
    drift_share : share of the drift's variance that is left in its mean over the frames that a smoothing fit averages
    """

    bias: NDArray
    drift: NDArray
    jitter: NDArray
    shared: NDArray
    drift_time: float
    bias_error: NDArray
    outlier: NDArray
    drift_share: float = 1.0

    @property
    def smoothed_drift(self) -> NDArray:
        """(C,) standard deviation of the drift's mean over the frames that a smoothing fit averages."""
        return np.asarray(np.sqrt(self.drift_share) * self.drift)

    @property
    def white(self) -> NDArray:
        """(C,) standard deviation of what averages out over these frames: the jitter, and the rest of the drift."""
        return np.asarray(np.sqrt(self.jitter**2 + (1.0 - self.drift_share) * self.drift**2))

    @property
    def systematic(self) -> NDArray:
        """(C,) standard deviation of systematic errors, which do not average out over neighbouring frames."""
        return np.asarray(np.sqrt(self.bias**2 + self.drift**2 + self.bias_error**2))

    def summary(self, unit: str, digits: int, groups: Sequence[str] = ()) -> dict[str, Any]:
        """Medians over the channels, rounded, and the shared bias of each group by name."""
        parts = (("bias", self.bias), ("drift", self.drift), ("jitter", self.jitter))
        shared = self.shared.round(digits).tolist()
        return {f"{name} [{unit}]": round(float(np.median(value)), digits) for name, value in parts} | {
            "drift time [s]": round(self.drift_time, 2),
            f"shared [{unit}]": dict(zip(groups, shared)) if groups else shared[0],
        }


def variance_components(
    residuals: NDArray, times: NDArray | None = None, *, leverage: NDArray | None = None, window: int = 1,
    pool: NDArray | None = None, group: NDArray | None = None,
) -> VarianceComponents:  # fmt: skip
    """Estimate bias, drift and jitter from the residuals of a fit.

    Parameters
    ----------
    residuals : (F, C, A) measured minus fitted, NaN where missing
    times : (F,) [s], increasing; None for frames so far apart that their drift is uncorrelated: it counts as jitter
    leverage : (C,) share of the variance of each channel's bias that the fit absorbs; below 0 where it adds errors of
        other channels; default: 0
    window : consecutive frames whose errors a smoothing fit averages: of jitter and drift it absorbs less
    pool : (C,) int, channels of one number have the same standard deviations; default: all
    group : (C,) int from 0, channels of one number share a bias; default: all
    """
    C = residuals.shape[1]
    pool = np.zeros(C, np.int64) if pool is None else np.unique(pool, return_inverse=True)[1]
    group = np.zeros(C, np.int64) if group is None else group
    outlier = _outliers(residuals, pool)
    r = np.where(outlier[..., None], np.nan, residuals)
    shared, centre = _shared(_means(r), group)
    r = r - centre
    mean, known = _means(r), np.isfinite(r)
    count, axes = known.sum(axis=(0, 2)), np.any(known, axis=0).sum(axis=1)
    bias2 = np.nansum(mean**2, axis=1) / np.maximum(axes, 1)
    clipped = np.minimum(bias2, _bias_limit(bias2, axes, pool))
    within = _mean_of_pools(np.nansum((r - mean) ** 2, axis=(0, 2)) / np.maximum(count, 1), count, pool)
    square = within + _mean_of_pools(clipped, count, pool)
    jitter2, drift2, drift_time = _jitter_and_drift(r, times, pool, square)
    systematic2 = np.maximum(square - jitter2, 0.0)
    drift2 = np.minimum(drift2, systematic2)
    of_mean = np.maximum(jitter2 + drift2 - within, 0.0)  # variance of a channel's mean from jitter and drift
    error2 = of_mean * np.sqrt(2.0 / np.maximum(np.bincount(pool, axes), 1))
    leverage = _mean_of_pools(np.zeros(C) if leverage is None else leverage, count, pool)
    # The fit takes h d̄ from an error d, with d̄ its mean over the window and h the leverage of an error that lasts.
    lasting, with_mean = _averaged(window, times, drift_time)
    absorbed = np.array([[1.0], [2.0 * with_mean - lasting], [1.0 / window]]) * leverage
    factor, drift_factor, jitter_factor = _inflation(1.0 - absorbed)
    pooled2, error2 = ((v * factor)[pool] for v in (systematic2 - drift2, error2))
    drift2, jitter2 = (drift2 * drift_factor)[pool], (jitter2 * jitter_factor)[pool]
    bias2 = pooled2 + (bias2 - clipped)
    bias, drift, jitter, error = (np.sqrt(v) for v in (bias2, drift2, jitter2, error2))
    return VarianceComponents(bias, drift, jitter, shared, drift_time, error, outlier, lasting)


def _averaged(window: int, times: NDArray | None, drift_time: float) -> tuple[float, float]:
    """Variance of the mean of a drift of variance 1 over a window of frames, and its covariance with the middle one."""
    frames = np.arange(window)
    if times is None or len(times) < 2:
        correlation = np.eye(window)
    else:
        correlation = np.exp(-np.abs(frames - frames[:, None]) * float(np.median(np.diff(times))) / drift_time)
    return float(correlation.mean()), float(correlation[window // 2].mean())


def _inflation(remaining: NDArray) -> NDArray:
    """Factor on variances whose share `remaining` is in the residuals: about 1 / remaining, falling to 0 near 0."""
    floor2 = _MIN_RESIDUAL_SHARE**2
    return np.asarray(np.where(remaining > 0.0, remaining * (1.0 + floor2) / (remaining**2 + floor2), 0.0))


def _outliers(residuals: NDArray, pool: NDArray) -> NDArray:
    """(F, C) bool: outliers from the channel's own distribution over time."""
    known = np.isfinite(residuals)
    square = (residuals - _medians(residuals, axis=0)) ** 2
    scale2, count = _medians(square, axis=(0, 2)) / _NORMAL_MAD**2, known.sum(axis=(0, 2))
    of_pool = _median_of_pools(scale2, pool)
    scale2 = (count * np.nan_to_num(scale2) + _PRIOR_SAMPLES * of_pool) / (count + _PRIOR_SAMPLES)
    limit = np.where(scale2 > 0.0, scale2 * _chi_square(known.sum(axis=2), _OUTLIER_QUANTILE), np.inf)
    return np.asarray(np.nansum(square, axis=2) > limit)


def _shared(mean: NDArray, group: NDArray) -> tuple[NDArray, NDArray]:
    """(G, A) size of the bias that a group shares, shrunk by its variance; (C, A) signed, of each channel's group."""
    shared, centre = np.zeros((int(group.max(initial=-1)) + 1, mean.shape[1])), np.zeros(mean.shape)
    for g in np.flatnonzero(np.bincount(group, minlength=len(shared)) > 1):
        own = mean[group == g]
        away2 = (own - _medians(own, axis=0)) ** 2
        inlier = away2 <= _chi_square(np.ones(1), _OUTLIER_QUANTILE) * _medians(away2, axis=0) / _NORMAL_MAD**2
        count, own = inlier.sum(axis=0), np.where(inlier, own, 0.0)
        middle = own.sum(axis=0) / np.maximum(count, 1)
        spread2 = np.where(inlier, own - middle, 0.0) ** 2
        variance = spread2.sum(axis=0) / np.maximum(count - 1, 1) / np.maximum(count, 1)
        shared2 = np.where(count > 1, np.maximum(middle**2 - variance, 0.0), 0.0)
        shared[g] = np.sqrt(shared2)
        centre[group == g] = shared2 / np.where(middle == 0.0, 1.0, middle)
    return shared, centre


def _bias_limit(bias2: NDArray, axes: NDArray, pool: NDArray) -> NDArray:
    """(C,) squared bias per axis above which a channel is an outlier of its pool."""
    scale2 = np.where(axes > 0, bias2 * axes / _chi_square(axes, 0.0), np.nan)
    return _median_of_pools(scale2, pool) * _chi_square(axes, _OUTLIER_QUANTILE) / np.maximum(axes, 1)


def _jitter_and_drift(
    r: NDArray, times: NDArray | None, pool: NDArray, square: NDArray
) -> tuple[NDArray, NDArray, float]:
    """Variances (P,) of jitter and drift, and the drift's time constant [s], from each pool's variogram.

    If no pool has enough pairs of frames, the mean square (P,) of a pool counts as its jitter.
    """
    F, P = len(r), len(square)
    lags = np.unique(np.round(np.geomspace(1, max(F // 2, 1), _LAGS)).astype(int))
    lags = lags[lags < F]
    dt = np.array([np.median(times[k:] - times[:-k]) if times is not None else np.inf for k in lags])
    near = dt <= max(_MAX_LAG_S, dt.min(initial=np.inf))
    lags, dt, gamma, pairs = lags[near], dt[near], np.zeros((near.sum(), P)), np.zeros((near.sum(), P))
    for k, lag in enumerate(lags):
        change = r[lag:] - r[:-lag]
        gamma[k] = 0.5 * np.bincount(pool, np.nansum(change**2, axis=(0, 2)), P)
        pairs[k] = np.bincount(pool, np.isfinite(change).sum(axis=(0, 2)), P)
    gamma, known = gamma / np.maximum(pairs, 1), pairs.sum(axis=0) >= _MIN_PAIRS
    if not known.any():
        return square, np.zeros(P), _MAX_LAG_S
    weight = pairs / lags[:, None]  # of pairs that do not overlap
    taus = np.full(1, _MAX_LAG_S)
    if times is not None and len(dt) >= _MIN_LAGS:  # a drift that decays within two frames is jitter
        taus = np.geomspace(2.0 * dt[0], 2.0 * dt[-1], _TIME_CONSTANTS)
    fits = [_fitted(gamma, weight, -np.expm1(-dt / tau)) for tau in taus]
    scale = np.maximum((weight * gamma**2).sum(axis=0), 1e-300)
    best = int(np.argmin([np.sum((loss / scale)[known]) for _, _, loss in fits]))
    jitter2, drift2 = (np.where(known, v, np.median(v[known])) for v in fits[best][:2])
    return jitter2, drift2, float(taus[best])


def _fitted(gamma: NDArray, weight: NDArray, rise: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Variances (P,) of jitter and drift, neither below 0, that fit γ (L, P) ≈ σ_j² + σ_d² rise (L,); residual sum."""
    g, y = rise[:, None], gamma
    w, wg, wgg, wy, wgy = (np.sum(weight * v, axis=0) for v in (1.0, g, g * g, y, g * y))
    drift = np.maximum((w * wgy - wg * wy) / np.maximum(w * wgg - wg**2, 1e-9 * w * w + 1e-300), 0.0)
    jitter = (wy - drift * wg) / np.maximum(w, 1e-300)
    drift = np.where(jitter < 0.0, wgy / np.maximum(wgg, 1e-300), drift)
    jitter = np.maximum(jitter, 0.0)
    return jitter, drift, np.sum(weight * (y - jitter - drift * g) ** 2, axis=0)


def _chi_square(dof: NDArray, quantile: float) -> NDArray:
    """χ² with `dof` degrees of freedom at a standard normal quantile (Wilson and Hilferty, 1931)."""
    spread = 2.0 / (9.0 * np.maximum(dof, 1))
    return np.asarray(np.maximum(dof, 1) * (1.0 - spread + quantile * np.sqrt(spread)) ** 3)


def _mean_of_pools(values: NDArray, weight: NDArray, pool: NDArray) -> NDArray:
    """(P,) weighted mean of values (C,) in each pool, 0 for a pool without weight."""
    return np.asarray(np.bincount(pool, values * weight) / np.maximum(np.bincount(pool, weight), 1e-300))


def _median_of_pools(values: NDArray, pool: NDArray) -> NDArray:
    """(C,) median of the values (C,) in each channel's pool, 0 for a pool without values."""
    out = np.zeros(len(values))
    for p in range(int(pool.max(initial=-1)) + 1):
        known = values[(pool == p) & np.isfinite(values)]
        out[pool == p] = np.median(known) if len(known) else 0.0
    return out


def _means(r: NDArray) -> NDArray:
    """(C, A) means over frames, without NaN; NaN if all are."""
    count = np.isfinite(r).sum(axis=0)
    return np.where(count > 0, np.nansum(r, axis=0) / np.maximum(count, 1), np.nan)


def _medians(values: NDArray, axis: int | tuple[int, ...]) -> NDArray:
    """Medians along the first axis, or the first and the last, without NaN; NaN if all are."""
    columns = values
    if axis != 0:
        columns = np.moveaxis(values, -1, 1).reshape(len(values) * values.shape[-1], *values.shape[1:-1])
    if not len(columns):
        return np.full(columns.shape[1:], np.nan)
    ordered, count = np.sort(columns, axis=0).reshape(len(columns), -1), np.isfinite(columns).sum(axis=0)
    column, k = np.arange(ordered.shape[1]), count.ravel()  # NaN is sorted last
    middle = 0.5 * (ordered[np.maximum(k - 1, 0) // 2, column] + ordered[k // 2, column])
    return np.asarray(np.where(count > 0, middle.reshape(count.shape), np.nan))
