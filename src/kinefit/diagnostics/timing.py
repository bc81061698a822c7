"""Estimate time offsets between cameras from the body's motion, to a fraction of a frame.

First the whole-frame shift of every pair of cameras minimises the distance between the rays of each point (epipolar
distance, Hartley and Zisserman 9.2), and the shifts of all pairs are combined. Then a joint least-squares solution
gives
fractions: the error of a late view is its pixel velocity times the delay. The constant error of a point in a camera (of
calibration or detector) is subtracted before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.bias import without_points
from kinefit.diagnostics.views import KeypointViews, meet
from kinefit.diagnostics.whole_frames import MIN_DEPTH, MIN_FRAMES, best_shift, depth, from_pairs, pair_curves

_MAX_FRAMES = 1500  # for the fractional offsets
_TIME_BLOCKS = 10  # for the standard error: errors within a block are correlated
_SPEED_WINDOW = 0.1  # [s] before and after, for a speed: longer than a detector's jitter, shorter than a swing
_NOISE_VARIANCES = 4.0  # of a speed, subtracted from its square
_MAX_ITERATIONS = 12
_MIN_SIGMA = 0.02  # [frames] added to the standard error: the excess error found in recorded motions


@dataclass(frozen=True, eq=False)
class TimeOffsets:
    """Time offsets of a rig's cameras, relative to those stated in the take.

    Parameters
    ----------
    cameras : (C,) names
    offsets : (C,) [s]
        To be added to each camera's `time_offset` in the take: positive for a camera that began later than stated.
        Their median is zero, because an offset of all cameras is unobserved (of two cameras the first counts as
        correct). NaN where undetermined.
    std : (C,) [s]
        Standard error, from the scatter over time and between points; infinite where undetermined.
    rate : float [Hz]
    curves : {(camera, camera): (shifts (S,) [frames], cost (S,) [px])}
        Distance between the rays of two cameras if the second is delayed by each shift.
    """

    cameras: tuple[str, ...]
    offsets: NDArray
    std: NDArray
    rate: float
    curves: dict[tuple[str, str], tuple[NDArray, NDArray]]

    @property
    def frames(self) -> NDArray:
        """Offsets (C,) [frames]."""
        return self.offsets * self.rate


def time_offsets(views: KeypointViews) -> TimeOffsets:
    """Estimate the time offsets of all cameras from the motion of their keypoints.

    Parameters
    ----------
    views : KeypointViews with consecutive frames.
    """
    cameras = len(views.rig)
    stated = (views.begins - np.median(views.begins)) * views.rate  # [frames] fractions that the take states
    unknown = TimeOffsets(views.rig.names, np.full(cameras, np.nan), np.full(cameras, np.inf), views.rate, {})
    if len(views) < MIN_FRAMES or cameras < 2:
        return unknown
    all_curves = pair_curves(views)
    named = {(views.rig.names[a], views.rig.names[b]): curve for (a, b), curve in all_curves.items()}
    curves = {pair: curve for pair, curve in all_curves.items() if depth(curve[1]) >= MIN_DEPTH}
    moving = sorted({c for pair in curves for c in pair})
    if not curves:
        return replace(unknown, curves=named)
    whole = from_pairs(cameras, {pair: best_shift(*curve) for pair, curve in curves.items()})
    delays, std = _fractions(_most_motion(views), whole)
    delays = delays - stated
    still = np.setdiff1d(np.arange(cameras), moving)
    delays[still], std[still] = np.nan, np.inf
    known = np.isfinite(delays)
    if known.any():
        delays -= np.median(delays[known]) if known.sum() > 2 else delays[known][0]
    std = np.hypot(std, _MIN_SIGMA)
    return TimeOffsets(views.rig.names, delays / views.rate, std / views.rate, views.rate, named)


def _most_motion(views: KeypointViews) -> KeypointViews:
    """At most `_MAX_FRAMES` consecutive frames, those with most motion."""
    if len(views) <= _MAX_FRAMES:
        return views
    speed = np.nan_to_num(np.abs(np.diff(views.uv, axis=0))).sum(axis=(1, 2, 3))
    total = np.concatenate([[0.0], np.cumsum(speed)])
    start = int(np.argmax(total[_MAX_FRAMES:] - total[:-_MAX_FRAMES]))
    return views.at(np.arange(start, start + _MAX_FRAMES))


def fast_pixels(views: KeypointViews) -> dict[str, float]:
    """Motion per frame {camera: [px]} of the fast points in each camera's image: their 90th percentile."""
    x, _ = meet(views)
    speed = _speed(x, max(2, round(_SPEED_WINDOW * views.rate)))
    out = {}
    for camera in views.rig:
        _, by_point = camera.project_with_jacobian(x)
        step = np.linalg.norm(np.einsum("fkij,fkj->fki", by_point, speed), axis=-1)
        out[camera.name] = float(np.percentile(step[np.isfinite(step)], 90)) if np.isfinite(step).any() else np.nan
    return out


