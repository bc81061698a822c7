"""Sequences of P2's experiment, and how accurate the joints and angles of a motion are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.bodies.motion import Motion
from kinefit.bodies.tree import twin
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.detectors.skin import LANDMARKS, SkinTracker, face_box
from kinefit.observations import MEDIAPIPE_33, DepthFrame, Frame, KeypointFrame
from kinefit.sensors.channels import joined
from kinefit.simulation.figures import in_front, shifted_camera
from kinefit.simulation.movements import MOVEMENTS, Performer, movement, people
from kinefit.simulation.rendering.scenes import ColourSensor, SimulatedScene, picture
from kinefit.simulation.rendering.sensors import TOF, DepthSensor, measured_depth


def joint_errors(truth: Motion, result: Motion) -> NDArray:
    """Distances (F, S) [m] between the joint centres of two motions; their bodies may have different lengths.

    Raises
    ------
    ObservationError
        The motions differ in frames or in their bodies' segments. All functions here raise it.
    """
    result = _comparable(truth, result)
    return np.linalg.norm(result.segment_poses()[..., :3, 3] - truth.segment_poses()[..., :3, 3], axis=-1)


def angle_errors(truth: Motion, result: Motion) -> NDArray:
    """Differences (F, D) [deg] of all angles, result minus truth, between -180 and 180; of prismatic joints [m].

    A ball joint with three orthogonal axes has two triples (a, b, c) and (a + 180, 180 - b, c + 180) for every
    rotation; the one nearer to the truth is used. Near gimbal lock, large angle errors may belong to nearly equal
    rotations: see `orientation_errors`.
    """
    result = _comparable(truth, result)
    tree = truth.body.tree
    errors = _wrapped(result.angles - truth.angles)
    for d in tree.ball_joints:
        other = _wrapped(twin(result.angles[:, d]) - truth.angles[:, d])
        nearer = np.abs(other).sum(axis=1) < np.abs(errors[:, d]).sum(axis=1)
        errors[nearer, d] = other[nearer]
    return np.where(tree.prismatic, result.angles - truth.angles, errors)


def _wrapped(radians: NDArray) -> NDArray:
    """Angles wrapped to -180..180 [deg]."""
    return np.degrees(np.angle(np.exp(1j * radians)))


def orientation_errors(truth: Motion, result: Motion, *, relative: bool = False) -> NDArray:
    """Angles (F, S) [deg] between the orientations of every segment: in the world, or relative to its parent."""
    result = _comparable(truth, result)
    a, b = (m.segment_poses()[..., :3, :3] for m in (truth, result))
    if relative:
        parents, child = truth.body.tree.parents, truth.body.tree.parents >= 0
        for R in (a, b):
            R[:, child] = R[:, parents[child]].swapaxes(-1, -2) @ R[:, child]
    # |A - B| (Frobenius) = 2 √2 sin(θ/2), exact for small angles too
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(8.0), 0.0, 1.0)))


@dataclass(frozen=True)
class ErrorBarCoverage:
    """Share 0..1 of the true values within the error bars; NaN without finite error bars.

    Parameters
    ----------
    joints : of the coordinates of all joint centres.
    angles : of all angles.
    """

    joints: float
    angles: float


def coverage(truth: Motion, result: Motion, *, sigmas: float = 2.0) -> ErrorBarCoverage:
    """Share of joint centres and angles whose truth lies within `sigmas` standard deviations; 0.954 is ideal for 2."""
    (shift, joints), (angles, dofs) = _errors_and_bars(truth, result, sigmas)
    return ErrorBarCoverage(_share(shift, joints), _share(angles, dofs))


def coverage_of_groups(truth: Motion, result: Motion, *, sigmas: float = 1.96) -> dict[str, ErrorBarCoverage]:
    """Coverage (see `coverage`) for each group of joints: the body's scale groups, with both sides together.

    A joint belongs to the group of the segment that it moves. sigmas: a number of standard deviations.
    """
    (shift, joints), (angles, dofs) = _errors_and_bars(truth, result, sigmas)
    out = {}
    for g, name in enumerate(truth.body.scale_groups):
        segments = truth.body.segment_scale == g
        own = segments[truth.body.tree.owners]
        covered = _share(shift[:, segments], joints[:, segments]), _share(angles[:, own], dofs[:, own])
        out[name] = ErrorBarCoverage(*covered)
    return out


def _errors_and_bars(truth: Motion, result: Motion, sigmas: float) -> tuple[tuple[NDArray, NDArray], ...]:
    """Errors of joint centres (F, S, 3) [m] and of angles (F, D) [rad, m], each with its error bars."""
    turned = _comparable(truth, result)
    shift = np.abs(turned.segment_poses()[..., :3, 3] - truth.segment_poses()[..., :3, 3])
    angles = angle_errors(truth, result)
    angles = np.abs(np.where(truth.body.tree.prismatic, angles, np.radians(angles)))
    return (shift, sigmas * turned.joint_std), (angles, sigmas * turned.dof_std[:, 6:])


def _share(errors: NDArray, bars: NDArray) -> float:
    known = np.isfinite(bars)
    return float(np.mean(errors[known] <= bars[known])) if known.any() else float("nan")


def _comparable(truth: Motion, result: Motion) -> Motion:
    """The result with the vertical axis of the truth; raises ObservationError for motions that do not match."""
    a, b = truth.body.tree, result.body.tree
    if a.segments != b.segments or a.coordinates != b.coordinates:
        raise ObservationError(
            f"the bodies '{truth.body.name}' and '{result.body.name}' have different segments",
            remedy="Compare motions of bodies with the same segments.",
        )
    if len(truth) != len(result) or not np.isclose(truth.rate, result.rate):
        raise ObservationError(
            f"the truth has {len(truth)} frames at {truth.rate:g} Hz, the result {len(result)} at {result.rate:g} Hz",
            remedy="Cut and resample one of them (kinefit.simulation).",
        )
    return result if result.up == truth.up else result.turned(truth.up)


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
    colour = shifted_camera(head.camera().with_pose(camera.T_camera_world), "colour", _BASELINE)
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
