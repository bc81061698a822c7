"""Guess the cameras of a take: their videos and image frames, rate, unit of length and vertical axis.

Nominal lenses of depth cameras, by the names of folders and the size of the image.
"""

from __future__ import annotations

import re
import struct
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import KinefitError, ObservationError, TakeError
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.observations import Keypoints
from kinefit.observations.clocks import frame_times, is_even, on_steps, steps_of
from kinefit.readers.guess import views as guess_views
from kinefit.readers.guess.draft import Draft, Value
from kinefit.readers.guess.files import DRAWN_ON, OF_CALIBRATION, STATIC, CalibrationFile, KeypointFile
from kinefit.readers.guess.names import HOW, Trial, trials
from kinefit.readers.take.cameras import DEFAULT_FIELD_OF_VIEW, turned_frame
from kinefit.readers.take.checks import ONE_CAMERA
from kinefit.readers.videos.video import Video, common_frames
from kinefit.readers.videos.video_files import stated_time_code

UNSTATED = 1.0  # [Hz] of files without a rate, until the user states it
_MIN_SPREAD = 0.2  # [m] of the cameras from their centre: a desk
_MAX_SPREAD = 15.0  # [m] of the cameras from their centre: a sports hall


def describe_cameras(
    draft: Draft, calibration: CalibrationFile, videos: Sequence[Path], keypoints: Sequence[KeypointFile]
) -> None:
    """Enter the cameras with their videos and keypoints, and everything that follows from these.

    Raises
    ------
    TakeError
        Neither videos nor keypoints fit a camera of the calibration.
    """
    rig = calibration.rig
    trials_only = [path for path in videos if not OF_CALIBRATION.search(draft.name(path))]
    chosen = _choose_recording(draft, trials_only if trials_only or keypoints else videos, rig)
    with ExitStack() as stack:
        files = chosen.files if chosen else {}
        opened = {name: stack.enter_context(Video(path, rate=UNSTATED)) for name, path in files.items()}
        length = min(map(len, opened.values()), default=0)
        sources = guess_views.keypoint_sources(draft, keypoints, rig, length, chosen.place if chosen else "")
        records = guess_views.read_sources(draft, sources)
        names = [name for name in rig.names if name in opened or any(name in record for record in records)]
        if not names:
            raise _nothing_fits(draft, calibration, found=bool(sources))
        draft.head["rate"] = draft.note_value("rate", _rate(draft, opened, records), "rate")
        rate = max((video.rate for video in opened.values()), default=UNSTATED)
        clocks = _clocks(opened, records, rate)
        records = _on_steps(records, clocks, opened, rate)
        first = next((record for record in records if record), {})
        sizes = {name: video.size for name, video in opened.items()}
        for name, entry in _time_codes(draft, opened).items():
            draft.cameras.setdefault(name, {}).update(entry)
        images = _pictures(draft, rig, names, opened, chosen, guess_views.guess_turn(rig, first, sizes))
        shown: dict[str, ImageFrame] = {}
        entries = []
        for source, record in zip(sources, records):
            frame = guess_views.keypoint_frame(rig, record, images, sizes)
            if frame is not None and frame.sure == "guess":
                same = [k for k in keypoints if k.format == next(iter(source.values())).format]
                frame = _frame_of_static(draft, calibration, videos, same) or frame
            if record is first and frame is not None and frame.value == "video":
                shown = images
            entries.append((source, record, frame))
        _world(draft, calibration, first, shown)
        _cut(draft, clocks, rate)
        for source, record, frame in entries:
            guess_views.keypoint_entries(draft, source, record, frame, images, active=record is first)
    if len(names) == 1:
        lifted = names[0] in opened and not first
        consequence = "the built-in detector estimates depth" if lifted else ONE_CAMERA
        draft.note("cameras", "likely" if lifted else "open", f"{names[0]} alone: {consequence}")
    if missing := [name for name in rig.names if name not in names]:
        draft.note("cameras", "sure", f"{', '.join(missing)} of the calibration: no file here fits, not used")
    if opened and not first:
        draft.note("keypoints", "sure", "none here: kinefit track runs the built-in detector on the videos")


