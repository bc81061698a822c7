"""Cameras out of step: time offsets to a fraction of a frame, and groups of cameras that show different motions.

First the whole-frame shift of every pair of cameras minimises the distance between the rays of each point (epipolar
distance, Hartley and Zisserman 9.2), and the shifts of all pairs are combined. Then a joint least-squares solution
gives fractions: the error of a late view is its pixel velocity times the delay. The constant error of a point in a
camera (of calibration or detector) is subtracted before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import TrackingError
from kinefit.findings import Edit, Finding, Severity, in_words, listed
from kinefit.fitting.multiview import views as keypoint_views
from kinefit.fitting.multiview.association import medians
from kinefit.fitting.multiview.views import KeypointViews, disagreement_share, meet, sample
from kinefit.geometry.camera import Rig
from kinefit.observations import Keypoints
from kinefit.rigs.diagnostics.cameras import MIN_SIGMAS, without_points
from kinefit.rigs.diagnostics.changes import MIN_FRAMES, pair_curves, shifted

_MAX_COST_RATIO = 0.9  # of a shift to no shift: one that fits no better counts as none
_MAX_SHARE_RATIO = 0.9  # of the cameras' disagreement after and before a shift of many frames, which changes much
_FAR_FRAMES = 5.0
_MAX_WEIGHT = 2.0  # of a pair's shift: one pair with a periodic motion must not outvote the others
_MIN_DEPTH = 1.4
"""Ratio of the median cost to the smallest one: noise alone gives 1.1, a waving hand 1.8. Also how far the advantage of
no shift falls from the part where groups agree to the other."""
_MAX_FRAMES = 1500  # for the fractional offsets
_TIME_BLOCKS = 10  # for the standard error: errors within a block are correlated
_SPEED_WINDOW = 0.1  # [s] before and after, for a speed: longer than a detector's jitter, shorter than a swing
_NOISE_VARIANCES = 4.0  # of a speed, subtracted from its square
_MAX_ITERATIONS = 12
_MIN_SIGMA = 0.02  # [frames] added to the standard error: the excess error found in recorded motions
_MIN_OFFSET_NOTE = 0.1  # [frames] twice as much is a doubt
_MIN_OFFSET_FAULT = 2.0  # [frames] free-running webcams differ by up to 1.6 from the median in a real recording; of two
# cameras, without a third to compare, twice as much: 3.4
_MIN_SHARE_OF_LARGEST = 0.7  # of the largest offset: smaller ones may come from an error of the median camera
_MAX_OFFSET_SIGMA = 0.5  # [frames] standard error beyond which an offset is undetermined
_MIN_PART_FRAMES = 30  # of a part: 12 of both cameras must remain after shifts of up to 0.4 of it
_MAX_PART_FRAMES = 90  # of a part that are compared, consecutive
# The advantage of a pair is the median cost over time shifts divided by the cost without a shift. Between groups that
# show different motions its median over pairs is 0.6 to 1.15, and single pairs reach 1.43. Between groups that show the
# same motion it is 1.2 and more, except without motion, which the last three limits exclude.
_MAX_MEDIAN_ADVANTAGE = 1.2
_MAX_PAIR_ADVANTAGE = 1.45
_MIN_WITHIN_ADVANTAGE = 1.3  # of a pair within a group: there is motion
_MIN_COST_RISE = 1.5  # factor, of the cost itself


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


def time_offsets(views: KeypointViews, *, near: bool = False) -> TimeOffsets:
    """Estimate the time offsets of all cameras from the motion of their keypoints.

    Parameters
    ----------
    views : KeypointViews with consecutive frames.
    near : bool, whether only offsets of about a frame are sought.
    """
    cameras = len(views.rig)
    stated = (views.begins - np.median(views.begins)) * views.rate  # [frames] fractions that the take states
    unknown = TimeOffsets(views.rig.names, np.full(cameras, np.nan), np.full(cameras, np.inf), views.rate, {})
    if len(views) < MIN_FRAMES or cameras < 2:
        return unknown
    all_curves, names = pair_curves(views), views.rig.names
    unknown = replace(unknown, curves={(names[a], names[b]): curve for (a, b), curve in all_curves.items()})
    curves = {pair: curve for pair, curve in all_curves.items() if _depth(curve[1]) >= _MIN_DEPTH}
    if not curves:
        return unknown
    far = {} if near else {pair: _best_shift(*curve) for pair, curve in curves.items()}
    whole = _from_pairs(cameras, far)
    delays, std = _fractions(_most_motion(views), whole)
    delays = delays - stated
    still = np.setdiff1d(np.arange(cameras), list(curves))
    delays[still], std[still] = np.nan, np.inf
    known = np.isfinite(delays)
    if known.any():
        delays -= np.median(delays[known]) if known.sum() > 2 else delays[known][0]
    return replace(unknown, offsets=delays / views.rate, std=np.hypot(std, _MIN_SIGMA) / views.rate)


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
    frames, points, cameras, _ = views.uv.shape
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
    residual -= _constant(residual)
    off = np.linalg.norm(residual, axis=-1)
    robust = 1.0 / (1.0 + np.square(off / (2.0 * np.nanmedian(off) + 1e-9)))  # square root of a weight
    weight = np.where(np.isfinite(off) & agree, robust, 0.0)
    velocity -= _constant(np.where(agree[..., None], velocity, np.nan))
    design = np.nan_to_num(velocity)[..., None] * np.eye(cameras)[:, None]
    n, rows = int(use.sum()), weight[..., None]
    matrix, right = without_points(
        np.nan_to_num(jacobian * rows[..., None])[use].reshape(n, -1, 3),
        (design * rows[..., None])[use].reshape(n, -1, cameras), np.nan_to_num(residual * rows)[use].reshape(n, -1),
    )  # fmt: skip
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


def _best_shift(shifts: NDArray, cost: NDArray) -> tuple[float, float]:
    """Shift [frames] of smallest cost, and its weight, from a curve (S,), (S,); 0 if no other fits clearly better."""
    cost = np.where(np.isfinite(cost), cost, np.inf)
    at, zero = int(np.argmin(cost)), int(np.flatnonzero(shifts == 0)[0])
    is_edge = at in np.flatnonzero(np.isfinite(cost))[[0, -1]]  # it falls on: the minimum may lie anywhere
    if is_edge or cost[at] > _MAX_COST_RATIO * cost[zero]:  # a periodic motion fits as well a step later: the nearest
        at = zero
    return float(shifts[at]), min(_depth(cost) - 1.0, _MAX_WEIGHT)


def _depth(cost: NDArray) -> float:
    """Ratio of the median to the smallest cost (S,); a number, 1 without motion."""
    cost = cost[np.isfinite(cost)]
    return float(np.median(cost) / max(cost.min(), 1e-12)) if len(cost) else 1.0


def _from_pairs(cameras: int, pairs: dict[tuple[int, int], tuple[float, float]]) -> NDArray:
    """Delays (C,) [frames] whose differences fit the pairs' shifts with the least weighted absolute error."""
    delays = np.zeros(cameras)
    weight = {pair: w for pair, (_, w) in pairs.items()}
    for _ in range(30):  # iteratively reweighted least squares
        matrix, right = np.full((cameras, cameras), 1e-9), np.zeros(cameras)
        for (a, b), (shift, _) in pairs.items():  # b shows later what a shows: b began earlier
            row = np.zeros(cameras)
            row[a], row[b] = 1.0, -1.0
            matrix += weight[a, b] * np.outer(row, row)
            right += weight[a, b] * shift * row
        delays = np.linalg.lstsq(matrix, right, rcond=None)[0]
        weight = {(a, b): w / max(abs(delays[a] - delays[b] - shift), 0.05) for (a, b), (shift, w) in pairs.items()}
    return np.round(delays - np.median(delays))



