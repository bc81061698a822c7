"""Choose the parameters of a person and of sensors that a recording determines, and their initial values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.fitting.multiview.followed import only_lifted
from kinefit.fitting.subject import parameters as kinds
from kinefit.fitting.subject.fit import REACH, MatchedFrames, Worlds
from kinefit.fitting.subject.subject import CameraExtrinsics, OwnUnknowns, Subject, SubjectFit
from kinefit.fitting.subject.surfaces import shape_of
from kinefit.fitting.tracking.recording import Recording
from kinefit.geometry.camera import Rig
from kinefit.sensors.base import Measurement
from kinefit.sensors.points.lifted import SIZE_STD, person_size
from kinefit.sensors.settings import CameraErrors
from kinefit.solving.bundle.border_frames import Weighing, differences, frame_at

_ONE_CAMERA = 0.02  # [m] how far a detector's points stand from their places, for one camera: with 0, 5, 10, 20 mm each
# camera of the balancing trial has joints 76, 70, 69 and 66 mm off and 79, 83, 89 and 95 % inside, in the worst axis
_START_ROUNDS = 20  # of reweighted least squares, at most ...
_START_SIGMAS = 0.1  # ... and fewer once a round changes the start by less than this share of its standard deviation
_SEAT = 0.01  # [m] how far a marker of the body's own set sits from its place on a person: as a detector's points


@dataclass(frozen=True, eq=False)
class Unknowns:
    """What a subject fit of all sensors is to find.

    Parameters
    ----------
    world : that the parameters apply to
    parameters : kinds of them
    start : (p,) values to start from
    """

    world: kinds.World
    parameters: tuple[kinds.Parameters, ...]
    start: NDArray

    def with_places_of(self, found: SubjectFit, stated: Unknowns) -> Unknowns:
        """The same from where a fit of them ended, with the spread of places and cameras that it found.

        How far the markers of a set stand from their places on this person, as a multiple of what is stated, is one
        number of the take (`place_spread`); a multiple of 1 is believed beforehand.

        Parameters
        ----------
        found : a fit of these unknowns
        stated : with the spreads that are stated
        """
        parameters, variance = list(self.parameters), np.diag(found.covariance)
        moved = found.mean - found.prior.mean
        for k, ((one, own), before) in enumerate(zip(kinds.with_slices(self.parameters), stated.parameters)):
            if isinstance(one, kinds.PointOffsets) and isinstance(before, kinds.PointOffsets):
                if one.name not in one.body.marker_sets:
                    continue
                std, factor = (1.0 / np.sqrt(np.diag(p.information)) for p in (before, one))
                ratio = float(np.median(factor / std))
                wider = kinds.place_spread(found.mean[own] / std, variance[own] / std**2, ratio, 1.0)
                parameters[k] = replace(one, std=wider * np.asarray(before.std))
            elif isinstance(one, CameraExtrinsics):
                parameters[k] = one.with_errors_of(own, moved, found.information, found.prior.information)
        return replace(self, parameters=tuple(parameters), start=found.mean)


def of_points(
    recording: Recording, generic: Body, subject: Subject, height: float | None, trial: Subject | None, *,
    calibrated: Rig | None = None, cameras: CameraErrors | None = None, states: Sequence[BodyState] = (),
) -> Unknowns | None:  # fmt: skip
    """Lengths, gear, offsets of points, and cameras, where there are markers; else the keypoints' fit has them.

    They have the generic body's prior: the fit from one kind of sensors that came first says where to begin, and is not
    counted again.

    Parameters
    ----------
    generic : the body before any fit
    subject : what the first fit found
    height, trial : as of `track`
    states : poses of the body, which tell where gear begins
    calibrated : Rig of the calibration, from which the recording's may have been moved; default: it is the recording's
    cameras : how far they may be from there; default: exact
    """
    sets = {m.marker_set: m.std for m in recording.markers if m.marker_set}
    if not sets and recording.alone is None:
        return None
    worn = {name: subject.body.markers(name) for name in sets}  # a fit from markers leaves those that were seen
    places = {name: generic.markers(name).select(points.names) for name, points in worn.items()}
    stds = {n: _SEAT if s is None else _of(s, generic.markers(n), places[n]) for n, s in sets.items()}
    generic = replace(generic, marker_sets={**generic.marker_sets, **places})
    lengths = _size_by_sensors(generic, recording)
    if height and generic.stature:
        lengths = kinds.SegmentScales(generic, height / generic.stature)
    if trial is not None and trial.covariance is not None:
        count = len(trial.scales)
        lengths = kinds.KnownLengths(generic, scales=trial.scales, covariance=trial.covariance[:count, :count])
    found: list[tuple[kinds.Parameters, NDArray]] = [(lengths, np.log(subject.scales)), *_gear(generic, states)]
    found += list(_keypoint_offsets(generic, subject).values())
    if recording.alone is not None:
        one = kinds.PointOffsets(generic, recording.keypoints[0].keypoint_set, _ONE_CAMERA)
        found.insert(0, (one, one.mean))  # offsets are of the generic body: in metres, they would favour a small one
    scaled = generic.scaled(subject.scales)
    for name in sets:
        offsets = kinds.PointOffsets(generic, name, stds[name])
        found.append((offsets, offsets.values_of(worn[name].points - scaled.markers(name).points)))
    used = tuple(dict.fromkeys(k.camera for k in recording.keypoints))
    if cameras is not None and used:
        before = subject.cameras
        factors = before.factors if before is not None and before.free == used else None
        poses = CameraExtrinsics.of(cameras, recording.rig, used, factors, calibrated)
        found.append((poses, np.zeros(len(poses.names))))
    return _together(kinds.World(generic, recording.rig), found)


def _size_by_sensors(body: Body, recording: Recording) -> kinds.SegmentScales:
    """Lengths whose common size is that of people, by the metres of a network that lifted landmarks and of sensors."""
    record = only_lifted(recording.keypoints)
    found = [sensor.person_size(body) for sensor in recording.sensors]
    found += [] if record is None else [(person_size(body, record), SIZE_STD)]
    known = np.array([(np.log(one[0]), one[1] ** -2) for one in found if one and np.isfinite(one[0])]).reshape(-1, 2)
    information = kinds.UNKNOWN_SIZE_STD**-2 + known[:, 1].sum()
    about = float(np.exp(known[:, 0] @ known[:, 1] / information))
    return kinds.SegmentScales(body, about=about, about_std=information**-0.5)


def _of(values: NDArray, whole: PointSet, part: PointSet) -> NDArray:
    """(K,) values of the points of a part of a set."""
    return np.asarray(values)[[whole.names.index(name) for name in part.names]]


def of_all(
    recording: Recording, body: Body, *, size: bool, lengths: bool, surfaces: bool,
    steps: Sequence[Sequence[Measurement]] = (), states: Sequence[BodyState] = (), height: float | None = None,
) -> Unknowns | None:  # fmt: skip
    """What is left for all sensors together: the body's surface, gear, and what sensors do not know of themselves.

    Parameters
    ----------
    body : as sized as it is already
    size : whether anything of the body is sought
    lengths : whether neither points nor a few depth images have determined them: nearest points of a surface of simple
        shapes, frame after frame, are surer of lengths than they are right
    surfaces : whether any sensor sees them
    steps, states : what was measured at some poses of the body, which tell where gear and sensors' unknowns begin
    height : [m] to which the body was scaled, as it is stated
    """
    found: list[tuple[kinds.Parameters, NDArray]] = []
    if size and lengths and (surfaces or recording.markers or any(s.places_points for s in recording.sensors)):
        known = kinds.SegmentScales(body, 1.0 if height else None)
        found.append((known, np.zeros(len(body.scale_groups))))
    if size and surfaces:
        found += [(shape, shape.mean) for shape in shape_of(body)]
    found += _gear(body, states)
    unknown = OwnUnknowns.of(recording.sensors)
    if unknown.names:
        found.append((unknown, _start_of(unknown, kinds.World(body, recording.rig), steps, states)))
    return _together(kinds.World(body, recording.rig), found)


def _gear(body: Body, states: Sequence[BodyState]) -> list[tuple[kinds.Parameters, NDArray]]:
    """The unknown gear of a body and where its fit begins; none where all is known."""
    gear = kinds.Gear(body)
    return [(gear, gear.start(states))] if gear.names else []


def _start_of(
    unknown: OwnUnknowns, world: kinds.World, steps: Sequence[Sequence[Measurement]], states: Sequence[BodyState]
) -> NDArray:
    """(p,) values at which the poses leave the least absolute residuals: a robust loss finds nothing from far away."""
    worlds, prior, theta = Worlds(world, (unknown,)), unknown.information, unknown.mean
    frames = MatchedFrames(worlds, steps, None, None, theta, states, REACH[0])
    for _ in range(_START_ROUNDS):
        H, g = prior.copy(), prior @ (unknown.mean - theta)
        moved = differences(frames, theta, unknown.step, states)
        for f, (state, D) in enumerate(zip(states, moved)):
            at = frame_at(frames, theta, f, state, Weighing())
            J = D * (at.used / np.maximum(np.abs(at.residual), 1.0))[:, None]
            H, g = H + D.T @ J, g + J.T @ at.residual
        step = np.linalg.solve(H, g)
        theta = theta + step
        if step @ H @ step < _START_SIGMAS**2 * len(step):
            break
    return theta


def _together(world: kinds.World, found: Sequence[tuple[kinds.Parameters, NDArray]]) -> Unknowns | None:
    if not found:
        return None
    return Unknowns(world, tuple(p for p, _ in found), np.concatenate([values for _, values in found]))


def _keypoint_offsets(generic: Body, subject: Subject) -> dict[str, tuple[kinds.Parameters, NDArray]]:
    """Of every keypoint set its offsets, as far as the keypoints' own fit found that they may be, and where it did."""
    scaled, out = generic.scaled(subject.scales), dict[str, tuple[kinds.Parameters, NDArray]]()
    for one in subject.fit.parameters if subject.fit is not None else ():
        if not isinstance(one, kinds.PointOffsets):
            continue
        name, offsets = one.name, kinds.PointOffsets(generic, one.name, one.std)
        out[name] = offsets, offsets.values_of(subject.body.keypoints(name).points - scaled.keypoints(name).points)
    return out
