"""How every other sensor lies against the cameras of the videos: by the person whom they all see.

The person is tracked in the keypoints alone. In some frames spread over the walk, poses, the person's surface, markers'
and detectors' places and the frames of the other sensors are then fitted together, from all that was measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.errors import ObservationError
from kinefit.frame.routing import Sensors
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.identification.take.named import with_names
from kinefit.motion import Motion
from kinefit.observations import DepthFrame, MarkerFrame
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.sensors.base import Measurement, matched_by, rows_at
from kinefit.sensors.channels import make_channels
from kinefit.sensors.displaced import AXES, CLOCK, Displaced, displacement
from kinefit.sensors.keypoints import KeypointMeasurement, KeypointSensor, Layout
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.subject.fit import Subject, fit_subject
from kinefit.subject.keypoints import Subject as Person
from kinefit.subject.keypoints import fit_subject as fit_person
from kinefit.subject.parameters import KnownLengths, Parameters, PointOffsets
from kinefit.subject.sensor_parameters import SensorFrames
from kinefit.subject.surfaces import CylinderShape
from kinefit.tracking.recording import Recording, spread
from kinefit.tracking.take_recording import recording_of
from kinefit.tracking.video import track

FRAMES = 12
"""Frames that are fitted, spread over those in which the person was tracked."""

Progress = Callable[[str, int, int], None]

_TRACKED = 0.3  # quality of a frame that counts
_FEWEST = 4  # frames in which a sensor must have seen the person
_FAR = (0.3, 0.2, 0.12, 0.08)  # [m] of correspondences while only the frames of the sensors move
_COARSE, _ROUNDS = 5, 3  # frames of the first fit; rounds of match and solve of the second
_DETECTOR = 0.005  # [m] by which a detector's points may stand elsewhere than the fit of the keypoints has them
# [m, rad, s], and [m] upwards: what a surface of simple shapes leaves wrong on a person of another shape, in all frames
# alike: RMS errors of three simulated Anny people (draws 100 to 102 of `benchmarks.mixed_misfit`).
_SURFACE, _UPRIGHT = np.array([0.003, 0.003, 0.003, 0.004, 0.004, 0.004, 0.0]), 0.01
_SETTINGS = TrackSettings(through=np.inf)  # with free space two heights were off by 8 and 21 mm, without by 7 and 17
_HEIGHTS, _NEAR = np.linspace(-0.06, 0.06, 9), 0.05  # [m] that are tried, and at which a distance counts in full
_INSIDE, _DRAWS = 0.95, 4000  # share of errors within the bars that are stated; numbers drawn for that


@dataclass(frozen=True, eq=False)
class SensorFit:
    """How a sensor's frame lies against the world of the videos.

    Parameters
    ----------
    sensor : name
    kind : "depth" or "markers"
    twist : (7,) [m, rad, s] shift of the centre, rotation vector, and clock: what must be done to the sensor.
    covariance : (7, 7) of them
    centre : (3,) [m] about which it turns, the middle of where the person was
    """

    sensor: str
    kind: str
    twist: NDArray
    covariance: NDArray
    centre: NDArray

    @property
    def T(self) -> NDArray:
        """(4, 4) x_world = T x, of a point x as the sensor's frame is stated to place it."""
        return displacement(dict(zip(AXES, self.twist)), self.centre)

    @property
    def shift(self) -> float:
        """[m] in the middle of where the person was."""
        return float(np.linalg.norm(self.twist[:3]))

    @property
    def turn(self) -> float:
        """[rad]."""
        return float(np.linalg.norm(self.twist[3:6]))

    @cached_property
    def bars(self) -> tuple[float, float]:
        """[m], [rad] within which 95 % of the errors of shift and turn have their length."""
        z = np.random.default_rng(0).standard_normal((_DRAWS, 7)) @ np.linalg.cholesky(self.covariance).T
        shift, turn = (np.linalg.norm(z[:, part], axis=1) for part in (slice(3), slice(3, 6)))
        return float(np.quantile(shift, _INSIDE)), float(np.quantile(turn, _INSIDE))

    @property
    def deviations(self) -> float:
        """How many standard deviations the six of shift and turn are from none, per degree of freedom."""
        moved, C = self.twist[:6], self.covariance[:6, :6]
        return float(np.sqrt(moved @ np.linalg.solve(C, moved) / 6.0))


