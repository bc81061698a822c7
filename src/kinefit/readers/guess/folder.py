"""Guess a take file from the files in a folder, with the confidence of every guess."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from kinefit._files import repeated
from kinefit.errors import CalibrationError, KinefitError, ObservationError, PluginError, TakeError, command
from kinefit.geometry.camera import Rig
from kinefit.observations.videos import DepthVideo
from kinefit.readers.depth.recordings import read_depth
from kinefit.readers.guess import files as guess_files
from kinefit.readers.guess.cameras import describe_cameras, describe_uncalibrated, guessed_intrinsics
from kinefit.readers.guess.draft import Draft, Entry, Note, Value
from kinefit.readers.guess.files import DRAWN_ON, OF_CALIBRATION, STATIC, CalibrationFile
from kinefit.readers.guess.names import COUNTED, later_chapters, trials
from kinefit.readers.markers import read_markers
from kinefit.readers.plates import read_force_file
from kinefit.readers.ros.images import Shown, mcap_rig, shown
from kinefit.readers.take.entries import TABLES
from kinefit.readers.take.kinds import KINDS, Proposal
from kinefit.readers.videos.video import ENDINGS

_CALIBRATE = (
    "Calibrate with a board (kinefit calibrate board) or, if the cameras' intrinsics are known, from the person "
    "(kinefit calibrate people); then run kinefit init again."
)


OPEN_HEIGHT = "height = 1.75  # open: the stature in metres, where you know it"
"""The commented line of a take file for the person's height."""


@dataclass(frozen=True)
class Guess:
    """The text of a take file (TOML), and a note on every guess."""

    text: str
    notes: tuple[Note, ...]


def guess_take(folder: str | PathLike[str], *, beside: str | PathLike[str] | None = None) -> Guess:
    """Make the text of a take file from the files in a folder, without writing it.

    Parameters
    ----------
    folder : path
        Searched with its subfolders; for a calibration also the parent folder.
    beside : path, optional
        Folder of the future take file, to which its paths are relative. Default: `folder`.

    Raises
    ------
    TakeError
        No such folder; no files of a take in it; files that fit no camera of the calibration.
    CalibrationError
        Videos or keypoints without a calibration.
    FileError
        A video or a recording of ROS 2 that is damaged, or of an unknown kind.
    """
    folder = Path(folder).absolute()
    if folder.is_file():
        remedy = f"Name its folder: {command('init', folder.parent)}"
        raise TakeError("a file, not a folder", file=folder, remedy=remedy)
    if not folder.is_dir():
        raise TakeError("no such folder", file=folder, remedy="Name the folder with videos, keypoints and calibration.")
    draft = Draft(folder, Path(beside).absolute() if beside else folder)
    files = guess_files.list_files(folder)
    faults: list[KinefitError] = []
    videos, markers = _recorded_videos(draft, files), guess_files.find_markers(files, faults)
    keypoints, remarks = guess_files.find_keypoints(files, faults)
    recordings = guess_files.find_recordings(files)
    for remark in remarks:
        draft.note("keypoints", "open", remark)
    for fault in faults:
        draft.note_error("files", fault)
    _describe_kinds(draft, files)
    videos = _describe_depth(draft, files, videos, alone=not (keypoints or markers or recordings))
    if not (videos or keypoints or markers or recordings or any(draft.tables.values())):
        if images := [path for path in files if path.suffix.lower() in (*ENDINGS, ".heic")]:
            such = f"{len(images)} images such as {draft.name(images[0])}"
            draft.note("files", "open", f"{such}: a recording is a video, or 12 numbered images or more")
        said = "; ".join(note.text for note in draft.notes)
        raise TakeError(
            f"no videos, keypoints, markers, depth or recordings among {len(files)} files{said and f': {said}'}",
            file=folder,
            remedy="Name a folder with videos (.mp4, .avi ...) or keypoints and a calibration, with depth images, "
            ".c3d, .trc or .mcap (ROS 2).",
        )
    if videos or keypoints:
        calibration = _choose_calibration(draft, files, videos, [k.path for k in keypoints], bool(markers))
        if calibration is not None:
            describe_cameras(draft, calibration, videos, keypoints)
    if recordings:
        describe_recordings(draft, recordings, alone=not (videos or keypoints or markers))
    used = _describe_markers(draft, markers)
    _describe_plates(draft, files, used)
    draft.comments.append(OPEN_HEIGHT)
    return Guess(draft.text(), tuple(draft.notes))