def synchronised(views: KeypointViews) -> tuple[TimeOffsets, KeypointViews, dict[str, int]]:
    """Time offsets, and the views with left and right corrected and, where offsets are significant, synchronised.

    Sides can only be corrected in synchronised cameras, offsets only estimated from correct sides: two rounds do both.
    """
    right = keypoint_views.with_sides_right(views)
    times = time_offsets(right)
    late = np.where(np.isfinite(times.frames) & (times.std * times.rate < 0.25), times.frames, 0.0)
    late = np.where(np.abs(late) > 0.75, late, 0.0)
    if not late.any():
        return times, right, {}
    delays = np.round(late + (views.begins - np.median(views.begins)) * views.rate)
    moved = keypoint_views.with_sides_right(shifted(views, delays))
    ratio = _MAX_SHARE_RATIO if np.abs(late).max() > _FAR_FRAMES else 1.0
    if disagreement_share(moved.rig, sample(moved)) > ratio * disagreement_share(right.rig, sample(right)):
        return time_offsets(right, near=True), right, {}  # of a periodic motion another period
    again = time_offsets(_unshifted(views, moved, delays) if moved.swapped.any() else right)
    return again, moved, dict(zip(views.rig.names, delays.astype(int).tolist(), strict=True))


def _unshifted(views: KeypointViews, moved: KeypointViews, delays: NDArray) -> KeypointViews:
    """The original views, with the sides swapped that were found swapped after synchronisation."""
    uv, swapped = views.uv.copy(), views.swapped.copy()
    for c, delay in enumerate(delays.astype(int)):
        frames = np.flatnonzero(moved.swapped[:, c]) - delay
        frames = frames[(frames >= 0) & (frames < len(views))]
        uv[frames, :, c] = uv[frames[:, None], views.partner, c]
        swapped[frames, c] = True
    return replace(views, uv=uv, swapped=swapped)



