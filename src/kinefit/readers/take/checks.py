"""Checks of a take file beyond its form: values that can be, names that agree, keys of use, files that exist."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kinefit._files import repeated
from kinefit.errors import FileError, ObservationError, TakeError, choices
from kinefit.motion import UP_AXES
from kinefit.observations.person import PersonChoice
from kinefit.readers.depth.images import listed
from kinefit.readers.keypoint_sets import FACE_SET, KEYPOINT_SETS, MEDIAPIPE_SETS
from kinefit.readers.ros.recordings import inside
from kinefit.readers.take.entries import SKIN_SETS, CalibrationEntry, StartEntry
from kinefit.readers.take.streams import odd_streams, refuse_streams
from kinefit.readers.take.values import wrong_ranges
from kinefit.readers.units import LENGTHS, worth

if TYPE_CHECKING:
    from kinefit.readers.take.file import Take

_ONLY: dict[str, dict[str, tuple[str, ...]]] = {
    "keypoints": {
        "file": ("openpose", "mediapipe", "caliscope", "detect"), "frame": ("openpose", "mediapipe", "caliscope"),
        "rate": ("openpose", "mediapipe", "caliscope"), "face": ("skin",), "stream": ("openpose",),
        **dict.fromkeys(("excluded", "swapped"), ("openpose", "mediapipe", "caliscope", "detect")),
    },
    "silhouette": {
        "file": ("masks", "background", "detect"), "frame": ("masks",), "rate": ("masks",),
        **dict.fromkeys(("low", "high", "channels", "smooth"), ("threshold",)),
    },
}  # fmt: skip
"""Formats for which a key means something: with any other it is refused."""

ONE_CAMERA = "keypoints of one camera do not give a person's distance; two cameras do, or one with depth or markers"
_SETS = {"openpose": tuple(KEYPOINT_SETS), "skin": SKIN_SETS, "detect": (*MEDIAPIPE_SETS, FACE_SET)}


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


def check_take(take: Take) -> None:
    """Refuse a take whose values cannot be, whose names do not agree, whose files are missing, or keys without use.

    Raises
    ------
    TakeError
        With the place, and what would work.
    FileError
        A file that it names is missing.
    """
    _values(take)
    _uses(take)
    _names(take)
    _files(take)


def _values(take: Take) -> None:
    """Refuse numbers that cannot be."""

    def refuse(problem: str, place: str, remedy: str) -> None:
        raise TakeError(problem, file=take.path, place=place, remedy=remedy)

    if take.rate is not None and not 0 < take.rate < 1e6:
        refuse(f"rate {take.rate:g} Hz", "[take] rate", "Give frames per second, or remove it.")
    if take.height is not None and not 0.3 < take.height < 3:
        metres = f": height = {take.height / 100:g}" if 30.0 < take.height < 300.0 else ""
        refuse(f"height {take.height:g} m", "[take] height", f"Give the stature in metres{metres}, or remove it.")
    if take.person is not None:
        try:
            PersonChoice.of(take.person)
        except ObservationError as error:
            refuse(error.problem, "[take] person", error.remedy or "")
        has_start = take.start is not None or take.pose is not None  # where the body is, and so who
        if not (take.keypoints or (take.depth and not has_start)) and (
            take.depth or take.stereo or take.markers or take.silhouettes or take.skin
        ):
            what = "[[keypoints]] if a start is given" if has_start else "[[keypoints]] or [[depth]]"
            refuse(f"'person' has no use without {what}", "[take] person", "Remove it.")
    for key in ("height", "subject", "size"):
        if take.start is not None and getattr(take, key) is not None:
            refuse(f"'{key}' has no use with start, which gives the body", f"[take] {key}", "Remove one of the two.")
        if take.size is False and key != "size" and getattr(take, key) is not None:
            refuse(f"'{key}' has no use with size = false", f"[take] {key}", "Remove one of the two.")
    if take.calibration is not None:
        _calibration(take, take.calibration, refuse)
    if take.pose is not None:
        _pose(take, take.pose, refuse)
    if not 0 < take.click_sigma < 1e4:
        refuse(f"click_sigma = {take.click_sigma:g} px", "[start]", "Give a positive number.")
    for camera in take.cameras:
        if not abs(camera.time_offset) < 1e6 or (camera.size and not _is_size(camera.size)):
            refuse(f"size {camera.size}, time offset {camera.time_offset} s", f"camera {camera.name}", "Give px and s.")
    for source in (*take.keypoints, *take.skin):
        place = f"keypoints of camera {source.camera}"
        sets = _SETS.get(source.format, MEDIAPIPE_SETS)
        if source.set is not None and source.set not in sets:
            kind = "keypoint set" if source.format == "openpose" else f"keypoint set of {source.format}"
            refuse(choices(kind, source.set, sets), place, f'Use set = "{sets[0]}", or remove it.')
        if source.file is None and source.stream is None and source.format not in ("detect", "skin"):
            refuse(f"no file of {source.format} keypoints", place, 'Write file = "...", or format = "detect".')
        if source.face is not None and not all(v > 0 for v in source.face[2:]):
            refuse(f"face = {list(source.face)}", place, "Give [left, top, width, height] in pixels of the video.")
    pixels: dict[str, tuple[Any, ...]] = {"keypoints": (*take.keypoints, *take.skin), "lines": take.lines}
    for kind, entries in (pixels | {"silhouette": take.silhouettes, "region": take.regions}).items():
        for e in entries:
            for key, unit, most in (("sigma", "px", 1e4), ("rate", "Hz", 1e6)):
                if (value := getattr(e, key, None)) is not None and not 0 < value < most:
                    refuse(f"{key} {value} {unit}", f"{kind} of camera {e.camera}", "Give a positive number.")
    for shape in take.silhouettes:
        place = f"silhouette of camera {shape.camera}"
        if shape.file is None and shape.format == "masks":
            refuse("no file of masks", place, 'Write file = "..." (a folder), or another format.')
        if shape.format == "threshold":
            if shape.low is None or shape.high is None:
                refuse("no colour of the body", place, "Write low = [r, g, b] and high = [r, g, b], 0 to 255 each.")
            elif not all(0 <= a <= b <= 255 for a, b in zip(shape.low, shape.high)):
                refuse(f"low = {list(shape.low)}, high = {list(shape.high)}", place, "0 to 255, the lower ones first.")
        if shape.smooth is not None and not 0 < shape.smooth < 100:
            refuse(f"smooth = {shape.smooth:g} px", place, "Give a positive number.")
    for lines in take.lines:
        place = f"lines of camera {lines.camera}"
        for name, own in lines.landmarks.items():
            if not 1 <= len(set(own)) == len(own) <= 2:
                refuse(f"line '{name}' has {len(own)} landmarks", place, "Give the two ends of an edge, or one point.")
        if not lines.landmarks:
            refuse("no landmarks", place, 'Write landmarks = { edge = ["r_asis", "l_asis"] }, one entry for each line.')
    for entry in take.markers:
        if entry.unit is not None and worth(entry.unit, LENGTHS) is None:
            refuse(choices("unit", entry.unit, LENGTHS), f"markers {entry.file.name}", "Use one of these.")
    for kind, table in _of_places(take):
        place = f"{kind} {table.file.name}"
        if not 0 < table.sigma < 1 or not abs(table.time_offset) < 1e6:
            refuse(f"sigma {table.sigma} m, time offset {table.time_offset} s", place, "Give metres and seconds.")
        shift, turn = getattr(table, "shift", (0.0,)), getattr(table, "turn", (0.0,))
        if not (all(abs(v) < 1e4 for v in shift) and all(abs(v) <= 360 for v in turn)):
            refuse(f"shift {list(shift)}, turn {list(turn)}", place, "Give metres and degrees.")
    for problem, place, remedy in (*wrong_ranges(take), *odd_streams(take), *_odd_depth(take)):
        refuse(problem, place, remedy)


def _of_places(take: Take) -> list[tuple[str, Any]]:
    """Tables of places in space, each with the name of its kind for messages."""
    kinds = (("markers", take.markers), ("surface points", take.surface_points), ("trackers", take.trackers))
    return [(kind, table) for kind, tables in kinds for table in tables]


def _is_size(size: tuple[int, int]) -> bool:
    """Whether an image may have a size [px]."""
    return 1 <= min(size) and max(size) < 100_000


def _calibration(take: Take, entry: CalibrationEntry, refuse: Callable[[str, str, str], None]) -> None:
    """Standard deviations of cameras' poses: both, and for keypoints."""
    shift, turn = entry.position_sigma, entry.rotation_sigma
    stated, place = f"position_sigma {shift}, rotation_sigma {turn}", "[calibration]"
    if shift is None and turn is None:
        return
    if shift is None or turn is None or (min(shift, turn) <= 0 and not shift == turn == 0):
        refuse(stated, place, "Give metres and degrees above 0, or 0 and 0 for an exact calibration, or neither.")
    elif not (shift < 1 and turn < 30):
        refuse(stated, place, "Give metres below 1 and degrees below 30: a camera that far off needs calibration.")
    others = (take.silhouettes, take.markers, take.depth, take.stereo, take.lines, take.skin, take.trackers)
    if not take.keypoints and any(others):
        refuse("position_sigma and rotation_sigma are for cameras with keypoints", place, "Remove both.")


