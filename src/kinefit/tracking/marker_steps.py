"""A recording of labelled markers alone: all its frames are fitted as one sequence by the compiled solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.bodies import Body, BodyState
from kinefit.errors import TrackingError
from kinefit.frame.results import FrameResult
from kinefit.markers.fit import MarkerTake, refit_outliers
from kinefit.sensors.base import Measurement
from kinefit.sensors.points.packed_markers import PackedMarkers
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.spool import stretches
from kinefit.smoothing.unwrap import unwrap
from kinefit.subject.subject import Progress
from kinefit.tracking.recording import Recording
from kinefit.tracking.run import TrackedSteps, tracker_of

_SEQUENCE_FRAMES = 6000  # that are fitted in one call


def fit_marker_steps(
    recording: Recording, body: Body, settings: TrackSettings, *, progress: Progress | None = None
) -> TrackedSteps | None:
    """Fit all steps of a recording of labelled markers alone, each from its neighbour's pose.

    None if the steps need the tracker: other sensors take part, a first pose is given, the body has closures or joints
    that move with its shape, markers were measured between the steps, or too few are visible to start. Standard
    deviations and quality are left to the smoother.
    """
    if not recording.markers_alone or recording.start is not None or recording.others or body.closures:
        return None
    tracker, times, sensors = tracker_of(recording, body, settings), recording.times, set[str]()
    scene = tracker.scene_of(body.usual_state(np.eye(4)))

    def measured(i: int) -> list[Measurement]:
        out = tracker.sensors.measurements(recording.steps(i), scene)
        sensors.update(m.sensor for m in out)
        return out

    markers = None
    if scene.morphing is None:
        markers = PackedMarkers.of(body, _OnDemand(len(times), measured), times, settings.marker_loss)
    if markers is None or sensors - set(markers.sensors):
        return None
    data = MarkerTake.of(body, markers)
    roots, angles = room((len(times), 4, 4)), room((len(times), len(body.tree.coordinates)))
    last: BodyState | None = None
    for some in stretches(len(times), _SEQUENCE_FRAMES):
        part = data.part(some)
        try:
            found = part.poses(slice(None)) if last is None else part.poses_after(last)
        except TrackingError:
            return None
        roots[some], angles[some] = refit_outliers(part, *found)
        last = BodyState(roots[some][-1], angles[some][-1])
        release(data.x, roots, angles)
        if progress:
            progress("frames", some.stop, len(times))
    angles[:] = unwrap(body.tree, angles)
    nothing = _OnDemand(len(times), lambda f: ())
    return TrackedSteps(
        _poses(body, times, roots, angles), nothing, nothing, times, recording.rate, tracker.scene_of, tracker.apart,
        list(range(len(times))), tracker, True, markers=markers,
    )  # fmt: skip


class _OnDemand(Sequence[Any]):
    """Records of so many frames, each made when it is read."""

    def __init__(self, count: int, make: Callable[[int], Any]) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, f: Any) -> Any:
        if isinstance(f, slice):
            return [self._make(k) for k in range(*f.indices(self._count))]
        if not 0 <= f < self._count:
            raise IndexError(f)
        return self._make(f)


def _poses(body: Body, times: NDArray, roots: NDArray, angles: NDArray) -> _OnDemand:
    """Fitted poses (F, 4, 4), (F, D) at times (F,) [s] as frames without standard deviations."""
    some = BodyState(roots[0], angles[0])
    std, joints = np.full(body.tree.n_dofs, np.inf), np.full((len(body.tree.segments), 3), np.inf)
    none = np.zeros(len(body.tree.segments), bool)
    blank = FrameResult(0.0, some, std, joints, np.zeros(len(none)), none, ~none, 0.0, 0)
    return _OnDemand(
        len(times), lambda f: replace(blank, time=float(times[f]), state=BodyState(roots[f], angles[f]))
    )
