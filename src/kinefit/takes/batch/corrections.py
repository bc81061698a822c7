"""Corrections of a tracked take by its user: edits of the take file that can be undone.

Each edit keeps the text before it in the folder TAKE-before next to the take, and the clicks where it changes these. A
take file that would not be valid is not written.

What a motion was computed from, and whether that was changed since.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import tomllib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from kinefit._files import read_bytes, regular, stature_of, write_bytes, write_text, writing
from kinefit.bodies import load_body
from kinefit.errors import ExportError, KinefitError, TakeError, choices, located
from kinefit.exporters.take_text import edited, quoted
from kinefit.findings import Edit, joined
from kinefit.readers.landmarks.annotations import Clicks, clicks_of, clicks_text, read_clicks
from kinefit.readers.landmarks.detections import detections_file, read_detections
from kinefit.readers.landmarks.keypoint_sets import FACE_SET
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import Take, find_take, read_take
from kinefit.takes.preparing.take import has_face, uses_detector

TakePath = str | PathLike[str]
Range = tuple[int, int]
CLICKS = "clicks.json"
"""File next to the take that new clicks are written to; with the take's name before it where another take has it."""
_CLICK_SIGMA = "1.0"  # [px] well below the noise of any detector, so that the joint goes where it was placed


def write_edits(take: TakePath, edits: Iterable[Edit], *, over: bytes | None = None) -> Path:
    """Write edits into a take file, all or none; returns the file that keeps its content before.

    Parameters
    ----------
    edits : such as those of findings
    over : content of the file for which the edits were made; default: what it holds now

    Raises
    ------
    TakeError, FileError
        Of this and all other edits: what the changed take file would have wrong; two edits that contradict each other;
        a file that was changed since `over`. Nothing is written then.
    ExportError
        Of all edits: the take is read-only, or the disk refuses.
    """
    read, now = _opened(take)
    return _write(read, over or now, edits)


def trim(take: TakePath, first: int, stop: int) -> None:
    """Use only the steps from `first` up to, not including, `stop` of the take's common time."""
    write_edits(take, [Edit("take", "frames", str([int(first), int(stop)]))])


def exclude_view(take: TakePath, camera: str, first: int, stop: int) -> None:
    """Exclude a camera's keypoints from step `first` up to, not including, `stop`."""
    _set_ranges(take, camera, "excluded", (first, stop))


def exchange_sides(take: TakePath, camera: str, first: int, stop: int) -> None:
    """Exchange left and right of a camera's keypoints in the steps [first, stop); a second time, exchange them back."""
    _set_ranges(take, camera, "swapped", (first, stop))


def choose_person(take: TakePath, person: int | str | None) -> None:
    """Track this person alone: a number from 1 as `kinefit track` lists them, or words such as "moving"; None: all."""
    value = quoted(person) if isinstance(person, str) else None if person is None else str(int(person))
    write_edits(take, [Edit("take", "person", value)])


def set_height(take: TakePath, height: float | str | None) -> None:
    """State the person's height [m], or a text that `stature_of` reads: "175 cm"; None or "": it is not stated."""
    metres = stature_of(height) if isinstance(height, str) and height else height
    write_edits(take, [Edit("take", "height", f"{float(metres)!r}" if metres else None)])


def can_undo(take: TakePath) -> bool:
    """Whether there is an edit to take back."""
    return bool(_kept(find_take(take).absolute()))


def add_click(take: TakePath, step: int, camera: str, landmark: str, uv: Sequence[float]) -> None:
    """Place a joint by hand in one image; a former click on it there is replaced.

    Parameters
    ----------
    step : int, of the take's common time
    camera : str, name in the take
    landmark : str, of the take's body, see `kinefit.fitting.initialization.from_points.clickable`
    uv : (2,) [px] in the camera's own image

    Raises
    ------
    TakeError
        No such camera, or no such landmark.
    FileError
        A step or a pixel that cannot be; a file of clicks that cannot be read.
    """
    read, before = _opened(take)
    body = load_body(read.body) if read.start is None else read_motion(read.start).body
    names = {"camera": (camera, [c.name for c in read.cameras]), "landmark": (landmark, body.landmarks.names)}
    for kind, (name, known) in names.items():
        if name not in known:
            raise TakeError(choices(kind, name, known), file=read.path)
    new = clicks_of({"step": int(step), "points": {camera: {landmark: [float(v) for v in uv]}}})
    steps = {of.step: of for of in (read_clicks(read.clicks) if read.clicks else ())}
    points = {c: dict(of) for c, of in steps[new.step].points.items()} if new.step in steps else {}
    points[camera] = {**points.get(camera, {}), **new.points[camera]}
    steps[new.step] = Clicks(new.step, points)
    file, edits = read.clicks or read.path.with_name(CLICKS), list[Edit]()
    if read.clicks is None:
        file = file.with_name(f"{read.path.stem}-{CLICKS}") if file.exists() else file
        edits = [Edit("start", "clicks", quoted(file.name)), Edit("start", "click_sigma", _CLICK_SIGMA)]
    _write(read, before, edits, (file, clicks_text([steps[k] for k in sorted(steps)])))