def _pose(take: Take, pose: StartEntry, refuse: Callable[[str, str, str], None]) -> None:
    """Refuse a start that is none."""
    if take.start is not None:
        refuse("[start] has no use with start = ... in [take]", "[start]", "Remove one of the two.")
    up = np.array(pose.upward or UP_AXES[take.up], float)
    if pose.at is None or pose.forward is None:
        return refuse("no `at` and `forward`", "[start]", "Give both; clicks alone need none, and no other key.")
    numbers = np.concatenate([pose.at, pose.forward, up, list(pose.angles.values())])
    if not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e6:
        refuse("numbers are not a position, direction or angle", "[start]", "Give metres, directions and degrees.")
    lengths = float(np.linalg.norm(pose.forward)) * float(np.linalg.norm(up))
    if not float(np.linalg.norm(np.cross(pose.forward, up))) > 1e-6 * max(lengths, 1e-12):
        refuse(
            f"forward = {list(pose.forward)} and upward = {up.tolist()} are along one line", "[start]",
            "Give two directions that differ: where the root's x and y look in the world.",
        )  # fmt: skip


def _odd_depth(take: Take) -> Iterator[tuple[str, str, str]]:
    """Numbers of depth sensors and stereo pairs that cannot be: problem, place, remedy."""
    for entry in take.depth:
        place = f"depth {entry.name}"
        if not 0 < entry.sigma < 1 or not abs(entry.time_offset) < 1e6:
            yield f"sigma {entry.sigma} m, time offset {entry.time_offset} s", place, "Give metres and seconds."
        for key, value in (("unit", entry.unit), ("rate", entry.rate), ("time_unit", entry.time_unit)):
            if value is not None and not 0 < value < 1e6:
                yield f"{key} = {value:g}", place, "Give a positive number: unit in metres a count, rate in Hz."
        if entry.range is not None and not 0 <= entry.range[0] < entry.range[1]:
            yield f"range = {list(entry.range)}", place, "Give [near, far] in metres."
        if entry.size is not None and not _is_size(entry.size):
            yield f"size = {list(entry.size)}", place, "Give [width, height] in pixels."
        if entry.camera is not None and take.calibration is None:
            yield f"camera = {entry.camera}, but no [calibration]", place, "Add one, or give intrinsics."
        if entry.distortion and entry.intrinsics is None:
            yield "distortion without intrinsics", place, "Write intrinsics = [fx, fy, cx, cy] too."
        if entry.intrinsics is not None and not all(v > 0 for v in entry.intrinsics[:2]):
            yield f"intrinsics = {list(entry.intrinsics)}", place, "Give [fx, fy, cx, cy] in pixels."
    for pair in take.stereo:
        if not (0 < pair.range[0] < pair.range[1] and 0 < pair.sigma < 100):
            yield (
                f"range {list(pair.range)} m, sigma {pair.sigma} px", f"stereo {pair.name}",
                "Give [near, far] in metres, nearer than far, and pixels.",
            )