def _recorded_videos(draft: Draft, files: list[Path]) -> list[Path]:
    """The videos that begin a recording; later chapters of one, and what stands in place of a file, become notes."""
    videos = guess_files.find_videos(files, draft.folder)
    chapters = later_chapters(videos)
    for path, first in chapters.items():
        text = f"{draft.name(path)}: a later chapter of {draft.name(first)}, so one camera. Not used; join both: "
        draft.note("video", "likely", f"{text}ffmpeg -f concat -i list.txt -c copy OUT.mp4 (in it: file 'NAME')")
    for path in files:
        if problem := guess_files.stand_in(path):
            draft.note("files", "open", f"{draft.name(path)}: {problem}")
    return [path for path in videos if path not in chapters]


def _describe_depth(draft: Draft, files: Sequence[Path], videos: Sequence[Path], *, alone: bool) -> list[Path]:
    """Enter depth of folders and of tracks in videos; returns the videos that are colour alone.

    Beside no other sensor the world is that of the first depth camera; beside others depth is a comment.
    """
    found, single = guess_files.find_depth(files)
    colour, seen = [path for path in videos if path not in found], list[DepthVideo]()
    for path in single:
        draft.note("depth", "open", f"{draft.name(path)}: one depth image, not a recording: one pose, without motion")
    pictures = [path for path in single if path.suffix != ".npy"]  # which may be any table
    for path in found or (pictures[:1] if alone and not colour else []):
        try:
            video, rate = _depth_of(path)
        except KinefitError as error:
            draft.note("depth", "open", f"{draft.name(path)}: not used as depth: {error.problem}. {error.remedy or ''}")
            continue
        seen.append(video)
        is_used = alone and not colour and len(seen) == 1
        why = f"{len(video)} depth image{'s' * (len(video) > 1)} of {video.size[0]}x{video.size[1]} px"
        entry = {"name": Value(path.stem), "file": Value(path, "likely", why)} | rate
        if video.camera is None:
            entry["intrinsics"] = guessed_intrinsics(Path(draft.folder.name) / draft.name(path), video.size)
            if is_used:
                draft.note_value("intrinsics", entry["intrinsics"], "intrinsics")
        draft.tables["depth"].append((is_used, entry))
        aside = "" if is_used else "; a comment, its pose among the other sensors is not stated"
        for text in (f"{draft.name(path)}: {why}{aside}", *video.notes):
            draft.note(f"depth {path.stem}", "likely", text)
        if is_used:
            draft.head["up"] = draft.note_value("up", _up(None), "up")
    return colour


def _depth_of(path: Path) -> tuple[DepthVideo, dict[str, Value]]:
    """A recording of depth, and its entry `rate` where no file states one."""
    try:
        return read_depth(path, default_rate=None), {}
    except ObservationError:
        video = read_depth(path)
        return video, {"rate": Value(video.rate, "guess", "that of nearly every depth camera: its files state none")}


def _describe_kinds(draft: Draft, files: Sequence[Path]) -> None:
    """Enter what kinds of sensors find among files; a plug-in that fails becomes a note."""
    for table in KINDS.names():
        try:
            KINDS.refuse_shadows(table, TABLES)
            kind, valid = KINDS.get(table), lambda found: all(isinstance(one, Proposal) and one.entry for one in found)
            found = kind.call("propose", files, valid=valid, what="proposals with an entry") if kind.propose else []
        except PluginError as error:
            draft.note_error(table, error)
            continue
        for one in found:
            (key, first), *more = one.entry.items()
            entry = {key: draft.note_value(table, Value(first, "likely", one.reason), key)}
            entry |= {name: Value(value) for name, value in more}
            draft.tables.setdefault(table, []).append((one.used, entry))
            draft.kinds[table] = kind.comment


