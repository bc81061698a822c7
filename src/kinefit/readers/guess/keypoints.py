"""Guess the keypoints of a take: which belong to the videos, their set, their image frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from kinefit.errors import KinefitError, ObservationError
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.observations import Keypoints
from kinefit.readers.guess.draft import Draft, Value
from kinefit.readers.guess.files import STATIC, KeypointFile
from kinefit.readers.guess.names import Trial, camera_number, common_words, trials
from kinefit.readers.keypoint_sets import HAND_POINTS, OPENPOSE_HANDS, SET_OF_COUNT, SETS_WITH_HANDS
from kinefit.readers.keypoints import read_keypoints

Source = dict[str, KeypointFile]  # camera -> its file, of one detector

_AMBIGUOUS_COUNTS = (25, 25 + 2 * HAND_POINTS)  # points of BODY_25 and BODY_25B, without hands and with them
_FORMATS = ("openpose", "mediapipe", "caliscope")  # the first that is there: its confidence is the most informative
_MAX_LENGTH_ERROR = 0.1  # share of the video's frames; keypoints with a larger error are of another recording


def keypoint_sources(
    draft: Draft, found: Sequence[KeypointFile], rig: Rig, frames: int, place: str
) -> list[Source]:
    """Keypoints of each detector that belong to the videos, by their number of frames (0 without videos) and place."""
    out: list[Source] = []
    for format in _FORMATS:
        of = {k.path: k for k in found if k.format == format and k.points}
        for k in found:
            if k.format == format and not k.points:
                draft.note("keypoints", "open", f"{draft.name(k.path)}: no person in any frame, not used")
        if format == "caliscope":  # one table of all cameras
            numbered = [name for name in rig.names if camera_number(name) is not None]
            groups = [Trial(dict.fromkeys(numbered, path), "number", draft.name(path)) for path in of]
        else:
            groups = trials(list(of), draft.folder, rig.names)[0]
        groups = [trial for trial in groups if len(trial.files) > 1]
        counts = {trial.place: min(of[path].frames for path in trial.files.values()) for trial in groups}

        def rank(trial: Trial, counts: Mapping[str, int] = counts) -> tuple[bool, bool, int, int]:
            off = abs(counts[trial.place] - frames) if frames else -counts[trial.place]
            shared = -common_words(trial.place, place)
            return bool(STATIC.search(trial.place)), bool(frames) and off > _MAX_LENGTH_ERROR * frames, shared, off

        for trial in sorted(groups, key=rank)[:1]:
            if frames and abs(counts[trial.place] - frames) > _MAX_LENGTH_ERROR * frames:
                reason = f"{counts[trial.place]} frames, the videos have {frames}: another recording, not used"
                draft.note("keypoints", "likely", f"{trial.place}: {reason}")
            else:
                out.append({name: of[path] for name, path in trial.files.items()})
    return out


def read_sources(draft: Draft, sources: Sequence[Source]) -> list[dict[str, Keypoints]]:
    """Read the keypoints of every detector and camera; add a remark on each file that cannot be read."""
    out = []
    for source in sources:
        read: dict[str, Keypoints] = {}
        for name, file in source.items():
            try:
                read[name] = _read(file, name)
            except KinefitError as error:
                draft.note(f"keypoints {name}", "open", f"{draft.name(file.path)} not used: {error.problem}")
        out.append(read)
    return out


def _read(file: KeypointFile, camera: str) -> Keypoints:
    """Read the keypoints of a camera, at 1 Hz if the format states no rate."""
    if file.format == "openpose":
        if file.points not in SET_OF_COUNT:
            known = ", ".join(map(str, sorted(SET_OF_COUNT)))
            raise ObservationError(f"{file.points} points; there are sets of {known}")
        record = read_keypoints(file.path, format=file.format, camera=camera, rate=1.0)
        if record.keypoint_set == "BODY_25" and file.points > 25:
            record = read_keypoints(
                file.path, format=file.format, camera=camera, rate=1.0, keypoint_set=OPENPOSE_HANDS
            )
    else:
        rate = None if file.format == "caliscope" else 1.0
        record = read_keypoints(file.path, format=file.format, camera=camera, rate=rate)
    return record


def keypoint_entries(
    draft: Draft, source: Source, records: Mapping[str, Keypoints], frame: Value | None,
    images: Mapping[str, ImageFrame], *, active: bool,
) -> None:
    """Enter the tables [[keypoints]] of one detector; as comments unless it is the one to use.

    Parameters
    ----------
    frame : image frame of the coordinates, of the cameras in `images`.
    """
    if not records:
        return
    format = next(iter(source.values())).format
    what = f"{format}, {', '.join(sorted({r.keypoint_set for r in records.values()}))}, {len(records)} cameras"
    text = f"{what}: used" if active else f"{what}: as comments, because one detector is enough to begin with"
    draft.note("keypoints", "sure" if active else "guess", text)
    if active and any(_hands_seen(record) for record in records.values()):
        body = Value("humanoid_hands", "likely", "the humanoid with fingers, as the keypoints have hands")
        draft.head["body"] = draft.note_value("body", body, "body")
    if frame is not None:
        draft.note_value(f"keypoints, {format}", frame, "frame")
    for name, record in records.items():
        entry = {"camera": Value(name), "file": Value(source[name].path), "format": Value(format)}
        if format == "openpose":
            of_two = source[name].points in _AMBIGUOUS_COUNTS
            why = f"{source[name].points} points" + ", recognised by the lengths of the bones" * of_two
            entry["set"] = Value(record.keypoint_set, "likely" if of_two else "sure", why)
        if frame is not None and name in images:
            entry["frame"] = frame
        draft.keypoints.append((active, entry))


def _hands_seen(record: Keypoints) -> bool:
    """Whether a record has points of hands, with some detected."""
    return record.keypoint_set in SETS_WITH_HANDS and bool(record.confidence[..., -2 * HAND_POINTS :].any())
