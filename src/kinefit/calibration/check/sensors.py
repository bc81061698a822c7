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
from kinefit.sensors.base import Measurement
from kinefit.sensors.channels import make_channels
from kinefit.sensors.displaced import AXES, CLOCK, Displaced, displacement
from kinefit.sensors.keypoints import KeypointMeasurement, KeypointSensor, Layout
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.subject.fit import Subject, fit_subject
from kinefit.subject.keypoints import Subject as Person
from kinefit.subject.keypoints import fit_subject as fit_person
from kinefit.subject.parameters import Parameters, PointOffsets
from kinefit.subject.sensor_parameters import SensorFrames
from kinefit.subject.surfaces import CylinderShape, CylinderSlide
from kinefit.tracking.recording import Recording, spread
from kinefit.tracking.sizing import FittedLengths
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
_SETTINGS = TrackSettings(through=np.inf)  # free space ends half a pixel within a person and lifts a standing one
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
        kind = "depth" if sensor in depth else "markers"
        out.append(SensorFit(sensor, kind, found.mean[own], found.covariance[own, own], centre))
    return tuple(out)


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
        good = [int(f) for f in good[spread(len(good), 4 * most)] if self.seen(int(f))]
        return np.array(good, int)[spread(len(good), most)]

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
        given = chosen, frames, states, times, velocities
        some = spread(len(chosen), _COARSE)
        few = [[values[k] for k in some] for values in given]
        coarse = self.fit(*few, centre, {}, [place], np.zeros(len(place.names)), reach=_FAR, rounds=len(_FAR), looks=1.0)
        parameters = [*self.parameters(frames), place]
        start = np.concatenate([*(p.mean for p in parameters[:-1]), coarse.mean])
        return self.fit(*given, centre, coarse.values, parameters, start, rounds=_ROUNDS), centre

    def fit(
        self, chosen: Sequence[int], frames: Sequence[Sequence[Any]], states: Sequence[BodyState],
        times: Sequence[float], velocities: Sequence[NDArray], centre: NDArray, values: Any,
        parameters: Sequence[Parameters], start: NDArray, **options: Any,
    ) -> Subject:  # fmt: skip
        """Parameters of some frames from a start, at which the sensors have `values`."""
        steps = self.measured(chosen, frames, states, times, centre, values)
        return fit_subject(
            self.body, self.recording.rig, steps, states, parameters, start=start, times=times, velocities=velocities,
            loss=self.settings.loss, **options,
        )  # fmt: skip

    def parameters(self, frames: Sequence[Sequence[Any]]) -> list[Parameters]:
        """What else is unknown: the surface where depth is seen, places of markers and of detectors' points."""
        out: list[Parameters] = [FittedLengths(self.body, self.person)]
        surfaces = self.body.surfaces if any(isinstance(f, DepthFrame) for seen in frames for f in seen) else ()
        if any(isinstance(s, TaperedCylinder) for s in surfaces) and not self.body.skin:
            out += [CylinderShape(self.body), CylinderSlide(self.body)]
        sets = {name: std for name, std in self.recording.marker_sets if std is not None}
        out += [PointOffsets(self.body, name, std) for name, std in sets.items()]
        return out + [PointOffsets(self.body, name, _DETECTOR) for name in self.layout.channels.sets]

    def measured(
        self, chosen: Sequence[int], frames: Sequence[Sequence[Any]], states: Sequence[BodyState], times: Sequence[float],
        centre: NDArray, values: Any,
    ) -> list[list[Measurement]]:  # fmt: skip
        """What was measured in each frame, prepared about the body where the sensors' frames have it."""
        channels, out = self.layout.channels, []
        for f, seen, state, time in zip(chosen, frames, states, times):
            several: list[Measurement] = []
            for frame in seen:
                T = displacement(values.get(frame.sensor, {}), centre)
                there = BodyState(se3.inverse(T) @ state.T_world_root, state.angles)
                scene = Scene(self.body, there, self.recording.rig, time=time, samples=self.settings.samples)
                several += [Displaced(m, centre) for m in self.sensors.measurements([frame], scene)]
            k = int(f) + self.first
            several.append(KeypointMeasurement(
                self.pixels, self.layout, channels.uv[k], channels.confidence[k], time
            ))
            out.append(several)
        return out

    def velocity(self, frame: int) -> NDArray:
        """(n,) [m/s, rad/s] of the body, from the frames beside one."""
        a, b = max(frame - 1, 0), min(frame + 1, len(self.motion) - 1)
        if a == b:
            raise ObservationError("a motion of one frame", remedy="Record the person for some seconds.")
        return self.motion.state(a).difference(self.motion.state(b)) / float(self.motion.times[b] - self.motion.times[a])
