"""From what a take names to a recording: every sensor, step by step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kinefit import observations
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.marker_sets import LANDMARK_SPREAD, MarkerPlacement, bare, find_placement, known_set, matched
from kinefit.bodies.motion import UP_AXES, Motion
from kinefit.errors import BodyError, KinefitError, ObservationError, TakeError, choices, located
from kinefit.findings import Finding
from kinefit.fitting.initialization.candidates import coarse_to_fine
from kinefit.fitting.markers.sides import label_findings, refuse_wrong_sides
from kinefit.fitting.multiview.people import PersonTrack
from kinefit.fitting.smoothing.foot_contacts import FloorPlane, find_contacts, soles
from kinefit.fitting.tracking.recording import Recording, spread
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.images.depth_scene import background_model
from kinefit.readers.motion import read_motion
from kinefit.readers.take.cameras import is_level
from kinefit.readers.take.entries import sensor_name
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.readers.take.videos import load_stereo, stereo_sigma
from kinefit.sensors.base import Sensor
from kinefit.sensors.points.poses import PoseSensor
from kinefit.sensors.settings import TrackSettings

FLOOR = "floor"
"""Key of `Motion.provenance`: the floor that was found from the feet, and how the world was moved onto it."""

_REJECTED_WEIGHT = 0.3  # robust weight, of 1, below which a joint hardly counts
_MAX_REJECTED_SHARE = 0.05  # of a file's joints: 0.001 where it is right; 0.19 of a slowed, 0.27 of another video's

_MAX_LOST = 0.5  # share of frames in which the feet may be lost, to tell a floor

_EMPTY = 30  # images of an empty scene that are looked at: more add nothing
_SIZING_IMAGES = 4  # depth images from which a person's size is found ...
_SIZING_S = 5.0  # ... spread over the beginning


def on_floor(motion: Motion, recording: Recording, floors: list[FloorPlane]) -> Motion:
    """A motion in a world whose floor is level and at zero; as it is where the vertical was measured, or no foot rests.

    Parameters
    ----------
    motion : of one person of the recording
    floors : the floor that an earlier person of the recording stands on, which holds for all; else it is added
    """
    if recording.level:
        return motion
    eye = None if recording.alone is None else recording.alone.centre_world
    if not floors and motion.lost[:, np.unique(soles(motion.body).segments)].mean() <= _MAX_LOST:
        states = motion.Ts_world_root, motion.angles
        found = find_contacts(motion.body, *states, motion.rate, motion.up, eye, level=False).floor
        floors += [] if found is None else [found]
    if not floors:
        return motion
    floor, axis = floors[0], np.array(UP_AXES[motion.up])
    T = floor.T_level_world(motion.up)
    entries = {
        "T_level_world": T.tolist(), "tilt_deg": float(np.degrees(np.arccos(np.clip(floor.normal @ axis, -1.0, 1.0)))),
        "height_std_m": round(floor.height_std, 4), "tilt_std_deg": round(float(np.degrees(floor.tilt_std)), 2),
    }  # fmt: skip
    return replace(motion.moved(T, eye), provenance={**motion.provenance, FLOOR: entries})


def rig_on_floor(rig: Rig, provenance: Mapping[str, Any]) -> Rig:
    """The cameras in the world of a motion that `on_floor` moved."""
    return rig.moved(np.array(provenance[FLOOR]["T_level_world"])) if FLOOR in provenance else rig


def floor_sentences(provenance: Mapping[str, Any]) -> list[str]:
    """What is worth saying of a floor that was found."""
    if FLOOR not in provenance:
        return []
    entries = provenance[FLOOR]
    return [
        "the floor was estimated from resting feet and is at height zero; standard deviations "
        f"{1e3 * entries['height_std_m']:.0f} mm and {entries['tilt_std_deg']:.1f} degrees. Resting soles stay still"
    ]


def recording_of(
    take: Take, seen: Observations, body: Body, people: Sequence[PersonTrack] | None = None
) -> tuple[Recording, Body]:
    """What all sensors of a take saw, and the body with the marker sets that they name.

    Parameters
    ----------
    seen : of the take
    body : the take's
    people : the people that its keypoints show, if they were detected

    Raises
    ------
    KinefitError
        What the sensors' readers raise; markers of which the body knows none.
    """
    stereo = load_stereo(take, seen)
    depth: tuple[observations.DepthVideo, ...] = (*seen.depth, *stereo)
    rig = Rig((*(seen.rig or ()), *(v.camera for v in stereo if v.camera is not None)))
    known = _motion_poses(take, body, seen)
    start = (0, known[0]) if known else posed_start(take, body, seen.frames)
    marked, body = _markers(take, seen, body)
    first, rate = seen.frames[0], seen.rate
    times = np.arange(*seen.frames) / rate + seen.first_time
    videos = (*stereo, *seen.recordings)

    def steps(i: int) -> Sequence[Any]:
        out: list[Any] = []
        for video in videos:
            k = video.at_step(first + i, rate)
            if k is not None:
                out.append(video.frame(k))
            elif isinstance(video, observations.KeypointVideo):
                out.append(video.unseen(float(times[i])))
        frames = (m.at(float(times[i])) for m in marked)
        return [*out, *(f for f in frames if f is not None)]

    for sensor, at in {
        **{v.sensor: lambda i, v=v: v.at_step(first + i, rate) for v in videos},
        **{m.sensor: lambda i, m=m: m.at(float(times[i])) for m in marked},
    }.items():
        if all(at(i) is None for i in range(len(times))):
            problem = f"{sensor} has no data in the take's time, {times[0]:.2f} to {times[-1]:.2f} s"
            raise ObservationError(problem, remedy="Set its time_offset, or frames in [take].")
    recording = Recording(
        times, rate, rig, steps=steps, sigma=_sigma(take, seen, stereo), markers=tuple(marked),
        depth=_first_depth(depth, seen), on_body=tuple(v.sensor for v in depth if v.on_body),
        backgrounds=_backgrounds(depth), start=start, up=take.up, level=is_level(take),
        name=take.name, poses=known if take.size else {},
        sensors=sensors_of(take, seen, body),
    )  # fmt: skip
    if seen.keypoints:
        following = {sensor.name for sensor in recording.sensors if sensor.follows}
        others = {video.sensor for video in videos if video not in seen.clicks} | {s.name for s in recording.sensors}
        bare = others <= following and not marked  # else what is lifted adds nothing
        keypoints = seen.keypoints if bare else [replace(k, lifted=None) for k in seen.keypoints]
        pixels = Recording.of_keypoints(
            rig, keypoints, sigma=[entry.sigma for entry in take.keypoints], person=take.person, people=people
        )
        recording = replace(
            recording, keypoints=pixels.keypoints, followed=pixels.followed, sigma={**recording.sigma, **pixels.sigma},
            steps=lambda i: [*_clicked_on_person(steps(i), i, seen, pixels), *pixels.steps(i)],
        )  # fmt: skip
    return recording, body


def _clicked_on_person(frames: Sequence[Any], i: int, seen: Observations, of_person: Recording) -> Sequence[Any]:
    """Frames of a step without clicks on others: the person with the nearest keypoint in the image was clicked on."""
    who = of_person.followed
    if who is None or len(who.people) < 2:
        return frames
    on_person = {}
    for frame in observations.by_record(frames)[observations.ClickFrame]:
        uv, distance = frame.ends.mean(axis=1), np.full((len(frame.names), len(who.people)), np.inf)
        for q, k in enumerate(seen.keypoints):
            for p, one in enumerate(who.people if k.camera == frame.sensor else ()):
                own = k.points[i, one.chosen[q][i]] if one.chosen[q][i] >= 0 else np.full((1, 2), np.inf)
                away = np.linalg.norm(uv[:, None] - own, axis=2)
                distance[:, p] = np.fmin(distance[:, p], np.fmin.reduce(away, axis=1))
        on_other = distance[:, who.number - 1] > distance.min(axis=1)
        on_person[id(frame)] = replace(frame, ends=np.where(on_other[:, None, None], np.nan, frame.ends))
    return [on_person.get(id(frame), frame) for frame in frames]


def with_fitted_start(
    recording: Recording, body: Body, settings: TrackSettings | None, *, low_pass: bool = True
) -> Recording:
    """A recording whose start, which may be tens of degrees off, is fitted to the silhouettes of its step."""
    if recording.start is None:
        return recording
    step, state = recording.start
    shown = observations.by_record(recording.steps(step))[observations.SilhouetteFrame]
    if not shown:
        return recording
    found = coarse_to_fine(
        body, recording.rig, shown, state, sigma=recording.sigma, low_pass=low_pass, settings=settings
    )
    return replace(recording, start=(step, found.result.state))


def _sigma(take: Take, seen: Observations, stereo: Sequence[observations.DepthVideo]) -> dict[str, float]:
    """Standard deviation of every sensor, [m] or [px]."""
    out = {entry.name: entry.sigma for entry in take.depth}
    out |= {entry.name: stereo_sigma(entry, video, seen) for entry, video in zip(take.stereo, stereo)}
    out |= {name: sigma for of in seen.sensors for name, sigma in of.kind.sigma(of.entry).items()}
    out |= {f"clicks {video.sensor}": take.click_sigma for video in seen.clicks}
    out |= {entry.camera: entry.sigma for entry in (*take.skin, *take.keypoints)}
    out |= {
        f"{seen_by.camera} {seen_by.keypoint_set}": seen_by.sigma
        for entry, seen_by in zip(take.keypoints, seen.keypoints)
        if seen_by.sigma is not None and entry.sigma == observations.KEYPOINT_SIGMA
    }  # fmt: skip
    return out | {sensor_name("markers", take.markers, k): entry.sigma for k, entry in enumerate(take.markers)}


def sensors_of(take: Take, seen: Observations, body: Body) -> tuple[Sensor, ...]:
    """Sensors of all kinds of a take that track frames of their own.

    Raises
    ------
    KinefitError
        What making them raises, with the entry; PluginError for what a plug-in returns in place of a sensor.
    """
    out, numbers = list[Sensor](), Counter[str]()
    for of in seen.sensors:
        kind, name = of.kind, of.recording.sensor
        numbers[kind.table] += 1
        if kind.sensor is None:
            continue
        with located(take.path, f"[[{kind.table}]] {numbers[kind.table]}"):
            valid = lambda s, name=name: isinstance(s, Sensor) and getattr(s, "name", None) == name
            what = f"a Sensor of the name '{name}'"
            out.append(kind.call("sensor", of.entry, of.recording, body, valid=valid, what=what))
    return tuple(out)


def posed_start(take: Take, body: Body, frames: tuple[int, int]) -> tuple[int, BodyState] | None:
    """Step and state of `[start]`; None where there is none.

    Raises
    ------
    TakeError
        A step that is not there, or angles that the body does not have.
    """
    pose, tree = take.pose, body.tree
    if pose is None or pose.at is None or pose.forward is None:
        return None
    step = frames[0] if pose.step is None else pose.step

    def wrong(problem: str, remedy: str | None = None) -> TakeError:
        return TakeError(problem, file=take.path, place="[start]", remedy=remedy)

    if not frames[0] <= step < frames[1]:
        problem = f"step = {step} is outside the take's steps {frames[0]} to {frames[1] - 1}"
        raise wrong(problem, "Write one of these steps, or leave out step for the first.")
    y, x = np.array(pose.upward or UP_AXES[take.up], float), np.array(pose.forward, float)
    if pose.upward is None:  # upright: forward as far as it is level
        x = x - (x @ y) * y
    x = x / np.linalg.norm(x)
    z = np.cross(x, y)
    z = z / np.linalg.norm(z)
    T = se3.transform(np.stack([x, np.cross(z, x), z], axis=1), np.array(pose.at))
    angles = np.array(body.default_state(T).angles)
    for name, value in pose.angles.items():
        if name not in tree.coordinates:
            raise wrong(choices(f"angle of body '{body.name}'", name, tree.coordinates))
        k = tree.coordinates.index(name)
        unit = 1.0 if tree.prismatic[k] else np.pi / 180.0
        angles[k] = value * unit
        if not tree.lower[k] - 1e-9 <= angles[k] <= tree.upper[k] + 1e-9:
            problem = f"{name} = {value:g} is outside its limits {tree.lower[k] / unit:g} to {tree.upper[k] / unit:g}"
            raise wrong(problem, f"Write {name} within these limits.")
    return step - frames[0], BodyState(T, angles)


def _motion_poses(take: Take, body: Body, seen: Observations) -> dict[int, BodyState]:
    """Poses of the motion of `start`, by step; the first alone where its body is not refined over them."""
    if take.start is None:
        return {}
    motion = read_motion(take.start)
    if len(motion.body.tree.coordinates) != len(body.tree.coordinates):
        raise BodyError(
            f"the motion of start has the body {motion.body.name}, not {body.name}", file=take.path,
            place="[take] start", remedy="Start from a motion of the take's body.",
        )  # fmt: skip
    steps = seen.frames[1] - seen.frames[0]
    if take.size and (len(motion) != steps or not np.isclose(motion.rate, seen.rate, rtol=1e-3)):
        problem = f"the motion of start has {len(motion)} frames at {motion.rate:g} Hz, "
        problem += f"this take {steps} at {seen.rate:g} Hz"
        remedy = "Start from a motion of this very take, or leave out size = true."
        raise TakeError(problem, file=take.path, place="[take] start", remedy=remedy)
    roots = motion.Ts_world_root
    if not is_level(take) and FLOOR in motion.provenance:
        roots = se3.inverse(np.array(motion.provenance[FLOOR]["T_level_world"])) @ roots
    return {i: BodyState(T, q) for i, (T, q) in enumerate(zip(roots, motion.angles)) if take.size or not i}


def _markers(take: Take, seen: Observations, body: Body) -> tuple[list[observations.NamedMarkers], Body]:
    """All marker recordings by the names of the body's sets; a set of the catalogue is put on the body where needed."""
    out = []
    for k, (entry, markers, trial) in enumerate(zip(take.markers, seen.markers, seen.static_markers, strict=True)):
        with located(entry.file, f"[[markers]] {k + 1}"):
            own, known, std = _set_of(body, markers.names, entry.set)
        if own and own not in body.marker_sets:
            body = replace(body, marker_sets={**body.marker_sets, own: known})
        named, trial = _named_as(markers, known.names), trial and _named_as(trial, known.names)
        name = sensor_name("markers", take.markers, k)
        out.append(observations.NamedMarkers(name, named, own, entry.time_offset, std, trial))
    return out, body


