"""Keypoints of a take that names none, found once and kept beside its videos."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec

from kinefit.bodies import load_body
from kinefit.errors import ObservationError
from kinefit.readers.landmarks.detections import detections_file, read_detections
from kinefit.readers.landmarks.keypoint_sets import FACE_SET
from kinefit.readers.take.entries import KeypointsEntry
from kinefit.readers.take.file import Take
from kinefit.readers.take.kinds import kinds_of
from kinefit.takes.preparing.detecting import DetectionJob, DetectionSettings, Step, Tell, detect, jobs_of_take


def warn(text: str) -> None:
    """Say something as Python does."""
    warnings.warn(text, UserWarning, stacklevel=3)


def ensure_detections(
    take: Take, *, people: int | None = None, masks: bool | None = None, force: bool = False,
    progress: Step | None = None, tell: Tell = warn,
) -> dict[str, Path]:
    """Detection files of all cameras of a take that show a person; missing ones are computed.

    With points of hands where the take's body has fingers, of faces where it has those or the take names them.

    Parameters
    ----------
    people : int, optional
        How many are followed at most; default: as it was done, or `PEOPLE`.
    masks : bool, optional
        Whether outlines are wanted; default: as it was done, or no, as they nearly double the time.
    force : bool
        Make them anew.
    progress : called with (camera, pictures done, pictures in all).

    Returns
    -------
    {camera: Path}
        For `[[keypoints]]` with format = "detect"; a camera that sees nobody is left out, with a note on stderr.

    Raises
    ------
    TakeError, ObservationError
        No camera has a video; nobody is seen by any; the extra `detect` is not installed.
    AssetError, FileError, ExportError
        What fetching the networks, reading a video and writing the file raise.
    """
    jobs = jobs_of_take(take)
    hands, face = has_fingers(take.body) or None, has_face(take.body) or any(map(_is_face, take.keypoints)) or None
    detect(jobs, DetectionSettings(people, masks, hands, face), force=force, progress=progress, tell=tell)
    return somebody(jobs, tell)


def has_fingers(name_or_file: str) -> bool:
    """Whether a body has points of hands beyond those of the pose; no for one that has neither set."""
    sets = {} if name_or_file == "anny" else load_body(name_or_file).keypoint_sets
    return "MEDIAPIPE_75" in sets and len(sets["MEDIAPIPE_75"]) > len(sets["MEDIAPIPE_33"])


def has_face(name_or_file: str) -> bool:
    """Whether a body has points of the face mesh."""
    return name_or_file != "anny" and FACE_SET in load_body(name_or_file).keypoint_sets


def _is_face(entry: KeypointsEntry) -> bool:
    return entry.format == "detect" and entry.set == FACE_SET


def with_detections(take: Take, progress: Step | None = None, tell: Tell = warn) -> Take:
    """The take with the built-in detector's keypoints where it asks for them, or has nothing but videos."""
    if not uses_detector(take):
        return take
    outlines = any(entry.format == "detect" and entry.file is None for entry in take.sensors.get("silhouette", ()))
    files = ensure_detections(take, masks=True if outlines else None, progress=progress, tell=tell)
    if take.keypoints:
        return replace(take, keypoints=tuple(_with_file(entry, take) for entry in take.keypoints))
    entries = [KeypointsEntry(camera=camera, file=file, format="detect") for camera, file in files.items()]
    if has_face(take.body):
        seen = [entry for entry in entries if entry.file and read_detections(entry.file).has_faces]
        entries += [msgspec.structs.replace(entry, set=FACE_SET) for entry in seen]
        if not seen:
            tell("No face was detected: jaw and eyes are lost. The detector needs faces of 40 px or more.")
    return replace(take, keypoints=tuple(entries))


def uses_detector(take: Take) -> bool:
    """Whether a take asks for the built-in detector's keypoints, or has nothing but videos and so gets them."""
    if any(entry.format == "detect" and entry.file is None for entry in take.keypoints):
        return True
    others = (take.depth, take.stereo, take.keypoints, take.skin, *(k.replaces_keypoints for k in kinds_of(take)))
    return any(camera.video for camera in take.cameras) and not any(others)


def _with_file(entry: KeypointsEntry, take: Take) -> KeypointsEntry:
    """An entry that names the file which the detector leaves."""
    if entry.format != "detect" or entry.file is not None:
        return entry
    return msgspec.structs.replace(entry, file=detections_file(take.path, entry.camera))


def somebody(jobs: Sequence[DetectionJob], tell: Tell = warn) -> dict[str, Path]:
    """Files of the cameras that show a person; a note names the others. ObservationError if no camera does."""
    empty = {job.camera: len(found) for job in jobs if not (found := read_detections(job.file)).seen.any()}
    remedy = "It needs at least half a body in view, taller than a tenth of the image, and enough light."
    if len(empty) == len(jobs):
        empty_videos = ", ".join(f"{camera} ({frames} images)" for camera, frames in empty.items())
        raise ObservationError(f"the detector finds no person in {empty_videos}", file=jobs[0].video, remedy=remedy)
    for camera, frames in empty.items():
        tell(f"The detector finds no person in camera {camera} ({frames} images), which is not used. {remedy}")
    return {job.camera: job.file for job in jobs if job.camera not in empty}
