"""Corrections of a tracked take by its user: edits of the take file that can be undone.

Each edit keeps the text before it in the folder TAKE-before beside the take, and the clicks where it changes these. A
take file that would not be valid is not written.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from kinefit._files import read_bytes, regular
from kinefit.bodies import load_body
from kinefit.errors import KinefitError, TakeError, check_choice, choices
from kinefit.exporters.atomic import write_bytes, write_text, writing
from kinefit.exporters.take_text import quoted, with_keys
from kinefit.preparing.take import has_face, uses_detector
from kinefit.readers.clicks import Clicks, clicks_of, clicks_text, read_clicks
from kinefit.readers.detections import detections_file, read_detections
from kinefit.readers.keypoint_sets import FACE_SET
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.find import find_take

TakePath = str | PathLike[str]
Range = tuple[int, int]
CLICKS = "clicks.json"
"""File beside the take that new clicks are written to; with the take's name before it where another take has it."""
_CLICK_SIGMA = "1.0"  # [px] well below the noise of any detector, so that the joint goes where it was placed


def trim(take: TakePath, first: int, stop: int) -> None:
    """Use only the steps from `first` up to, not including, `stop` of the take's common time.

    Raises
    ------
    TakeError, FileError
        Of this and all other edits: what the changed take file would have wrong. Nothing is written then.
    ExportError
        Of all edits: the disk refuses.
    """
    _set(take, "take", {"frames": _listed([first, stop])})


def exclude_view(take: TakePath, camera: str, first: int, stop: int) -> None:
    """Exclude a camera's keypoints from step `first` up to, not including, `stop`."""
    _set_ranges(take, camera, "excluded", (first, stop))


def exchange_sides(take: TakePath, camera: str, first: int, stop: int) -> None:
    """Exchange left and right of a camera's keypoints in the steps [first, stop); a second time, exchange them back."""
    _set_ranges(take, camera, "swapped", (first, stop))


def choose_person(take: TakePath, person: int | str | None) -> None:
    """Track this person alone: a number from 1 as `kinefit track` lists them, or words such as "moving"; None: all."""
    value = quoted(person) if isinstance(person, str) else None if person is None else str(int(person))
    _set(take, "take", {"person": value})


def can_undo(take: TakePath) -> bool:
    """Whether there is an edit to take back."""
    return bool(_kept(find_take(take).absolute()))


def set_height(take: TakePath, height: float | None) -> None:
    """State the person's height [m]; None: it is not stated."""
    _set(take, "take", {"height": None if height is None else f"{float(height)!r}"})


def set_camera_keys(take: TakePath, camera: str, keys: Mapping[str, str]) -> None:
    """Set keys of a `[[camera]]`, with values as TOML has them, such as those of a `Finding`."""
    read, text = _opened(take)
    names = [entry.name for entry in read.cameras]
    check_choice("camera", camera, names, TakeError, file=read.path)
    _write(read.path, with_keys(text, "camera", names.index(camera), keys))


def add_click(take: TakePath, step: int, camera: str, landmark: str, uv: Sequence[float]) -> None:
    """Place a joint by hand in one image; a former click on it there is replaced.

    Parameters
    ----------
    step : int, of the take's common time
    camera : str, name in the take
    landmark : str, of the take's body, see `kinefit.initialization.from_clicks.clickable`
    uv : (2,) [px] in the camera's own image

    Raises
    ------
    TakeError
        No such camera, or no such landmark.
    FileError
        A step or a pixel that cannot be; a file of clicks that cannot be read.
    """
    read, text = _opened(take)
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
    file = read.clicks or read.path.with_name(CLICKS)
    if read.clicks is None:
        file = file.with_name(f"{read.path.stem}-{CLICKS}") if file.exists() else file
        text = with_keys(text, "start", None, {"clicks": quoted(file.name), "click_sigma": _CLICK_SIGMA})
    _write(read.path, text, (file, clicks_text([steps[k] for k in sorted(steps)])))


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


