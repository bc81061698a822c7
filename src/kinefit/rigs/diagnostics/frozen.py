"""Streams that freeze: a sensor repeats its last frame, to the bit, while time goes on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.findings import Finding, runs_of
from kinefit.observations import DepthVideo, Keypoints
from kinefit.readers.take.load import Observations

_MIN_FROZEN_S = 0.25  # of a repeated frame: shorter ones are dropped frames, or a video of a third of its stated rate
_MIN_FROZEN_FRAMES = 5
_MIN_POINTS = 4  # of a frame; single points are held by programs that fill gaps
_MIN_PIXELS = 100  # of a depth image that measure something: images of an empty range are all alike
_TOLERANCE = 1e-9  # of the largest value: interpolation at the take's steps rounds equal rows
_MIN_CHANGED_SHARE = 0.8  # of the points in other frames: coordinates in whole pixels repeat often
_MIN_JUMP = 0.05
"""Median step of the points into or out of a repeated frame, as a share of the recording's: sensors have noise, and a
simulated body without noise comes to rest smoothly."""
_SEARCH_HZ = 4.0  # of depth images that are compared


def without_frozen(seen: Observations) -> tuple[Observations, list[Finding]]:
    """Exclude the repeated frames of frozen streams; a doubt on each names frames and times."""
    findings = list[Finding]()

    def thawed(record: Any, sensor: str, drop: Callable[[Any, NDArray], Any]) -> Any:
        runs = _depth_runs(record) if isinstance(record, DepthVideo) else _runs(_rows(record), record.rate)
        if not runs:
            return record
        findings.append(_finding(sensor, runs, record.times, seen.frames[0] if isinstance(record, Keypoints) else 0))
        flags = np.zeros(len(record.times), bool)
        for a, b in runs:
            flags[a:b] = True
        return drop(record, flags)

    keypoints = tuple(thawed(k, k.camera, Keypoints.without) for k in seen.keypoints)
    number = lambda k: f"markers {k + 1}" if len(seen.markers) > 1 else "markers"
    markers = tuple(thawed(m, number(k), _emptied) for k, m in enumerate(seen.markers))
    depth = tuple(thawed(d, d.sensor, lambda video, at: video.without(np.flatnonzero(at))) for d in seen.depth)
    sensors = tuple(replace(s, recording=thawed(s.recording, s.recording.sensor, _emptied)) for s in seen.sensors)
    return replace(seen, keypoints=keypoints, markers=markers, depth=depth, sensors=sensors), findings


def _finding(sensor: str, runs: Sequence[tuple[int, int]], times: NDArray, first: int) -> Finding:
    parts = [f"frames {first + a} to {first + b - 1} ({times[a]:.2f} to {times[b - 1]:.2f} s)" for a, b in runs]
    text = f"{sensor} is frozen in {', '.join(parts)}: it repeats one frame exactly, and these are excluded."
    confidence = "Certain: a person who stands still never gives equal numbers twice."
    remedy = "Nothing for these frames. Check its cable, buffer or recorder before the next recording."
    return Finding("doubt", "frozen", text, (sensor,), confidence, remedy)


def _emptied(record: Any, frames: NDArray) -> Any:
    """A record with NaN for all that it measured in some frames (F,) bool."""
    arrays = {name: np.array(values) for name, values in _arrays(record).items()}
    for values in arrays.values():
        values[frames] = np.nan
    return replace(record, **arrays)


def _arrays(record: Any) -> dict[str, NDArray]:
    """Arrays (F, points, ...) of numbers that a record of F frames holds."""
    values = {f.name: getattr(record, f.name) for f in fields(record)}
    return {
        name: v for name, v in values.items()
        if isinstance(v, np.ndarray) and v.ndim > 2 and len(v) == len(record.times) and v.dtype.kind == "f"
    }  # fmt: skip


def _rows(record: Any) -> NDArray:
    """(F, K, D) values of K points in each frame; no frames where the record does not hold its measurements."""
    values = record.points if isinstance(record, Keypoints) else next(iter(_arrays(record).values()), None)
    if values is None:
        return np.zeros((0, 0, 1))
    width = values.shape[-1] if isinstance(record, Keypoints) else int(np.prod(values.shape[2:]))
    return values.reshape(len(values), -1, width)


def _runs(x: NDArray, rate: float) -> list[tuple[int, int]]:
    """(start, stop) of the frames of points (F, K, D) that repeat the frame before `start`."""
    known = np.isfinite(x).all(axis=-1)
    if len(x) < 2 * _MIN_FROZEN_FRAMES or not known.any():
        return []
    step = np.linalg.norm(np.diff(x, axis=0), axis=-1)
    changed = ~(step <= _TOLERANCE * np.abs(x[known]).max()) & (known[1:] | known[:-1])
    equal = ~changed.any(axis=1) & (known[1:].sum(axis=1) >= _MIN_POINTS)
    least = max(_MIN_FROZEN_S * rate, _MIN_FROZEN_FRAMES)
    both = known[1:] & known[:-1]
    moving = np.where(both & ~equal[:, None], step, np.nan)
    steps = moving[np.isfinite(moving)]
    if not len(steps) or np.mean(changed[~equal][both[~equal]]) < _MIN_CHANGED_SHARE:
        return []

    def jumps(at: int) -> bool:
        own = moving[at][np.isfinite(moving[at])] if 0 <= at < len(moving) else np.zeros(0)
        return len(own) > 0 and float(np.median(own)) > _MIN_JUMP * float(np.median(steps))

    runs = [(a, b) for a, b in runs_of(equal) if b - a >= least and (jumps(a - 1) or jumps(b))]
    return [(a + 1, b + 1) for a, b in runs]


def _depth_runs(video: DepthVideo) -> list[tuple[int, int]]:
    """(start, stop) of the depth images that repeat the image before `start`."""
    step = max(int(video.rate / _SEARCH_HZ), 1)

    def alike(a: NDArray, b: NDArray) -> bool:
        return bool(np.sum(a > 0.0) >= _MIN_PIXELS and np.array_equal(a, b))

    def same(i: int, j: int) -> bool:
        return alike(video.frame(i).depth, video.frame(j).depth)

    tested = np.arange(0, len(video), step)
    images = (video.frame(int(i)).depth for i in tested)  # each is decoded once
    equal = np.array([alike(a, b) for a, b in pairwise(images)], bool)
    out = []
    for a, b in runs_of(equal) if not equal.all() else ():
        first, last = int(tested[a]), int(tested[b])
        while first > 0 and same(first - 1, first):
            first -= 1
        while last + 1 < len(video) and same(last, last + 1):
            last += 1
        if last - first >= max(_MIN_FROZEN_S * video.rate, _MIN_FROZEN_FRAMES):
            out.append((first + 1, last + 1))
    return out