def time_findings(
    times: TimeOffsets, take_offsets: Mapping[str, float], whole: Mapping[str, float], *, confirmed: bool
) -> list[Finding]:
    """Findings on cameras that are out of sync.

    Parameters
    ----------
    times : TimeOffsets
    take_offsets : {camera: [s]} `time_offset` as the take states it.
    whole : {camera: [px]} motion of the fast points per frame, see `fast_pixels`.
    confirmed : bool, whether the shifts improve the agreement of the cameras; of a periodic motion, several would fit.
    """
    out: list[Finding] = []
    known = np.isfinite(times.offsets) & (times.std * times.rate < _MAX_OFFSET_SIGMA)
    if not known.any():
        text = "Too little motion is visible in several cameras to check their clocks."
        return [Finding("note", "time", text, remedy="Clap, jump or swing the arms once at the start of a recording.")]
    undetermined = [name for name, fine in zip(times.cameras, known, strict=True) if not fine]
    if undetermined:
        text = f"Too little motion to check the clock of {listed(undetermined)}."
        out.append(Finding("note", "time", text, tuple(undetermined)))
    largest = float(np.max(np.abs(times.frames[known])))
    least = _MIN_OFFSET_FAULT * (1 if known.sum() > 2 else 2)
    for c in np.flatnonzero(known):
        name, late, std = times.cameras[c], times.frames[c], times.std[c] * times.rate
        if abs(late) < max(_MIN_OFFSET_NOTE, MIN_SIGMAS * std):
            continue
        value = take_offsets.get(name, 0.0) + times.offsets[c]
        way = "later" if late > 0 else "earlier"
        amount = f"{abs(late):.2f} ± {std:.2f} frames ({1e3 * abs(times.offsets[c]):.0f} ms)"
        text = f"{name} is {amount} {way} than the take states, which moves a fast point by "
        text += f"{abs(late) * whole.get(name, np.nan):.0f} px."
        is_fault = confirmed and abs(late) >= max(least + 3.0 * std, _MIN_SHARE_OF_LARGEST * largest)
        severity: Severity = "fault" if is_fault else "doubt" if abs(late) >= 2 * _MIN_OFFSET_NOTE else "note"
        confidence = "Certain" if abs(late) >= 2 * max(_MIN_OFFSET_NOTE, MIN_SIGMAS * std) else "Likely"
        if abs(late) < 1.0:
            confidence += "; but temporal smoothing in a detector, or a rolling shutter, also delays by part of a frame"
        edit = Edit("camera", "time_offset", f"{value:.4f}", name)
        out.append(Finding(severity, "time", text, (name,), f"{confidence}.", edits=(edit,)))
    if not out:
        within = max(largest, float(np.max(times.std[known])) * times.rate)
        out.append(Finding("good", "time", f"The cameras are synchronised to {within:.2f} frames."))
    return out