def _choose_calibration(
    draft: Draft, files: list[Path], videos: list[Path], keypoints: list[Path], markers: bool
) -> CalibrationFile | None:
    """The calibration that most files fit; from the parent folder if there is none here; None without one."""
    found, singles, faults = guess_files.find_calibrations(files, videos, draft.folder)
    for error in [fault for fault in faults if isinstance(fault, PluginError)]:
        draft.note_error("calibration", error)
        faults.remove(error)
    if not found:
        found = guess_files.find_calibrations(_above(draft.folder), videos, draft.folder)[0]
    if not found and markers:
        draft.note("calibration", "open", f"none, so videos and keypoints are not used. {_CALIBRATE}")
        return None
    if not found and faults:
        fault = faults[0]
        raise CalibrationError(
            f"no calibration can be used: {fault.problem}", file=fault.file, place=fault.place,
            remedy=f"{fault.remedy or ''} {_CALIBRATE}".strip(),
        )
    if not found:
        if videos and (not keypoints or len(videos) == 1):
            for path in keypoints:
                draft.note("keypoints", "open", f"{draft.name(path)}: not used without a calibration of its camera")
            if singles:
                draft.note("calibration", "open", f"{draft.name(singles[0])} has one camera only: not used")
            describe_uncalibrated(draft, _of_one_moment(draft, videos))
            return None
        alone = f" ({draft.name(singles[0])} has one camera only)" if singles else ""
        raise CalibrationError(f"no calibration of the cameras{alone}", file=draft.folder, remedy=_CALIBRATE)

    def fitting(c: CalibrationFile) -> int:
        return max((len(t.files) for t in trials([*videos, *keypoints], draft.folder, c.rig.names)[0]), default=0)

    def rank(c: CalibrationFile) -> tuple[int, bool, int, str]:
        return -fitting(c), not c.is_refined, len(Path(draft.name(c.path)).parts), c.path.name

    best, *others = sorted(found, key=rank)
    why = f"{len(best.rig)} cameras: {', '.join(best.rig.names)}"
    if others:
        draft.others = [c.path for c in others]
        reason = (
            "more files fit its cameras" if fitting(best) > fitting(others[0])
            else "its name says that it was refined" if best.is_refined > others[0].is_refined
            else "it is nearer to the folder"
        )  # fmt: skip
        why += f"; chosen over {', '.join(map(draft.name, draft.others))}: {reason}"
    file = Value(best.path, "likely" if others else "sure", why)
    draft.note("calibration", file.sure, f"{draft.name(best.path)}: {why}")
    if best.sized:
        draft.note("calibration", "likely", f"no image size of {', '.join(best.sized)}: that of the video is used")
    draft.calibration = best, {"file": file}
    return best


def _of_one_moment(draft: Draft, videos: Sequence[Path]) -> dict[str, Path]:
    """{camera: video} of those nearest to the folder, without static trials, calibrations and overlays of a detector.

    Raises
    ------
    TakeError
        Two videos of one name.
    """
    moving = [v for v in videos if not any(p.search(draft.name(v)) for p in (STATIC, DRAWN_ON, OF_CALIBRATION))]
    moving = moving or list(videos)
    depth = min(draft.name(path).count("/") for path in moving)
    moving = [path for path in moving if draft.name(path).count("/") == depth]
    folders = list(dict.fromkeys(path.parent for path in moving))
    if len(folders) > 1 and all(COUNTED.fullmatch(path.stem) for path in moving):  # cameras count their own files
        first = {folder.name: next(path for path in moving if path.parent == folder) for folder in folders}
        for path in (path for path in moving if path not in first.values()):
            draft.note("video", "guess", f"{draft.name(path)}: a later recording; kinefit init on its own folder")
        return first
    if twice := repeated(path.stem for path in moving):
        both = [draft.name(path) for path in moving if path.stem == twice[0]]
        problem = f"two videos are called {twice[0]}: {both[0]} and {both[1]}"
        remedy = "Name the folder of one recording, with one video of each camera."
        raise TakeError(problem, file=draft.folder, remedy=remedy)
    return {path.stem: path for path in moving}