def corrections_of(take: TakePath) -> tuple[str, ...]:
    """One sentence for each correction that a take file holds, whoever wrote it."""
    read = read_take(take)
    out = [] if read.frames is None else [f"Only {_steps(read.frames)} are used."]
    for key, words in {"excluded": "is excluded", "swapped": "has left and right exchanged"}.items():
        found = {(k.camera, steps): None for k in (*read.keypoints, *read.skin) for steps in getattr(k, key)}
        out += [f"Camera {camera} {words} in {_steps(steps)}." for camera, steps in found]
    if read.person is not None:
        out.append(f"Person {read.person} is tracked." if isinstance(read.person, int) else
                   f"One person is tracked: {read.person}.")  # fmt: skip
    if read.height is not None:
        out.append(f"The person is {read.height:g} m tall.")
    for of in read_clicks(read.clicks) if read.clicks else ():
        out += [f"{name} is placed by hand in camera {camera} at step {of.step}."
                for camera, points in of.points.items() for name in points]  # fmt: skip
    return tuple(out)


def undo(take: TakePath) -> bool:
    """Take the last edit back, and what was changed in the take file since; False where there is none."""
    path = find_take(take).absolute()
    if not (kept := _kept(path)):
        return False
    clicks = kept[-1].with_suffix(".json")
    try:
        with writing(path) as temporary:
            temporary.write_bytes(read_bytes(kept[-1]))
            read_take(temporary)
            if clicks.exists() and (file := read_take(path).clicks) is not None:
                _put(file, read_bytes(clicks))
    except KinefitError as error:
        raise type(error)(error.problem, file=kept[-1], place=error.place, remedy=error.remedy) from error
    for done in (kept[-1], clicks):
        done.unlink(missing_ok=True)
    return True


def _before(path: Path) -> Path:
    """Folder of the texts before each edit: 0001.txt, and 0001.json with the clicks, empty where there were none."""
    return path.with_name(f"{path.stem}-before")


def _kept(path: Path) -> list[Path]:
    """The texts before each edit, in order; other files there are none of ours."""
    return sorted(
        (file for file in _before(path).glob("*.txt") if file.stem.isdecimal() and file.is_file()),
        key=lambda file: int(file.stem),
    )


def _put(file: Path, content: bytes) -> None:
    """Write a file as it was; remove one that was not there."""
    if content:
        write_bytes(file, content)
    else:
        file.unlink(missing_ok=True)


def _opened(take: TakePath) -> tuple[Take, bytes]:
    """A take, and the content of its file."""
    read = read_take(take)
    return read, regular(read.path).read_bytes()


def _write(read: Take, before: bytes, edits: Iterable[Edit], clicks: tuple[Path, str] | None = None) -> Path:
    """Write edits over the content of a take, and its clicks, if it is valid then; keep what was there before."""
    path = read.path
    if not os.access(path, os.W_OK) or not path.stat().st_mode & stat.S_IWUSR:
        raise ExportError("the take file is read-only", file=path, remedy="Make it writable, or edit a copy.")
    with located(path):
        text = edited(before.decode("utf-8-sig"), edits)
    kept = _kept(path)
    copy = _before(path) / f"{int(kept[-1].stem) + 1 if kept else 1:04}.txt"
    former = clicks[0].read_bytes() if clicks and clicks[0].exists() else b""
    try:
        if clicks:
            write_text(*clicks)
        with writing(path) as temporary:
            temporary.write_bytes(text.encode("utf-8"))
            read_take(temporary)
            if clicks:
                write_bytes(copy.with_suffix(".json"), former)
            write_bytes(copy, before)
            if regular(path).read_bytes() != before:
                remedy = "Look at the take, then do it again."
                raise TakeError("the take file was changed by another program in the meantime", remedy=remedy)
    except BaseException as error:
        for part in (copy, copy.with_suffix(".json")):
            part.unlink(missing_ok=True)
        with suppress(OSError):  # no such folder, or former edits in it
            copy.parent.rmdir()
        if clicks:
            _put(clicks[0], former)
        if not isinstance(error, KinefitError):
            raise
        raise type(error)(error.problem, file=path, place=error.place, remedy=error.remedy) from error
    return copy


