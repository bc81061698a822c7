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
from kinefit.findings import runs_of
from kinefit.fitting.frame.results import UNOBSERVED_STD_RATIO, FrameResult, frame_results
from kinefit.fitting.markers.poses import sequence_both_ways
from kinefit.fitting.smoothing.packed import PackedMarkers
from kinefit.fitting.smoothing.sensor_noise import covariance_alone
from kinefit.fitting.smoothing.spool import MATRIX_FRAMES, Spool, stretches
from kinefit.fitting.smoothing.unwrap import unwrap
from kinefit.fitting.subject.subject import Progress
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.run import TrackedSteps, tracker_of
from kinefit.sensors.base import Measurement
from kinefit.sensors.settings import TrackSettings

_SEQUENCE_FRAMES = 6000  # that are fitted in one call
_OUTLIER_MISFIT_RATIO = 4.0  # times the take's median misfit: such frames are fitted again without initial pose
_MAX_REFIT_RUNS = 50  # runs of such frames


def fit_marker_steps(
    recording: Recording, body: Body, settings: TrackSettings, *, judge: bool = False, progress: Progress | None = None
) -> TrackedSteps | None:
    """Fit all steps of a recording of labelled markers alone, each from its neighbour's pose.

    None if the steps need the tracker: other sensors take part, a first pose is given, the body has closures or joints
    that move with its shape, markers were measured between the steps, or too few are visible to start.

    Parameters
    ----------
    judge : whether frames get standard deviations and quality of their own, which otherwise the smoother gives
    """
    if not recording.markers_alone or recording.start is not None or recording.others or body.closures:
        return None
    tracker, times, sensors = tracker_of(recording, body, settings), recording.times, set[str]()
    scene = tracker.scene_of(body.default_state(np.eye(4)))

    def measured(i: int) -> list[Measurement]:
        out = tracker.sensors.measurements(recording.steps(i), scene)
        sensors.update(m.sensor for m in out)
        return out

    if scene.morphing is not None:
        return None
    markers = PackedMarkers.of(body, _OnDemand(len(times), measured), times, settings.marker_loss)
    if not markers.sensors or sensors - set(markers.sensors):
        return None
    roots, angles = room((len(times), 4, 4)), room((len(times), len(body.tree.coordinates)))
    last: BodyState | None = None
    for some in stretches(len(times), _SEQUENCE_FRAMES):
        part = markers.part(some)
        try:
            roots[some], angles[some] = _refit_outliers(body, part, *_poses(body, part, last))
        except TrackingError:
            return None
        last = BodyState(roots[some][-1], angles[some][-1])
        markers.release()
        release(roots, angles)
        if progress:
            progress("frames", some.stop, len(times))
    angles[:] = unwrap(body.tree, angles)
    results = _judged(body, markers, roots, angles) if judge else _blank(body, times, roots, angles)
    return TrackedSteps(results, times, tracker, list(range(len(times))), True, markers=markers)


def _poses(body: Body, markers: PackedMarkers, start: BodyState | None = None) -> tuple[NDArray, NDArray]:
    """Roots (F, 4, 4) and angles (F, D) [rad], fitted from the state before the first frame; None: without one."""
    x, sigma = markers.measured
    return sequence_both_ways(body, markers.points, x, sigma, start=start, loss=markers.loss)


def _misfit(body: Body, markers: PackedMarkers, roots: NDArray, angles: NDArray) -> NDArray:
    """(F,) mean misfit of the markers in each frame, in standard deviations, each clipped at ten."""
    off = np.sqrt(markers.squares(markers.gaps(body, roots, angles)))
    seen = np.isfinite(off)
    return np.where(seen, np.minimum(np.nan_to_num(off), 10.0), 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)


def _refit_outliers(body: Body, markers: PackedMarkers, roots: NDArray, angles: NDArray) -> tuple[NDArray, NDArray]:
    """Fit frames with an outlying misfit again without initial pose; the better fit replaces the other in place."""
    misfit = _misfit(body, markers, roots, angles)
    is_outlier = misfit > max(_OUTLIER_MISFIT_RATIO * float(np.median(misfit)), 3.0)
    for a, b in sorted(runs_of(is_outlier), key=lambda run: run[0] - run[1])[:_MAX_REFIT_RUNS]:
        part = markers.part(slice(a, b))
        try:
            other_roots, other_angles = _poses(body, part)
        except TrackingError:
            continue
        better = _misfit(body, part, other_roots, other_angles) < 0.9 * misfit[a:b]
        roots[a:b][better], angles[a:b][better] = other_roots[better], other_angles[better]
    return roots, angles


def _judged(body: Body, markers: PackedMarkers, roots: NDArray, angles: NDArray) -> Spool[FrameResult]:
    """Fitted poses (F, 4, 4), (F, D) as frames with the standard deviations of each frame on its own."""
    out = Spool[FrameResult]()
    for some in stretches(len(roots), MATRIX_FRAMES):
        part, at = markers.part(some), (roots[some], angles[some])
        states = [BodyState(root, q) for root, q in zip(*at)]
        covariances = np.stack([covariance_alone(body, *s) for s in zip(states, part.information(body, *at))])
        observed = np.sqrt(np.einsum("fii->fi", covariances))[:, 6:] <= UNOBSERVED_STD_RATIO * body.tree.spread
        for result in frame_results(
            body, states, part.times, covariances, part.evidence(body, part.gaps(body, *at)), observed=observed,
            iterations=[0] * len(covariances),
        ):
            out.append(result)
    return out


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


def _blank(body: Body, times: NDArray, roots: NDArray, angles: NDArray) -> _OnDemand:
    """Fitted poses (F, 4, 4), (F, D) at times (F,) [s] as frames without standard deviations."""
    some = BodyState(roots[0], angles[0])
    std, joints = np.full(body.tree.n_dofs, np.inf), np.full((len(body.tree.segments), 3), np.inf)
    none = np.zeros(len(body.tree.segments), bool)
    blank = FrameResult(0.0, some, std, joints, np.zeros(len(none)), none, ~none, 0.0, 0)
    return _OnDemand(
        len(times), lambda f: replace(blank, time=float(times[f]), state=BodyState(roots[f], angles[f]))
    )
