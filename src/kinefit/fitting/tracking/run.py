"""A whole recording through the tracker: forwards from the first start, and what lies before it backwards.

A recording of labelled markers alone: all its frames are fitted as one sequence by the compiled solver.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit._records import restore_state, save_state
from kinefit.bodies import Body, BodyState
from kinefit.bodies.motion import Motion
from kinefit.errors import FileError, TrackingError
from kinefit.findings import runs_of
from kinefit.fitting.frame.results import UNOBSERVED_STD_RATIO, FrameResult, frame_results
from kinefit.fitting.markers.subject import sequence_both_ways
from kinefit.fitting.smoothing.packed import PackedMarkers
from kinefit.fitting.smoothing.sensor_noise import covariance_alone
from kinefit.fitting.smoothing.spool import MATRIX_FRAMES, Spool, stretches
from kinefit.fitting.smoothing.tracked_frames import TrackedFrames
from kinefit.fitting.smoothing.unwrap import unwrap
from kinefit.fitting.subject.subject import Progress
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint, append_rows
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Rig
from kinefit.sensors.base import Measurement
from kinefit.sensors.points.views import ViewBias
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings

_GIVE_UP = 150  # steps without a start before the first one: five seconds at 30 Hz, some minutes of searching
_EVERY = 300  # steps after which a checkpoint is written: ten seconds of video, a second of work or half a minute


@dataclass(frozen=True, eq=False)
class TrackedSteps(TrackedFrames):
    """A recording, tracked frame by frame; what its frames hold is read on demand.

    Parameters
    ----------
    steps : numbers of the steps that were done, in order
    complete : whether all steps were done
    """

    tracker: Tracker
    steps: list[int]
    complete: bool


class _Frames:
    """What is kept of all steps done, in the order in which they were done; in a file that stays, with a checkpoint."""

    def __init__(self, checkpoint: Checkpoint | None, recording: Recording) -> None:
        store = None if checkpoint is None else checkpoint.frames
        self.results = Spool[FrameResult](store=store, places=() if store is None else store.places)
        self.place = {step: k for k, step in enumerate(() if store is None else store.steps)}
        self.written = 0  # rows of the table
        self.streams = [(k.camera, k.keypoint_set, k.names) for k in recording.keypoints]

    def add(self, i: int, one: FrameResult) -> None:
        count = len(self.place)
        self.results.append(one, i)
        self.place[i] = count  # last: Ctrl-C may come between

    def keep(self, checkpoint: Checkpoint, tracker: Tracker, at: int, anew: Callable[[], Tracker]) -> Tracker:
        """Have all that was done in the folder; the tracker to go on with, as it will be read back."""
        return self.go_on(checkpoint, checkpoint.frames.keep(at, save_tracker(tracker)), anew())

    def go_on(self, checkpoint: Checkpoint, state: Any, tracker: Tracker) -> Tracker:
        """A tracker that was made anew, in a state that was kept."""
        restore_tracker(tracker, state)
        self.name(checkpoint, tracker)
        new = list(self.place)[self.written :]
        append_rows(checkpoint.rows, tracker.body, ((step, self.results[self.place[step]]) for step in new))
        self.written = len(self.place)
        return tracker

    def name(self, checkpoint: Checkpoint, tracker: Tracker) -> None:
        """Names for what the records of all frames refer to."""
        keypoints, body = tracker.sensors.keypoints, tracker.body
        checkpoint.frames.name(body=body, layout=keypoints.layout(body, self.streams)[0])
        checkpoint.frames.name_layouts(lambda streams: keypoints.layout(body, streams)[0])
        checkpoint.frames.name_sensors(tracker.sensors)

    def tracked(self, tracker: Tracker, recording: Recording, *, stopped: bool) -> TrackedSteps:
        """In the order of time."""
        done = sorted(self.place)
        order = [self.place[i] for i in done]
        return TrackedSteps(
            self.results.chosen(order), recording.times[done], tracker, done,
            not stopped and len(done) == len(recording), looked=recording.looked[done],
        )  # fmt: skip


def tracker_of(
    recording: Recording, body: Body, settings: TrackSettings, *, values: Any = None, view_bias: ViewBias | None = None
) -> Tracker:
    """A tracker for all sensors of a recording, which knows what it states of them; arguments as of `run`."""
    tracker = Tracker(
        body, recording.rig, rate=recording.rate, sigma=recording.sigma, up=recording.up_axis,
        on_body=recording.on_body, settings=settings, sensors=deepcopy(recording.sensors), values=values,
    )  # fmt: skip
    tracker.sensors.view_bias = view_bias
    for name, depth in recording.backgrounds.items():
        tracker.know_background(name, depth)
    return tracker


def run(
    recording: Recording, body: Body, settings: TrackSettings, *, values: Any = None, view_bias: ViewBias | None = None,
    progress: Progress | None = None, checkpoint: Checkpoint | None = None,
) -> TrackedSteps:  # fmt: skip
    """Track all steps of a recording, each from those before it.

    Parameters
    ----------
    recording : its `start` is the first that the tracker finds by itself where none is given; its `poses` are where the
        body may be, by an earlier fit
    values : {sensor: {name: value}} of the sensors' own unknowns
    view_bias : of the keypoints' detectors; default: none
    checkpoint : where it goes on from, and what is done is kept

    Raises
    ------
    TrackingError
        The body is found in none of the first steps.
    """
    anew = partial(tracker_of, recording, body, settings, values=values, view_bias=view_bias)
    tracker, times, begin = anew(), recording.times, 0
    if recording.start is not None:
        begin, state = recording.start
        tracker.start_at(state)
    frames, at = _Frames(checkpoint, recording), begin
    others = OtherPeople(recording.others, recording.rig, 0.5 / recording.rate + 1e-6)
    if checkpoint is not None:
        frames.name(checkpoint, tracker)
        if checkpoint.frames.at is not None:
            at = checkpoint.frames.at
            tracker = frames.go_on(checkpoint, checkpoint.frames.state, anew())

    def step(tracker: Tracker, i: int, time: float) -> bool:
        seen, guess = recording.steps(i), recording.poses.get(i)
        if not len(seen) and not recording.looked[i]:
            found = tracker.between(time)
        else:
            found = tracker.update(seen, time, others=others.at(time), guess=guess)
        if found is not None:
            moving = {"measurements": found.measurements, "velocity": tracker.speed}
            frames.add(i, found.kept(tracker.scene_of(found.state, time).at(found.state, **moving)))
        return found is not None

    stopped = False
    try:
        for i in range(at, len(times)):
            if i > at and (i - begin) % _EVERY == 0:
                release(*(array for k in recording.keypoints for array in (k.points, k.confidence)))
                if checkpoint is not None:
                    tracker = frames.keep(checkpoint, tracker, i, anew)
            found = step(tracker, i, float(times[i])) or frames.place
            if not found and i - begin >= _GIVE_UP and tracker.sees_surfaces:
                break
            if progress:
                progress("frames", i + 1 - begin, len(times))
        if not frames.place:
            remedy = "Start with a step that shows the whole person, or give the first pose: [start], or in Python "
            remedy += "start=(step, state). Check units, calibration and the range of depth cameras."
            raise TrackingError(f"the person is not found in the first {i + 1 - begin} steps", remedy=remedy)
        if checkpoint is not None and len(times) > at:
            tracker = frames.keep(checkpoint, tracker, len(times), anew)
        first = min(frames.place)
        back = tracker.backwards(frames.results[frames.place[first]].state)
        for i in range(first - 1, -1, -1):
            again = step(back, i, float(times[i]))
            assert again
            if progress:
                progress("frames", len(frames.place), len(times))
    except KeyboardInterrupt:
        if not frames.place:
            raise
        stopped = True
    return frames.tracked(tracker, recording, stopped=stopped)


class OtherPeople:
    """Scenes of other people at any time of a recording.

    Parameters
    ----------
    motions : in the recording's world and time; one whose body has no surfaces hides nothing
    rig : Rig of all cameras
    within : float [s], how far the nearest frame of a motion may be
    """

    def __init__(self, motions: Sequence[Motion], rig: Rig, within: float) -> None:
        self.motions, self.within = tuple(m for m in motions if m.body.surfaces), within
        self._scenes = [Scene(m.body, m.body.default_state(np.eye(4)), rig) for m in self.motions]

    def at(self, time: float) -> list[Scene]:
        """Everybody who is there at a time [s]."""
        out = []
        for motion, scene in zip(self.motions, self._scenes):
            k = int(np.argmin(np.abs(motion.times - time)))
            if abs(motion.times[k] - time) <= self.within and np.isfinite(motion.Ts_world_root[k]).all():
                out.append(scene.at(BodyState(motion.Ts_world_root[k], motion.angles[k]), time=time))
        return out


def save_tracker(tracker: Tracker) -> dict[str, Any]:
    """The state of a tracker between two steps, without images: plain values, arrays and records of `record_classes`.

    The last result is not part of it: an update that comes too late right after a restored state returns None.
    """
    return {
        "tracker": save_state(tracker), "prediction": save_state(tracker._prediction),
        "recovery": save_state(tracker._recovery), "sensors": tracker.sensors.save_state(),
    }  # fmt: skip


def restore_tracker(tracker: Tracker, state: Mapping[str, Any]) -> None:
    """Set a tracker, made anew, to the state of another of the same body and sensors.

    Raises
    ------
    FileError
        What is no state of such a tracker.
    """
    try:
        restore_state(tracker, state["tracker"])
        restore_state(tracker._prediction, state["prediction"])
        restore_state(tracker._recovery, state["recovery"])
        tracker.sensors.restore_state(state["sensors"])
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        remedy = "Run again: all frames are then tracked again."
        raise FileError("the stored state is not one of this tracker", remedy=remedy) from error


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
