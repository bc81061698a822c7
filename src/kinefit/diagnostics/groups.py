"""Two groups of cameras that show the same motion in one part of a recording and different ones in another."""

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

_MIN_FRAMES = 30  # of a part: 12 of both cameras must be left after shifts of up to 0.4 of it
_MAX_FRAMES = 90  # of a part that are looked at, consecutive
# How many times less it costs to take two cameras as they are than by a usual shift in time. Of two groups that show
# different motions the medians over pairs are 0.6 to 1.15 and single pairs up to 1.43; of groups that show the same one
# 1.2 and more, except where nothing moves, which the next three tell apart.
_MAX_MEDIAN = 1.2
_MAX_PAIR = 1.45
_MIN_WITHIN = 1.3  # of a pair within a group: something moves
_MIN_FALL = 1.4  # of the median, from the part where the groups agree
_MIN_RISE = 1.5  # of the cost itself


@dataclass(frozen=True)
class _FrameRun:
    """Consecutive frames, and of every pair of cameras how well no shift fits beside others, and its cost [px]."""

    start: int
    stop: int
    advantage: dict[Pair, float]
    cost: dict[Pair, float]


def group_findings(rig: Rig, keypoints: Sequence[Keypoints], first: int = 0) -> list[Finding]:
    """Whether two groups of two cameras or more show different motions in the last or the first third.

    Two cameras that show one motion are best taken without a shift in time; where they show different ones, no shift
    fits better than any other. Cameras that are out of step all the time never agree without one, and are no group.

    Parameters
    ----------
    keypoints : records of the same number of frames and the same rate.
    first : number of the records' first frame, for remedies.
    """
    length = min(len(k) for k in keypoints)
    if len(rig) < 4 or length < 3 * _MIN_FRAMES:
        return []
    edges = np.linspace(0, length, 4).astype(int).tolist()
    parts = [_part(rig, keypoints, edges[k], edges[k + 1]) for k in (0, 2)]
    for good, bad in (parts, parts[::-1]):
        for group in _groups(len(rig)):
            if _is_apart(good, bad, group):
                return [_finding(rig, group, good, bad, first)]
    return []


def _part(rig: Rig, keypoints: Sequence[Keypoints], start: int, stop: int) -> _FrameRun:
    count = min(stop - start, _MAX_FRAMES)
    begin = (start + stop - count) // 2
    part = _FrameRun(start, stop, {}, {})
    try:
        records = [k.rows(slice(begin, begin + count), k.time_offset) for k in keypoints]
        views = make_views(rig, records, filled=True)
    except TrackingError:  # nobody is seen there
        return part
    for pair, (shifts, costs) in pair_curves(with_sides_right(views)).items():
        near = costs[np.abs(shifts) <= 1]  # cameras may be parts of a frame out of step
        if np.isfinite(near).any():
            part.cost[pair] = float(np.nanmin(near))
            part.advantage[pair] = float(np.nanmedian(costs)) / max(part.cost[pair], 1e-9)
    return part


def _groups(cameras: int) -> list[tuple[int, ...]]:
    """Groups of two cameras up to half of them, each way to part them once."""
    sizes = range(2, cameras // 2 + 1)
    every = [group for size in sizes for group in combinations(range(cameras), size)]
    return [group for group in every if 2 * len(group) < cameras or group[0] == 0]


def _is_apart(good: _FrameRun, bad: _FrameRun, group: tuple[int, ...]) -> bool:
    common = [pair for pair in bad.cost if pair in good.cost]
    across = [pair for pair in common if (pair[0] in group) != (pair[1] in group)]
    within = [bad.advantage[pair] for pair in common if pair not in across]
    if len(across) < 2 or not within:
        return False
    advantages = [bad.advantage[pair] for pair in across]
    median = float(np.median(advantages))
    fall = float(np.median([good.advantage[pair] for pair in across])) / max(median, 1e-9)
    rise = float(np.median([bad.cost[pair] / max(good.cost[pair], 1e-9) for pair in across]))
    fits_nowhere = median <= _MAX_MEDIAN and max(advantages) <= _MAX_PAIR
    return fits_nowhere and max(within) >= _MIN_WITHIN and fall >= _MIN_FALL and rise >= _MIN_RISE


def _finding(rig: Rig, group: tuple[int, ...], good: _FrameRun, bad: _FrameRun, first: int) -> Finding:
    names = [rig.names[c] for c in group]
    others = [rig.names[c] for c in range(len(rig)) if c not in group]
    text = (
        f"{listed(names)} show another motion than {listed(others)} in frames {first + bad.start} to "
        f"{first + bad.stop - 1}; in frames "
        f"{first + good.start} to {first + good.stop - 1} all show the same."
    )
    sure = "Sure: no shift in time brings them together there, while the cameras of one group still agree."
    remedy = (
        "Look whether videos are cut, have lost frames or go on with another take. Until then write "
        f"frames = [{first + good.start}, {first + good.stop}] into [take]."
    )
    return Finding("fault", "groups", text, (*names, *others), sure, remedy)
