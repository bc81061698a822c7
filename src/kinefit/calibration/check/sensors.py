"""Align depth cameras and marker systems with the cameras of the videos, by the person in view of all.

The person is tracked in the keypoints alone. Then a joint fit of all measurements in some frames, spread over the walk,
estimates poses, the person's surface, marker and landmark offsets, and the frames of the other sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.diagnostics.sensors import MISFIT_SIGMAS, POSE_SIGMAS, SensorAlignment, doubts_of
from kinefit.errors import ObservationError
from kinefit.frame.routing import Sensors
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.identification.take.takes import with_names
from kinefit.motion import Motion
from kinefit.observations import sensor_of
from kinefit.readers.take.entries import sensor_name
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.sensors.base import Measurement
from kinefit.sensors.displaced import AXES, Displaced, displacement
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.registration import (
    COARSE_DISTANCES,
    FINE_DISTANCES,
    Ends,
    Registration,
    apart,
    starts,
    twist_of,
    values_of,
)
from kinefit.subject.fit import fit_subject
from kinefit.subject.keypoints import fit_subject as fit_person
from kinefit.subject.parameters import KnownLengths, Parameters, PointOffsets
from kinefit.subject.sensor_parameters import SensorFrames
from kinefit.subject.subject import Subject, SubjectFit
from kinefit.subject.surfaces import CylinderShape
from kinefit.tracking.placing import PlacedCamera, placed_cameras
from kinefit.tracking.recording import Recording, spread
from kinefit.tracking.sizing import channels_of
from kinefit.tracking.takes.take_recording import recording_of
from kinefit.tracking.video import track

FRAMES = 12
"""Number of fitted frames, spread over those in which the person was tracked."""

Progress = Callable[[str, int, int], None]

_MIN_QUALITY = 0.3  # of a frame that counts
_MIN_FRAMES = 4  # with the person in a sensor
_MARKER_DISTANCES = (0.3, 0.2, 0.12, 0.08)  # [m] of correspondences while only the frames of the sensors move
_FIRST_FRAMES = 5  # of the first fit
_JOINT_ROUNDS = 3  # of match and solve, of the joint fit
_LANDMARK_SIGMA = 0.005  # [m] of a detector's points about the fit of the keypoints
# Systematic errors of a surface of simple shapes on a person of another shape: RMS errors of three simulated Anny
# people (draws 100 to 102 of `benchmarks.mixed_misfit`).
_SURFACE_SIGMA = np.array([0.003, 0.003, 0.003, 0.004, 0.004, 0.004, 0.0])  # [m, rad, s]
_UP_SIGMA = 0.01  # [m] in addition, upwards
_SETTINGS = TrackSettings(through=np.inf)  # two heights were off by 7 and 17 mm; with free space by 8 and 21
_WIDE_SETTINGS = replace(_SETTINGS, reach=0.45, render_every=1)  # for a sensor that is off by three sigmas of 10 cm
_CLOCK_SIGMA = 0.02  # [s]


def fit_sensors(
    take: Take, seen: Observations, rig: Rig | None = None, *, frames: int = FRAMES, progress: Progress | None = None
) -> tuple[SensorAlignment, ...]:
    """Align the depth cameras and marker systems of a take with the cameras with keypoints.

    Parameters
    ----------
    seen : observations of the take
    rig : Rig, refined one of cameras with keypoints; default: the take's.
    frames : int, largest number of fitted frames

    Returns
    -------
    tuple of SensorAlignment
        Empty without such a sensor, or without frames in which it and two cameras see the person.

    Raises
    ------
    KinefitError
        As tracking the keypoints and reading the sensors.
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
    alone = replace(
        recording, steps=recording.keypoints_at, markers=(), depth={}, on_body=(), backgrounds={}
    )  # fmt: skip
    person = fit_person(body, channels_of(recording, body, TrackSettings()), height=take.height, progress=progress)
    motion = track(alone, body, subject=person, progress=progress)
    placed = placed_cameras(recording, person, TrackSettings())
    away = [_elsewhere(name, p, motion) for name, p in placed.items() if not (p.usable or p.fits)]
    recording, depth = recording.without(names := {fit.sensor for fit in away}), depth - names
    origins = {name: recording.rig[name].centre_world for name in depth}
    for k, entry in enumerate(take.markers):
        origins[sensor_name("markers", take.markers, k)] = entry.T_world_file[:3, 3]
    problem = _PlacementProblem(recording, motion, person, frozenset(depth), origins)
    chosen = problem.chosen(frames)
    return (*away, *(problem.fits(chosen) if len(chosen) >= _MIN_FRAMES else ()))


