"""A recording: what all sensors saw at each of its times, from a take or from arrays in memory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from numbers import Real
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import renamed
from kinefit.bodies import BodyState
from kinefit.bodies.motion import UP_AXES, Motion
from kinefit.errors import ObservationError, check_choice, choices
from kinefit.fitting.multiview.association import choose_people, person_records
from kinefit.fitting.multiview.followed import PersonKeypoints, follow, only_lifted
from kinefit.fitting.multiview.people import PersonTrack
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import (
    KEYPOINT_SIGMA,
    KEYPOINTS,
    ClickFrame,
    DepthFrame,
    Frame,
    KeypointFrame,
    Keypoints,
    LiftedFrame,
    MarkerFrame,
    Markers,
    NamedMarkers,
    by_record,
    sensor_of,
)
from kinefit.observations.arrays import is_number
from kinefit.sensors.base import Sensor, of_kind

_FIRST_STEPS = 100  # in which every sensor that takes part is expected to see something
_PARTS = ("keypoint_set", "marker_set", "segment")  # of which one sensor may have several frames at one time

Steps = Callable[[int], Sequence[Any]]
"""Number of a step of time -> what the sensors saw then; nothing where none did."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What all sensors of a take saw.

    Parameters
    ----------
    times : (F,) [s] of the steps
    rate : float [Hz]
    rig : Rig of all cameras
    steps : what all sensors saw at each step
    keypoints : records of the person's keypoints among what the steps show, whole, for the subject fit
    followed : who of several people that is, where the cameras see others
    sigma : {sensor: standard deviation}, [px] of cameras' keypoints ("CAMERA SET" of one of several detectors) and of
        "silhouette CAMERA", else [m]; "SENSOR MARKER" of one marker
    sensors : of one's own, see `kinefit.sensors.base`
    markers : labelled recordings among what the steps show, whole, for the subject fit
    depth : some of the first images of the depth sensor that comes first, by step, for the subject fit
    on_body : depth cameras whose images show nothing but the body
    backgrounds : {depth camera: (H, W) [m]} of the empty scene
    start : step and state to begin with
    poses : {step: state} of a former motion of all steps, over which its body is refined
    others : motions of other people in view, in the same world and time, by which depth images, masks and colours are
        parted
    up : vertical axis of the world
    level : whether that was measured; otherwise the floor is the plane on which the feet rest
    name : str
    """

    times: NDArray
    rate: float
    rig: Rig
    steps: Steps = lambda i: ()
    keypoints: tuple[Keypoints, ...] = ()
    followed: PersonKeypoints | None = None
    sigma: Mapping[str, float] = field(default_factory=dict)
    sensors: tuple[Sensor, ...] = ()
    markers: tuple[NamedMarkers, ...] = ()
    depth: Mapping[int, DepthFrame] = field(default_factory=dict)
    on_body: tuple[str, ...] = ()
    backgrounds: Mapping[str, NDArray] = field(default_factory=dict)
    start: tuple[int, BodyState] | None = None
    poses: Mapping[int, BodyState] = field(default_factory=dict)
    others: tuple[Motion, ...] = ()
    up: str = "z"
    level: bool = True
    name: str = "motion"

    def __post_init__(self) -> None:
        of_kind(self.times, np.ndarray, "the times of a recording", "Give an array [s], as of_frames makes it.")
        of_kind(self.rig, Rig, "the rig of a recording", "Give a Rig, such as read_calibration returns.")
        of_kind(self.rate, Real, "the rate of a recording", "Give it in Hz.")
        if not len(self.times) or not 0.0 < self.rate < np.inf:
            problem = f"the recording has {len(self.times)} steps at {self.rate} Hz"
            raise ObservationError(problem, remedy="Give sensors that overlap in time, and a positive rate.")
        check_choice("vertical axis", self.up, UP_AXES, ObservationError)
        if self.start is not None and not 0 <= self.start[0] < len(self.times):
            problem = f"start is at step {self.start[0]}, but the recording has {len(self.times)} steps"
            raise ObservationError(problem, remedy=f"Start at a step from 0 to {len(self.times) - 1}.")
        for name in (*self.on_body, *self.backgrounds):
            self.rig.index(name)
        names = [s.name for s in self.sensors]
        for name in names:
            if names.count(name) > 1:
                raise ObservationError(f"two sensors are named '{name}'", remedy="Give each sensor its own name.")

    def __len__(self) -> int:
        return len(self.times)

    @property
    def up_axis(self) -> NDArray:
        """(3,) upwards in the world."""
        return np.array(UP_AXES[self.up])

    @classmethod
    @renamed(accuracy="sigma")
    def of_keypoints(
        cls, rig: Rig, keypoints: Sequence[Keypoints], *, sigma: float | Sequence[float] = KEYPOINT_SIGMA,
        person: int | str | None = None, people: Sequence[PersonTrack] | None = None, **more: Any,
    ) -> Recording:  # fmt: skip
        """Keypoints of calibrated cameras; the person is chosen among all detected.

        Parameters
        ----------
        rig : Rig
        keypoints : records of the same number of frames and the same rate.
        sigma : [px] standard deviation of a keypoint of confidence 1, one for all records or one for each.
        person : "first" (with most visible points, the default), "moving", "largest", "nearest X Y Z" [m], or a number
        people : everybody in view, where `people_in_view` has found them; default: they are looked for
        more : other arguments of a recording

        Raises
        ------
        ObservationError
            No keypoints, or of different lengths or rates; a person in another form.
        TrackingError
            Nobody is seen in any frame, or fewer people than the number.
        """
        given = () if keypoints is None else keypoints
        of_kind(given, Sequence, "keypoints", "Give a list of Keypoints, one for each camera.", each=Keypoints)
        if not given:
            remedy = "Add at least one [[keypoints]] to the take."
            raise ObservationError("there are no keypoints to track", remedy=remedy)
        lengths, rates = {len(k) for k in keypoints}, {k.rate for k in keypoints}
        if len(lengths) > 1 or len(rates) > 1:
            streams = ", ".join(f"{k.camera}: {len(k)} frames at {k.rate:g} Hz" for k in keypoints)
            raise ObservationError(f"keypoint streams differ ({streams})", remedy="Set frames or rate in [take].")
        sigmas = _sigmas(sigma, len(keypoints))
        one = follow(rig, keypoints, person, people)
        records, times = person_records(one.keypoints, choose_people(rig, one.keypoints)), keypoints[0].times
        stated = {k.camera: s for k, s in zip(keypoints, sigmas)}
        several = {f"{k.camera} {k.keypoint_set}": s for k, s in zip(keypoints, sigmas) if s != stated[k.camera]}
        known: dict[str, Any] = {"steps": partial(_seen_in, records, times), "sigma": stated | several}
        return cls(times, keypoints[0].rate, rig, keypoints=records, followed=one, **known | more)

    @cached_property
    def looked(self) -> NDArray:
        """(F,) bool: steps at which a detector of keypoints looked at an image, or all where it skipped none."""
        looks = [k.looked for k in self.keypoints if k.looked is not None]
        all_looked = np.ones(len(self), bool)
        return np.any(looks, axis=0) if looks and len(looks) == len(self.keypoints) else all_looked

    @property
    def sees_more(self) -> bool:
        """Whether in the first steps any other sensor than the keypoints' detectors sees something; clicks are none."""
        first = range(min(len(self), _FIRST_STEPS))
        steps = ((self.steps(i), len(self.keypoints_at(i))) for i in first)
        return any(len(seen) - len(by_record(seen)[ClickFrame]) > keypoints for seen, keypoints in steps)

    @property
    def markers_alone(self) -> bool:
        """Whether one marker system is the only sensor."""
        if len(self.markers) != 1 or self.keypoints or self.depth or self.sensors or self.backgrounds:
            return False
        first = range(min(len(self), _FIRST_STEPS))
        return all(f.sensor == self.markers[0].sensor for i in first for f in self.steps(i))

    def keypoints_at(self, i: int) -> list[KeypointFrame]:
        """The keypoints among what is seen at a step: a frame of every record, or none where no point is seen."""
        return keypoint_frames(self.keypoints, i, float(self.times[i]))

    @property
    def alone(self) -> Camera | None:
        """The camera that is the only sensor, but for those that follow it, its landmarks lifted to space."""
        lifted = only_lifted(self.keypoints)
        of_world = any(not sensor.follows for sensor in self.sensors)
        others = self.markers or self.depth or of_world or self.backgrounds or len(self.rig) > 1
        return None if lifted is None or others else self.rig[lifted.camera]

    @classmethod
    def of_frames(
        cls, steps: Sequence[Sequence[Any]], rig: Rig, *, rate: float, sigma: Mapping[str, float] | None = None,
        **more: Any,
    ) -> Recording:  # fmt: skip
        """What the sensors saw at each time, in memory: depth images, clouds, keypoints, markers, your own, in any mix.

        Parameters
        ----------
        steps : lists of frames
        rig : Rig
        rate : float [Hz] of the steps
        sigma : {sensor: standard deviation}
        more : other arguments of a recording

        Raises
        ------
        ObservationError
            No steps, or steps without any frame; two frames of one sensor in a step; a standard deviation of no sensor.
        """
        of_kind(rig, Rig, "the rig", "Give a Rig; without cameras Rig(()).")
        of_kind(steps, Sequence, "steps", "Give a list of steps, each a list of frames.", each=Sequence)
        if not (is_number(rate) and 0.0 < rate < np.inf):
            raise ObservationError(f"rate is {rate} Hz", remedy="Give a positive rate.")
        by_source = frames_by_source(steps)
        mean_times = [float(np.mean([f.time for f in seen])) if len(seen) else np.nan for seen in steps]
        timed = np.flatnonzero(np.isfinite(mean_times))
        if not len(timed):
            raise ObservationError("no step has a frame", remedy="Give a list of frames for each step.")
        times = np.interp(np.arange(len(mean_times)), timed, np.array(mean_times)[timed])
        if len(timed) < len(mean_times):  # evenly beyond the ends
            even = times[timed[0]] + (np.arange(len(mean_times)) - timed[0]) / rate
            times = np.where(np.isfinite(mean_times), times, even)
        sigma = dict(sigma or {})
        worn = tuple(
            NamedMarkers(source[0], Markers(names, rate, x, source=source[0]), source[1])
            for source, frames in by_source[MarkerFrame].items()
            for names, x in [_stacked(frames, len(steps), "positions")]
        )
        there = {*rig.names, *(sensor_of(f) for seen in steps for f in seen)}
        there |= {f"{m.sensor} {name}" for m in worn for name in m.markers.names}
        for name in sigma:
            if name not in there:
                remedy = "Correct its name in sigma, or leave it out."
                raise ObservationError(choices("sensor", name, sorted(there)), remedy=remedy)
        records = keypoint_records(steps, rate, start=float(times[0]))
        others = [[f for f in seen if sensor_of(f) != KEYPOINTS] for seen in steps]
        return cls(
            times, rate, rig, keypoints=records, sigma=sigma,
            steps=lambda i: [*others[i], *keypoint_frames(records, i, float(times[i]))],
            depth=_first_depth(by_source[DepthFrame], rate), **{"markers": worn, **more},
        )  # fmt: skip

    def without(self, sensors: Collection[str]) -> Recording:
        """The same without what some depth cameras saw."""
        kept = {i: f for i, f in self.depth.items() if f.sensor not in sensors}
        return replace(self, steps=lambda i: [f for f in self.steps(i) if sensor_of(f) not in sensors], depth=kept)

    def part(self, frames: slice) -> Recording:
        """A stretch of its steps."""
        own = range(len(self))[frames]
        start = (self.start[0] - own.start, self.start[1]) if self.start and self.start[0] in own else None
        return replace(
            self, times=self.times[frames], steps=lambda i: self.steps(i + own.start), start=start,
            poses={i - own.start: state for i, state in self.poses.items() if i in own},
            keypoints=tuple(_cut(k, frames) for k in self.keypoints),
        )  # fmt: skip