def fit_sensors(
    take: Take, seen: Observations, rig: Rig | None = None, *, frames: int = FRAMES, progress: Progress | None = None
) -> tuple[SensorFit, ...]:
    """How the depth cameras and marker systems of a take lie against the cameras with keypoints.

    Parameters
    ----------
    seen : of the take
    rig : Rig, better one of cameras with keypoints; default: as the take has them.

    Returns
    -------
    tuple of SensorFit
        None where there is no such sensor, or no frames in which it and two cameras saw the person.

    Raises
    ------
    KinefitError
        What tracking the keypoints and reading the sensors raise.
    """
    videos = {k.camera for k in seen.keypoints}
    depth = {e.name for e in take.depth if (e.camera or e.name) not in videos} & {v.sensor for v in seen.depth}
    if not (depth or seen.markers) or len(videos) < 2 or seen.rig is None:
        return ()
    if rig is not None:
        cameras = (rig[c.name] if c.name in rig else c for c in seen.rig)
        seen = replace(seen, rig=Rig(tuple(cameras)))
    seen = with_names(take, seen)
    recording, body = recording_of(replace(take, start=None), seen, load_body(take.body))
    alone = replace(recording, steps=lambda i: (), markers=(), marker_sets=(), depth={}, on_body=(), backgrounds={})
    channels = make_channels(body, recording.rig, recording.keypoints, recording.people, recording.keypoint_sigma)
    person = fit_person(body, channels, height=take.height, progress=progress)
    motion = track(alone, body, subject=person, progress=progress)
    problem = _Problem(recording, motion, person, frozenset(depth))
    chosen = problem.chosen(frames)
    if len(chosen) < _FEWEST:
        return ()
    found, centre = problem.fitted(chosen)
    out = []
    for sensor in problem.names:
        k = found.names.index(f"{sensor} {AXES[0]}")
        own = slice(k, k + 7)
        C, kind = found.covariance[own, own], "depth" if sensor in depth else "markers"
        if sensor in depth:
            up = np.append(recording.up_axis, np.zeros(4))
            C = C + np.diag(_SURFACE**2) + _UPRIGHT**2 * np.outer(up, up)
        out.append(SensorFit(sensor, kind, found.mean[own], C, centre))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class _Look:
    """One frame of the motion: what the sensors saw, the body's state, time [s] and velocity (n,)."""

    frame: int
    seen: Sequence[Any]
    state: BodyState
    time: float
    velocity: NDArray


