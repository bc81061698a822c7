"""A whole recording through the tracker: forwards from the first start, and what lies before it backwards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from kinefit.bodies import Body
from kinefit.errors import TrackingError
from kinefit.frame.results import FrameResult
from kinefit.motion import Residuals
from kinefit.sensors.base import Measurement
from kinefit.sensors.channels import Channels
from kinefit.sensors.keypoints import KeypointMeasurement, Layout
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.spool import Spool
from kinefit.subject.subject import Progress
from kinefit.tracking.recording import Recording
from kinefit.tracking.residuals import Remains
from kinefit.tracking.session import KeptFrame
from kinefit.tracking.tracker import Tracker

_GIVE_UP = 150  # steps without a start before the first one: five seconds at 30 Hz, some minutes of searching


@dataclass(frozen=True, eq=False)
class Tracked:
    """A recording, tracked frame by frame.

    Parameters
    ----------
    results : one for each step of `steps`, with the matches of keypoints alone
    steps : numbers of the steps that were done, in order
    measurements : of each of them what all sensors but the keypoints measured, without whole images; read on demand
    residuals : what the fit leaves over of every sensor in them
    tracker : that did it
    complete : whether all steps were done
    """

    results: list[FrameResult]
    steps: list[int]
    measurements: Sequence[tuple[Measurement, ...]]
    residuals: Mapping[str, Residuals]
    tracker: Tracker
    complete: bool


def run(
    recording: Recording, body: Body, channels: Channels, settings: TrackSettings, *,
    start: Any = None, values: Any = None, progress: Progress | None = None,
) -> Tracked:  # fmt: skip
    """Track all steps of a recording, each from those before it.

    Parameters
    ----------
    channels : the person's keypoints on this body
    start : step and state to begin with; default: the first that the tracker finds by itself.
    values : {sensor: {name: value}} of the sensors' own unknowns

    Raises
    ------
    TrackingError
        The body is found in none of the first steps.
    """
    sigma = {**{k.camera: s for k, s in zip(recording.keypoints, recording.keypoint_sigma)}, **recording.sigma}
    tracker = Tracker(
        body, recording.rig, rate=recording.rate, accuracy=sigma, up=recording.up_axis, on_body=recording.on_body,
        settings=settings, sensors=deepcopy(recording.sensors), values=values,
    )  # fmt: skip
    for name, depth in recording.backgrounds.items():
        tracker.know_background(name, depth)
    layout, times, begin = Layout(channels, body), recording.times, 0
    if start is not None:
        begin, state = start
        tracker.start_at(state)
    results: dict[int, FrameResult] = {}
    kept, place = Spool[tuple[Measurement, ...]](), dict[int, int]()
    remains = Remains(len(times))

    def step(tracker: Tracker, i: int, time: float) -> FrameResult | None:
        frames = list(recording.steps(i))
        if len(layout.points) and (channels.confidence[i] > 0).any():
            seen = channels.uv[i], channels.confidence[i]
            frames.append(KeypointMeasurement(tracker.sensors.keypoints, layout, *seen, time))
        found = tracker.update(frames, time)
        if found is None:
            return None
        moving = {"measurements": found.measurements, "velocity": tracker.speed}
        one = KeptFrame.of(found, tracker.scene_of(found.state, time).at(found.state, **moving))
        remains.add(i, one.leftovers)
        place[i] = len(kept)
        kept.append(one.measurements)
        return one.result

    stopped = False
    try:
        for i in range(begin, len(times)):
            found = step(tracker, i, float(times[i]))
            if found is not None:
                results[i] = found
            elif not results and i - begin >= _GIVE_UP and tracker.sees_surfaces:
                break
            if progress:
                progress("frames", i + 1 - begin, len(times))
        if not results:
            remedy = "Begin with a step that shows the whole person; check units, calibration and the range gate."
            raise TrackingError(f"the body is found in none of the first {i + 1 - begin} steps", remedy=remedy)
        first = min(results)
        back = tracker.backwards(results[first].state)
        for i in range(first - 1, -1, -1):
            again = step(back, i, float(times[i]))
            assert again is not None
            results[i] = again
            if progress:
                progress("frames", len(results), len(times))
    except KeyboardInterrupt:
        if not results:
            raise
        stopped = True
    done = sorted(results)
    return Tracked(
        [results[i] for i in done], done, kept.chosen(place[i] for i in done), remains.residuals(done), tracker,
        not stopped and len(done) == len(times),
    )  # fmt: skip