def keypoint_frames(keypoints: Sequence[Keypoints], i: int, time: float) -> list[KeypointFrame]:
    """A frame of every record of one person, at the i-th time [s]; none where no record shows any point then."""
    if not any((k.confidence[i, 0] > 0).any() for k in keypoints):
        return []
    return [KeypointFrame.of_record(k, i, time) for k in keypoints]


def _seen_in(records: Sequence[Keypoints], times: NDArray, i: int) -> Sequence[Any]:
    """Frames of records of one person at a step, and of what a network lifted of it, where it is the only camera."""
    time, one = float(times[i]), only_lifted(records)
    seen: list[Any] = []
    if one is not None and one.lifted is not None and (one.confidence[i] > 0).any():
        seen.append(LiftedFrame(one.camera, time, one.names, one.lifted[i, 0], one.points[i, 0], one.keypoint_set))
    return [*seen, *keypoint_frames(records, i, time)]


def frames_by_source(steps: Sequence[Sequence[Any]]) -> Mapping[type, Mapping[tuple[str, str], Mapping[int, Any]]]:
    """Frames of kinefit's records: {record: {(sensor, set or segment of its points): {step: frame}}}.

    Raises
    ------
    ObservationError
        Two frames of one sensor in a step that are of the same points.
    """
    out: dict[type, dict[tuple[str, str], dict[int, Any]]] = {record: {} for record in get_args(Frame)}
    for i, seen in enumerate(steps):
        for record, frames in by_record(seen).items():
            for f in frames if record in out else ():
                part = next((getattr(f, name) for name in _PARTS if hasattr(f, name)), "") or ""
                own = out[record].setdefault((f.sensor, part), {})
                if i in own:
                    problem = f"step {i} has two frames of sensor '{f.sensor}'"
                    raise ObservationError(problem, remedy="Give each sensor its own name, or each time its own step.")
                own[i] = f
    return out


