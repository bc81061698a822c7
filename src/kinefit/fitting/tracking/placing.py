"""Depth cameras that do not stand where the videos see the person: where they belong, or that they are of no use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.fitting.frame.routing import Sensors
from kinefit.fitting.subject.sensor_parameters import SensorFrames
from kinefit.fitting.subject.subject import Subject
from kinefit.fitting.tracking.recording import Recording, spread
from kinefit.geometry import se3
from kinefit.observations import DepthFrame
from kinefit.sensors.alignment import POSE_SIGMAS, SensorAlignment
from kinefit.sensors.base import Measurement
from kinefit.sensors.displaced import Displaced, displacement
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.point_cloud import (
    COARSE_DISTANCES,
    FINE_DISTANCES,
    Ends,
    Registration,
    clearly_above,
    starts,
    values_of,
)

_FRAMES = 10  # of the keypoints' fit in which depth images are laid onto the person
_MIN_FRAMES = 4
_WIDE_REACH = 0.45  # [m] about the person: a camera may be off by 3 of 10 cm

Look = tuple[Sequence[Any], Scene]
"""Frames of the sensors at one time, and the body as the keypoints have it then."""


def sensors_of(recording: Recording, settings: TrackSettings, **changes: Any) -> Sensors:
    """The sensors of a recording with the backgrounds that they know, by changed settings."""
    settings = replace(settings, through=np.inf, **changes)
    sensors = Sensors(recording.rig, recording.rate, recording.sigma, settings, on_body=recording.on_body)
    for name, empty in recording.backgrounds.items():
        sensors.know_background(name, empty)
    return sensors


def wide_sensors(recording: Recording, settings: TrackSettings) -> Sensors:
    """The same for a sensor that is off by three of its prior's standard deviations."""
    return sensors_of(recording, settings, reach=_WIDE_REACH, render_every=1)


def measurements_at(look: Look, sensors: Sensors, centre: NDArray, twists: dict[str, NDArray]) -> list[Measurement]:
    """What sensors measured about the person, if each belongs at its twist (7,) about a centre; default: zero."""
    (frames, scene), out = look, list[Measurement]()
    for frame in frames:
        T = displacement(values_of(twists.get(frame.sensor, np.zeros(7))), centre)
        there = scene.at(BodyState(se3.inverse(T) @ scene.state.T_world_root, scene.state.angles))
        out += [Displaced(m, centre) for m in sensors.measurements([frame], there)]
    return out


def registration(
    sensor: str, looks: Sequence[Look], sensors: Sensors, origin: NDArray, centre: NDArray, twist: NDArray | None = None
) -> Registration:
    """What one sensor with its origin (3,) measured about the person, if it belongs at a twist about the centre."""
    own = [([f for f in frames if f.sensor == sensor], scene) for frames, scene in looks]
    own = [look for look in own if look[0]]
    steps = [measurements_at(look, sensors, centre, {} if twist is None else {sensor: twist}) for look in own]
    prior = SensorFrames((sensor,), POSE_SIGMAS, {sensor: origin - centre}).information
    return Registration(sensor, steps, [scene for _, scene in own], centre, prior[:6, :6])


def placed_cameras(recording: Recording, subject: Subject, settings: TrackSettings) -> dict[str, SensorAlignment]:
    """{depth camera: where it belongs} of those without keypoints, by the poses of the keypoints' subject fit."""
    if subject.fit is None or not subject.body.surfaces:
        return {}
    videos = {k.camera for k in recording.keypoints}
    looks: dict[str, list[Look]] = {}
    for k in spread(len(subject.frames), _FRAMES):
        for frame in recording.steps(subject.frames[k]):
            if isinstance(frame, DepthFrame) and recording.rig[frame.sensor].name not in videos:
                state, samples = subject.fit.states[k], settings.samples
                scene = Scene(subject.body, state, recording.rig, time=frame.time, samples=samples)
                looks.setdefault(frame.sensor, []).append(([frame], scene))
    sensors = wide_sensors(recording, settings)
    return {
        name: placed_camera(name, own, sensors, recording.rig[name].T_camera_world, _middle(own))[0]
        for name, own in looks.items() if len(own) >= _MIN_FRAMES
    }  # fmt: skip


def placed_camera(
    sensor: str, looks: Sequence[Look], sensors: Sensors, T_camera_world: NDArray, centre: NDArray, *,
    thorough: bool = False,
) -> tuple[SensorAlignment, Ends | None]:  # fmt: skip
    """Where one depth camera belongs, and the ends of all starts, if the stated pose is not near or if `thorough`."""
    origin, still = se3.inverse(T_camera_world)[:3, 3], np.zeros(7)
    stated = registration(sensor, looks, sensors, origin, centre)
    covariance, ends = np.diag(np.repeat(POSE_SIGMAS, (3, 3, 1)) ** 2), None
    found = SensorAlignment(sensor, "depth", still if thorough else stated.settled(still, FINE_DISTANCES), covariance,
                            centre)  # fmt: skip
    if thorough or not found.is_near:
        reach = *COARSE_DISTANCES, *FINE_DISTANCES
        ends = Ends(stated, tuple(stated.settled(s, reach) for s in starts(origin, centre, POSE_SIGMAS[:2])))
        found = replace(found, twist=ends.best)
    axis = np.pi * T_camera_world[2, :3]
    way = centre - origin
    over = np.concatenate([se3.exp_so3(axis) @ way - way, axis, [0.0]])
    rolled = registration(sensor, looks, sensors, origin, centre, over)
    over = rolled.settled(over, FINE_DISTANCES)
    if clearly_above(stated.costs(found.twist), rolled.costs(over)):
        return replace(found, twist=over), None
    return replace(found, falls=stated.above(still, found.twist)), ends


def _middle(looks: Sequence[Look]) -> NDArray:
    """(3,) [m] mean of the joints in some scenes."""
    states = [scene.state for _, scene in looks]
    roots, angles = np.stack([s.T_world_root for s in states]), np.stack([s.angles for s in states])
    return np.asarray(looks[0][1].body.tree.segment_poses(roots, angles)[:, :, :3, 3].mean(axis=(0, 1)))
