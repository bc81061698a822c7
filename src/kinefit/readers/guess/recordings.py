"""Recordings of ROS 2 in a take to be: their depth, their colour images, and where their cameras stand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kinefit.errors import CalibrationError, TakeError
from kinefit.geometry.camera import Rig
from kinefit.readers.guess.draft import Draft, Entry, Told
from kinefit.readers.guess.files import CalibrationFile
from kinefit.readers.ros.contents import Shown, shown
from kinefit.readers.ros.rig import mcap_rig

_ALIGNED = "aligned"  # in the name of a topic with the same depth once more, as another camera would see it


def describe_recordings(draft: Draft, paths: Sequence[Path], *, alone: bool) -> None:
    """Enter the first of some recordings, topic by topic; beside other files they are only told of.

    Raises
    ------
    TakeError
        A recording that shows nothing.
    FileError
        A damaged one; the extra `ros` is not installed.
    """
    path, *others = paths
    if not alone:
        told = "left out beside the other files; alone in a folder, kinefit init enters its topics"
        for one in paths:
            draft.note("recording", "open", f"{draft.name(one)}: {told}")
        return
    for one in others:
        draft.note("recording", "open", f"{draft.name(one)}: left out, {draft.name(path)} is larger")
    topics = shown(path)
    if not topics:
        remedy = "Record depth (16UC1, 32FC1) or colour images of the cameras."
        raise TakeError("no topic of it has two images that can be read", file=path, remedy=remedy)
    depth, colour = [t for t in topics if t.deep], [t for t in topics if not t.deep]
    rig = _calibration(draft, path)
    first = (depth or colour)[0]
    draft.head["rate"] = draft.tell("rate", Told(first.rate, "sure", f"of {first.topic}"), "rate")
    draft.head["up"] = draft.tell("up", _up(rig), "up")
    _depth(draft, path, depth, rig)
    _colour(draft, path, colour, rig, beside_depth=bool(depth))


def _calibration(draft: Draft, path: Path) -> Rig | None:
    """Where the cameras stand, as the recording tells; None where it does not."""
    try:
        rig = mcap_rig(path)
    except CalibrationError as error:
        draft.note("calibration", "open", f"{error.problem}. {error.remedy or ''}".strip())
        return None
    why = f"{len(rig)} cameras: {', '.join(rig.names)}"
    draft.calibration = CalibrationFile(path, rig), {"file": Told(path, "sure", why)}
    draft.note("calibration", "sure", f"{draft.name(path)}: {why}")
    return rig


def _up(rig: Rig | None) -> Told:
    if rig is not None and len(rig) > 1:
        return Told("z", "likely", "worlds of ROS are z up (REP 103)")
    return Told("-y", "guess", "the world is the camera's own, taken as held level: y points down")


def _depth(draft: Draft, path: Path, topics: Sequence[Shown], rig: Rig | None) -> None:
    plain = [t for t in topics if _ALIGNED not in t.topic] or list(topics)
    placed = [t for t in plain if rig is not None and t.camera in rig.names]
    used = placed or plain[:1]
    for t in topics:
        told = f"{t.frames} images, {t.rate:g} Hz"
        entry: dict[str, Told] = {"name": Told(t.name), "file": Told(path), "topic": Told(t.topic, "sure", told)}
        if t.camera is None:
            entry["intrinsics"] = Told(None, "open", "[fx, fy, cx, cy] in pixels: no camera_info lies beside the topic")
        draft.depth.append((t in used, entry))
        why = "" if t in used else (
            ": a comment, the same once more" if t not in plain else ": a comment, nothing tells where it stands"
        )  # fmt: skip
        draft.note(f"depth {t.name}", "sure" if t in used else "guess", f"{t.topic}, {told}{why}")


def _colour(draft: Draft, path: Path, topics: Sequence[Shown], rig: Rig | None, *, beside_depth: bool) -> None:
    for t in topics:
        if rig is None or t.camera not in rig.names:
            draft.note("camera", "open", f"{t.topic}: left out, nothing tells its lens and where it stands")
            continue
        draft.cameras[t.name] = {
            "video": Told(path), "topic": Told(t.topic, "sure", f"{t.frames} images, {t.rate:g} Hz"),
        }  # fmt: skip
        draft.note(f"camera {t.name}", "sure", t.topic)
        if beside_depth:
            entry: Entry = {"camera": Told(t.name), "format": Told("detect", "open", "keypoints beside the depth")}
            draft.keypoints.append((False, entry))
    if draft.cameras and not beside_depth:
        draft.note("keypoints", "sure", "none here: kinefit track runs the built-in detector on the videos")
