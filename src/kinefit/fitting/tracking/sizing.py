"""The body fitted to the person of a recording: first by what needs no pose, then by all sensors together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.marker_sets import MarkerPlacement
from kinefit.bodies.parts import has_unknown_gear
from kinefit.errors import KinefitError, ObservationError, TrackingError
from kinefit.findings import INVERTED
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.initialization.from_depth import Start, StartSearch, sized_start, start_from_points
from kinefit.fitting.markers.subject import MarkerSubject, fit_marker_subject
from kinefit.fitting.multiview.views import make_views, turned_cameras
from kinefit.fitting.subject import fit as joint
from kinefit.fitting.subject.keypoints import fit_subject
from kinefit.fitting.subject.metaballs import ROUNDS, MetaballShape
from kinefit.fitting.subject.parameters import Gear, SegmentScales
from kinefit.fitting.subject.subject import CameraExtrinsics, Progress, Subject, SubjectFit, moved_rig
from kinefit.fitting.tracking.cameras import CAMERAS, LEFT_OUT, between, composed, placed_cameras
from kinefit.fitting.tracking.recording import Recording, spread
from kinefit.fitting.tracking.recovery import is_rare
from kinefit.fitting.tracking.run import OtherPeople, TrackedSteps, run, tracker_of
from kinefit.fitting.tracking.unknowns import Unknowns, of_all, of_points
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.sensors.base import Measurement
from kinefit.sensors.channels import Channels, known_names, make_channels
from kinefit.sensors.points.keypoints import keypoint_sigma, pixels_of
from kinefit.sensors.settings import TrackSettings

_MAX_STEPS = 100  # steps that are tracked to find the person's shape ...
_MAX_STEPS_ONE_CAMERA = 600  # of one camera's keypoints: poses that differ distinguish the lengths
_POSES = 8  # and how many of them it is found from: twice as many change no half axis by more than its deviation
_REFINING_POSES = 20  # of a former motion: they are near the truth, and cost no tracking
_MARKER_POSES = 16  # of markers alone, whose places are found by how they move; a frame of them costs little
_MATCHES = 3  # rounds of matching and solving
_MATCHES_OF_LENGTHS = 20  # of lengths by surfaces alone, at most: after 3, those of a rendered person are 2 cm off
_PLACES = 2  # fits with a better spread of the markers' places; it changes by less than a tenth from then on
_TURN_FRAMES, _TURN_POSES = 240, 10  # that decide whether a video camera was rotated, and which
_MOVES = 3  # times that cameras are moved to where a subject fit has found them
_MIN_FRAME_QUALITY = 0.5  # quality of a frame that the shape may be found from

_MIN_UPRIGHT = 0.65  # mean score of starts of people who stand as the take says: 0.7 and more of drawn ones
_MIN_INVERTED_GAIN = 0.04  # of the score: 0.06 to 0.07 of two drawn people upside down, -0.24 and -0.02 of upright ones

KnownStart = tuple[int, BodyState]


@dataclass(frozen=True, eq=False)
class SizedPerson:
    """A body of the person's size and shape.

    Parameters
    ----------
    recording : Recording
    subject : Subject with the body
    start : step and state to begin with
    values : {sensor: {name: value}} of the sensors' own unknowns
    provenance : what the fits report, for `Motion.provenance`
    poses : {step: state} of steps that were fitted, where images are so far apart that none holds the next
    joint : what fits of several kinds of sensors together found, in their order
    calibrated : Rig as its calibration has it
    """

    recording: Recording
    subject: Subject
    start: KnownStart | None = None
    values: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    poses: Mapping[int, BodyState] = field(default_factory=dict)
    joint: tuple[SubjectFit, ...] = ()
    calibrated: Rig = field(default_factory=lambda: Rig(()))

    def reporting(self, **entries: Any) -> SizedPerson:
        """The same with more entries of `provenance`."""
        return replace(self, provenance={**self.provenance, **entries})

    def with_markers(self, found: MarkerSubject, body: Body) -> SizedPerson:
        """The same with the subject that labelled markers gave, on a body of its size."""
        subject = Subject(body, found.scales, length_share=found.scale_std / found.scales)
        person = replace(self, subject=subject, joint=(*self.joint, found.fit))
        fit = found.fit
        if gear := Gear(fit.prior_world.body).names:
            person = person.reporting(shape={name: value for name, value in fit.record().items() if name in gear})
        return person.reporting(markers={"rms_m": round(found.rms, 4), "frames": found.frames})


def channels_of(recording: Recording, body: Body, settings: TrackSettings) -> Channels:
    """The keypoints of a recording on a body, whole."""
    sigma = keypoint_sigma(recording.keypoints, recording.sigma, settings.pixel)
    return make_channels(body, recording.rig, recording.keypoints, sigma)


def fitted_to_person(
    recording: Recording, body: Body, settings: TrackSettings, *, subject: Subject | None = None,
    trial: Subject | None = None, height: float | None = None, frames: int | None = None,
    progress: Progress | None = None,
) -> SizedPerson:  # fmt: skip
    """The body in the person's size and shape, where no subject has it already; arguments as of `track`.

    Raises
    ------
    ObservationError
        A trial or a number of frames, for lengths from keypoints, and no keypoints of two cameras; a trial or a height
        with a body that is not sized.
    KinefitError
        What the fits raise.
    """
    known_names(body, recording.rig, recording.keypoints)
    cameras, others = len({k.camera for k in recording.keypoints}), recording.sees_more
    if cameras == 1 and not (others or recording.start):
        name = recording.keypoints[0].camera
        problem = f"only one camera, {name}, has keypoints"
        remedy = "Add a second camera or another sensor; or run kinefit detect --force, which also estimates 3D points"
        raise TrackingError(problem, remedy=f"{remedy}.")
    ignored = {"a height": height, "a trial of the same person": trial, "shape_frames": frames}
    for what, given in ignored.items():
        if given is not None and subject is not None:
            problem = f"{what} has no effect: the size of the body is given"
            raise ObservationError(problem, remedy=f"Leave out {what}, or the given subject.")
        if given is not None and cameras < 2 and given is not height:
            problem = f"{what} needs keypoints of two cameras, which this recording does not have"
            raise ObservationError(problem, remedy=f"Leave out {what}, or add [[keypoints]] of two cameras.")
    person = SizedPerson(recording, Subject.as_is(body), recording.start, calibrated=recording.rig)
    of_sensors = any(s.unknowns for s in recording.sensors)
    unknown = of_sensors or has_unknown_gear(body if subject is None else subject.body)
    if subject is not None:
        person = replace(person, subject=subject)
        return _by_all(person, body, settings, progress, size=False) if unknown else person
    if cameras >= 2:
        person = _with_turned_camera(person, body, settings) if cameras == 2 and others else person
        moved: CameraExtrinsics | None = None
        for last in (False,) * _MOVES + (True,):
            by_keypoints = fit_subject(
                body, channels_of(person.recording, body, settings), frames=frames or 25, height=height, trial=trial,
                cameras=moved or settings.camera_errors, view_bias=settings.view_bias and not others,
                progress=progress,
            )  # fmt: skip
            if last or not (errors := by_keypoints.camera_errors):
                break
            moved = by_keypoints.cameras and replace(by_keypoints.cameras, calibrated=recording.rig)
            person = _with_cameras(person, moved_rig(person.recording.rig, errors))
        person = replace(person, subject=by_keypoints).reporting(**_gear_of(body, by_keypoints))
        person = _with_depth_cameras(person, settings)
    elif recording.markers and recording.markers[0].marker_set:
        person = _by_markers(person, height, progress)
        if recording.markers_alone and not of_sensors:
            return person
        person = replace(person, joint=())
    else:
        if height:
            scales = np.full(len(body.scale_groups), height / body.stature)
            person = replace(person, subject=Subject(body.scaled(scales), scales)).reporting(size="as stated")
        if recording.depth:
            person = sized_by_depth(person, progress)
    unknown = unknown and (bool(recording.sensors) or has_unknown_gear(person.subject.body))
    return _by_all(person, body, settings, progress, height=height, trial=trial) if others or unknown else person


def _with_turned_camera(person: SizedPerson, body: Body, settings: TrackSettings) -> SizedPerson:
    """With the one of two video cameras turned back that does not agree; depth cameras decide if these two do not."""
    r = person.recording
    videos = tuple(dict.fromkeys(k.camera for k in r.keypoints))
    tried = [
        _with_cameras(person, r.rig.with_camera(camera))
        for camera in turned_cameras(make_views(r.rig.select(videos), r.keypoints).spread(_TURN_FRAMES))
    ]
    if len(tried) > 1:
        subjects = [fit_subject(body, channels_of(p.recording, body, settings), frames=_TURN_POSES) for p in tried]
        placed = [placed_cameras(p.recording, subject, settings) for p, subject in zip(tried, subjects)]
        tried = [p for p, depth in zip(tried, placed) if depth and all(one.is_near for one in depth.values())]
    return tried[0] if len(tried) == 1 else person


def _with_cameras(person: SizedPerson, rig: Rig) -> SizedPerson:
    """With cameras where they belong in place of where their calibration has them."""
    moved = composed(person.provenance.get(CAMERAS, {}), between(person.recording.rig, rig))
    return replace(person, recording=replace(person.recording, rig=rig)).reporting(**{CAMERAS: moved})


def _with_depth_cameras(person: SizedPerson, settings: TrackSettings) -> SizedPerson:
    """With depth cameras where they belong, and without those whose pose is of no use."""
    rig, gone = person.recording.rig, dict[str, list[float]]()
    for name, placed in placed_cameras(person.recording, person.subject, settings).items():
        camera = rig[name]
        if placed.usable and not placed.is_near:
            twist = se3.log(camera.T_camera_world @ se3.inverse(placed.T) @ se3.inverse(camera.T_camera_world))
            rig = moved_rig(rig, {camera.name: twist})
        elif not placed.is_near:
            gone[name] = [placed.shift, placed.turn]
    person = person if rig is person.recording.rig else _with_cameras(person, rig)
    if not gone:
        return person
    return replace(person, recording=person.recording.without(gone)).reporting(**{LEFT_OUT: gone})


def _gear_of(body: Body, found: Subject) -> dict[str, Any]:
    """What keypoints show of a body's gear, with standard deviations."""
    names = Gear(body).names
    if not names or found.fit is None or found.covariance is None:
        return {}
    std = dict(zip(found.fit.names, np.sqrt(np.diag(found.covariance))))
    return {"shape": {n: [round(found.fit.value(n)[0], 4), round(float(std[n]), 4)] for n in names}}