def _above(folder: Path) -> list[Path]:
    """Files in the parent of a folder, and in its subfolders with "calib" in their name."""
    out: list[Path] = []
    for path in sorted(folder.parent.iterdir()):
        inside = sorted(path.iterdir()) if path.is_dir() and "calib" in path.name.lower() else [path]
        out += [file for file in inside if file.is_file()]
    return out


def _describe_markers(draft: Draft, files: Sequence[Path]) -> Path | None:
    """Enter marker files: in use without cameras, else as comments (they may be another program's results).

    Returns the file in use.
    """
    faults: list[KinefitError] = []
    records = {}
    for path in files:
        try:
            records[path] = read_markers(path)
        except KinefitError as error:
            faults.append(error)
            draft.note("markers", "open", f"{draft.name(path)} not used: {error.problem}")
    if faults and not records and not draft.cameras:
        raise TakeError(
            f"no marker file can be read: {faults[0].problem}", file=faults[0].file, remedy=faults[0].remedy
        )
    moving = [path for path in records if not STATIC.search(path.name)]
    used = next(iter(moving or records), None) if not draft.cameras else None
    still = next((path for path, record in records.items() if moving and used and path not in moving
                  and {*record.names} & {*records[used].names}), None)  # fmt: skip
    for path, record in records.items():
        file = Value(path, "sure", f"{len(record.names)} markers, {len(record.positions)} frames, {record.rate:g} Hz")
        trial = {"static": Value(still, "guess", "by its name, of the same person")} if path == used and still else {}
        draft.tables["markers"] += [(path == used, {"file": file} | trial)] if path != still else []
        for text in record.notes:
            draft.note("markers", "open", text)
    if used is not None:
        record = records[used]
        shown = record.positions[np.isfinite(record.positions[..., 0]).any(axis=1)]
        extent = np.median(np.nanmax(shown, 1) - np.nanmin(shown, 1), axis=0)
        up = Value("xyz"[int(np.nanargmax(extent))], "likely", f"markers spread {np.nanmax(extent):.2f} m along it")
        up = Value(record.up, "sure", "stated by the file") if record.up else up
        draft.head = {"rate": Value(record.rate, "sure", "of the markers"), "up": draft.note_value("up", up, "up")}
        draft.note("markers", "sure" if len(records) == 1 else "guess", f"{draft.name(used)}: used")
        if still:
            draft.note("markers", "guess", f"{draft.name(still)}: the static trial, for lengths and marker offsets")
    left = len(records) - (used is not None) - (still is not None)
    if left:
        reason = "results of other programs, or" if draft.cameras else ""
        draft.note("markers", "guess", f"{left} files are comments: {reason} other recordings".replace("  ", " "))
    plates = records[used].plates if used is not None else ()
    if plates:
        draft.note("plates", "sure", f"{len(plates)} force plates come with {draft.name(used or draft.folder)}")
    return None if plates else used


def _describe_plates(draft: Draft, files: Sequence[Path], markers: Path | None) -> None:
    """Enter ground forces beside the markers in use, where their file has none: of the same name, or the only ones."""
    forces = {}
    for path in files if markers is not None else ():
        if path.suffix.lower() in (".mot", ".sto"):
            with suppress(KinefitError):  # a table of angles
                forces[path] = read_force_file(path).plates
    trials = [path for path in files if path.suffix.lower() in (".trc", ".c3d")]
    of_trial = {
        path: max((t for t in trials if re.fullmatch(rf"{re.escape(t.stem)}(\W|_|$).*", path.stem)),
                  key=lambda t: len(t.stem), default=None)
        for path in forces
    }  # fmt: skip
    named = [path for path in forces if of_trial[path] == markers]
    for path, plates in forces.items():
        alone = len(forces) == 1 and of_trial[path] is None
        is_used = path in named[:1] or alone
        why = f"{len(plates)} force plates, {plates[0].rate:g} Hz" + (", the only forces here" if alone else "")
        sure = "guess" if alone else "likely"
        draft.tables["plate"].append((is_used, {"file": Value(path, sure, why)}))
        draft.note("plates", sure, f"{draft.name(path)}: ground forces{'' if is_used else ', as a comment'}")


