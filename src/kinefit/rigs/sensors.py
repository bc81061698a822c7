"""Align depth cameras and marker systems with the cameras of the videos, by the person in view of all.

The person is tracked in the keypoints alone. Then a joint fit of all measurements in some frames, spread over the walk,
estimates poses, the person's surface, marker and landmark offsets, and the frames of the other sensors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, load_body
from kinefit.bodies.motion import Motion
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.errors import ObservationError
from kinefit.fitting.subject.fit import fit_subject
from kinefit.fitting.subject.keypoints import fit_subject as fit_person
from kinefit.fitting.subject.parameters import KnownLengths, Parameters, PointOffsets
from kinefit.fitting.subject.subject import Progress, SensorFrames, Subject, SubjectFit
from kinefit.fitting.subject.surfaces import CylinderShape
from kinefit.fitting.tracking.cameras import (
    Look,
    measurements_at,
    placed_camera,
    registration,
    sensors_of,
    wide_sensors,
)
from kinefit.fitting.tracking.recording import Recording, spread
from kinefit.fitting.tracking.sizing import channels_of
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.fitting.tracking.video import track
from kinefit.geometry.camera import Rig
from kinefit.markers.take.takes import with_names
from kinefit.observations import sensor_of
from kinefit.readers.take.entries import sensor_name
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.sensors.alignment import MISFIT_SIGMAS, POSE_SIGMAS, SensorAlignment, doubts_of
from kinefit.sensors.displaced import AXES
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.point_cloud import FINE_DISTANCES, Ends, Registration, apart, twist_of

FRAMES = 12
"""Number of fitted frames, spread over those in which the person was tracked."""

_MIN_QUALITY = 0.3  # of a frame that counts
_MIN_FRAMES = 4  # with the person in a sensor
_MARKER_DISTANCES = (0.3, 0.2, 0.12, 0.08)  # [m] of correspondences while only the frames of the sensors move
_FIRST_FRAMES = 5  # of the first fit
_JOINT_ROUNDS = 3  # of match and solve, of the joint fit
_LANDMARK_SIGMA = 0.005  # [m] of a detector's points about the fit of the keypoints
# Systematic errors of a surface of simple shapes on a person of another shape: RMS errors of three simulated Anny
# people (draws 100 to 102 of benchmark `mixed_misfit`).
_SURFACE_SIGMA = np.array([0.003, 0.003, 0.003, 0.004, 0.004, 0.004, 0.0])  # [m, rad, s]
_UP_SIGMA = 0.01  # [m] in addition, upwards


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
    alone = replace(recording, steps=recording.keypoints_at, markers=(), depth={}, on_body=(), backgrounds={})
    person = fit_person(body, channels_of(recording, body, TrackSettings()), height=take.height, progress=progress)
    motion = track(alone, body, subject=person, progress=progress)
    origins = {name: recording.rig[name].centre_world for name in depth}
    for k, entry in enumerate(take.markers):
        origins[sensor_name("markers", take.markers, k)] = entry.T_world_file[:3, 3]
    return _PlacementProblem(recording, motion, person, frozenset(depth), origins).fits(frames)


class _PlacementProblem:
    """A recording, tracked in its keypoints alone, and the sensors to align."""

    def __init__(
        self, recording: Recording, motion: Motion, person: Subject, depth: frozenset[str], origins: dict[str, NDArray]
    ) -> None:
        self.recording, self.motion, self.depth = recording, motion, depth
        self.person, self.origins, self.centre = person, origins, np.zeros(3)
        self.body: Body = motion.body
        self.first = round((motion.times[0] - recording.times[0]) * recording.rate)
        self.sensors, self.wide = sensors_of(recording, TrackSettings()), wide_sensors(recording, TrackSettings())

    def seen(self, frame: int) -> list[Any]:
        """The sensors' frames at a frame of the motion."""
        return [f for f in self.recording.steps(frame + self.first) if sensor_of(f) in self.origins]

    def look(self, frame: int) -> Look:
        """The data of one frame of the motion."""
        scene = Scene(
            self.body, self.motion.state(frame), self.recording.rig,
            time=float(self.recording.times[frame + self.first]), velocity=self.velocity(frame),
            samples=TrackSettings().samples,
        )  # fmt: skip
        return self.seen(frame), scene

    def fits(self, most: int) -> tuple[SensorAlignment, ...]:
        """Alignments of the sensors; those that do not fit also from each half of the frames.

        From at most `most` frames with a tracked person and a frame of a sensor; `FRAMES` show where cameras belong.
        """
        good, wanted = np.flatnonzero(self.motion.quality > _MIN_QUALITY), max(most, FRAMES)
        some = np.array([f for f in good[spread(len(good), 4 * wanted)] if self.seen(int(f))], int)
        chosen = some[spread(len(some), wanted)]
        if len(chosen) < _MIN_FRAMES:
            return ()
        every = [self.look(int(f)) for f in chosen]
        self.centre = np.mean([self.motion.positions()[f].mean(axis=0) for f in chosen], axis=0)
        names = tuple(dict.fromkeys(f.sensor for frames, _ in every for f in frames))
        away, found = list[SensorAlignment](), dict[str, Ends | None]()
        for name in (name for name in names if name in self.depth):
            T_camera_world = self.recording.rig[name].T_camera_world
            fit, found[name] = placed_camera(name, every, self.wide, T_camera_world, self.centre, thorough=True)
            if not (fit.usable or fit.is_near):
                doubt = f"it would turn by {np.degrees(fit.turn):.0f}°: more than "
                doubt += f"{np.degrees(MISFIT_SIGMAS * POSE_SIGMAS[1]):.0f}°"
                away.append(replace(fit, falls=True, doubts=(doubt,)))
        gone = {fit.sensor for fit in away}
        self.names = tuple(name for name in names if name not in gone)
        if not self.names:
            return tuple(away)
        few = [every[k] for k in spread(len(every), most)]
        looks = [([f for f in frames if f.sensor not in gone], scene) for frames, scene in few]
        arms = {name: self.origins[name] - self.centre for name in self.names}
        self.place = SensorFrames(self.names, POSE_SIGMAS, arms)
        near, ends = self.coarse(looks, found)
        out = [self.with_surface(fit) for fit in self.fitted(looks, near)]
        if any(fit.misfit for fit in out):
            a, b = (self.fitted(looks[k::2], near) for k in range(2))
            out = [self.judged(looks, fit, (a[k], b[k]), ends.get(fit.sensor)) for k, fit in enumerate(out)]
        return (*away, *out)

    def with_surface(self, fit: SensorAlignment) -> SensorAlignment:
        """The alignment with the surface's systematic errors added to the covariance."""
        if fit.kind != "depth":
            return fit
        up = np.append(self.recording.up_axis, np.zeros(4))
        return replace(fit, covariance=fit.covariance + np.diag(_SURFACE_SIGMA**2) + _UP_SIGMA**2 * np.outer(up, up))

    def judged(
        self, looks: Sequence[Look], fit: SensorAlignment, halves: tuple[SensorAlignment, SensorAlignment],
        ends: Ends | None,
    ) -> SensorAlignment:  # fmt: skip
        """The alignment with the difference of two halves of the frames in its covariance, and reasons for doubt."""
        if not fit.misfit:
            return fit
        half = 0.5 * apart(*(each.twist for each in halves))
        falls = self.registration(fit.sensor, looks).above(np.zeros(7), fit.twist)
        wide = replace(fit, covariance=fit.covariance + np.outer(half, half), falls=falls)
        rivals = ends.rivals if ends is not None else ()
        return replace(wide, doubts=doubts_of(wide, self.origins[fit.sensor], halves, rivals))

    def coarse(
        self, looks: Sequence[Look], found: Mapping[str, Ends | None]
    ) -> tuple[dict[str, NDArray], dict[str, Ends]]:
        """Initial twists (7,) of all sensors; of depth sensors also all local minima, at their best heights."""
        up = self.recording.up_axis
        ends = {
            name: Ends(end.registration, tuple(end.registration.height(twist, up) for twist in end.twists))
            for name, end in found.items() if end is not None and name in self.names
        }  # fmt: skip
        near = {sensor: end.best for sensor, end in ends.items()}
        named = tuple(name for name in self.names if name not in near)
        if named:
            few = [looks[k] for k in spread(len(looks), _FIRST_FRAMES)]
            few = [([f for f in frames if f.sensor in named], scene) for frames, scene in few]
            place = replace(self.place, sensors=named)
            start, reach = np.zeros(len(place.names)), _MARKER_DISTANCES
            fit = self.fit(few, {}, [place], start, reach=reach, rounds=len(reach), looks=1.0)
            near |= {name: twist_of(fit.values[name]) for name in named}
        return near, ends

    def registration(self, sensor: str, looks: Sequence[Look]) -> Registration:
        """The measurements of one sensor, with the poses from the keypoints alone."""
        return registration(sensor, looks, self.wide, self.origins[sensor], self.centre)

    def fitted(self, looks: Sequence[Look], near: Mapping[str, NDArray]) -> list[SensorAlignment]:
        """Joint fit of some frames, from twists (7,) of the sensors."""
        twists = dict(near)
        for sensor in self.depth & set(self.names):
            own = self.registration(sensor, looks)
            twists[sensor] = own.height(own.settled(twists[sensor], FINE_DISTANCES), self.recording.up_axis)
        parameters = [*self.parameters([frames for frames, _ in looks]), self.place]
        start = np.concatenate([*(p.mean for p in parameters[:-1]), *(twists[name] for name in self.names)])
        found = self.fit(looks, twists, parameters, start, rounds=_JOINT_ROUNDS)
        out = []
        for sensor in self.names:
            k = found.names.index(f"{sensor} {AXES[0]}")
            part = slice(k, k + 7)
            C, kind = found.covariance[part, part], "depth" if sensor in self.depth else "markers"
            out.append(SensorAlignment(sensor, kind, found.mean[part], C, self.centre))
        return out

    def fit(
        self, some: Sequence[Look], twists: dict[str, NDArray], parameters: Sequence[Parameters], start: NDArray,
        **options: Any,
    ) -> SubjectFit:  # fmt: skip
        """Fit parameters to some frames from a start (P,), at which the sensors have twists (7,)."""
        measured, scenes = [], [scene for _, scene in some]
        for look in some:
            at = round((look[1].time - self.recording.times[0]) * self.recording.rate)
            pixels = self.sensors.measurements(self.recording.keypoints_at(at), look[1])
            measured.append([*measurements_at(look, self.sensors, self.centre, twists), *pixels])
        return fit_subject(
            self.body, self.recording.rig, measured, [scene.state for scene in scenes], parameters, start=start,
            times=[scene.time for scene in scenes], loss=TrackSettings().loss,
            velocities=[scene.velocity for scene in scenes if scene.velocity is not None], **options,
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

    def velocity(self, frame: int) -> NDArray:
        """(n,) [m/s, rad/s] of the body, from the adjacent frames; raises ObservationError for a single frame."""
        a, b = max(frame - 1, 0), min(frame + 1, len(self.motion) - 1)
        if a == b:
            raise ObservationError("the motion has only one frame", remedy="Record the person for some seconds.")
        seconds = float(self.motion.times[b] - self.motion.times[a])
        return self.motion.state(a).difference(self.motion.state(b)) / seconds