def _by_markers(person: SizedPerson, height: float | None, progress: Progress | None) -> SizedPerson:
    """Lengths, the markers' own places and how far each moves on its segment, from one marker system alone."""
    r, body, worn = person.recording, person.subject.body, person.recording.markers[0]
    name, points = worn.marker_set, body.markers(worn.marker_set)
    placed = name if worn.std is None else MarkerPlacement(name, points, worn.std)
    trials = [worn.trial, worn.markers] if worn.trial is not None else [worn.markers]
    found = fit_marker_subject(body, trials, placed, height=height, progress=progress)
    each = {f"{worn.sensor} {name}": float(s) for name, s in zip(found.points.names, found.sigma)}
    person = replace(person, recording=replace(r, sigma={**r.sigma, **each}))
    return person.with_markers(found, found.body)


def sized_by_depth(person: SizedPerson, progress: Progress | None = None) -> SizedPerson:
    """Scale the body to the person in some depth images, if found; `provenance` has INVERTED for people head down."""
    r, body = person.recording, person.subject.body
    frames = r.depth
    camera = r.rig[next(iter(frames.values())).sensor]
    empty = {r.rig[name].name: depth for name, depth in r.backgrounds.items()}.get(camera.name)
    if progress:
        progress("size", 0, 1)
    try:
        fit, starts = sized_start(body, [f.depth for f in frames.values()], camera, background=empty, up=r.up_axis)
    except KinefitError as error:
        return person.reporting(size=f"not found: {error.problem}")
    finally:
        if progress:
            progress("size", 1, 1)
    step, best = max(zip(frames, starts), key=lambda found: found[1].score)
    if _is_inverted(fit.body, [f.depth for f in frames.values()], camera, empty, r.up_axis, starts):
        person = person.reporting(**{INVERTED: camera.name})
    person = _by_joint(person, fit).reporting(size=fit.record())
    if is_rare(r.rate):
        person = replace(person, poses={i: found.state for i, found in zip(frames, starts)})
    return person if person.start is not None else replace(person, start=(step, best.state))