def shifted(views: KeypointViews, delays: Sequence[float] | NDArray) -> KeypointViews:
    """Shift the views to common times: frame f of camera c was recorded at f + delays[c], delays (C,) [frames].

    Interpolates linearly between frames.
    """
    uv = np.full_like(views.uv, np.nan)
    t = np.arange(len(views))
    for c, delay in enumerate(delays):
        at = t - float(delay)
        low = np.floor(at + 1e-9).astype(int)
        part = np.clip(at - low, 0.0, 1.0)
        first, second = np.clip(low, 0, len(t) - 1), np.clip(low + (part > 1e-6), 0, len(t) - 1)
        inside = (low >= 0) & (low + (part > 1e-6) < len(t))
        mixed = (1 - part)[:, None, None] * views.uv[first, :, c] + part[:, None, None] * views.uv[second, :, c]
        uv[:, :, c] = np.where(inside[:, None, None], mixed, np.nan)
    return replace(views, uv=uv)


def _fractions(views: KeypointViews, delays: NDArray) -> tuple[NDArray, NDArray]:
    """Refine whole-frame delays (C,) [frames] by Gauss-Newton; delays and standard errors (C,) [frames]."""
    cameras = len(views.rig)
    for _ in range(_MAX_ITERATIONS):
        system = _delay_equations(shifted(views, delays))
        if not system:
            return np.full(cameras, np.nan), np.full(cameras, np.inf)
        matrix, right = system[0]
        step = _solve(matrix.sum(0), right.sum(0))
        delays = delays + np.clip(step, -1.0, 1.0)
        delays -= np.median(delays)
        if np.abs(step).max() < 0.01:
            break
    std = np.hypot(*(_jackknife(*blocks) for blocks in system))
    diagonal = np.diag(matrix.sum(0))
    unseen = diagonal < 1e-6 * max(diagonal.max(), 1e-300)
    return np.where(unseen, np.nan, delays), np.where(unseen | ~np.isfinite(std), np.inf, std)


def _jackknife(matrix: NDArray, right: NDArray) -> NDArray:
    """Standard errors (C,) of the delays from normal equations (B, C, C), (B, C) of blocks with correlated errors."""
    used = np.flatnonzero(np.trace(matrix, axis1=1, axis2=2) > 0.0)
    whole, n = _solve(matrix.sum(0), right.sum(0)), len(used)
    left = [_solve(matrix.sum(0) - matrix[b], right.sum(0) - right[b]) for b in used]
    return np.sqrt((n - 1) / n * np.sum(np.square(np.stack(left) - whole), axis=0))


def _solve(matrix: NDArray, right: NDArray) -> NDArray:
    """Delays (C,) [frames] with zero mean."""
    weight = np.trace(matrix) / len(matrix)
    return np.linalg.lstsq(matrix + weight * np.ones_like(matrix), right, rcond=1e-9)[0]


