"""How a detector errs: jitter that is new in every frame, drift that lasts, and a shift of a whole camera.

Frames are not independent looks at a person: what a detector misses by in one frame it misses by in the next, and a
camera that is calibrated a little wrong shifts all its points alike. Only the jitter averages out over time. The three
are told apart by how residuals change from frame to frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.sensors.channels import Channels

_NORMAL = 0.6745  # median |x| of a normal variable with standard deviation 1
_INLIER = 0.25  # robust factor above which a residual is noise and not of an outlier
_FEW = 30  # samples of a point below which it is taken for as noisy as the others
_SPAN = 0.5  # [s] over which residuals are followed


@dataclass(frozen=True, eq=False)
class DetectorNoise:
    """Standard deviations of a detector's errors along u and v.

    Parameters
    ----------
    white : (N,) [px] of each channel, independent from frame to frame.
    drift : (N,) [px] of each channel, lasting about `memory`.
    memory : float [s] in which a drift forgets itself by 1/e.
    shift : (Q, 2) [px] what all points of a source have in common, always.
    """

    white: NDArray
    drift: NDArray
    memory: float
    shift: NDArray

    def as_told(self, sources: tuple[str, ...]) -> dict[str, Any]:
        """The same in a few numbers: medians over all channels."""
        return {
            "jitter [px]": round(float(np.median(self.white)), 2),
            "drift [px]": round(float(np.median(self.drift)), 2),
            "drift lasts [s]": round(self.memory, 2),
            "shift of a camera [px]": {q: s.round(2).tolist() for q, s in zip(sources, self.shift)},
        }


def estimate_noise(
    channels: Channels, values: NDArray, factor: NDArray, rate: float, *, leverage: NDArray | None = None
) -> DetectorNoise:
    """Noise from what a fit left over.

    Left and right points of all cameras of one keypoint set are taken together; those seen too rarely are taken for as
    noisy as the median one.

    Parameters
    ----------
    values : (F, N, 2) [px] measured minus fitted.
    factor : (F, N) robust factor of each, 0 where unseen.
    rate : float [Hz]
    leverage : (N,) share of a channel's own error that the fit follows, 0..1, and so hides from its residual.
    """
    used = np.isfinite(values).all(axis=2) & (factor > _INLIER)
    r = np.where(used[..., None], values, np.nan)
    shift = np.zeros((len(channels.sources), 2))
    for q in range(len(shift)):
        mine = r[:, channels.source == q]
        if np.isfinite(mine).any():
            shift[q] = np.nanmedian(mine, axis=(0, 1))
    r = r - shift[channels.source]
    hidden = np.zeros(r.shape[1]) if leverage is None else np.clip(leverage, 0.0, 0.9)
    total, white = np.full(r.shape[1], np.nan), np.full(r.shape[1], np.nan)
    for members in _alike(channels):
        together = r[:, members]
        steps = np.diff(together, axis=0)
        if np.isfinite(steps).sum() >= _FEW:
            kept = 1.0 - float(hidden[members].mean())
            total[members] = _variance(together) / kept
            white[members] = min(0.5 * _variance(steps) / kept, total[members][0])
    total = np.where(np.isfinite(total), total, _middle(total))
    white = np.where(np.isfinite(white), white, _middle(white))
    memory, whole = _memory(r, rate)
    drift = np.maximum(total - white, 0.0)
    # Between two frames a drift changes by 2 (1 - exp(-dt / memory)) of its variance, which looks like jitter.
    change = -np.expm1(-1.0 / (rate * memory))
    drift = np.where(whole, np.minimum(drift / max(1.0 - change, 0.1), total), drift)
    white = np.maximum(total - drift, 0.0)
    return DetectorNoise(np.sqrt(white), np.sqrt(drift), memory, np.abs(shift))


def _alike(channels: Channels) -> list[NDArray]:
    """Channels of one point, of its mirror image too, in all cameras."""
    lowest = np.minimum(channels.column, channels.column[channels.partner])
    return [np.flatnonzero(lowest == k) for k in np.unique(lowest)]


def _variance(values: NDArray) -> float:
    """Variance along u and v about zero, by the median."""
    seen = np.abs(values[np.isfinite(values)])
    return float(np.square(np.median(seen) / _NORMAL)) if seen.size else float("nan")


def _middle(values: NDArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 0.0


def _memory(r: NDArray, rate: float) -> tuple[float, bool]:
    """Time [s] after which residuals are as different as they get, and whether that could be determined."""
    lags = np.unique(np.round(np.geomspace(1, max(_SPAN * rate, 2), 8)).astype(int))
    lags = lags[lags < len(r) // 2]
    if len(lags) < 2:
        return _SPAN, False
    growth = np.array([0.5 * _variance(r[lag:] - r[:-lag]) for lag in lags])
    if not np.isfinite(growth).all() or growth[-1] - growth[0] <= 0.05 * growth[-1]:
        return _SPAN, False
    share = (growth - growth[0]) / (growth[-1] - growth[0])
    reached = float(np.interp(1.0 - np.exp(-1.0), share, lags))
    return reached / rate, True
