"""What a live session keeps of each frame, so that it becomes a motion like any other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import check_shape
from kinefit.bodies import Body
from kinefit.bodies.motion import UP_AXES
from kinefit.errors import ObservationError, choices
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.smoothing.spool import Spool
from kinefit.fitting.smoothing.tracked_frames import TrackedFrames, TrackerLike
from kinefit.observations.arrays import numbers
from kinefit.sensors.points.keypoints import KeypointMatched, KeypointMeasurement, Layout, pixels_of
from kinefit.sensors.scene import Scene


class Session:
    """Frames of a live session, one a step of its rate: steps that were dropped are kept as frames that see nothing.

    Parameters
    ----------
    rate : float [Hz]
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.clear()

    def __len__(self) -> int:
        return len(self._results)

    def clear(self) -> None:
        """Begin anew: another body, or another clock."""
        self._results = Spool[FrameResult]()

    def _append(self, one: FrameResult) -> None:
        self._results.append(one)
        self._last = one

    def add(self, result: FrameResult, scene: Scene) -> None:
        """Keep a result; a time before that of the last frame begins anew."""
        new = result.kept(scene)
        if not len(self):
            self._append(new)
            return
        last = self._last
        ahead = round((result.time - last.time) * self.rate)
        if result.time < last.time:
            self.clear()
            self._append(new)
        elif ahead == 0:
            self._results[-1] = self._last = last.joined(new)
        else:
            gap = result.time - last.time
            for k in range(1, ahead):
                self._append(unseen(last, last.time + gap * k / ahead))
            self._append(new)

    def frames(self, tracker: TrackerLike) -> TrackedFrames:
        """All of them, with the keypoints of whatever cameras in one layout."""
        results = in_one_layout(tracker.body, self._results[:])
        return TrackedFrames(results, np.array([r.time for r in results]), tracker)


def unseen(last: FrameResult, time: float) -> FrameResult:
    """Add a frame without measurements after a result."""
    segments = np.zeros(len(last.hidden), bool)
    return FrameResult(
        time, last.state, np.full_like(last.dof_std, np.inf), np.full_like(last.joint_std, np.inf),
        np.zeros_like(last.segment_quality), segments, ~segments, 0.0, 0,
    )  # fmt: skip


def in_one_layout(body: Body, results: Sequence[FrameResult]) -> Sequence[FrameResult]:
    """Results (F,) with their keypoints in one layout of all cameras, whatever cameras took part in each."""
    matches = [pixels_of(r.matched) for r in results]
    layouts = {id(m.measurement.layout): m.measurement.layout for several in matches for m in several}
    if len(layouts) < 2 and max(map(len, matches)) < 2:
        return results
    streams: dict[tuple[str, str], dict[str, None]] = {}
    for one in layouts.values():
        for camera, keypoint_set, names in one.streams:
            streams.setdefault((camera, keypoint_set), {}).update(dict.fromkeys(names))
    sensor = next(several[-1] for several in reversed(matches) if several).measurement.of
    layout, _ = sensor.layout(body, [(*key, tuple(names)) for key, names in streams.items()])
    place = {point: k for k, point in enumerate(layout.of_streams)}
    columns = {key: np.array([place[point] for point in one.of_streams], np.int64) for key, one in layouts.items()}
    return Spool(
        replace(r, matched=(_together(several, columns, layout, r.time),) if several else ())
        for r, several in zip(results, matches)
    )


def _together(
    several: Sequence[KeypointMatched], columns: dict[int, NDArray], layout: Layout, time: float
) -> KeypointMatched:
    """Matches of one time in another layout."""
    N = len(layout.points)
    uv, confidence, swapped, hidden = np.full((N, 2), np.nan), np.zeros(N), np.zeros(N, bool), []
    sides_known = np.zeros(N, bool)
    for m in several:
        column, of = columns[id(m.measurement.layout)], m.measurement
        seen = of.confidence > 0.0
        uv[column[seen]], confidence[column[seen]], swapped[column] = of.uv[seen], of.confidence[seen], m.swapped
        sides_known[column] = False if of.sides_known is None else of.sides_known
        hidden += [replace(h, index=column[h.index], far=column[h.far]) for h in m.hidden]
    measurement = KeypointMeasurement(several[0].measurement.of, layout, uv, confidence, time, sides_known)
    order = np.where(swapped, layout.channels.partner, np.arange(N))
    return KeypointMatched(
        measurement, np.ascontiguousarray(measurement.uv[order]), np.ascontiguousarray(measurement.weight[order]),
        swapped, several[0].loss, tuple(hidden),
    )  # fmt: skip


def axis_of(up: NDArray) -> str:
    """Name of the axis of the world that is nearest to a direction (3,)."""
    return max(UP_AXES, key=lambda name: float(np.dot(up, UP_AXES[name])))


def up_vector(up: str | ArrayLike) -> NDArray:
    """(3,) upwards in the world, of the name of an axis ("z", "-y", ...) or of three numbers.

    Raises
    ------
    ObservationError
        No such axis; not three numbers.
    """
    if isinstance(up, str) and up not in UP_AXES:
        raise ObservationError(choices("vertical axis", up, UP_AXES))
    vector = numbers(UP_AXES[up] if isinstance(up, str) else up, float, "up")
    check_shape(vector, (3,), "up")
    return vector