def describe_uncalibrated(draft: Draft, videos: Mapping[str, Path]) -> None:
    """Enter the cameras of a folder with videos {camera: path} and no calibration."""
    with ExitStack() as stack:
        opened = {name: stack.enter_context(Video(path, rate=UNSTATED)) for name, path in videos.items()}
        draft.head["rate"] = draft.note_value("rate", _rate(draft, opened, []), "rate")
        counts = {name: f"{len(video)} frames" for name, video in opened.items()}
        for one in opened.values():
            if len(one) == 1:
                draft.note("video", "open", f"{draft.name(one.path)}: one frame: one pose, without motion")
            if one.size[0] == 2 * one.size[1]:
                text = "twice as wide as high, as 360° videos: export a flat view; telephones of 18:9 look the same"
                draft.note("video", "open", f"{draft.name(one.path)}: {text}")
    more = "10 % wider places people 10 % nearer" if len(opened) == 1 else "kinefit track estimates it with the poses"
    why = f"degrees across the longer side; {DEFAULT_FIELD_OF_VIEW:g} is typical of telephones; {more}"
    offsets = _time_codes(draft, opened)
    for name, path in videos.items():
        video = Value(path, "likely", counts[name]) if len(videos) > 1 else Value(path)
        wide = Value(DEFAULT_FIELD_OF_VIEW, "guess", why)
        if (stated := stated_focal_length(path)) is not None:
            whence = f"degrees across the longer side; the file states a lens of {stated:g} mm; {more}"
            wide = Value(round(field_of_view(stated), 1), "likely", whence)
        draft.cameras[name] = {"video": video, "field_of_view": wide, **offsets.get(name, {})}
    if len(videos) == 1:
        alone = f"{draft.name(*videos.values())} alone: a network estimates depth; state height"
        draft.note("camera", "likely", alone)
        return
    draft.head["up"] = Value("z", "sure", "found with the floor, from the people in view")
    listed = ", ".join(map(draft.name, videos.values()))
    draft.note("cameras", "likely", f"{len(videos)} videos of one moment: {listed}")
    found = "none here: kinefit track finds lenses, poses and clocks from the people in view"
    draft.note("calibration", "guess", found)


def _time_codes(draft: Draft, opened: Mapping[str, Video]) -> dict[str, dict[str, Value]]:
    """{camera: its `time_offset`} by the time codes of all videos; none where they are equal, or one lacks it."""
    found = {name: stated_time_code(video.path, video.rate) for name, video in opened.items()}
    codes = {name: code for name, code in found.items() if code is not None}
    late = np.ptp([start for start, _ in codes.values()]) if codes else 0.0
    if len(codes) < len(opened) or not late:
        return {}
    if late > (shortest := min(float(video.times[-1]) for video in opened.values())):
        text = f"time codes {late:.6g} s apart, of videos of {shortest:.3g} s: not used, as clocks never set"
        draft.note("clocks", "open", text)
        return {}
    draft.note("clocks", "likely", "time_offset of each camera by its time code; clocks never set look the same")
    first = min(start for start, _ in codes.values())
    why = "its time code "
    return {name: {"time_offset": Value(start - first, "likely", why + code)} for name, (start, code) in codes.items()}


def _nothing_fits(draft: Draft, calibration: CalibrationFile, *, found: bool) -> TakeError:
    """Make the error of a folder whose files do not fit its calibration."""
    names = ", ".join(calibration.rig.names)
    remedy = f"Name each file, or its folder, after its camera: {names}."
    if found:  # keypoints are there, but none can be read
        remedy = "; ".join(note.text for note in draft.notes if note.about.startswith("keypoints"))
    problem = "neither videos nor keypoints can be used with the cameras of the calibration"
    return TakeError(problem, file=draft.folder, place=draft.name(calibration.path), remedy=remedy)