def _delay_equations(views: KeypointViews) -> list[tuple[NDArray, NDArray]]:
    """Normal equations (B, C, C), (B, C) of the cameras' delays [frames]: by blocks of time, and by points.

    Empty where too few points are known.
    """
    cameras, (frames, points) = len(views.rig), views.uv.shape[:2]
    x, agree = meet(views)
    speed = _speed(x, max(2, round(_SPEED_WINDOW * views.rate)))  # in space: robust to outliers of one camera
    agree &= np.isfinite(speed).all(-1)[..., None]
    use = agree.sum(axis=2) >= 2
    if use.sum() < MIN_FRAMES:
        return []
    residual, velocity = np.full(views.uv.shape, np.nan), np.full(views.uv.shape, np.nan)
    jacobian = np.zeros((frames, points, cameras, 2, 3))
    for c, camera in enumerate(views.rig):
        predicted, jacobian[:, :, c] = camera.project_with_jacobian(x)
        residual[:, :, c] = np.where(agree[:, :, c, None], views.uv[:, :, c] - predicted, np.nan)
        velocity[:, :, c] = np.einsum("fkij,fkj->fki", jacobian[:, :, c], speed)
    residual -= _nanmedian(residual)
    off = np.linalg.norm(residual, axis=-1)
    spread = np.nanmedian(off)
    weight = np.where(
        np.isfinite(off) & agree, 1.0 / (1.0 + np.square(off / (2.0 * spread + 1e-9))), 0.0
    )  # √ of robust
    velocity = velocity - _nanmedian(np.where(agree[..., None], velocity, np.nan))
    design = np.zeros((frames, points, cameras, 2, cameras))
    for c in range(cameras):
        design[:, :, c, :, c] = np.nan_to_num(velocity[:, :, c])
    rows = weight[..., None]
    n = int(use.sum())
    matrix, right = without_points(
        np.nan_to_num(jacobian * rows[..., None])[use].reshape(n, -1, 3),
        (design * rows[..., None])[use].reshape(n, -1, cameras),
        np.nan_to_num(residual * rows)[use].reshape(n, -1),
    )
    frame, point = np.nonzero(use)
    out = []
    for block, count in (((frame * _TIME_BLOCKS) // frames, _TIME_BLOCKS), (point, points)):
        sums = np.zeros((count, cameras, cameras)), np.zeros((count, cameras))
        np.add.at(sums[0], block, matrix)
        np.add.at(sums[1], block, right)
        out.append(sums)
    return out


def _speed(x: NDArray, reach: int) -> NDArray:
    """Speeds (F, K, 3) [m/frame] of points x (F, K, 3) [m], by robust lines through the frames within `reach`.

    NaN where half of the frames are missing. Speeds are shrunk towards zero by the noise: the speed of a resting point
    is only noise, and biases delays towards zero.
    """
    ways = np.arange(-reach, reach + 1)
    at = np.arange(len(x))[:, None] + ways
    near = np.where(((at >= 0) & (at < len(x)))[..., None, None], x[np.clip(at, 0, len(x) - 1)], np.nan)  # (F, W, K, 3)
    known = np.isfinite(near[..., :1])
    near, t, weight = np.where(known, near, 0.0), ways[:, None, None].astype(float), 1.0 * known
    for _ in range(4):
        n, s, ss = (np.sum(weight * t**k, axis=1) for k in range(3))
        y, ty = np.sum(weight * near, axis=1), np.sum(weight * t * near, axis=1)
        spread = np.maximum(n * ss - s * s, 1e-9)
        slope, level = (n * ty - s * y) / spread, (ss * y - s * ty) / spread
        off = np.linalg.norm(near - level[:, None] - t * slope[:, None], axis=-1, keepdims=True)
        typical = np.median(off[known]) if known.any() else 1.0
        weight = known / (1.0 + np.square(off / (2.0 * typical + 1e-12)))
    noise = np.sum(weight * off**2, axis=1) / np.maximum(n - 1.0, 1.0) * n / spread
    power = np.sum(slope**2, axis=-1, keepdims=True)
    slope = slope * np.maximum(0.0, 1.0 - _NOISE_VARIANCES * noise / np.maximum(power, 1e-30))
    return np.where(known.sum(axis=1) > reach, slope, np.nan)


def _nanmedian(values: NDArray) -> NDArray:
    """Median over time, 0 where all values are NaN."""
    known = np.isfinite(values).any(axis=0)
    return np.where(known, np.nanmedian(np.where(known, values, 0.0), axis=0), 0.0)