def _is_inverted(
    body: Body, depths: Sequence[NDArray], camera: Camera, empty: NDArray | None, up: NDArray, starts: Sequence[Start]
) -> bool:
    """Whether people who are explained poorly are explained better with their heads where `up` has their feet."""
    scores = [start.score for start in starts]
    if np.mean(scores) > _MIN_UPRIGHT:
        return False
    try:
        how = StartSearch(attempts=1)
        turned = [start_from_points(body, None, camera, d, background=empty, up=-up, search=how)[0] for d in depths]
    except KinefitError:
        return False
    return bool(np.mean([start.score for start in turned]) > np.mean(scores) + _MIN_INVERTED_GAIN)


def _by_all(
    person: SizedPerson, generic: Body, settings: TrackSettings, progress: Progress | None, *, size: bool = True,
    height: float | None = None, trial: Subject | None = None,
) -> SizedPerson:  # fmt: skip
    """Lengths, girths, places of markers, sensors' own unknowns, from all sensors of some frames together.

    The first steps are tracked with the body as it is; poses of some of them, spread over the time, are fitted along.
    Where images are far apart, those are taken whose poses are known: no step helps to find the next.
    """
    r, body = person.recording, person.subject.body
    first = 0 if person.start is None else person.start[0]
    tried, many = (_MAX_STEPS_ONE_CAMERA, _MARKER_POSES) if r.alone is not None else (_MAX_STEPS, _POSES)
    many = _REFINING_POSES if r.poses else many
    near = person.poses or {i: r.poses[i] for i in spread(len(r.poses), many).tolist()}
    stretch = slice(first, min(first + tried, len(r)))
    counted = None
    if progress:
        counted = lambda what, done, total: progress("shape", done, total)
    try:
        if near:
            first, tracked = 0, _fitted_at(near, r, body, settings)
        else:
            part = replace(r, start=person.start).part(stretch)
            tracked = run(part, body, settings, view_bias=person.subject.view_bias, progress=counted)
    except TrackingError as error:
        return person.reporting(shape=f"not found: {error.problem}")
    shown = [k for k, result in enumerate(tracked.results) if result.measurements or r.keypoints]
    good = [k for k in shown if tracked.results[k].quality > _MIN_FRAME_QUALITY]
    if not good and person.recording.markers:  # a body of another size agrees with few of them
        good = [k for k in shown if tracked.results[k].measurements]
    surfaces = any(not m.settled for k in good for m in tracked.results[k].measurements)
    poses = many if surfaces or r.keypoints else _MARKER_POSES
    chosen = [good[k] for k in spread(len(good), poses)]
    if not chosen:
        return person
    frames = [tracked.results[k] for k in chosen]
    steps = [[*r.measurements, *(m.measurement for m in pixels_of(r.matched))] for r in frames]
    states: Sequence[BodyState] = [r.state for r in frames]
    times, velocities = [r.time for r in frames], [_velocity(tracked.results, k) for k in chosen]

    def fit(unknown: Unknowns, seen: Sequence[Sequence[Measurement]], near: Sequence[BodyState]) -> SubjectFit:
        world = unknown.world
        balls = any(isinstance(p, MetaballShape) for p in unknown.parameters)
        lengths = any(isinstance(p, SegmentScales) for p in unknown.parameters)
        slow = lengths and not any(m.settled for several in seen for m in several)
        matches = _MATCHES_OF_LENGTHS if slow else _MATCHES
        rounds, coarse = ROUNDS if balls else (matches, joint.COARSE_ITERATIONS)
        return joint.fit_subject(
            world.body, world.rig, seen, near, unknown.parameters, start=unknown.start, loss=settings.loss,
            times=times, velocities=velocities, rounds=rounds, coarse=coarse, progress=progress,
        )  # fmt: skip

    points = None
    if size:
        points = of_points(
            r, generic, person.subject, height, trial, calibrated=person.calibrated, cameras=settings.camera_errors,
            states=states,
        )  # fmt: skip
    if points is not None:
        own = {sensor.name for sensor in r.sensors if sensor.person_size(generic) is not None}
        seen, stated = [[m for m in several if m.settled and m.sensor not in own] for several in steps], points
        found = fit(points, seen, states)
        for _ in range(_PLACES if r.markers else 0):
            points = points.with_places_of(found, stated)
            found = fit(points, seen, found.states)
        person, states = _by_joint(person, found), found.states
    lengths = points is None and person.subject.fit is None and not person.joint
    left = of_all(
        person.recording, person.subject.body, size=size, lengths=lengths, surfaces=surfaces, steps=steps,
        states=states, height=height,
    )  # fmt: skip
    if left is not None:
        found = fit(left, steps, states)
        person, states = _by_joint(person, found), found.states
    found_at = [first + tracked.steps[k] for k in chosen]
    known = {**person.poses, **dict(zip(found_at, states))} if person.poses else {}
    return replace(person, start=(found_at[0], states[0]), poses=known)