def _clocks(
    opened: Mapping[str, Video], records: Sequence[Mapping[str, Keypoints]], rate: float
) -> dict[str, NDArray]:
    """{stream: (N,) [s]} times of the frames of the videos, and of the keypoints of the first detector."""
    out = {f"video {name}": video.times for name, video in opened.items()}
    for name, record in next((record for record in records if record), {}).items():
        video = opened.get(name)
        own, clock = (video.rate, video.times) if video else (rate, None)
        out[f"keypoints {name}"] = frame_times(len(record), own, clock)
    return out


def _on_steps(
    records: Sequence[dict[str, Keypoints]], clocks: Mapping[str, NDArray], opened: Mapping[str, Video], rate: float
) -> list[dict[str, Keypoints]]:
    """Keypoints interpolated to common times, if the times of the videos differ."""
    if all(is_even(times, rate) for times in clocks.values()):
        return list(records)
    stop = min(steps_of(times, rate)[1] for times in clocks.values())

    def stepped(name: str, k: Keypoints) -> Keypoints:
        video = opened.get(name)
        return on_steps(k, frame_times(len(k), video.rate, video.times), rate, (0, stop)) if video else k

    return [{name: stepped(name, k) for name, k in record.items()} for record in records]


def _cut(draft: Draft, clocks: Mapping[str, NDArray], rate: float) -> None:
    """Enter the frames that all streams share, if they differ in length."""
    try:
        common_frames(clocks, rate)
    except ObservationError:
        lengths = sorted({steps_of(times, rate)[1] for times in clocks.values()})
        listed = ", ".join(map(str, lengths))
        frames = Value((0, lengths[0]), "guess", f"streams of {listed} frames, assumed to start together")
        draft.head["frames"] = draft.note_value("frames", frames, "frames")


def _frame_of_static(
    draft: Draft, calibration: CalibrationFile, videos: Sequence[Path], keypoints: Sequence[KeypointFile]
) -> Value | None:
    """Image frame of a detector's keypoints from a static trial, in which they are most accurate; None without one."""
    still = [path for path in videos if STATIC.search(draft.name(path))]
    points = [k for k in keypoints if STATIC.search(draft.name(k.path))]
    if not (still and points) or len(still) == len(videos):
        return None
    aside = Draft(draft.folder, draft.beside)
    try:
        describe_cameras(aside, calibration, still, points)
    except KinefitError:
        return None
    found = next((entry["frame"] for _, entry in aside.tables["keypoints"] if "frame" in entry), None)
    if found is None or found.sure == "guess":
        return None
    return Value(found.value, "likely", f"as in the static trial, where {found.why}")


def _choose_recording(draft: Draft, paths: Sequence[Path], rig: Rig) -> Trial | None:
    """Choose the videos of one recording; add remarks on all others.

    In order of priority: no static trial, without a detector's overlay, most cameras, nearest to the folder, largest.
    """
    sizes: dict[Path, object] = {}
    wanted = {camera.name: camera.size for camera in rig}
    if len(set(wanted.values())) == len(rig):
        for path in paths:
            with Video(path, rate=UNSTATED) as video:
                sizes[path] = video.size
    found, left = trials(paths, draft.folder, rig.names, sizes, wanted)
    for path in left:
        draft.note("video", "open", f"{draft.name(path)} fits no camera of the calibration: not used")

    def rank(trial: Trial) -> tuple[bool, bool, int, int, int]:
        size = sum(path.stat().st_size for path in trial.files.values() if path.exists())
        drawn, deep = bool(DRAWN_ON.search(trial.place)), trial.place.count("/")
        return bool(STATIC.search(trial.place)), drawn, -len(trial.files), deep, -size

    found = sorted(found, key=rank)
    if len(found) > 1:
        draft.note("video", "guess", f"{found[0].place}: used, the first or largest of {len(found)} recordings")
    for trial in found[1:]:
        still = bool(STATIC.search(trial.place))
        drawn = "another recording, or a detector's overlay" if DRAWN_ON.search(trial.place) else "another recording"
        what = "a static trial" if still else drawn
        draft.note("video", "likely" if still else "guess", f"{trial.place}: {what}; kinefit init on its own folder")
        if still:
            draft.comments.append(
                f"subject = \"...\"  # open: take of the static trial {trial.place}, for its bone lengths"
            )
    return found[0] if found else None


