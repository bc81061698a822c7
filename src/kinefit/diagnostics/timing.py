"""Time offsets between cameras, found from the body's motion to a fraction of a frame.

First every pair of cameras is shifted against each other in whole frames until the rays of each point meet best
(epipolar distance, Hartley and Zisserman 9.2); the pairs' shifts are brought together. Then all offsets are solved at
once to fractions: the error of a view that comes late is its pixel velocity times the delay. What stays the same for a
point in a camera over time (a wrong calibration, a detector's habit) is taken out beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.bias import without_points
from kinefit.diagnostics.views import KeypointViews, meet
from kinefit.diagnostics.whole_frames import MIN_FRAMES, VALLEY, best_shift, depth, from_pairs, pair_curves

_LONGEST = 1500  # frames that fractions are found from
_BLOCKS = 10  # of time, for the standard error: errors within a block are alike
_STEP = 0.1  # [s] before and after, that a speed is taken over: longer than a detector's jitter, shorter than a swing
_NOISE = 4.0  # variances of a speed's own noise that are taken off its square
_ROUNDS = 12
_FLOOR = 0.02  # [frames] that is added to the standard error: what recorded motions were off beyond it


@dataclass(frozen=True, eq=False)
class TimeOffsets:
    """Time offsets of a rig's cameras, told against the take's own.

    Parameters
    ----------
    cameras : (C,) names
    offsets : (C,) [s]
        To be added to each camera's `time_offset` in the take: positive for a camera that began later than was stated.
        Their median is zero, as nobody can see what all share (of two cameras the first is taken to be right). NaN
        where nothing shows it.
    std : (C,) [s]
        Standard error, from the scatter over time and between points; infinite where nothing shows it.
    rate : float [Hz]
    curves : {(camera, camera): (shifts (S,) [frames], cost (S,) [px])}
        How well the rays of two cameras meet when the second is taken so many frames later.
    """

    cameras: tuple[str, ...]
    offsets: NDArray
    std: NDArray
    rate: float
    curves: dict[tuple[str, str], tuple[NDArray, NDArray]]

    @property
    def frames(self) -> NDArray:
        """(C,) [frames] the offsets."""
        return self.offsets * self.rate


def time_offsets(views: KeypointViews) -> TimeOffsets:
    """Offsets of all cameras from the motion of the points they see.

    Parameters
    ----------
    views : KeypointViews with consecutive frames.
    """
    cameras = len(views.rig)
    told = (views.begins - np.median(views.begins)) * views.rate  # parts of a frame that the take tells already
    nothing = TimeOffsets(views.rig.names, np.full(cameras, np.nan), np.full(cameras, np.inf), views.rate, {})
    if len(views) < MIN_FRAMES or cameras < 2:
        return nothing
    every = pair_curves(views)
    named = {(views.rig.names[a], views.rig.names[b]): curve for (a, b), curve in every.items()}
    curves = {pair: curve for pair, curve in every.items() if depth(curve[1]) >= VALLEY}
    moving = sorted({c for pair in curves for c in pair})
    if not curves:
        return replace(nothing, curves=named)
    whole = from_pairs(cameras, {pair: best_shift(*curve) for pair, curve in curves.items()})
    delays, std = _fractions(_liveliest(views), whole)
    delays = delays - told
    still = np.setdiff1d(np.arange(cameras), moving)
    delays[still], std[still] = np.nan, np.inf
    known = np.isfinite(delays)
    if known.any():
        delays -= np.median(delays[known]) if known.sum() > 2 else delays[known][0]
    std = np.hypot(std, _FLOOR)
    return TimeOffsets(views.rig.names, delays / views.rate, std / views.rate, views.rate, named)


def _liveliest(views: KeypointViews) -> KeypointViews:
    """At most `_LONGEST` consecutive frames, those with most motion."""
    if len(views) <= _LONGEST:
        return views
    speed = np.nan_to_num(np.abs(np.diff(views.uv, axis=0))).sum(axis=(1, 2, 3))
    total = np.concatenate([[0.0], np.cumsum(speed)])
    start = int(np.argmax(total[_LONGEST:] - total[:-_LONGEST]))
    return views.at(np.arange(start, start + _LONGEST))


def fast_pixels(views: KeypointViews) -> dict[str, float]:
    """{camera: [px]} how far the faster points of a camera's picture (the upper tenth) move in a frame."""
    x, _ = meet(views)
    speed = _speed(x, max(2, round(_STEP * views.rate)))
    out = {}
    for camera in views.rig:
        _, by_point = camera.project_with_jacobian(x)
        step = np.linalg.norm(np.einsum("fkij,fkj->fki", by_point, speed), axis=-1)
        out[camera.name] = float(np.percentile(step[np.isfinite(step)], 90)) if np.isfinite(step).any() else np.nan
    return out