@dataclass(frozen=True)
class _Part:
    """Consecutive frames, and of every pair of cameras (C, C) the advantage of no time shift, and its cost [px]."""

    start: int
    stop: int
    advantage: NDArray
    cost: NDArray


def group_findings(rig: Rig, keypoints: Sequence[Keypoints], first: int = 0) -> list[Finding]:
    """Find two groups of at least two cameras that show different motions in the first or the last third.

    Two cameras that show the same motion fit best without a time shift. If they show different motions, no shift fits
    better than any other. Cameras that are out of sync all the time never fit without a shift, and form no group.

    Parameters
    ----------
    rig : Rig
    keypoints : records of the same number of frames and the same rate.
    first : number of the records' first frame, for remedies.
    """
    length = min(len(k) for k in keypoints)
    if len(rig) < 4 or length < 3 * _MIN_PART_FRAMES:
        return []
    edges = np.linspace(0, length, 4).astype(int).tolist()
    parts = [_part(rig, keypoints, edges[k], edges[k + 1]) for k in (0, 2)]
    sizes = range(2, len(rig) // 2 + 1)
    groups = [group for size in sizes for group in combinations(range(len(rig)), size)
              if 2 * size < len(rig) or group[0] == 0]  # fmt: skip
    every = product((parts, parts[::-1]), groups)
    found = [(good, bad, group) for (good, bad), group in every if _differs(good, bad, group)]
    if not found:
        return []
    good, bad, group = found[0]
    names = [rig.names[c] for c in group]
    others = [rig.names[c] for c in range(len(rig)) if c not in group]
    part = lambda run: f"frames {first + run.start} to {first + run.stop - 1}"
    text = f"{listed(names)} show another motion than {listed(others)} in {part(bad)}; "
    text += f"in {part(good)} all cameras show the same motion."
    confidence = "Certain: no time shift makes the two groups agree there, while the cameras within a group agree."
    edits = (Edit("take", "frames", f"[{first + good.start}, {first + good.stop}]"),)
    remedy = "Check whether videos are cut, have dropped frames or continue with another take. Until it is corrected, "
    remedy = f"{remedy}write {in_words(edits)}."
    return [Finding("fault", "groups", text, (*names, *others), confidence, remedy, edits)]


def _part(rig: Rig, keypoints: Sequence[Keypoints], start: int, stop: int) -> _Part:
    count = min(stop - start, _MAX_PART_FRAMES)
    begin = (start + stop - count) // 2
    advantage, cost = np.full((2, len(rig), len(rig)), np.nan)
    try:
        records = [k.rows(slice(begin, begin + count), k.time_offset) for k in keypoints]
        curves = pair_curves(keypoint_views.with_sides_right(keypoint_views.make_views(rig, records, filled=True)))
    except TrackingError:  # no person detected
        curves = {}
    for pair, (shifts, costs) in curves.items():
        near = costs[np.abs(shifts) <= 1]  # cameras may be out of sync by part of a frame
        if np.isfinite(near).any():
            cost[pair] = max(np.nanmin(near), 1e-9)
            advantage[pair] = np.nanmedian(costs) / cost[pair]
    return _Part(start, stop, advantage, cost)


def _differs(good: _Part, bad: _Part, group: tuple[int, ...]) -> bool:
    """Whether a group shows the other cameras' motion in the good part, and another one in the bad part."""
    known, member = np.isfinite(good.cost + bad.cost), np.isin(np.arange(len(bad.cost)), group)
    across = known & (member[:, None] != member)
    within = bad.advantage[known & ~across]
    if across.sum() < 2 or not len(within):
        return False
    median = float(np.median(bad.advantage[across]))
    fall = float(np.median(good.advantage[across])) / max(median, 1e-9)
    rise = float(np.median(bad.cost[across] / good.cost[across]))
    fits_nowhere = median <= _MAX_MEDIAN_ADVANTAGE and bad.advantage[across].max() <= _MAX_PAIR_ADVANTAGE
    moves = within.max() >= _MIN_WITHIN_ADVANTAGE
    return bool(fits_nowhere and moves and fall >= _MIN_DEPTH and rise >= _MIN_COST_RISE)


def _constant(values: NDArray) -> NDArray:
    """Medians over time (first axis), 0 where all values are NaN."""
    return np.nan_to_num(medians(np.moveaxis(values, 0, -1)))