def _elsewhere(sensor: str, placed: PlacedCamera, motion: Motion) -> SensorAlignment:
    """Alignment of a depth camera too far from its stated pose for a correction, such as upside down."""
    T, centre = placed.T, motion.positions().mean(axis=(0, 1))
    twist = np.array([*(se3.apply(T, centre) - centre), *se3.log_so3(T[:3, :3]), 0.0])
    std = np.array([*np.repeat(POSE_SIGMAS, 3), _CLOCK_SIGMA])
    limit = np.degrees(MISFIT_SIGMAS * POSE_SIGMAS[1])
    doubts = (f"it would turn by {np.degrees(placed.turn):.0f}°: more than {limit:.0f}°",)
    return SensorAlignment(sensor, "depth", twist, np.diag(std**2), centre, True, doubts)


@dataclass(frozen=True, eq=False)
class _Look:
    """One frame of the motion: the sensors' frames, the body's state, time [s] and velocity (n,)."""

    frame: int
    seen: Sequence[Any]
    state: BodyState
    time: float
    velocity: NDArray


class _PlacementProblem:
    """A recording, tracked in its keypoints alone, and the sensors to align."""

    def __init__(
        self, recording: Recording, motion: Motion, person: Subject, depth: frozenset[str], origins: dict[str, NDArray]
    ) -> None:
        self.recording, self.motion, self.depth, self.settings = recording, motion, depth, _SETTINGS
        self.person, self.origins, self.centre = person, origins, np.zeros(3)
        self.body: Body = motion.body
        self.first = round((motion.times[0] - recording.times[0]) * recording.rate)
        self.sensors, self.wide = self.prepared(_SETTINGS), self.prepared(_WIDE_SETTINGS)
        self.names: tuple[str, ...] = ()

    def prepared(self, settings: TrackSettings) -> Sensors:
        """The sensors with their backgrounds."""
        of = self.recording
        out = Sensors(of.rig, of.rate, of.sigma, settings, on_body=of.on_body)
        for name, empty in of.backgrounds.items():
            out.know_background(name, empty)
        return out

    def look(self, frame: int) -> _Look:
        """The data of one frame of the motion."""
        time = float(self.recording.times[frame + self.first])
        return _Look(frame, self.seen(frame), self.motion.state(frame), time, self.velocity(frame))

    def seen(self, frame: int) -> list[Any]:
        """The sensors' frames at a frame of the motion."""
        return [f for f in self.recording.steps(frame + self.first) if sensor_of(f) in self.origins]

    def chosen(self, most: int) -> NDArray:
        """(K,) at most `most` frames with a tracked person and a frame of a sensor."""
        good = np.flatnonzero(self.motion.quality > _MIN_QUALITY)
        some = np.array([f for f in good[spread(len(good), 4 * most)] if self.seen(int(f))], int)
        return some[spread(len(some), most)]

    def fits(self, chosen: NDArray) -> tuple[SensorAlignment, ...]:
        """Alignments of the sensors from frames (K,); those that do not fit also from each half of the frames."""
        looks = [self.look(int(f)) for f in chosen]
        self.names = tuple(dict.fromkeys(f.sensor for look in looks for f in look.seen))
        self.centre = np.mean([self.motion.positions()[f].mean(axis=0) for f in chosen], axis=0)
        self.place = SensorFrames(
            self.names, (*POSE_SIGMAS, _CLOCK_SIGMA), {name: self.origins[name] - self.centre for name in self.names}
        )
        near, ends = self.coarse(looks)
        out = [self.with_surface(fit) for fit in self.fitted(looks, near)]
        if any(fit.misfit for fit in out):
            a, b = (self.fitted(looks[k::2], near) for k in range(2))
            out = [self.judged(looks, fit, (a[k], b[k]), ends.get(fit.sensor)) for k, fit in enumerate(out)]
        return tuple(out)

    def with_surface(self, fit: SensorAlignment) -> SensorAlignment:
        """The alignment with the surface's systematic errors added to the covariance."""
        if fit.kind != "depth":
            return fit
        up = np.append(self.recording.up_axis, np.zeros(4))
        return replace(fit, covariance=fit.covariance + np.diag(_SURFACE_SIGMA**2) + _UP_SIGMA**2 * np.outer(up, up))

    def judged(
        self,
        looks: Sequence[_Look],
        fit: SensorAlignment,
        halves: tuple[SensorAlignment, SensorAlignment],
        ends: Ends | None,
    ) -> SensorAlignment:
        """The alignment with the difference of two halves of the frames in its covariance, and reasons for doubt."""
        if not fit.misfit:
            return fit
        half = 0.5 * apart(*(each.twist for each in halves))
        falls = self.registration(fit.sensor, looks).above(np.zeros(7), fit.twist)
        wide = replace(fit, covariance=fit.covariance + np.outer(half, half), falls=falls)
        rivals = ends.rivals if ends is not None else ()
        return replace(wide, doubts=doubts_of(wide, self.origins[fit.sensor], halves, rivals))

    def coarse(self, looks: Sequence[_Look]) -> tuple[dict[str, NDArray], dict[str, Ends]]:
        """Initial twists (7,) of all sensors; of depth sensors also all local minima."""
        ends = {}
        for sensor in self.names:
            if sensor in self.depth:
                own = self.registration(sensor, looks)
                first = starts(self.origins[sensor], self.centre, POSE_SIGMAS)
                rest = [own.settled(twist, (*COARSE_DISTANCES, *FINE_DISTANCES)) for twist in first]
                ends[sensor] = Ends(own, tuple(own.height(twist, self.recording.up_axis) for twist in rest))
        near = {sensor: end.best for sensor, end in ends.items()}
        named = tuple(name for name in self.names if name not in near)
        if named:
            few = [looks[k] for k in spread(len(looks), _FIRST_FRAMES)]
            few = [replace(look, seen=[f for f in look.seen if f.sensor in named]) for look in few]
            place = replace(self.place, sensors=named)
            start, reach = np.zeros(len(place.names)), _MARKER_DISTANCES
            found = self.fit(few, {}, [place], start, reach=reach, rounds=len(reach), looks=1.0)
            near |= {name: twist_of(found.values[name]) for name in named}
        return near, ends

    def registration(self, sensor: str, looks: Sequence[_Look]) -> Registration:
        """The measurements of one sensor, with the poses from the keypoints alone."""
        own = [replace(look, seen=[f for f in look.seen if f.sensor == sensor]) for look in looks]
        own = [look for look in own if look.seen]
        scenes = [
            Scene(self.body, look.state, self.recording.rig, time=look.time, velocity=look.velocity,
                  samples=self.settings.samples) for look in own
        ]  # fmt: skip
        place = replace(self.place, sensors=(sensor,))
        return Registration(sensor, self.measured(own, {}, self.wide), scenes, self.centre, place.information[:6, :6])

    def fitted(self, looks: Sequence[_Look], near: Mapping[str, NDArray]) -> list[SensorAlignment]:
        """Joint fit of some frames, from twists (7,) of the sensors."""
        twists = dict(near)
        for sensor in self.depth & set(self.names):
            own = self.registration(sensor, looks)
            twists[sensor] = own.height(own.settled(twists[sensor], FINE_DISTANCES), self.recording.up_axis)
        parameters = [*self.parameters([look.seen for look in looks]), self.place]
        start = np.concatenate([*(p.mean for p in parameters[:-1]), *(twists[name] for name in self.names)])
        values = {name: values_of(twist) for name, twist in twists.items()}
        found = self.fit(looks, values, parameters, start, rounds=_JOINT_ROUNDS)
        out = []
        for sensor in self.names:
            k = found.names.index(f"{sensor} {AXES[0]}")
            part = slice(k, k + 7)
            C, kind = found.covariance[part, part], "depth" if sensor in self.depth else "markers"
            out.append(SensorAlignment(sensor, kind, found.mean[part], C, self.centre))
        return out

    def fit(
        self, some: Sequence[_Look], values: Mapping[str, Mapping[str, float]], parameters: Sequence[Parameters],
        start: NDArray, **options: Any,
    ) -> SubjectFit:  # fmt: skip
        """Fit parameters to some frames from a start (P,), at which the sensors have `values`."""
        return fit_subject(
            self.body, self.recording.rig, self.measured(some, values, self.sensors), [look.state for look in some],
            parameters, start=start, times=[look.time for look in some],
            velocities=[look.velocity for look in some], loss=self.settings.loss, **options,
        )  # fmt: skip

    def parameters(self, frames: Sequence[Sequence[Any]]) -> list[Parameters]:
        """Further parameters: the surface if there is depth, marker offsets and landmark offsets."""
        scales, covariance = self.person.scales, self.person.covariance
        assert covariance is not None  # of a fit
        known = covariance[: len(scales), : len(scales)]
        out: list[Parameters] = [KnownLengths(self.body, scales=np.ones(len(scales)), covariance=known)]
        surfaces = self.body.surfaces if any(f.sensor in self.depth for seen in frames for f in seen) else ()
        if any(isinstance(s, TaperedCylinder) for s in surfaces) and not self.body.skin:
            out.append(CylinderShape(self.body))
        sets = {m.marker_set: m.std for m in self.recording.markers if m.std is not None}
        out += [PointOffsets(self.body, name, std) for name, std in sets.items()]
        detected = dict.fromkeys(k.keypoint_set for k in self.recording.keypoints)
        return out + [PointOffsets(self.body, name, _LANDMARK_SIGMA) for name in detected]

    def measured(self, looks: Sequence[_Look], values: Any, sensors: Sensors) -> list[list[Measurement]]:
        """Measurements of each frame, prepared with the body in the sensors' frames."""
        out = []
        for look in looks:
            several: list[Measurement] = []
            for frame in look.seen:
                T = displacement(values.get(frame.sensor, {}), self.centre)
                there = BodyState(se3.inverse(T) @ look.state.T_world_root, look.state.angles)
                scene = Scene(self.body, there, self.recording.rig, time=look.time, samples=self.settings.samples)
                several += [Displaced(m, self.centre) for m in sensors.measurements([frame], scene)]
            scene = Scene(self.body, look.state, self.recording.rig, time=look.time)
            pixels = self.recording.keypoints_at(look.frame + self.first)
            out.append([*several, *self.sensors.measurements(pixels, scene)])
        return out

    def velocity(self, frame: int) -> NDArray:
        """(n,) [m/s, rad/s] of the body, from the adjacent frames; raises ObservationError for a single frame."""
        a, b = max(frame - 1, 0), min(frame + 1, len(self.motion) - 1)
        if a == b:
            raise ObservationError("the motion has only one frame", remedy="Record the person for some seconds.")
        seconds = float(self.motion.times[b] - self.motion.times[a])
        return self.motion.state(a).difference(self.motion.state(b)) / seconds