def _named_as(markers: observations.Markers, known: Sequence[str]) -> observations.Markers:
    """The markers that a set knows, by its names."""
    names = matched(markers.names, known)
    here = [i for i, (label, name) in enumerate(zip(markers.names, names)) if (name or bare(label)) in known]
    return replace(
        markers, names=tuple(names[i] or bare(markers.names[i]) for i in here), positions=markers.positions[:, here]
    )


def label_findings_of(take: Take, seen: Observations, body: Body, *, refuse: bool = False) -> tuple[Finding, ...]:
    """Check the labels of every marker recording (see `label_findings`), where it has enough of them.

    Raises
    ------
    ObservationError
        With `refuse`: the sides of a recording are wrong.
    """
    out: list[Finding] = []
    of_entries = zip(take.markers, seen.markers, seen.static_markers, strict=True)
    each = [(k, e, file, m) for k, (e, *two) in enumerate(of_entries) for file, m in zip((e.file, e.static), two) if m]
    for k, entry, file, markers in each:
        with located(file, f"[[markers]] {k + 1}"):
            found: tuple[Finding, ...] = ()
            with suppress(KinefitError):  # which tracking raises
                own, points, std = _set_of(body, markers.names, entry.set)
                spread = np.full(len(points), LANDMARK_SPREAD) if std is None else std
                placed = MarkerPlacement(own or body.name, points, spread)
                found = label_findings(body, markers, placed, sides=entry.sides)
            if refuse:
                refuse_wrong_sides(found)
            out += found
    return *out, *pose_findings_of(take, seen, body, refuse=refuse)