_ALIGNED = "aligned"  # in the name of a topic with the same depth, warped to another camera


def describe_recordings(draft: Draft, paths: Sequence[Path], *, alone: bool) -> None:
    """Enter the first of some recordings, topic by topic; if other files are there, only add remarks.

    Raises
    ------
    TakeError
        A recording without images.
    FileError
        A damaged recording; the extra `ros` is not installed.
    """
    path, *others = paths
    if not alone:
        text = "not used with the other files; alone in a folder, kinefit init enters its topics"
        for recording in paths:
            draft.note("recording", "open", f"{draft.name(recording)}: {text}")
        return
    for other in others:
        draft.note("recording", "open", f"{draft.name(other)}: not used, {draft.name(path)} is larger")
    topics = shown(path)
    if not topics:
        remedy = "Record depth (16UC1, 32FC1) or colour images of the cameras."
        raise TakeError("no topic of it has two images that can be read", file=path, remedy=remedy)
    depth, colour = [t for t in topics if t.deep], [t for t in topics if not t.deep]
    rig = _calibration(draft, path)
    first = (depth or colour)[0]
    draft.head["rate"] = draft.note_value("rate", Value(first.rate, "sure", f"of {first.topic}"), "rate")
    draft.head["up"] = draft.note_value("up", _up(rig), "up")
    _depth(draft, path, depth, rig)
    _colour(draft, path, colour, rig, beside_depth=bool(depth))


def _calibration(draft: Draft, path: Path) -> Rig | None:
    """The cameras' rig from the recording; None if it has none that can be used."""
    try:
        rig = mcap_rig(path)
    except CalibrationError as error:
        draft.note_error("calibration", error)
        return None
    why = f"{len(rig)} cameras: {', '.join(rig.names)}"
    draft.calibration = CalibrationFile(path, rig), {"file": Value(path, "sure", why)}
    draft.note("calibration", "sure", f"{draft.name(path)}: {why}")
    return rig


def _up(rig: Rig | None) -> Value:
    if rig is not None and len(rig) > 1:
        return Value("z", "likely", "worlds of ROS are z up (REP 103)")
    return Value("-y", "guess", "the world is the camera's frame, assumed level: y points down")


def _depth(draft: Draft, path: Path, topics: Sequence[Shown], rig: Rig | None) -> None:
    plain = [t for t in topics if _ALIGNED not in t.topic] or list(topics)
    placed = [t for t in plain if rig is not None and t.camera in rig.names]
    used = placed or plain[:1]
    for t in topics:
        count = f"{t.frames} images, {t.rate:g} Hz"
        entry: dict[str, Value] = {"name": Value(t.name), "file": Value(path), "topic": Value(t.topic, "sure", count)}
        if t.camera is None:
            entry["intrinsics"] = Value(None, "open", "[fx, fy, cx, cy] in pixels: the topic has no camera_info")
        draft.tables["depth"].append((t in used, entry))
        why = "" if t in used else (
            ": a comment, the same images again" if t not in plain else ": a comment, its pose is unknown"
        )  # fmt: skip
        draft.note(f"depth {t.name}", "sure" if t in used else "guess", f"{t.topic}, {count}{why}")


def _colour(draft: Draft, path: Path, topics: Sequence[Shown], rig: Rig | None, *, beside_depth: bool) -> None:
    for t in topics:
        if rig is None or t.camera not in rig.names:
            draft.note("camera", "open", f"{t.topic}: not used, its lens and pose are unknown")
            continue
        draft.cameras[t.name] = {
            "video": Value(path), "topic": Value(t.topic, "sure", f"{t.frames} images, {t.rate:g} Hz"),
        }  # fmt: skip
        draft.note(f"camera {t.name}", "sure", t.topic)
        if beside_depth:
            entry: Entry = {"camera": Value(t.name), "format": Value("detect", "open", "keypoints besides depth")}
            draft.tables["keypoints"].append((False, entry))
    if draft.cameras and not beside_depth:
        draft.note("keypoints", "sure", "none here: kinefit track runs the built-in detector on the videos")
