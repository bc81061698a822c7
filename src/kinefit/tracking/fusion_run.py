"""Whole recordings through the fusion tracker: what each step of time shows, tracked forwards from the first start."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import KinefitError, TrackingError
from kinefit.geometry.camera import Camera
from kinefit.initialization.from_depth import sized_start
from kinefit.motion import Motion, Residuals
from kinefit.observations import DepthFrame, Frame, KeypointFrame, MarkerFrame
from kinefit.subject.keypoints import Progress
from kinefit.tracking.fusion import FusionResult, FusionTracker
from kinefit.tracking.interrupted import TrackingInterrupted

Steps = Callable[[int], Sequence[Frame]]
"""Number of a step of time -> what the sensors saw then; nothing where none did."""

_GIVE_UP = 150  # steps without a start before the first one: five seconds at 30 Hz, some minutes of searching


@dataclass(frozen=True, eq=False)
class Sized:
    """A body of the person's size, the step and state that it was found in, and what there is to tell of it."""

    body: Body
    start: tuple[int, BodyState] | None = None
    told: Mapping[str, Any] = field(default_factory=dict)


def sized_by_depth(body: Body, frames: Mapping[int, DepthFrame], camera: Camera, up: NDArray) -> Sized:
    """The body in the size of the person in some depth images, by step; as it is where nobody is found in them."""
    try:
        fit, starts = sized_start(body, [f.depth for f in frames.values()], camera, up=up)
    except KinefitError as error:
        return Sized(body, told={"size": f"not found: {error.problem}"})
    step, best = max(zip(frames, starts), key=lambda found: found[1].score)
    return Sized(fit.body, (step, best.state), {"size": dict(zip(fit.names, map(float, fit.factors)))})


def run_steps(
    tracker: FusionTracker, steps: Steps, times: NDArray, *, up: str, start: tuple[int, BodyState] | None = None,
    name: str = "motion", provenance: Mapping[str, Any] | None = None, progress: Progress | None = None,
) -> Motion:  # fmt: skip
    """Track all steps of a recording: forwards from a start, and what lies before it backwards.

    Parameters
    ----------
    tracker : FusionTracker, fresh
    times : (F,) [s] of the steps
    up : vertical axis of the world
    start : step and state to begin with; default: the first that the tracker finds by itself.

    Raises
    ------
    TrackingError
        The body is found in none of the first steps.
    TrackingInterrupted
        Ctrl-C after at least one tracked step.
    """
    begin = 0
    if start is not None:
        begin, state = start
        tracker.start_at(state)
    results: dict[int, FusionResult] = {}
    seen: dict[int, list[Frame]] = {}
    try:
        for i in range(begin, len(times)):
            found = tracker.update(_told(steps, i, seen), float(times[i]))
            if found is not None:
                results[i] = found
            elif not results and i - begin >= _GIVE_UP:
                break
            if progress:
                progress("frames", i + 1 - begin, len(times))
        if not results:
            remedy = "Begin with a step that shows the whole person; check units, calibration and the range gate."
            raise TrackingError(f"the body is found in none of the first {i + 1 - begin} steps", remedy=remedy)
        first = min(results)
        back = tracker.backwards(results[first].state)
        for i in range(first - 1, -1, -1):
            again = back.update(_told(steps, i, seen), float(-times[i]))
            assert again is not None
            results[i] = again
            if progress:
                progress("frames", len(results), len(times))
    except KeyboardInterrupt:
        if not results:
            raise
    done = sorted(results)
    told = {**(provenance or {}), "fusion": {"dropped": tracker.dropped, "late": tracker.late}}
    motion = _motion(tracker, [seen[i] for i in done], [results[i] for i in done], times[done], up, name, told)
    if len(done) < len(times):
        raise TrackingInterrupted(motion, len(times))
    return motion


def _told(steps: Steps, i: int, seen: dict[int, list[Frame]]) -> Sequence[Frame]:
    """What the sensors saw at a step; the points of it are kept in `seen`, as images would take much room."""
    frames = steps(i)
    seen[i] = [frame for frame in frames if isinstance(frame, KeypointFrame | MarkerFrame)]
    return frames


def _motion(
    tracker: FusionTracker, seen: Sequence[Sequence[Frame]], found: list[FusionResult], times: NDArray, up: str,
    name: str, provenance: dict[str, Any],
) -> Motion:  # fmt: skip
    return Motion(
        body=tracker.body,
        rate=tracker.rate,
        times=times,
        Ts_world_root=np.stack([r.state.T_world_root for r in found]),
        angles=np.stack([r.state.angles for r in found]),
        dof_std=np.stack([r.dof_std for r in found]),
        joint_std=np.stack([r.joint_std for r in found]),
        quality=np.array([r.quality for r in found]),
        segment_quality=np.stack([r.segment_quality for r in found]),
        residuals=_residuals(tracker, seen, found),
        up=up,
        name=name,
        provenance=provenance,
    )


def _residuals(
    tracker: FusionTracker, seen: Sequence[Sequence[Frame]], found: list[FusionResult]
) -> dict[str, Residuals]:
    """What keypoints and markers left over, sensor by sensor."""
    body, rig = tracker.body, tracker.rig
    points_of: dict[str, dict[int, KeypointFrame | MarkerFrame]] = {}
    for i, several in enumerate(seen):
        for frame in several:
            if isinstance(frame, KeypointFrame | MarkerFrame):
                points_of.setdefault(frame.sensor, {})[i] = frame
    out = {}
    for sensor, frames in points_of.items():
        one = next(iter(frames.values()))
        pixels = isinstance(one, KeypointFrame)
        known = _known(body, one)
        names = tuple(n for n in one.names if n in known.names)
        points = known.select(names)
        measured = np.full((len(found), len(names), 2 if pixels else 3), np.nan)
        fitted = np.array(measured)
        for i, frame in frames.items():
            columns = [frame.names.index(n) for n in names]
            x = body.positions(found[i].state, points)
            if isinstance(frame, KeypointFrame):
                measured[i], fitted[i] = frame.uv[columns], rig[sensor].project(x)
                measured[i][frame.confidence[columns] <= 0] = np.nan
            else:
                measured[i], fitted[i] = frame.positions[columns], x
        values = measured - fitted
        sigma = tracker.accuracy.get(sensor, tracker.settings.pixel if pixels else tracker.settings.marker)
        square = np.square(values).sum(axis=-1) / sigma**2
        weights = np.where(np.isfinite(square), tracker.settings.loss.factor(np.nan_to_num(square)), 0.0)
        none = np.zeros(len(found), bool)
        unit = "px" if pixels else "m"
        out[sensor] = Residuals(names, points.segments, values, weights, unit, measured, none)
    return out


def _known(body: Body, frame: KeypointFrame | MarkerFrame) -> Any:
    if isinstance(frame, KeypointFrame):
        return body.keypoints(frame.keypoint_set) if frame.keypoint_set else body.landmarks
    return body.markers(frame.marker_set) if frame.marker_set else body.landmarks