def pose_contradictions(motion: Motion, seen: Observations) -> list[Finding]:
    """Files of poses many of whose joints the fit rejected: other sensors, or constant bones, contradict them."""
    found = []
    for of in seen.sensors:
        if of.kind.table != "pose" or (left := motion.residuals.get(of.recording.sensor)) is None:
            continue
        known = np.isfinite(left.norms)
        rejected = float(np.mean(left.weights[known] < _REJECTED_WEIGHT)) if known.any() else 0.0
        if rejected > _MAX_REJECTED_SHARE:
            name, share = of.entry.file.name, f"{100 * rejected:.0f} %"
            text = f"{share} of the joints of {name} fit neither one body nor the other measurements."
            sure = "Likely: the file is of another video or person, or its times are not those of the take."
            remedy = "Compare them, state its rate or time_offset, or leave out [[pose]]."
            found.append(Finding("fault", "pose", text, (), sure, remedy))
    return found


def pose_findings_of(take: Take, seen: Observations, body: Body, *, refuse: bool = False) -> tuple[Finding, ...]:
    """Check the sides of the joints that other programs estimated, as those of markers.

    Raises
    ------
    ObservationError
        With `refuse`: the sides of a file are wrong.
    """
    out, poses = list[Finding](), [of for of in seen.sensors if of.kind.table == "pose"]
    try:
        sensors = cast(tuple[PoseSensor, ...], sensors_of(take, replace(seen, sensors=tuple(poses)), body))
    except KinefitError:
        if refuse:
            raise
        return ()  # which the check of the whole take tells
    for of, sensor in zip(poses, sensors, strict=True):
        entry, recording = of.entry, cast(Any, of.recording)
        used = [name for name in recording.names if name in sensor.points]
        names = tuple(place if isinstance(place := sensor.points[name], str) else name for name in used)
        points, std = replace(sensor.places(body, used), names=names), sensor.errors.offset + sensor.errors.sigma
        x = recording.x_world[:, [recording.names.index(name) for name in used]]
        with located(entry.file, f"[[pose]] {sensor.name}"):
            found: tuple[Finding, ...] = ()
            with suppress(KinefitError):  # which tracking raises
                placed = MarkerPlacement(sensor.name, points, np.full(len(points), std))
                seen_as = observations.Markers(names, recording.rate, x, up=take.up.strip("-"))
                found = label_findings(body, seen_as, placed, sides=entry.sides)
            found = tuple(f for f in found if (f.severity, f.kind) == ("fault", "sides"))
            out += [replace(f, remedy=f.remedy.replace("[[markers]]", "[[pose]]")) for f in found]
            if refuse:
                refuse_wrong_sides(tuple(out))
    return tuple(out)