def _uses(take: Take) -> None:
    """Refuse a key that means nothing with the entry's format."""
    given = {"keypoints": (*take.keypoints, *take.skin), "silhouette": take.silhouettes}
    for table, entries in given.items():
        for entry in entries:
            for key, formats in _ONLY[table].items():
                if getattr(entry, key) not in (None, ()) and entry.format not in formats:  # type: ignore[attr-defined]
                    raise TakeError(
                        f"'{key}' has no use with format = \"{entry.format}\"", file=take.path,  # type: ignore[attr-defined]
                        place=f"{table} of camera {entry.camera}",  # type: ignore[attr-defined]
                        remedy=f"Remove it; it is for {', '.join(formats)}.",
                    )  # fmt: skip


def _names(take: Take) -> None:
    """Names within the take agree, and there is something to see."""
    shapes, places = (*take.silhouettes, *take.regions), _of_places(take)
    if not (take.cameras or take.keypoints or take.skin or take.depth or places or shapes):
        remedy = "Add [[camera]] with [[keypoints]], [[depth]], or [[markers]]."
        raise TakeError("an empty take: it names no sensor", file=take.path, remedy=remedy)
    names = [entry.name for entry in take.cameras]
    sensors = [*names, *(entry.name for entry in take.depth), *(entry.name for entry in take.stereo)]
    for name in sensors:
        if sensors.count(name) > 1:
            kind = "camera" if name in names else "depth" if any(d.name == name for d in take.depth) else "stereo"
            raise TakeError("two have this name", file=take.path, place=f"{kind} {name}", remedy="Rename one.")
    named = [("keypoints", k.camera) for k in (*take.keypoints, *take.skin)]
    named += [("silhouette", s.camera) for s in take.silhouettes] + [("region", r.camera) for r in take.regions]
    named += [("lines", e.camera) for e in take.lines]
    for kind, camera in named:
        if camera not in names:
            raise TakeError(
                choices("camera", camera, names), file=take.path, place=f"{kind} of camera {camera}",
                remedy=f'Add [[camera]] with name = "{camera}", or correct the name.',
            )
    beside = (places, take.depth, take.stereo)  # of a world in which its place is not known
    if take.cameras and take.calibration is None and any(beside):
        remedy = 'Add [calibration] with file = "...". Only a take of nothing but videos of people needs none.'
        raise TakeError("cameras without calibration", file=take.path, remedy=remedy)
    for entry in take.cameras:
        angle, place = entry.field_of_view, f"camera {entry.name}"
        if angle is not None and take.calibration is not None:
            problem = "field_of_view has no use with a calibration"
            raise TakeError(problem, file=take.path, place=place, remedy="Remove it: the calibration states it.")
        if angle is not None and not 5.0 <= angle <= 150.0:
            problem = f"field_of_view {angle:g}"
            raise TakeError(problem, file=take.path, place=place, remedy="Give degrees from 5 to 150.")
    for pair in take.stereo:
        for side in (pair.left, pair.right):
            if not any(entry.name == side and entry.video is not None for entry in take.cameras):
                raise TakeError(
                    choices("camera with a video", side, [e.name for e in take.cameras if e.video is not None]),
                    file=take.path, place=f"stereo {pair.name}", remedy="Name two [[camera]] that have a video.",
                )  # fmt: skip
        if pair.left == pair.right:
            raise TakeError("left and right are one camera", file=take.path, place=f"stereo {pair.name}")
    videos = [entry.name for entry in take.cameras if entry.video is not None]
    seen = [("silhouette", s.camera) for s in take.silhouettes if s.format in ("background", "threshold")]
    seen += [("region", r.camera) for r in take.regions]
    for kind, camera in [*seen, *(("keypoints", k.camera) for k in take.skin)]:
        if camera not in videos:
            raise TakeError(
                choices("camera with a video", camera, videos), file=take.path,
                place=f"{kind} of camera {camera}", remedy="Give the [[camera]] its video.",
            )  # fmt: skip
    for kind, several in (("silhouettes", take.silhouettes), ("regions", take.regions)):
        for camera in repeated(s.camera for s in several):  # type: ignore[attr-defined]
            raise TakeError(f"two {kind}", file=take.path, place=f"camera {camera}", remedy="Remove one.")
    inputs: list[tuple[object, ...]] = [
        (f"keypoints of camera {k.camera}", k.file, k.format, k.frames, k.set == FACE_SET)
        for k in (*take.keypoints, *take.skin)
    ]
    inputs += [(f"markers {m.file.name}", m.file, m.set) for m in take.markers]
    inputs += [(f"surface points {p.file.name}", p.file) for p in take.surface_points]
    inputs += [(f"trackers {p.file.name}", p.file, sorted(p.points)) for p in take.trackers]
    for one in inputs:
        if inputs.count(one) > 1:
            remedy = "Remove one: a file named twice would count twice."
            raise TakeError("the same file twice", file=take.path, place=str(one[0]), remedy=remedy)
    of_one = [(f"camera {c.name}", c.name, c.video) for c in take.cameras if c.video is not None]
    of_one += [(f"keypoints of camera {k.camera}", k.camera, k.file) for k in take.keypoints
               if k.file is not None and k.format != "caliscope"]  # fmt: skip
    for place, camera, file in of_one:
        others = [other for _, other, same in of_one if same == file and other != camera]
        if others:
            problem = f"{file.name} is also the file of camera {others[0]}"
            raise TakeError(problem, file=take.path, place=place, remedy="Give each camera its own file.")
    alone = [entry.name for entry in take.depth if entry.intrinsics is not None]
    if alone and (take.calibration is not None or len(take.depth) > 1):
        raise TakeError(
            "intrinsics alone do not give a sensor's pose relative to the others", file=take.path,
            place=f"depth {alone[0]}", remedy="Put its intrinsics and its pose into the calibration, and not here.",
        )  # fmt: skip