def _pictures(
    draft: Draft, rig: Rig, names: Sequence[str], opened: dict[str, Video], chosen: Trial | None, turn: Value
) -> dict[str, ImageFrame]:
    """Enter each camera's video and image frame; returns the frames that differ from the calibration's."""
    images = {}
    for name in names:
        entry = draft.cameras.setdefault(name, {})
        if name not in opened or chosen is None:
            continue
        video, (sure, why) = opened[name], HOW[chosen.how]
        entry["video"] = Value(video.path, sure, f"{why}; {len(video)} frames")
        draft.note(f"camera {name}", sure, f"{draft.name(video.path)}: found {why}")
        relation = guess_views.picture(rig[name].size, video, turn)
        for key, value in relation.items():
            entry[key] = draft.note_value(f"camera {name}", value, key)
        if relation:
            image = str(relation["image"].value) if "image" in relation else ""
            images[name] = turned_frame(rig[name].size, video.size, _turn(relation), image)
    return images


def _turn(entry: dict[str, Value]) -> int:
    return int(str(entry["rotation"].value)) if "rotation" in entry else 0


def _rate(draft: Draft, opened: Mapping[str, Video], records: Sequence[Mapping[str, Keypoints]]) -> Value:
    files = {name: video for name, video in opened.items() if video.path.is_file()}
    first = next((record for record in records if record), {})
    tables = [k.rate for k in first.values() if k.rate != UNSTATED]
    for name, video in files.items():
        if video.unevenness:
            draft.note(f"camera {name}", "likely", video.unevenness)
    if files:
        rate = max(video.rate for video in files.values())
        if all(is_even(video.times, rate) for video in files.values()):
            return Value(rate, "sure", "of the videos")
        if min(video.rate for video in files.values()) > 0.999 * rate:
            return Value(rate, "likely", "nominal, of the videos; points are interpolated between their frames")
        listed = ", ".join(f"{name} {video.rate:.4g}" for name, video in files.items())
        return Value(rate, "likely", f"the highest of the videos ({listed} Hz); points are interpolated between frames")
    if tables:
        return Value(round(min(tables), 3), "likely", "median of the table's own times")
    return Value(None, "open", "no file states the frame rate: write it")


def _world(
    draft: Draft, calibration: CalibrationFile, records: dict[str, Keypoints], images: dict[str, ImageFrame]
) -> None:
    """Enter unit and vertical axis of the calibration's world."""
    person: NDArray | None = None
    spread = calibration.spread
    size = Value(None, "open", f"the cameras would be {2 * spread:.3g} m apart, and no keypoints show a person's size")
    if _MIN_SPREAD < spread < _MAX_SPREAD:
        size = Value("m", "likely", f"the cameras are about {2 * spread:.2g} m apart")
    if len(records) > 1:
        x, _ = guess_views.meet(calibration.rig, records, images)
        points = next(iter(records.values())).names
        size, person = guess_views.guess_unit(x, points), guess_views.up_of_person(x, points)
    unit = Value(calibration.unit, "guess", "with it the cameras are some metres apart")
    if unit.value == "auto" and size.value not in (None, "m"):
        unit = size
    if unit.value != "auto" and draft.calibration:
        draft.calibration[1]["unit"] = draft.note_value("calibration", unit, "unit")
    else:
        stated = "as Qualisys defines it" if calibration.is_qualisys else "metres"
        draft.note("calibration", size.sure, f"unit: {stated}{'' if size.value else '?'}: {size.why}")
    turns = {name: _turn(entry) for name, entry in draft.cameras.items()}
    up = guess_views.guess_up(calibration.rig, person, turns, qualisys=calibration.is_qualisys)
    draft.head["up"] = draft.note_value("up", up, "up")


_KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
_VIDEO_CROP_FACTOR = 1.15  # on the stated length: a video crops the sensor, wide and stabilised (one: 32 for 27 mm)
_MAX_MOOV_BYTES = 1 << 26  # an hour at 240 Hz has a tenth
_FULL_FRAME_MM = 36.0  # longer side of the sensor