def _stacked(frames: Mapping[int, Any], count: int, *values: str) -> tuple[Any, ...]:
    """Names of all points in frames by their step, and each of their `values` at `count` steps: NaN where unseen."""
    names = tuple(dict.fromkeys(n for f in frames.values() for n in f.names))
    shapes = [getattr(next(iter(frames.values())), value).shape[1:] for value in values]
    out = [np.full((count, len(names), *shape), np.nan) for shape in shapes]
    for i, f in frames.items():
        places = [names.index(n) for n in f.names]
        for array, value in zip(out, values):
            array[i, places] = getattr(f, value)
    return names, *out


def _cut(record: Keypoints, frames: slice) -> Keypoints:
    first = range(len(record))[frames].start
    return record.rows(frames, record.time_offset + first / record.rate)


def _sigmas(sigma: float | Sequence[float], count: int) -> tuple[float, ...]:
    """One standard deviation [px] for each of the records."""
    values = np.asarray(sigma, float).ravel()
    if len(values) not in (1, count) or not np.all((values > 0) & np.isfinite(values)):
        problem = f"sigma is {values}"
        raise ObservationError(problem, remedy=f"Give one positive number of pixels, or {count} of them.")
    return tuple(float(v) for v in np.broadcast_to(values, count))


def keypoint_records(steps: Sequence[Sequence[Any]], rate: float, *, start: float = 0.0) -> tuple[Keypoints, ...]:
    """Keypoints of single frames as records of all of them, one for each camera and keypoint set.

    Parameters
    ----------
    rate : float [Hz] of the steps, of which the first is at `start` [s]
    """
    out = []
    for (camera, name), frames in frames_by_source(steps)[KeypointFrame].items():
        names, uv, confidence = _stacked(frames, len(steps), "uv", "confidence")
        seen = np.nan_to_num(confidence[:, None])
        sides_known = np.array([i in frames and frames[i].sides_known for i in range(len(steps))])
        record = Keypoints(camera, name, names, rate, uv[:, None], seen, time_offset=start)
        out.append(replace(record, sides_known=sides_known) if sides_known.any() else record)
    return tuple(out)


_SIZING_IMAGES = 4  # depth images from which a person's size is found ...
_SIZING_S = 5.0  # ... spread over the beginning


def _first_depth(cameras: Mapping[Any, Mapping[int, DepthFrame]], rate: float) -> dict[int, DepthFrame]:
    """Some of the first images of the depth camera that comes first, by step."""
    shown = next(iter(cameras.values()), {})
    some = [i for i in shown if i <= next(iter(shown)) + _SIZING_S * rate]
    return {some[k]: shown[some[k]] for k in spread(len(some), _SIZING_IMAGES)}


def spread(count: int, most: int) -> NDArray:
    """(N,) int: at most so many of `count` places, spread evenly."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int)) if count else np.zeros(0, int)
