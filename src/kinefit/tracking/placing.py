"""Depth cameras that do not stand where the videos see the person: where they belong, or that they are of no use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.diagnostics.sensors import MISFIT_SIGMAS, POSE_SIGMAS
from kinefit.frame.routing import Sensors
from kinefit.geometry import se3
from kinefit.observations import DepthFrame
from kinefit.sensors.displaced import Displaced, displacement
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.registration import (
    COARSE_DISTANCES,
    FINE_DISTANCES,
    Ends,
    Registration,
    clearly_above,
    starts,
    values_of,
)
from kinefit.subject.subject import Subject
from kinefit.tracking.recording import Recording, spread

_FRAMES = 10  # of the keypoints' fit in which depth images are laid onto the person
_MIN_FRAMES = 4
_WIDE_REACH = 0.45  # [m] about the person: a camera may be off by 3 of 10 cm
_MAX_SHIFT, _MAX_TURN = 0.05, float(np.radians(3.0))  # [m], [rad] by which one that fits seems off: shapes are simple


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A depth camera, laid onto the person of the keypoints.

    Parameters
    ----------
    T : (4, 4) x_world = T x of a point x as the calibration places it
    turn, shift : [rad], and [m] of the middle of where the person was
    nearer : whether the person surely lies nearer to what it measured then
    """

    T: NDArray
    turn: float
    shift: float
    nearer: bool

    @property
    def fits(self) -> bool:
        """Whether the camera stands where its calibration has it, as far as the person shows."""
        return not self.nearer or (self.turn < _MAX_TURN and self.shift < _MAX_SHIFT)

    @property
    def usable(self) -> bool:
        """Whether it is so near to where it is stated that a person's surface tells where it belongs."""
        return self.turn < MISFIT_SIGMAS * POSE_SIGMAS[1]


def placed_cameras(recording: Recording, subject: Subject, settings: TrackSettings) -> dict[str, PlacedCamera]:
    """{depth camera: where it belongs} of those without keypoints, by the poses of the keypoints' subject fit."""
    if subject.fit is None or not subject.body.surfaces:
        return {}
    videos = {k.camera for k in recording.keypoints}
    wide = replace(settings, through=np.inf, reach=_WIDE_REACH, render_every=1)
    sensors = Sensors(recording.rig, recording.rate, recording.sigma, wide, on_body=recording.on_body)
    for name, empty in recording.backgrounds.items():
        sensors.know_background(name, empty)
    looks: dict[str, list[tuple[DepthFrame, Scene]]] = {}
    for k in spread(len(subject.frames), _FRAMES):
        for frame in recording.steps(subject.frames[k]):
            if isinstance(frame, DepthFrame) and recording.rig[frame.sensor].name not in videos:
                scene = Scene(
                    subject.body, subject.fit.states[k], recording.rig, time=frame.time, samples=settings.samples
                )  # fmt: skip
                looks.setdefault(frame.sensor, []).append((frame, scene))
    return {
        name: _placed(recording.rig[name].T_camera_world, own, sensors)
        for name, own in looks.items() if len(own) >= _MIN_FRAMES
    }  # fmt: skip


def _placed(T_camera_world: NDArray, looks: Sequence[tuple[DepthFrame, Scene]], sensors: Sensors) -> PlacedCamera:
    origin = se3.inverse(T_camera_world)[:3, 3]
    centre = np.mean([_joints(scene).mean(axis=0) for _, scene in looks], axis=0)
    A = np.eye(6)
    A[:3, 3:] = se3.hat(centre - origin)
    information = A.T @ np.diag(np.repeat(POSE_SIGMAS, 3) ** -2.0) @ A

    def seen_from(twist: NDArray) -> Registration:
        """What the camera measured about the person, if it belongs at a twist."""
        T, steps = _moved(twist, centre), []
        for frame, scene in looks:
            there = scene.at(BodyState(se3.inverse(T) @ scene.state.T_world_root, scene.state.angles))
            steps.append([Displaced(m, centre) for m in sensors.measurements([frame], there)])
        return Registration(looks[0][0].sensor, steps, [scene for _, scene in looks], centre, information)

    stated = seen_from(np.zeros(7))
    best = stated.settled(np.zeros(7), FINE_DISTANCES)
    if _size(best)[0] > _MAX_TURN or _size(best)[1] > _MAX_SHIFT:
        reach = *COARSE_DISTANCES, *FINE_DISTANCES
        best = Ends(stated, tuple(stated.settled(s, reach) for s in starts(origin, centre, POSE_SIGMAS))).best
    nearer = stated.above(np.zeros(7), best)
    axis = np.pi * T_camera_world[2, :3]
    way = centre - origin
    over = np.concatenate([se3.exp_so3(axis) @ way - way, axis, [0.0]])
    rolled = seen_from(over)
    over = rolled.settled(over, FINE_DISTANCES)
    if clearly_above(stated.costs(best), rolled.costs(over)):
        best, nearer = over, True
    turn, shift = _size(best)
    return PlacedCamera(_moved(best, centre), turn, shift, nearer)


def _size(twist: NDArray) -> tuple[float, float]:
    """[rad] turn and [m] shift of a twist (7,)."""
    return float(np.linalg.norm(twist[3:6])), float(np.linalg.norm(twist[:3]))


def _joints(scene: Scene) -> NDArray:
    """(S, 3) [m] of a scene's body."""
    state = scene.state
    return np.asarray(scene.body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, 3])


def _moved(twist: NDArray, centre: NDArray) -> NDArray:
    """(4, 4) x_world = T x of a sensor's frame at a twist (7,) about a centre (3,) [m]."""
    return displacement(values_of(twist), centre)