class _Problem:
    """A recording, tracked in its keypoints alone, and the sensors that are to be placed."""

    def __init__(self, recording: Recording, motion: Motion, person: Person, depth: frozenset[str]) -> None:
        self.recording, self.motion, self.depth, self.settings = recording, motion, depth, _SETTINGS
        self.person = person
        self.body: Body = motion.body
        channels = make_channels(
            self.body, recording.rig, recording.keypoints, recording.people, recording.keypoint_sigma
        )
        self.layout = Layout(channels, self.body)
        self.first = round((motion.times[0] - recording.times[0]) * recording.rate)
        s = self.settings
        self.sensors = Sensors(recording.rig, recording.rate, recording.sigma, s, on_body=recording.on_body)
        for name, empty in recording.backgrounds.items():
            self.sensors.know_background(name, empty)
        self.pixels = KeypointSensor(recording.rig, {}, s.pixel, s.loss, s.near)
        self.names: tuple[str, ...] = ()

    def seen(self, frame: int) -> list[Any]:
        """What the sensors saw in a frame of the motion."""
        every = self.recording.steps(frame + self.first)
        return [
            f for f in every if isinstance(f, MarkerFrame) or (isinstance(f, DepthFrame) and f.sensor in self.depth)
        ]

    def chosen(self, most: int) -> NDArray:
        """Frames to fit, in which the person was tracked and a sensor saw something."""
        good = np.flatnonzero(self.motion.quality > _TRACKED)
        some = np.array([f for f in good[spread(len(good), 4 * most)] if self.seen(int(f))], int)
        return some[spread(len(some), most)]

    def fitted(self, chosen: NDArray) -> tuple[Subject, NDArray]:
        """The fit of everything, and the centre (3,) [m] of the sensors' frames."""
        motion = self.motion
        states = [motion.state(int(f)) for f in chosen]
        velocities = [self.velocity(int(f)) for f in chosen]
        times = [float(self.recording.times[int(f) + self.first]) for f in chosen]
        frames = [self.seen(int(f)) for f in chosen]
        self.names = tuple(dict.fromkeys(f.sensor for seen in frames for f in seen))
        centre = np.mean([motion.positions()[f].mean(axis=0) for f in chosen], axis=0)
        place = SensorFrames(self.names)
        looks = [_Look(*each) for each in zip(chosen.tolist(), frames, states, times, velocities)]
        few = [looks[k] for k in spread(len(looks), _COARSE)]
        nothing = np.zeros(len(place.names))
        coarse = self.fit(few, centre, {}, [place], nothing, reach=_FAR, rounds=len(_FAR), looks=1.0)
        few = [replace(look, state=state) for look, state in zip(few, coarse.states)]
        values = {name: dict(own) for name, own in coarse.values.items()}
        for sensor in self.depth & set(self.names):
            raised = self.height(sensor, few, centre, values) * self.recording.up_axis
            for axis, shift in zip(AXES, raised):
                values[sensor][axis] += float(shift)
        parameters = [*self.parameters(frames), place]
        moved = [values[name][what] for name in self.names for what in (*AXES, CLOCK)]
        start = np.concatenate([*(p.mean for p in parameters[:-1]), moved])
        return self.fit(looks, centre, values, parameters, start, rounds=_ROUNDS), centre

    def height(self, sensor: str, looks: Sequence[_Look], centre: NDArray, values: Any) -> float:
        """[m] by which a depth sensor is to be raised, so that its points lie nearest to the surface.

        Correspondences slide along a standing person: matched and solved in turn, heights come 3 % nearer in a round.
        So heights are tried, and the smallest truncated distances of all points, with new correspondences, are found.
        """
        own = [replace(look, seen=[f for f in look.seen if f.sensor == sensor]) for look in looks]
        steps = self.measured(own, centre, values)
        cost = np.zeros(len(_HEIGHTS))
        for k, raised in enumerate(_HEIGHTS):
            shift = dict(zip(AXES, raised * self.recording.up_axis))
            there = {sensor: {what: v + shift.get(what, 0.0) for what, v in values[sensor].items()}}
            for several, look in zip(steps, own):
                scene = Scene(self.body, look.state, self.recording.rig, time=look.time, values=there)
                for m in several:
                    if m.sensor == sensor:
                        r = rows_at(matched_by(m, scene, _NEAR), scene)[0].residual
                        cost[k] += float(np.sum(np.minimum(np.square(r), _NEAR**2) - _NEAR**2))
        least = int(np.clip(np.argmin(cost), 2, len(_HEIGHTS) - 3))
        a, b, _ = np.polyfit(_HEIGHTS[least - 2 : least + 3], cost[least - 2 : least + 3], 2)
        best = -0.5 * b / a if a > 0.0 else _HEIGHTS[least]
        return float(np.clip(best, _HEIGHTS[0], _HEIGHTS[-1]))

    def fit(
        self, some: Sequence[_Look], centre: NDArray, values: Any, parameters: Sequence[Parameters], start: NDArray,
        **options: Any,
    ) -> Subject:  # fmt: skip
        """Parameters of some frames from a start, at which the sensors have `values`."""
        return fit_subject(
            self.body, self.recording.rig, self.measured(some, centre, values), [look.state for look in some],
            parameters, start=start, times=[look.time for look in some],
            velocities=[look.velocity for look in some], loss=self.settings.loss, **options,
        )  # fmt: skip

    def parameters(self, frames: Sequence[Sequence[Any]]) -> list[Parameters]:
        """What else is unknown: the surface where depth is seen, places of markers and of detectors' points."""
        scales, covariance = self.person.scales, self.person.covariance
        assert covariance is not None  # of a fit
        known = covariance[: len(scales), : len(scales)] / np.outer(scales, scales)
        out: list[Parameters] = [KnownLengths(self.body, scales=np.ones(len(scales)), covariance=known)]
        surfaces = self.body.surfaces if any(isinstance(f, DepthFrame) for seen in frames for f in seen) else ()
        if any(isinstance(s, TaperedCylinder) for s in surfaces) and not self.body.skin:
            out.append(CylinderShape(self.body))
        sets = {name: std for name, std in self.recording.marker_sets if std is not None}
        out += [PointOffsets(self.body, name, std) for name, std in sets.items()]
        return out + [PointOffsets(self.body, name, _DETECTOR) for name in self.layout.channels.sets]

    def measured(self, looks: Sequence[_Look], centre: NDArray, values: Any) -> list[list[Measurement]]:
        """What was measured in each frame, prepared about the body where the sensors' frames have it."""
        channels, out = self.layout.channels, []
        for look in looks:
            several: list[Measurement] = []
            for frame in look.seen:
                T = displacement(values.get(frame.sensor, {}), centre)
                there = BodyState(se3.inverse(T) @ look.state.T_world_root, look.state.angles)
                scene = Scene(self.body, there, self.recording.rig, time=look.time, samples=self.settings.samples)
                several += [Displaced(m, centre) for m in self.sensors.measurements([frame], scene)]
            k = look.frame + self.first
            pixels = channels.uv[k], channels.confidence[k]
            several.append(KeypointMeasurement(self.pixels, self.layout, *pixels, look.time))
            out.append(several)
        return out

    def velocity(self, frame: int) -> NDArray:
        """(n,) [m/s, rad/s] of the body, from the frames beside one."""
        a, b = max(frame - 1, 0), min(frame + 1, len(self.motion) - 1)
        if a == b:
            raise ObservationError("a motion of one frame", remedy="Record the person for some seconds.")
        seconds = float(self.motion.times[b] - self.motion.times[a])
        return self.motion.state(a).difference(self.motion.state(b)) / seconds