def _set_of(body: Body, labels: Sequence[str], wanted: str | None) -> tuple[str, PointSet, NDArray | None]:
    """The set that labels belong to, its points, and how far each may sit elsewhere, where the catalogue says so.

    That is the body's own set, or "" for its landmarks, unless a set of the catalogue knows more of the labels.
    """
    own, known, count = None, body.landmarks, 0
    with suppress(KinefitError):
        own = known_set(body, labels, wanted if wanted in body.marker_sets else None)
        known = body.markers(own) if own else body.landmarks
        count = len(set(matched(labels, known.names)) - {None})
    if own is not None and wanted and own == wanted:
        return own, known, None
    try:
        placed = find_placement(body, {bare(n) for n in labels}, wanted)
    except KinefitError:
        if own is None or wanted or 2 * count < len(labels):
            raise
        return own, known, None
    if own is not None and not wanted and count >= len(placed.points):
        return own, known, None
    return placed.name, placed.points, placed.spread


def _first_depth(depth: Sequence[observations.DepthVideo], seen: Observations) -> dict[int, observations.DepthFrame]:
    """Some images of the first depth sensor from the beginning of the take, by step."""
    start, stop = seen.frames
    for video in depth:
        frames = {s - start: k for s in range(start, stop) if (k := video.at_step(s, seen.rate)) is not None}
        first = [step for step in frames if step <= min(frames) + _SIZING_S * seen.rate]
        if first:
            return {first[c]: video.frame(frames[first[c]]) for c in spread(len(first), _SIZING_IMAGES)}
    return {}


def _backgrounds(depth: Sequence[observations.DepthVideo]) -> dict[str, NDArray]:
    """What depth sensors saw of the empty scene."""
    out = {}
    for video in depth:
        if video.background is not None:
            empty = [video.background.frame(i).depth for i in range(min(len(video.background), _EMPTY))]
            out[video.sensor] = background_model(empty, share=0.5)
    return out
