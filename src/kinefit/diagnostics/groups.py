"""Find two groups of cameras that show the same motion in one part of a recording and different motions in another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from kinefit.diagnostics.views import make_views, with_sides_right
from kinefit.diagnostics.whole_frames import pair_curves
from kinefit.errors import TrackingError
from kinefit.findings import Finding, listed
from kinefit.geometry.camera import Rig
from kinefit.observations import Keypoints

Pair = tuple[int, int]

_MIN_FRAMES = 30  # of a part: 12 of both cameras must remain after shifts of up to 0.4 of it
_MAX_FRAMES = 90  # of a part that are compared, consecutive
# The advantage of a pair is the median cost over time shifts divided by the cost without a shift. Between groups that
# show different motions its median over pairs is 0.6 to 1.15, and single pairs reach 1.43. Between groups that show the
# same motion it is 1.2 and more, except without motion, which the last three limits exclude.
_MAX_MEDIAN_ADVANTAGE = 1.2
_MAX_PAIR_ADVANTAGE = 1.45
_MIN_WITHIN_ADVANTAGE = 1.3  # of a pair within a group: there is motion
_MIN_ADVANTAGE_FALL = 1.4  # factor, of the median from the part where the groups agree to the other
_MIN_COST_RISE = 1.5  # factor, of the cost itself


@dataclass(frozen=True)
class _FrameRun:
    """Consecutive frames, and for every pair of cameras the advantage of no time shift, and its cost [px]."""

    start: int
    stop: int
    advantage: dict[Pair, float]
    cost: dict[Pair, float]


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
    if len(rig) < 4 or length < 3 * _MIN_FRAMES:
        return []
    edges = np.linspace(0, length, 4).astype(int).tolist()
    parts = [_frame_run(rig, keypoints, edges[k], edges[k + 1]) for k in (0, 2)]
    for good, bad in (parts, parts[::-1]):
        for group in _groups(len(rig)):
            if _differs(good, bad, group):
                return [_finding(rig, group, good, bad, first)]
    return []


def _frame_run(rig: Rig, keypoints: Sequence[Keypoints], start: int, stop: int) -> _FrameRun:
    count = min(stop - start, _MAX_FRAMES)
    begin = (start + stop - count) // 2
    run = _FrameRun(start, stop, {}, {})
    try:
        records = [k.rows(slice(begin, begin + count), k.time_offset) for k in keypoints]
        views = make_views(rig, records, filled=True)
    except TrackingError:  # no person detected
        return run
    for pair, (shifts, costs) in pair_curves(with_sides_right(views)).items():
        near = costs[np.abs(shifts) <= 1]  # cameras may be out of sync by part of a frame
        if np.isfinite(near).any():
            run.cost[pair] = float(np.nanmin(near))
            run.advantage[pair] = float(np.nanmedian(costs)) / max(run.cost[pair], 1e-9)
    return run


def _groups(cameras: int) -> list[tuple[int, ...]]:
    """Groups of two cameras up to half of them, each partition once."""
    sizes = range(2, cameras // 2 + 1)
    every = [group for size in sizes for group in combinations(range(cameras), size)]
    return [group for group in every if 2 * len(group) < cameras or group[0] == 0]


def _differs(good: _FrameRun, bad: _FrameRun, group: tuple[int, ...]) -> bool:
    common = [pair for pair in bad.cost if pair in good.cost]
    across = [pair for pair in common if (pair[0] in group) != (pair[1] in group)]
    within = [bad.advantage[pair] for pair in common if pair not in across]
    if len(across) < 2 or not within:
        return False
    advantages = [bad.advantage[pair] for pair in across]
    median = float(np.median(advantages))
    fall = float(np.median([good.advantage[pair] for pair in across])) / max(median, 1e-9)
    rise = float(np.median([bad.cost[pair] / max(good.cost[pair], 1e-9) for pair in across]))
    fits_nowhere = median <= _MAX_MEDIAN_ADVANTAGE and max(advantages) <= _MAX_PAIR_ADVANTAGE
    moves = max(within) >= _MIN_WITHIN_ADVANTAGE
    return fits_nowhere and moves and fall >= _MIN_ADVANTAGE_FALL and rise >= _MIN_COST_RISE


def _finding(rig: Rig, group: tuple[int, ...], good: _FrameRun, bad: _FrameRun, first: int) -> Finding:
    names = [rig.names[c] for c in group]
    others = [rig.names[c] for c in range(len(rig)) if c not in group]
    text = (
        f"{listed(names)} show another motion than {listed(others)} in frames {first + bad.start} to "
        f"{first + bad.stop - 1}; in frames "
        f"{first + good.start} to {first + good.stop - 1} all cameras show the same motion."
    )
    confidence = "Certain: no time shift makes the two groups agree there, while the cameras within a group agree."
    remedy = (
        "Check whether videos are cut, have dropped frames or continue with another take. Until it is corrected, write "
        f"frames = [{first + good.start}, {first + good.stop}] into [take]."
    )
    return Finding("fault", "groups", text, (*names, *others), confidence, remedy)