def shifted(views: KeypointViews, delays: Sequence[float] | NDArray) -> KeypointViews:
    """The views at common times: camera c's frame f shows what happened at f + delays[c]; straight between frames."""
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
    """Delays (C,) [frames] and their standard errors by Gauss-Newton from whole ones."""
    cameras = len(views.rig)
    for _ in range(_ROUNDS):
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
    """(C,) standard errors of the delays from normal equations (B, C, C), (B, C) of blocks whose errors are alike."""
    used = np.flatnonzero(np.trace(matrix, axis1=1, axis2=2) > 0.0)
    whole, n = _solve(matrix.sum(0), right.sum(0)), len(used)
    left = [_solve(matrix.sum(0) - matrix[b], right.sum(0) - right[b]) for b in used]
    return np.sqrt((n - 1) / n * np.sum(np.square(np.stack(left) - whole), axis=0))


def _solve(matrix: NDArray, right: NDArray) -> NDArray:
    """Delays whose mean is zero."""
    weight = np.trace(matrix) / len(matrix)
    return np.linalg.lstsq(matrix + weight * np.ones_like(matrix), right, rcond=1e-9)[0]


def _delay_equations(views: KeypointViews) -> list[tuple[NDArray, NDArray]]:
    """Normal equations (B, C, C), (B, C) of the cameras' delays [frames]: of blocks of time, and of single points.

    None of either where too little is seen.
    """
    cameras, (frames, points) = len(views.rig), views.uv.shape[:2]
    x, agree = meet(views)
    speed = _speed(x, max(2, round(_STEP * views.rate)))  # of the points in space: strays of one camera do not make it
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
    for block, count in (((frame * _BLOCKS) // frames, _BLOCKS), (point, points)):
        sums = np.zeros((count, cameras, cameras)), np.zeros((count, cameras))
        np.add.at(sums[0], block, matrix)
        np.add.at(sums[1], block, right)
        out.append(sums)
    return out


def _speed(x: NDArray, reach: int) -> NDArray:
    """Speeds (F, K, 3) per frame of points x, by robust lines through the frames within `reach`; NaN where half miss.

    Shrunk towards zero by what noise alone would make: the speed of a point that stands still is all noise, and a delay
    that is found by it comes out too small.
    """
    ways = np.arange(-reach, reach + 1)
    at = np.arange(len(x))[:, None] + ways
    near = np.where(((at >= 0) & (at < len(x)))[..., None, None], x[np.clip(at, 0, len(x) - 1)], np.nan)  # (F, W, K, 3)
    seen = np.isfinite(near[..., :1])
    near, t, weight = np.where(seen, near, 0.0), ways[:, None, None].astype(float), 1.0 * seen
    for _ in range(4):
        n, s, ss = (np.sum(weight * t**k, axis=1) for k in range(3))
        y, ty = np.sum(weight * near, axis=1), np.sum(weight * t * near, axis=1)
        spread = np.maximum(n * ss - s * s, 1e-9)
        slope, level = (n * ty - s * y) / spread, (ss * y - s * ty) / spread
        off = np.linalg.norm(near - level[:, None] - t * slope[:, None], axis=-1, keepdims=True)
        typical = np.median(off[seen]) if seen.any() else 1.0
        weight = seen / (1.0 + np.square(off / (2.0 * typical + 1e-12)))
    noise = np.sum(weight * off**2, axis=1) / np.maximum(n - 1.0, 1.0) * n / spread
    power = np.sum(slope**2, axis=-1, keepdims=True)
    slope = slope * np.maximum(0.0, 1.0 - _NOISE * noise / np.maximum(power, 1e-30))
    return np.where(seen.sum(axis=1) > reach, slope, np.nan)


def _nanmedian(values: NDArray) -> NDArray:
    """Median over time, 0 where nothing was seen."""
    seen = np.isfinite(values).any(axis=0)
    return np.where(seen, np.nanmedian(np.where(seen, values, 0.0), axis=0), 0.0)
