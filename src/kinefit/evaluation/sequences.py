"""Simulate the hundred sequences of P2's experiment: ten movements by ten people, in depth images and 2D features."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from kinefit.bodies import Body, PointSet
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.detectors.skin import LANDMARKS, SkinTracker, face_box
from kinefit.motion import Motion
from kinefit.observations import MEDIAPIPE_33, DepthFrame, Frame, KeypointFrame
from kinefit.sensors.channels import joined
from kinefit.simulation._postures import MOVEMENTS
from kinefit.simulation.movements import Performer, movement, people
from kinefit.simulation.placing import beside, in_front
from kinefit.simulation.rendering.pictures import ColourSensor, picture
from kinefit.simulation.rendering.scenes import SimulatedScene
from kinefit.simulation.rendering.sensors import TOF, DepthSensor, measured_depth

Inputs = Literal["3d", "2d", "fusion"]
INPUTS: tuple[Inputs, ...] = ("3d", "2d", "fusion")

FEATURES = LANDMARKS
"""Landmarks of the skin colour tracker: the face and both hands."""

_HAND_RATIO = 4.0 / 3.0  # distance of the hand's centre from the elbow to the length of the forearm
_HEAD_SIZE = (320, 240)  # [px] of one camera of P2's stereo head (P2 3.1)
_BASELINE = 0.1  # [m] from the depth camera to the colour camera
_FEATURE_SIGMA = 4.0  # [px] of the centre of a patch of skin: a hand's half width at 3 m
_RATE = 10.0  # [Hz] P2: 10 to 14


@dataclass(frozen=True, eq=False)
class TruthSequence:
    """One sequence: a known motion and its simulated observations.

    Parameters
    ----------
    number : int
    person : Performer
    truth : Motion
    rig : Rig of the depth camera "depth" and the colour camera "colour".
    sensor : DepthSensor
    depth : DepthFrame for each frame.
    features : KeypointFrame for each frame, of the body's landmarks in `FEATURES`, as `images.skin` finds them in
        rendered images of the colour camera; the face of the first image is given.
    """

    number: int
    person: Performer
    truth: Motion
    rig: Rig
    sensor: DepthSensor
    depth: tuple[DepthFrame, ...]
    features: tuple[KeypointFrame, ...]

    def seen(self, inputs: Inputs) -> list[tuple[Frame, ...]]:
        """Observations of one experiment, for each time: depth (3D), face and hands (2D), or both."""
        if inputs == "3d":
            return [(d,) for d in self.depth]
        if inputs == "2d":
            return [(f,) for f in self.features]
        return list(zip(self.depth, self.features))

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviations of the sensors: depth [m] at the person's distance, features [px]."""
        distance = float(np.linalg.norm(self.rig["depth"].centre_world - self.truth.Ts_world_root[0, :3, 3]))
        return {"depth": float(self.sensor.sigma(distance)), "colour": _FEATURE_SIGMA}


def sequences(
    count: int = 100,
    *,
    body: Body | None = None,
    sensor: DepthSensor = TOF,
    rate: float = _RATE,
    room: bool = True,
    seed: int = 0,
) -> Iterator[TruthSequence]:
    """The first `count` of a hundred sequences; each ten of them contain every movement and every person once.

    Parameters
    ----------
    count : int
    body : Body, optional
        From which the people are made; default the catalogue's "humanoid10".
    sensor : DepthSensor
    rate : float [Hz] of all sensors.
    room : bool, whether there are a floor, walls and a table.
    seed : int, of the people and of all errors.
    """
    crowd, names = people(body, seed=seed), tuple(MOVEMENTS)
    for number in range(count):
        k = number % len(names)
        person = crowd[(k + number // len(names)) % len(crowd)]
        yield sequence(names[k], person, sensor=sensor, rate=rate, room=room, seed=seed, number=number)


def with_hands(body: Body) -> Body:
    """Add landmarks of the hands' centres to a body whose hands are part of its forearms."""
    names = [name for name in FEATURES if name not in body.landmarks.names]
    wrists = body.landmarks.select(tuple(f"{name[0]}_wrist" for name in names))
    hands = PointSet(tuple(names), wrists.segments, _HAND_RATIO * wrists.points)
    return replace(body, landmarks=joined([body.landmarks, hands])) if names else body


def sequence(
    name: str,
    person: Performer,
    *,
    sensor: DepthSensor = TOF,
    rate: float = _RATE,
    room: bool = True,
    seed: int = 0,
    number: int = 0,
) -> TruthSequence:
    """Simulate one movement of one person at a rate [Hz]; see `sequences`."""
    truth = movement(name, with_hands(person.body), rate=rate, speed=person.speed)
    return sequence_of(truth, person, sensor=sensor, room=room, seed=seed, number=number)


def sequence_of(
    truth: Motion, person: Performer, *, sensor: DepthSensor = TOF, room: bool = True, seed: int = 0, number: int = 0
) -> TruthSequence:
    """Simulate the sensors for a known motion of a body `with_hands`; see `sequences`."""
    camera = in_front(truth, sensor.camera(name="depth"), azimuth=person.azimuth, near=sensor.near, far=sensor.far)
    head = ColourSensor("colour", _HEAD_SIZE, _HEAD_SIZE[1] / sensor.size[1] * sensor.focal, samples=1)
    colour = beside(head.camera().with_pose(camera.T_camera_world), "colour", _BASELINE)
    scene = SimulatedScene.of(truth, camera if room else None)
    depth = []
    for frame, time in enumerate(truth.times):
        random = np.random.default_rng([seed, number, frame])
        depth.append(DepthFrame("depth", float(time), measured_depth(scene, frame, camera, sensor, random)))
    features = features_of(scene, head, colour, seed=1000 * seed + number)
    return TruthSequence(number, person, truth, Rig((camera, colour)), sensor, tuple(depth), features)


def features_of(
    scene: SimulatedScene, sensor: ColourSensor, camera: Camera, *, seed: int = 0
) -> tuple[KeypointFrame, ...]:
    """Track face and hands by skin colour in rendered images of a scene; no detections if the first shows no face."""
    motion, tracker, out = scene.motion, None, []
    face = _face(scene, camera)
    for frame, time in enumerate(motion.times):
        if face is not None:
            image = np.ascontiguousarray(picture(scene, frame, camera, sensor, seed=seed)[..., ::-1])
            tracker = tracker or SkinTracker(image, face, rate=motion.rate)
            tracker.update(image)
        none = KeypointFrame(camera.name, float(time), FEATURES, np.full((len(FEATURES), 2), np.nan), np.zeros(3))
        out.append(none if tracker is None else tracker.frame(camera.name, float(time), FEATURES))
    return tuple(out)


def _face(scene: SimulatedScene, camera: Camera) -> tuple[float, float, float, float] | None:
    """Box [px] of the face in the first image, from a detector's landmarks; None if the person looks away."""
    body, state = scene.motion.body, scene.motion.state(0)
    points = body.keypoints("MEDIAPIPE_33")
    uv = np.full((33, 2), np.nan)
    uv[[MEDIAPIPE_33.index(name) for name in points.names]] = camera.project(body.positions(state, points))
    nose = body.positions(state, body.landmarks.select(("nose_tip", "r_tragion", "l_tragion")))
    depth = nose @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    return face_box(uv) if depth[0] < depth[1:].min() and np.isfinite(uv[[2, 5, 7, 8, 9, 10]]).all() else None
