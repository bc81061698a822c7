"""Write a calibration in the format of an existing one: the same file, or folder, with other numbers."""

from __future__ import annotations

import json
import os
import re
import tempfile
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit._files import regular
from kinefit.errors import CalibrationError, ExportError, KinefitError, check_choice, located
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import inverse, log_so3
from kinefit.readers.calibration import read
from kinefit.readers.calibration.keys import find, find_all
from kinefit.readers.calibration.programs import colmap_texts, qualisys_text
from kinefit.readers.calibration.tables import is_transposed, read_table
from kinefit.readers.calibration.trees import tables_of
from kinefit.readers.ros.recordings import inside

_REMEDY = "Write it as Pose2Sim TOML instead: kinefit.readers.calibration.read.write_calibration."


@checked
def write_calibration_like(
    rig: Rig,
    like: str | PathLike[str],
    path: str | PathLike[str],
    *,
    unit: str | float = "auto",
    image_size: tuple[int, int] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a rig in the format of an existing calibration, and keep all of its other content.

    Intrinsics, distortion and poses of the rig's cameras are replaced, in the file's own unit and notation; other
    cameras, comments, boards and names stay. The result is read back and compared before it appears. OpenCV's stereo
    pair has no entry for the pose of its first camera: it is written in that camera's frame, and its rectifications
    (R1 .. Q) stay those of the old calibration.

    Parameters
    ----------
    rig : Rig
        Some or all of the cameras of `like`, by name.
    like, path : file or folder, as in `read_calibration`
        `path` becomes what `like` is.
    unit, image_size : as in `read_calibration`, of `like`.
    overwrite : bool
        Whether an existing `path` may be replaced; `like` itself never is.

    Returns
    -------
    Path
        The path.

    Raises
    ------
    CalibrationError
        A camera that `like` lacks, or a property that the format cannot represent.
    ExportError
        `path` exists, or cannot be written.
    """
    like, path = Path(like), Path(path)
    like = like.parent if like.name in ("cameras.txt", "images.txt") else like
    if inside(like) is not None:
        remedy = "Use `read_calibration` and `write_calibration` to make a TOML of it, and name that in the take."
        raise CalibrationError("kinefit cannot write cameras into a recording of ROS 2", file=like, remedy=remedy)
    old = read.read_calibration(like, unit=unit, image_size=image_size, exteriors=False)
    for name in rig.names:
        check_choice("camera", name, old.names, CalibrationError, file=like, remedy="Give the rig these names.")
    _check_target(like, path, overwrite)
    with located(like):
        texts, rig = _texts(rig, like, unit)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}-") as staging:
            root = Path(staging) / path.name
            for relative, text in texts.items():
                (root / relative).parent.mkdir(parents=True, exist_ok=True)
                (root / relative).write_bytes(text.encode("utf-8"))
            _compare(rig, root, like, unit=unit, image_size=image_size)
            _move(root, path, texts)
    except OSError as error:
        raise ExportError(
            f"cannot be written: {error.strerror or error}", file=path, remedy="Choose a folder that has room."
        ) from None
    return path


def _check_target(like: Path, path: Path, overwrite: bool) -> None:
    if path.exists() and path.samefile(like):
        raise ExportError("this is the original calibration, which must stay", file=path, remedy="Give another name.")
    if path.exists() and (not overwrite or path.is_dir() != like.is_dir()):
        raise ExportError("this name is already taken", file=path, remedy="Give another name.")


def _move(root: Path, path: Path, texts: dict[str, str]) -> None:
    if path.is_dir():
        for relative in texts:
            (path / relative).parent.mkdir(parents=True, exist_ok=True)
            os.replace(root / relative, path / relative)
    else:
        os.replace(root, path)


def _compare(rig: Rig, written: Path, like: Path, **reading: Any) -> None:
    """Read the written calibration back; raise CalibrationError for what the format did not represent."""
    try:
        back = read.read_calibration(written, exteriors=False, **reading)
    except KinefitError as error:
        raise CalibrationError(
            f"the file cannot hold the rig's numbers ({error.problem})", file=like, place=error.place, remedy=_REMEDY
        ) from None
    for camera in rig:
        found = back[camera.name] if camera.name in back else None
        if found is not None and (found.size, found.model) == (camera.size, camera.model):
            scale = max(1.0, float(np.abs(camera.T_camera_world[:3, 3]).max()))
            equal = {
                "matrix": np.allclose(found.matrix, camera.matrix, rtol=1e-9, atol=1e-9),
                "distortion": np.allclose(_padded(found), _padded(camera), rtol=1e-9, atol=1e-12),
                "pose": np.allclose(found.T_camera_world, camera.T_camera_world, rtol=0, atol=1e-8 * scale),
            }
            lost = [what for what, kept in equal.items() if not kept]
        else:
            lost = ["image size or lens model"]
        if lost:
            problem = f"its format does not hold the {' and '.join(lost)}"
            raise CalibrationError(problem, file=like, place=f"camera {camera.name}", remedy=_REMEDY)


def _padded(camera: Camera) -> NDArray:
    return np.pad(camera.distortion, (0, 8 - camera.distortion.size))


def _texts(rig: Rig, like: Path, unit: str | float) -> tuple[dict[str, str], Rig]:
    """Text of each file by its path below `like` ("" for the file itself), and the rig in the format's frame."""
    if like.is_dir() and ((like / "cameras.txt").exists() or (like / "cameras.bin").exists()):
        texts = colmap_texts(rig, like, read.metres_per_unit([], unit))
        points = like / "points3D.txt"  # COLMAP opens no model without
        if points.exists():
            texts["points3D.txt"] = regular(points).read_text(encoding="utf-8")
        return texts, rig
    texts = {}
    for name, group in read.calibration_sources(like):
        if odd := [file for file in group if file.suffix.lower() in (".mat", ".xcp")]:
            raise CalibrationError("files of MATLAB and Vicon are read, not written", file=odd[0], remedy=_REMEDY)
        files = {file: regular(file).read_bytes().decode("utf-8-sig") for file in group}
        kinds = {file: read.recognise(text, file) for file, text in files.items()}
        if "qualisys" in kinds.values():
            scale = read.metres_per_unit([{"unit": "mm"}], unit)
            files = {file: qualisys_text(rig, text, scale) for file, text in files.items()}
        else:
            rig = _replace_tables(rig, name, files, kinds, unit)
        texts |= {"" if file == like else str(file.relative_to(like)): text for file, text in files.items()}
    return texts, rig


def _replace_tables(rig: Rig, name: str, files: dict[Path, str], kinds: dict[Path, str], unit: str | float) -> Rig:
    """Replace the numbers of all cameras of one group of files, in `files`; returns the rig in their frame."""
    trees = {file: read_table(text, kinds[file]) for file, text in files.items()}
    merged = {key: value for tree in trees.values() for key, value in tree.items()}
    tables = tables_of(merged, name, exteriors=False)
    if "M1" in merged and tables[0][0] in rig:
        rig = rig.moved(rig[tables[0][0]].T_camera_world)
    scale = read.metres_per_unit([table for _, table in tables], unit)
    places = {at: (file, *spot) for file, tree in trees.items() for at, spot in _places(tree, kinds[file]).items()}
    edits: dict[Path, list[tuple[int, int, str]]] = {file: [] for file in files}
    roots = {file: _xml_root(files[file]) for file in files if kinds[file] == "xml"}
    for camera_name, table in tables:
        if camera_name not in rig:
            continue
        known = places.get(id(find(table, "matrix")))
        for key, value, new in _entries(rig[camera_name], table, scale):
            place = places.get(id(value))
            if place is None and (value is not None or known is None):
                continue  # the zero pose of a stereo pair; reading back finds anything else that is missing
            file, word, n = place or known  # type: ignore[misc]
            if file in roots:
                _edit_xml(roots[file], word, n, new, None if place else key)
            else:
                edits[file] += _edit(files[file], word, n, new, None if place else key, kinds[file])
    for file, changes in edits.items():
        for start, stop, text in sorted(changes, reverse=True):
            files[file] = files[file][:start] + text + files[file][stop:]
    for file, root in roots.items():
        files[file] = '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
    return rig


def _places(tree: Any, kind: str) -> dict[int, tuple[str, int]]:
    """{identity of a list: (its key, number of the same keys before it)}, in the order of the text."""
    counts: dict[str, int] = {}
    out: dict[int, tuple[str, int]] = {}

    def walk(value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                if not (kind == "toml" and isinstance(inner, dict)):  # its tables have headings, not keys
                    if isinstance(inner, list):
                        out[id(inner)] = (key, counts.get(key, 0))
                    counts[key] = counts.get(key, 0) + 1
                walk(inner)
        elif isinstance(value, list):
            for inner in value:
                walk(inner)

    walk(tree)
    return out


def _entries(camera: Camera, table: dict, scale: float) -> list[tuple[str, Any, NDArray]]:
    """(key of a new entry, old value or None, new value) of each entry of a camera."""
    T = np.array(camera.T_camera_world)
    T[:3, 3] /= scale
    pose, inverse_pose = find(table, "pose"), find(table, "inverse pose")
    matrix, k, given = find(table, "matrix"), camera.distortion, find(table, "distortion")
    of_rows = is_transposed(matrix)
    count = np.size([] if given is None else given)
    entries = [
        ("matrix", matrix, _shaped(camera.matrix.T if of_rows else camera.matrix, matrix)),
        ("distortions", given, _shaped(np.pad(k, (0, max(0, count - k.size))), given)),
    ]
    if given is None and not k.any():
        entries.pop()
    if pose is not None:
        return [*entries, ("pose", pose, _shaped(T[: np.size(pose) // 4], pose))]
    if inverse_pose is not None:
        return [*entries, ("c2w", inverse_pose, _shaped(inverse(T)[: np.size(inverse_pose) // 4], inverse_pose))]
    R, translation = T[:3, :3], find(table, "translation")
    whole = R.T if of_rows else R
    rotations = [  # EasyMocap's Rot and R are the same
        ("rotation", old, _shaped(whole if np.size(old) == 9 else log_so3(R), old))
        for old in find_all(table, "rotation") or [None]
    ]
    return [*entries, *rotations, ("translation", translation, _shaped(T[:3, 3], translation))]


def _shaped(new: ArrayLike, old: Any) -> NDArray:
    """The new value in the shape of the old one, if it has as many numbers."""
    array = np.asarray(new, dtype=float)
    return array if old is None or np.size(old) != array.size else array.reshape(np.shape(old))


def _edit(text: str, word: str, n: int, new: NDArray, key: str | None, kind: str) -> list[tuple[int, int, str]]:
    """Edits (start, stop, text) that replace the value of the n-th `word`, or add a new `key` after it."""
    span = value_span(text, word, n)
    if span is None:
        return []
    if key is None:
        numbers = str(new.ravel().tolist() if span.matrix else new.tolist())
        return [(span.start, span.stop, numbers if text[span.start] == "[" else f" {numbers}")]
    start = span.indent.replace("-", " ")
    named = {"toml": f"{key} = ", "yaml": f"{key}: ", "json": f'"{key}": '}[kind]
    own_line = not start.strip()
    between = ("," if kind == "json" or not own_line else "") + (f"\n{start}" if own_line else " ")
    return [(span.after, span.after, f"{between}{named}{new.tolist()}")]


def _xml_root(text: str) -> ElementTree.Element:
    return ElementTree.fromstring(text, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True)))


def _edit_xml(root: ElementTree.Element, word: str, n: int, new: NDArray, key: str | None) -> None:
    element = list(root.iter(word))[n]
    numbers = re.sub(r"[\[\],]", " ", str(new.ravel().tolist()))
    if key is None:
        data = element.find("data")
        (element if data is None else data).text = numbers
    else:
        parent = next(p for p in root.iter() if element in list(p))
        added = ElementTree.SubElement(parent, key)
        added.text, added.tail = numbers, "\n"


_STRING = r'"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\''
_TOKEN = re.compile(rf"#[^\n]*|({_STRING}|[\w.-]+)(?:[ \t]*([:=]))?")
_BRACKET = re.compile(rf"#[^\n]*|{_STRING}|[\[\]{{}}]")
_LEAD = re.compile(r"\s*(!!opencv-[\w-]+|\{|\[)?")


class ValueSpan(NamedTuple):
    """Position of one value in a text.

    `start:stop` are the brackets of its numbers, `after` is the end of the whole value (an OpenCV matrix has more than
    its numbers), `indent` the text before its key on the key's line; `matrix`: whether it is an OpenCV matrix.
    """

    start: int
    stop: int
    after: int
    indent: str
    matrix: bool


def value_span(text: str, key: str, occurrence: int) -> ValueSpan | None:
    """Span of the list or matrix of the n-th `key` in a text; None if the value has another notation."""
    for token in _TOKEN.finditer(text):
        if token[2] and _name(token[1]) == key:
            if occurrence == 0:
                return _span(text, token)
            occurrence -= 1
    return None


def _name(text: str) -> str:
    return json.loads(text) if text[0] == '"' else text.strip("'")


def _span(text: str, token: re.Match) -> ValueSpan | None:
    indent = text[text.rfind("\n", 0, token.start()) + 1 : token.start()]
    lead = _LEAD.match(text, token.end())
    kind = lead[1] if lead else None
    if lead is None or kind is None:
        return _block(text, token.end(), indent)
    if kind == "[":
        stop = _closing(text, lead.end() - 1)
        return ValueSpan(lead.end() - 1, stop, stop, indent, False) if stop else None
    for inner in _TOKEN.finditer(text, lead.end()):
        if inner[2] and _name(inner[1]) == "data":
            start = text.find("[", inner.end())
            stop = _closing(text, start) if start >= 0 else None
            after = _closing(text, lead.end() - 1) if kind == "{" else stop
            return ValueSpan(start, stop, after, indent, True) if stop and after else None
    return None


def _block(text: str, start: int, indent: str) -> ValueSpan | None:
    """Span of a YAML block sequence: the lines below its key that are indented more."""
    rest = re.compile(rf"[ \t]*\r?\n(?:{' ' * len(indent)}[ \t]+[^\n]*(?:\n|$))+").match(text, start)
    if rest is None or not rest[0].lstrip().startswith("-"):
        return None
    stop = start + len(rest[0].rstrip())
    return ValueSpan(start, stop, stop, indent, False)


def _closing(text: str, start: int) -> int | None:
    """Index behind the bracket that closes the one at `start`."""
    depth = 0
    for token in _BRACKET.finditer(text, start):
        depth += (token[0] in "[{") - (token[0] in "]}")
        if depth == 0:
            return token.end()
    return None