def _files(take: Take) -> None:
    """Every file that the take names is there."""
    named: list[tuple[str, Path | None]] = [("[calibration] file", take.calibration.file if take.calibration else None)]
    named += [(f"camera {entry.name}, video", entry.video) for entry in take.cameras]
    named += [(f"keypoints of camera {entry.camera}", entry.file) for entry in take.keypoints]
    named += [(f"silhouette of camera {entry.camera}", entry.file) for entry in take.silhouettes]
    named += [(f"lines of camera {entry.camera}", entry.file) for entry in take.lines]
    named += [("[start] clicks", take.clicks)]
    named += [("[take] subject", take.subject), ("[take] start", take.start), ("[session] norms", take.session.norms)]
    named += [(kind, table.file) for kind, table in _of_places(take)]
    named += [(f"markers {entry.file.name}, model", entry.model) for entry in take.markers]
    named += [("[take] body", Path(take.body) if take.body.endswith((".toml", ".npz")) else None)]
    named += [(f"depth {entry.name}", entry.file) for entry in take.depth]
    named += [(f"depth {entry.name}, background", entry.background) for entry in take.depth]
    for place, file in named:
        if file is None or file.exists() or inside(file) is not None:
            continue
        if not ("*" in file.name and listed(file)):
            raise FileError(
                f"no such file or folder: {file}", file=take.path, place=place,
                remedy="Correct the path; a relative one starts at the take file.",
            )