def _fitted_at(
    poses: Mapping[int, BodyState], recording: Recording, body: Body, settings: TrackSettings
) -> TrackedSteps:
    """Steps fitted from known poses, each by itself."""
    tracker, times = tracker_of(recording, body, settings), recording.times
    others = OtherPeople(recording.others, recording.rig, 0.5 / recording.rate + 1e-6)
    frames = []
    for step in sorted(poses):
        tracker.others = tuple(others.at(float(times[step])))
        found = tracker.fitted(float(times[step]), recording.steps(step), poses[step]).result
        scene = tracker.scene_of(found.state, found.time).at(found.state, measurements=found.measurements)
        frames.append(found.kept(scene))
    return TrackedSteps(frames, times[sorted(poses)], tracker, sorted(poses), False)


def _by_joint(person: SizedPerson, found: SubjectFit) -> SizedPerson:
    """The person as a fit of several kinds of sensors found it; with its lengths where they were sought."""
    subject = person.subject
    for kind, own in found.kinds:
        if isinstance(kind, SegmentScales):
            base = subject.scales if found.prior_world.body is subject.body else 1.0
            scales = base * np.exp(found.mean[own])
            subject = replace(subject, scales=scales, fit=None, covariance=None, length_share=found.std[own])
    shape = {**person.provenance.get("shape", {}), **found.record()}
    person = replace(person, subject=replace(subject, body=found.body)).reporting(shape=shape)
    if found.cameras is not None:
        person = replace(person, recording=replace(person.recording, rig=found.rig))
    values = {**person.values, **found.values}
    return replace(person, values=values, joint=(*person.joint, found))


def _velocity(results: Sequence[FrameResult], k: int) -> NDArray:
    """(n,) [m/s, rad/s] of one of several results, from those beside it."""
    a, b = results[max(k - 1, 0)], results[min(k + 1, len(results) - 1)]
    return a.state.difference(b.state) / max(b.time - a.time, 1e-6)