def stated_focal_length(path: Path) -> float | None:
    """Focal length [mm, full-frame equivalent] that a video file states; None if it states none."""
    try:
        with path.open("rb") as file:
            while len(head := file.read(16)) == 16:
                size, kind, long = struct.unpack(">I4sQ", head)
                file.seek(-8 if size != 1 else 0, 1)
                left = size - 8 if size != 1 else long - 16
                if kind == b"moov" and 0 < left <= _MAX_MOOV_BYTES:
                    return _value(file.read(left))
                if left < 0:
                    break
                file.seek(left, 1)
    except (OSError, struct.error, ValueError, OverflowError):  # a file that is cut or of another kind states nothing
        pass
    return None


def field_of_view(focal_length: float) -> float:
    """Field of view [deg] across the longer side of a video, from the stated focal length [mm]; good to a tenth."""
    return float(2.0 * np.degrees(np.arctan(_FULL_FRAME_MM / 2.0 / (_VIDEO_CROP_FACTOR * focal_length))))


def _value(data: bytes) -> float | None:
    """Value of `_KEY` in any `meta` of a moov box; None without one."""
    for kind, inner in _boxes(data):
        if kind in (b"trak", b"udta"):
            found = _value(inner)
        elif kind == b"meta":
            parts = dict(_boxes(inner if inner[4:8] == b"hdlr" else inner[4:]))  # QuickTime's has no version
            found = _item(parts.get(b"keys", b""), parts.get(b"ilst", b""))
        else:
            continue
        if found is not None:
            return found
    return None


def _item(keys: bytes, items: bytes) -> float | None:
    """Value of `_KEY`, from names in a `keys` box and values in an `ilst` box, numbered from 1; None without it."""
    names = [name for _, name in _boxes(keys[8:])]
    values = {int.from_bytes(kind, "big"): item for kind, item in _boxes(items)}
    if _KEY not in names or (item := values.get(names.index(_KEY) + 1)) is None:
        return None
    data = dict(_boxes(item)).get(b"data", b"")
    kind, value = int.from_bytes(data[:4], "big"), data[8:]
    if kind == 1:  # well-known types of QuickTime: text, and numbers
        number = float(value.decode("ascii", "replace"))
    elif kind in (23, 24):
        number = float(struct.unpack(">f" if kind == 23 else ">d", value)[0])
    else:
        number = float(int.from_bytes(value, "big", signed=True))
    return number if 5.0 <= number <= 500.0 else None


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(kind, content) of consecutive boxes."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        if size < 8 or at + size > len(data):
            return
        yield kind, data[at + 8 : at + size]
        at += size


_LENSES = Path(__file__).with_name("depth_cameras.toml")


def guessed_intrinsics(path: Path, size: tuple[int, int]) -> Value:
    """[fx, fy, cx, cy] [px] of a depth image: by a name in the path and the size, by a size of one kind; else open.

    Parameters
    ----------
    path : of the images, from the recording's folder on
    size : (width, height) [px]
    """
    shape = f"{size[0]}x{size[1]}"
    fitting = [one for one in tomllib.loads(_LENSES.read_text("utf-8"))["camera"] if shape in one["focal"]]
    named = [one for one in fitting if re.search(one["words"], str(path), re.IGNORECASE)]
    chosen = named or fitting
    each = [f"{one['focal'][shape]:g} ({one['name']})" for one in chosen]
    if not (named or len(chosen) == 1):
        likely = f": fx = fy = {', '.join(each)}" if each else ""
        return Value(None, "open", f"[fx, fy, cx, cy] in pixels of the depth image{likely}")
    focal = chosen[0]["focal"][shape]
    why = f"nominal, {each[0]}, by its {'name' if named else 'image size'}; the camera's own are better"
    values = [focal, focal, (size[0] - 1) / 2.0, (size[1] - 1) / 2.0]
    return Value(values, "likely" if named else "guess", why)