def _opened(take: TakePath) -> tuple[Take, str]:
    """A take, and the text of its file, line ends as they are."""
    read = read_take(take)
    return read, regular(read.path).read_bytes().decode("utf-8").removeprefix("\ufeff")


def _write(path: Path, text: str, clicks: tuple[Path, str] | None = None) -> None:
    """Write the text of a take, and its clicks, if it is valid; keep what was there before."""
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
            write_bytes(copy, regular(path).read_bytes())
    except BaseException as error:
        if clicks:
            _put(clicks[0], former)
        if not isinstance(error, KinefitError):
            raise
        raise type(error)(error.problem, file=path, place=error.place, remedy=error.remedy) from error


def _set(take: TakePath, table: str, keys: dict[str, str | None]) -> None:
    """Set keys of a single table."""
    read, text = _opened(take)
    _write(read.path, with_keys(text, table, None, keys))


def _set_ranges(take: TakePath, camera: str, key: str, steps: Range) -> None:
    """Add steps to those of all keypoints of a camera; of "swapped" take those away that are there."""
    read, text = _opened(take)
    if not 0 <= steps[0] < steps[1]:
        problem, remedy = f"{key} has {list(steps)}", "Give the first step and the one after the last, from 0."
        raise TakeError(problem, file=read.path, place=f"keypoints of camera {camera}", remedy=remedy)
    if uses_detector(read) and not read.keypoints:
        text = _with_detector(read, text)
    tables: list[dict[str, Any]] = tomllib.loads(text).get("keypoints", [])
    own = [n for n, k in enumerate(tables) if k["camera"] == camera and k.get("format") != "skin"]
    if not own:
        seeing = dict.fromkeys(k["camera"] for k in tables)
        raise TakeError(choices("camera with keypoints", camera, seeing), file=read.path)
    for n in own:
        former = _united(tables[n].get(key, []))
        both = _united([*former, steps]) if key == "excluded" else _either(former, steps)
        text = with_keys(text, "keypoints", n, {key: _listed(both) if both else None})
    _write(read.path, text)


def _with_detector(read: Take, text: str) -> str:
    """The text with a table for all keypoints that the built-in detector gives a take without any."""
    number = 0
    for camera in read.cameras:
        file = detections_file(read.path, camera.name)
        found = read_detections(file) if file.exists() else None
        if camera.video is None or (found is not None and not found.seen.any()):
            continue
        sets = [None, *([FACE_SET] if found is not None and found.has_faces and has_face(read.body) else [])]
        for points in sets:
            keys = {"camera": quoted(camera.name), "format": '"detect"', "set": quoted(points) if points else None}
            text, number = with_keys(text, "keypoints", number, keys), number + 1
    return text


def _united(ranges: Sequence[Any]) -> list[Range]:
    """Ranges of steps in order, those that touch as one."""
    out: list[Range] = []
    for first, stop in sorted((int(a), int(b)) for a, b in ranges):
        if out and first <= out[-1][1]:
            out[-1] = out[-1][0], max(out[-1][1], stop)
        else:
            out.append((first, stop))
    return out


def _either(ranges: Sequence[Range], steps: Range) -> list[Range]:
    """Steps of one but not of both: of united ranges, or of `steps`."""
    ends = sorted([*(end for one in ranges for end in one), int(steps[0]), int(steps[1])])
    single = [end for end in ends if ends.count(end) == 1]
    return list(zip(single[::2], single[1::2]))


def _listed(values: Sequence[Any]) -> str:
    """Numbers, or pairs of them, as a TOML list."""
    return str([list(map(int, v)) if isinstance(v, tuple) else int(v) for v in values])


def _steps(steps: Range) -> str:
    """Steps of a range in words."""
    return f"step {steps[0]}" if steps[1] == steps[0] + 1 else f"steps {steps[0]} to {steps[1] - 1}"