def _set_ranges(take: TakePath, camera: str, key: str, steps: Range) -> None:
    """Add steps to those of all keypoints of a camera; of "swapped" take those away that are there."""
    read, before = _opened(take)
    if not 0 <= steps[0] < steps[1]:
        problem, remedy = f"{key} has {list(steps)}", "Give the first step and the one after the last, from 0."
        raise TakeError(problem, file=read.path, place=f"keypoints of camera {camera}", remedy=remedy)
    edits = _of_detector(read) if uses_detector(read) and not read.keypoints else []
    tables: list[dict[str, Any]] = tomllib.loads(before.decode("utf-8-sig")).get("keypoints", [])
    tables += [{"camera": json.loads(edit.value or "")} for edit in edits if edit.key == "camera"]
    own = [n for n, k in enumerate(tables) if k["camera"] == camera and k.get("format") != "skin"]
    if not own:
        seeing = dict.fromkeys(k["camera"] for k in tables)
        raise TakeError(choices("camera with keypoints", camera, seeing), file=read.path)
    for n in own:
        former, new = {step for a, b in tables[n].get(key, ()) for step in range(a, b)}, {*range(*steps)}
        both = joined(np.array(sorted(former | new if key == "excluded" else former ^ new)))
        edits.append(Edit("keypoints", key, str([list(run) for run in both]) if both else None, n))
    _write(read, before, edits)


def _of_detector(read: Take) -> list[Edit]:
    """Tables for all keypoints that the built-in detector gives a take without any."""
    cameras: list[tuple[str, str | None]] = []
    for camera in read.cameras:
        file = detections_file(read.path, camera.name)
        found = read_detections(file) if file.exists() else None
        if camera.video is not None and (found is None or found.seen.any()):
            has_faces = found is not None and found.has_faces and has_face(read.body)
            cameras += [(camera.name, None), *([(camera.name, FACE_SET)] if has_faces else [])]
    return [
        Edit("keypoints", key, quoted(value), n)
        for n, (name, points) in enumerate(cameras)
        for key, value in (("camera", name), ("format", "detect"), ("set", points)) if value
    ]  # fmt: skip


def _steps(steps: Range) -> str:
    """Steps of a range in words."""
    return f"step {steps[0]}" if steps[1] == steps[0] + 1 else f"steps {steps[0]} to {steps[1] - 1}"


OUTDATED = "The take was changed after this motion was computed: run kinefit track again"
"""What is said of a result for which `is_outdated` holds."""

_INPUTS = "inputs_sha256"  # key of `Motion.provenance`


def inputs_entry(take: Take) -> dict[str, str]:
    """Entry of `Motion.provenance`: what a motion is computed from that a user edits, wherever it lies.

    That are the take file, its clicks, its body and its T-pose take; changes of the calibration are noticed apart.
    """
    digest = hashlib.sha256(take.digest.encode())
    for file in (take.clicks, take.subject, Path(take.body)):
        if file is not None and file.is_absolute() and file.is_file():
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    return {_INPUTS: digest.hexdigest()}


def is_outdated(provenance: Mapping[str, Any], take: Path) -> bool:
    """Whether a take was changed after a motion was computed from it, as far as the motion's provenance says."""
    if _INPUTS not in provenance or provenance.get("take") != take.name:
        return False
    try:
        return inputs_entry(_read(take, take.stat().st_mtime_ns))[_INPUTS] != provenance[_INPUTS]
    except (KinefitError, OSError):
        return False


@lru_cache(1024)
def _read(take: Path, changed: int) -> Take:
    """The take file of this change [ns]: the window's lists ask for the same ones every two seconds."""
    with warnings.catch_warnings(action="ignore", category=FutureWarning):  # old keys were reported when it was tracked
        return read_take(take)
