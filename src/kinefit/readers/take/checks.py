"""Checks of a take file beyond its entries: keys and names that agree with each other, files that exist."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kinefit._files import repeated
from kinefit.bodies.motion import UP_AXES
from kinefit.errors import FileError, ObservationError, TakeError, choices, command
from kinefit.observations.recordings import PersonChoice
from kinefit.readers.depth.images import listed
from kinefit.readers.landmarks.keypoint_sets import FACE_SET
from kinefit.readers.plugins import KEYPOINTS
from kinefit.readers.ros.recordings import inside
from kinefit.readers.take.entries import NO_FILES, SINGLE_TABLES, Take, keys_of

ONE_CAMERA = "keypoints of one camera do not give a person's distance; two cameras do, or one with depth or markers"


def check_enough(take: Take) -> None:
    """Refuse to track a take with the keypoints of a single camera that no network lifts, before anything is read.

    Raises
    ------
    TakeError
        With what to add.
    """
    refuse_streams(take)
    seeing = {entry.camera for entry in take.keypoints} or {entry.name for entry in take.cameras if entry.video}
    lifted = not take.keypoints or any(entry.format == "detect" for entry in take.keypoints)
    if len(seeing) == 1 and not (lifted or take.other_sensors or take.start or take.pose):
        raise TakeError(
            ONE_CAMERA, file=take.path, place=f"camera {next(iter(seeing))}",
            remedy="Remove its [[keypoints]] and give it its video: the built-in detector estimates depth; or add "
            "[[camera]] of a second one, calibrated with the first, or [[depth]].",
        )  # fmt: skip


_Odd = Iterator[tuple[str, str, str]]
"""What is wrong with a take: problem, place, remedy."""


def check_take(take: Take) -> None:
    """Refuse a take whose entries do not agree, or whose files are missing.

    Raises
    ------
    TakeError
        With the place, and what would work.
    FileError
        A file that it names is missing.
    """
    for odd in (_head, _pose, _names, _cameras, odd_streams, _files_of_two):
        for problem, place, remedy in odd(take):
            raise TakeError(problem, file=take.path, place=place, remedy=remedy)
    for place, file in _files(take):
        if not (file.exists() or inside(file) is not None or ("*" in file.name and listed(file))):
            raise FileError(
                f"no such file or folder: {file}", file=take.path, place=place,
                remedy="Correct the path; a relative one starts at the take file.",
            )  # fmt: skip


def _head(take: Take) -> _Odd:
    """Keys of [take] that have no use together with others."""
    if take.frames is not None and not take.frames[0] < take.frames[1]:
        yield f"frames {list(take.frames)}", "[take] frames", "Give [first, one after the last]."
    if take.person is not None:
        try:
            PersonChoice.of(take.person)
        except ObservationError as error:
            yield error.problem, "[take] person", error.remedy or ""
        has_start = take.start is not None or take.pose is not None  # where the body is, and so who
        if not (take.keypoints or (take.depth and not has_start)) and (
            take.depth or take.stereo or take.markers or take.skin or take.sensors
        ):
            what = "[[keypoints]] if a start is given" if has_start else "[[keypoints]] or [[depth]]"
            yield f"'person' has no use without {what}", "[take] person", "Remove it."
    for key in ("height", "subject", "size"):
        given = getattr(take, key)
        if take.start is not None and given is not None and given is not True:  # size = true: refined over its poses
            yield f"'{key}' has no use with start, which gives the body", f"[take] {key}", "Remove one of the two."
        if take.size is False and key != "size" and given is not None:
            yield f"'{key}' has no use with size = false", f"[take] {key}", "Remove one of the two."
    for k, entry in enumerate(take.markers):
        unused = len({one.camera for one in take.keypoints}) > 1 or k or entry.model
        if entry.static is not None and (unused or take.subject or take.start or take.size is False):
            remedy = "Remove it. It is for the first [[markers]] with labels, where nothing else gives the lengths."
            yield "'static' has no use here", f"[[markers]] {k + 1}", remedy
    others = (take.markers, take.depth, take.stereo, take.skin, take.sensors)
    if take.calibration and take.calibration.position_sigma is not None and not take.keypoints and any(others):
        yield "position_sigma and rotation_sigma are for cameras with keypoints", "[calibration]", "Remove both."


def _pose(take: Take) -> _Odd:
    """A start that is none."""
    if (pose := take.pose) is None:
        return
    if take.start is not None:
        yield "[start] has no use with start = ... in [take]", "[start]", "Remove one of the two."
    if pose.at is None or pose.forward is None:
        yield "no `at` and `forward`", "[start]", "Give both; clicks alone need none, and no other key."
        return
    up = np.array(pose.upward or UP_AXES[take.up], float)
    lengths = float(np.linalg.norm(pose.forward)) * float(np.linalg.norm(up))
    if not float(np.linalg.norm(np.cross(pose.forward, up))) > 1e-6 * max(lengths, 1e-12):
        problem = f"forward = {list(pose.forward)} and upward = {up.tolist()} are along one line"
        yield problem, "[start]", "Give two directions that differ: where the root's x and y look in the world."


def _cameras(take: Take) -> _Odd:
    """There is something to see, by cameras whose places are known where they have to be."""
    of_world = [one for entries in take.sensors.values() for one in entries if not hasattr(one, "camera")]
    places = (take.markers, of_world, take.depth)
    if not (take.cameras or take.keypoints or take.skin or take.sensors or any(places)):
        remedy = "Add [[camera]] with [[keypoints]], [[depth]], or [[markers]]."
        yield "an empty take: it names no sensor", "", remedy
    calibrated = take.calibration is not None
    if take.cameras and not calibrated and (any(places) or take.stereo):  # in a world in which their place is not known
        remedy = 'Add [calibration] with file = "...". Only a take of nothing but videos of people needs none.'
        yield "cameras without calibration", "", remedy
    for entry in take.cameras:
        if entry.field_of_view is not None and calibrated:
            problem = "field_of_view has no use with a calibration"
            yield problem, f"camera {entry.name}", "Remove it: the calibration states it."
    for sensor in take.depth:
        place = f"depth {sensor.name}"
        if sensor.camera is not None and not calibrated:
            yield f"camera = {sensor.camera}, but no [calibration]", place, "Add one, or give intrinsics."
        if sensor.intrinsics is not None and (calibrated or len(take.depth) > 1):
            remedy = "Put its intrinsics and its pose into the calibration, and not here."
            yield "intrinsics alone do not give a sensor's pose relative to the others", place, remedy


def _names(take: Take) -> _Odd:
    """Names of cameras and sensors."""
    entries = [one for one in take.entries if one[0] not in ("take", "session", "start", "calibration")]
    named = [(name, entry.name) for table, name, entry in entries if table in ("camera", "depth", "stereo")]
    for twice in repeated(name for _, name in named):
        yield "two have this name", next(place for place, name in named if name == twice), "Rename one."
    cameras = [entry.name for entry in take.cameras]
    videos = [entry.name for entry in take.cameras if entry.video is not None]
    for table, place, entry in entries:
        if table not in ("camera", "depth") and getattr(entry, "camera", None) not in (None, *cameras):
            remedy = f'Add [[camera]] with name = "{entry.camera}", or correct the name.'
            yield choices("camera", entry.camera, cameras), place, remedy
        seen = table == "region" or getattr(entry, "format", "") in ("background", "threshold", "skin")
        if seen and entry.camera not in videos:
            yield choices("camera with a video", entry.camera, videos), place, "Give the [[camera]] its video."
    for pair in take.stereo:
        for side in (pair.left, pair.right):
            if side not in videos:
                remedy = "Name two [[camera]] that have a video."
                yield choices("camera with a video", side, videos), f"stereo {pair.name}", remedy
    for table in ("silhouette", "region"):
        for camera in repeated(one.camera for one in take.sensors.get(table, ())):
            yield f"two [[{table}]]", f"camera {camera}", "Remove one."


def _files_of_two(take: Take) -> _Odd:
    """One file for two entries."""
    inputs = [
        (name, entry.file, sorted(getattr(entry, "points", ())),
         *(getattr(entry, key, None) for key in (("set",) if table == "markers" else ("format", "frames"))),
         getattr(entry, "set", None) == FACE_SET)
        for table, name, entry in take.entries if table in ("keypoints", "markers")
    ]  # fmt: skip
    inputs += [
        (name, entry.file, sorted(getattr(entry, "points", ())),
         [value for key in keys_of(table) if isinstance(value := getattr(entry, key), str | bool)])
        for table, name, entry in take.entries
        if table in take.sensors and not hasattr(entry, "camera") and isinstance(getattr(entry, "file", None), Path)
    ]  # fmt: skip
    for one in inputs:
        if inputs.count(one) > 1:
            yield "the same file twice", str(one[0]), "Remove one: a file named twice would count twice."
    of_one = [(f"camera {c.name}", c.name, c.video) for c in take.cameras if c.video is not None]
    of_one += [(f"keypoints of camera {k.camera}", k.camera, k.file) for k in take.keypoints
               if k.file is not None and (k.format in NO_FILES or not KEYPOINTS.get(k.format).has_all_cameras)]
    for place, camera, file in of_one:
        others = [other for _, other, same in of_one if same == file and other != camera]
        if others:
            problem = f"{file.name} is also the file of camera {others[0]}"
            yield problem, place, "Give each camera its own file."


def _files(take: Take) -> Iterator[tuple[str, Path]]:
    """Every file that the take names, with its place."""
    if take.body.endswith((".toml", ".npz")):
        yield "[take] body", Path(take.body)
    for table, name, entry in take.entries:
        for key in keys_of(table):
            if key != "stream" and isinstance(file := getattr(entry, key), Path):
                yield f"{name} {key}" if name.startswith("[") else name if key == "file" else f"{name}, {key}", file


def streams_of(take: Take) -> list[str]:
    """Every sensor of a take that has a `stream`, as messages name it."""
    return [name for _, name, entry in take.entries if getattr(entry, "stream", None) is not None]


def refuse_streams(take: Take) -> None:
    """Refuse a take of streams where a recording is needed.

    Raises
    ------
    TakeError
        With the command that follows them.
    """
    streams = streams_of(take)
    if streams:
        remedy = f"Track it live ({command('live', take.path)}), or name its recording in place of the stream."
        raise TakeError("a stream is no recording", file=take.path, place=streams[0], remedy=remedy)


def odd_streams(take: Take) -> Iterator[tuple[str, str, str]]:
    """Streams that are given together with what excludes them: problem, place, remedy."""
    streaming = {camera.name for camera in take.cameras if camera.stream is not None}
    for source in take.keypoints:
        if source.stream is not None and source.camera in streaming:
            place = f"keypoints of camera {source.camera}"
            yield "its camera also has a stream", place, "Remove one: the detector runs on the camera's stream."
    streams = streams_of(take)
    if not streams:
        return
    recorded = [
        name for table, name, entry in take.entries
        if table not in SINGLE_TABLES and getattr(entry, "stream", None) is None
        and (table != "camera" or entry.video is not None)
    ]  # fmt: skip
    recorded += ["[start] clicks"] * (take.clicks is not None)
    seen = {entry.camera for entry in take.keypoints}
    blind = [entry.name for entry in take.cameras if entry.stream is None and entry.name not in seen]
    if recorded:
        yield f"a recording cannot be combined with streams ({streams[0]})", recorded[0], "Remove it."
    elif blind and streaming:
        yield "it has no stream, others have", f"camera {blind[0]}", "Give each camera a stream, or remove it."
