"""Read 2D keypoints of detectors and programs that write all frames of a video into one file.

AlphaPose, COCO and MMPose write the people of every frame; DeepLabCut, SLEAP and Sports2D points whose names may be the
user's own.
"""

from __future__ import annotations

import csv
import io
import pickletools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import read_bytes, read_table
from kinefit.errors import FileError, ObservationError, check_choice, extra, names_file
from kinefit.observations import Keypoints
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS, frame_numbers, keypoint_record, known_set, stacked
from kinefit.readers.landmarks.keypoints import OpenPoseFrame, OpenPosePerson, decoded, people_record, with_new_keys
from kinefit.readers.markers import TRC, is_in_pixels
from kinefit.readers.plugins import FileFormat

Row = tuple[int, list[float]]  # frame, and x, y [px], confidence of each point of a person; empty if undetected
_HALPE, _HALPE_MORE = 3 * 26, (3 * 136, 3 * 68)  # numbers of a person of HALPE_26; with face and hands, with hands
_VIDEO_IMAGE = re.compile(r"(0|[1-9]\d*)\.\w+")  # name that AlphaPose gives to a frame of a video: "0.jpg"
_MAX_START_BYTES = 4096  # in which the keys of a form are


class _Person(msgspec.Struct):
    """A person of AlphaPose's results, whose form is that of COCO's."""

    image_id: str | int
    keypoints: list[float]


class _Instance(msgspec.Struct):
    """A person of MMPose."""

    keypoints: list[tuple[float, float]]
    keypoint_scores: list[float]

    def __post_init__(self) -> None:
        if len(self.keypoints) != len(self.keypoint_scores):
            raise ValueError(f"{len(self.keypoints)} points and {len(self.keypoint_scores)} scores")

    @property
    def numbers(self) -> list[float]:
        """x, y [px], score of each point."""
        return [v for point, score in zip(self.keypoints, self.keypoint_scores) for v in (*point, score)]


class _Instances(msgspec.Struct):
    frame_id: int
    instances: list[_Instance]


class _Predictions(msgspec.Struct):
    instance_info: list[_Instances]


_ALPHAPOSE = msgspec.json.Decoder(list[_Person] | dict[str, OpenPoseFrame])
_MMPOSE = msgspec.json.Decoder(list[_Instances] | _Predictions)


def _alphapose(raw: bytes) -> list[Row]:
    found = _ALPHAPOSE.decode(with_new_keys(raw))
    if isinstance(found, dict):
        people = [(name, person.pose_keypoints_2d) for name, frame in found.items() for person in frame.persons()]
    else:
        people = [(str(one.image_id), one.keypoints) for one in found]
    people = [(name, numbers[:_HALPE] if len(numbers) in _HALPE_MORE else numbers) for name, numbers in people]
    return list(zip(_frames([name for name, _ in people]), [numbers for _, numbers in people], strict=True))


def _frames(names: Sequence[str]) -> list[int]:
    """Frame of each image, from its name: of a video ("0.jpg") its number, else counted from the smallest number."""
    numbers = [int(re.findall(r"\d+", name)[-1][-18:]) if re.search(r"\d", name) else -1 for name in names]
    if min(numbers, default=0) < 0:
        problem = f"no frame number in the name of the image {names[numbers.index(-1)]!r}"
        raise ObservationError(problem, remedy="Run the detector on the video, or on images that are numbered.")
    first = 0 if all(map(_VIDEO_IMAGE.fullmatch, names)) else min(numbers, default=0)
    return [number - first for number in numbers]


def _mmpose(raw: bytes) -> list[Row]:
    found = _MMPOSE.decode(raw)
    frames = found if isinstance(found, list) else found.instance_info
    first = min((frame.frame_id for frame in frames), default=0)  # 0 or 1: all frames are in the file
    return [(f.frame_id - first, row) for f in frames for row in [one.numbers for one in f.instances] or [[]]]


@checked
@names_file
def _read_all(
    path: Path, *, format: str, rows_of: Callable[[bytes], list[Row]], camera: str, rate: float,
    keypoint_set: str | None = None,
) -> Keypoints:  # fmt: skip
    """The keypoints of a file, all people in the order of the file; see `read_keypoints`."""
    rows = decoded(path, rows_of, format)
    frames = frame_numbers([frame for frame, _ in rows], "frames")
    people: list[list[OpenPosePerson]] = [[] for _ in range(frames.max(initial=-1) + 1)]
    for frame, numbers in rows:
        people[frame] += [OpenPosePerson(numbers)] if numbers else []
    places = [(path, f"frame {k}, ") for k in range(len(people))]
    return people_record(people, places, path, camera, rate, keypoint_set)


def _begins(path: Path, *patterns: bytes) -> bool:
    """Whether the start of a file has one of these patterns, after spaces."""
    start = read_bytes(path, _MAX_START_BYTES).lstrip() if path.is_file() else b""
    return any(re.match(pattern, start, re.DOTALL) for pattern in patterns)


ALPHAPOSE = FileFormat(
    "all frames' people by AlphaPose (Fang et al. 2022, IEEE TPAMI 45:7157), or COCO's results", (".json",),
    partial(_read_all, format="alphapose", rows_of=_alphapose),
    lambda path: _begins(
        path, rb'\[\s*\{(?=.*"image_id")(?=.*"keypoints")', rb'\{\s*"[^"]*\.(?i:jpe?g|png|bmp|tiff?)"\s*:'
    ),
)
MMPOSE = FileFormat(
    "all frames' people by MMPose (OpenMMLab 2020)", (".json",), partial(_read_all, format="mmpose", rows_of=_mmpose),
    lambda path: _begins(path, rb'\[\s*\{\s*"frame_id"\s*:', rb'\{\s*"(?:meta_info|instance_info)"\s*:'),
)


Table = tuple[Sequence[str], NDArray]  # names of the points, and (F, P, K, 3) x, y [px], confidence; NaN where unseen
_HDF5 = b"\x89HDF\r\n\x1a\n"
_MAX_BYTES = 2**32  # of an array, which a damaged file may declare to be larger than memory
_EXPORT_AGAIN = "Export it again."


@checked
@names_file
def _read_named(
    path: Path, *, table: Callable[[Path], Table], camera: str, rate: float, keypoint_set: str | None = None,
    names: Mapping[str, str] | None = None,
) -> Keypoints:  # fmt: skip
    """The keypoints of a file, as points of a known set or of one of the user's own; see `read_keypoints`."""
    own, data = table(path)
    if data.shape[2] != len(own):
        raise FileError(f"{len(own)} names of {data.shape[2]} points", remedy=_EXPORT_AGAIN)
    data = np.where(np.isfinite(data).all(axis=-1, keepdims=True), data, 0.0)
    if not data.any():
        problem = f"no point of camera {camera} is seen in any of {len(data)} frames"
        raise ObservationError(problem, remedy=_EXPORT_AGAIN)
    for name in names or ():
        check_choice("point in this file named", name, own, ObservationError)
    renamed = [(names or {}).get(name, name) for name in own]
    kept, chosen = [k for k, name in enumerate(renamed) if name], [name for name in renamed if name]
    if keypoint_set is not None and keypoint_set not in KEYPOINT_SETS:
        return keypoint_record(data[:, :, kept], camera, keypoint_set, rate, path, names=chosen)
    keypoint_set, at = known_set(chosen, keypoint_set, path)
    whole = np.zeros((*data.shape[:2], len(KEYPOINT_SETS[keypoint_set]), 3))
    whole[:, :, at] = data[:, :, kept]
    return keypoint_record(whole, camera, keypoint_set, rate, path)


def _of_columns(columns: Sequence[Sequence[str]], frames: NDArray, values: NDArray) -> Table:
    """Points of DeepLabCut's columns (..., [individual], part, coordinate) with values (N, C) of frames (N,)."""
    if any(len(column) not in (3, 4) for column in columns) or not columns or not len(frames):
        raise ObservationError("columns of another form, or no rows", remedy=_EXPORT_AGAIN)
    people = list(dict.fromkeys(column[-3] if len(column) == 4 else "" for column in columns))
    parts, axes = list(dict.fromkeys(column[-2] for column in columns)), ["x", "y", "likelihood"]
    if odd := {column[-1] for column in columns} ^ set(axes):
        problem = f"columns {', '.join(sorted(odd))} beside, or without, x, y and likelihood"
        raise ObservationError(problem, remedy="Give the results of a network on a video, not labels or 3D points.")
    at = frame_numbers(frames)
    data = np.full((at.max() + 1, len(people), len(parts), 3), np.nan)
    for k, column in enumerate(columns):
        person = people.index(column[-3]) if len(column) == 4 else 0
        data[at, person, parts.index(column[-2]), axes.index(column[-1])] = values[:, k]
    return parts, data


def _deeplabcut(path: Path) -> Table:
    if _is_hdf5(path):
        return _deeplabcut_hdf5(path)
    try:
        rows = list(csv.reader(io.StringIO(read_bytes(path).decode("utf-8-sig", "replace"))))
        heads = [row for row in rows[:4] if row and row[0] in ("scorer", "individuals", "bodyparts", "coords")]
        numbers = np.array([[float(cell or "nan") for cell in row] for row in rows[len(heads) :] if row])
    except (ValueError, csv.Error) as error:
        raise FileError(f"a cell is not a number ({error})", remedy=_EXPORT_AGAIN) from error
    if numbers.ndim != 2 or {len(row) for row in heads} != {numbers.shape[1]} or heads[-1][0] != "coords":
        raise FileError("rows of different lengths, or none", remedy=_EXPORT_AGAIN)
    return _of_columns(list(zip(*(row[1:] for row in heads), strict=True)), numbers[:, 0], numbers[:, 1:])


def _pickled_texts(raw: bytes) -> list[str]:
    """The texts of pickled lists of texts, in their order; the bytes are read, not run."""
    texts: list[str] = []
    memo: dict[int, str | None] = {}
    text = None
    for operation, argument, _ in pickletools.genops(raw):
        name = operation.name
        if "UNICODE" in name:
            text = str(argument)
            texts.append(text)
        elif "GET" in name:
            text = memo[int(argument or 0)]
            texts += [text] if text is not None else []
        elif "PUT" in name or name == "MEMOIZE":
            memo[len(memo) if argument is None else argument] = text
        else:
            text = None
    return texts


def _deeplabcut_hdf5(path: Path) -> Table:
    """The table of pandas that DeepLabCut writes (`df_with_missing`, format "table")."""
    with _hdf5(path) as file:
        group = next(group for group in file.values() if "table" in group)
        table, texts = _whole(group["table"]), _pickled_texts(bytes(group.attrs["non_index_axes"]))
        columns = np.reshape(texts, (table["values_block_0"].shape[1], -1)).tolist()
        return _of_columns(columns, table["index"].astype(float), table["values_block_0"])


def _sleap(path: Path) -> Table:
    if not _is_hdf5(path):
        return _sleap_csv(path)
    with _hdf5(path) as file:
        names = [name.decode() for name in file["node_names"][:].tolist()]
        xy, scores = _whole(file["tracks"]), _whole(file["point_scores"])  # (P, 2, K, F) and (P, K, F)
        xy, scores = np.transpose(xy, (3, 0, 2, 1)), np.transpose(scores, (2, 0, 1))
        labelled = np.isnan(scores) & np.isfinite(xy).all(axis=-1)  # by hand, without a score
        return names, np.concatenate([xy, np.where(labelled, 1.0, scores)[..., None]], axis=-1)


def _sleap_csv(path: Path) -> Table:
    """SLEAP's table of a row for each person in each frame."""
    head = read_bytes(path, 2**20).partition(b"\n")[0].decode("utf-8-sig", "replace").split(",")
    names = [cell.strip().removesuffix(".x") for cell in head if cell.strip().endswith(".x")]
    columns = [f"{name}.{axis}" for name in names for axis in ("x", "y", "score")]
    table = read_table(path, ["frame_idx"], _EXPORT_AGAIN, optional=columns)[1]
    frames = frame_numbers(table[:, 0], "frame_idx")
    order = np.argsort(frames, kind="stable")
    values = table[order, 1:].reshape(len(table), len(names), 3)
    starts = np.searchsorted(frames[order], np.arange(1, frames.max(initial=0) + 1))
    return names, stacked(np.split(values, starts), len(names))


def _sports2d(path: Path) -> Table:
    """Sports2D's coordinates in pixels, written as those of markers in a plane; it states no confidence."""
    markers = TRC.read(path, unit="m")
    seen = np.isfinite(markers.positions).all(axis=-1, keepdims=True)
    first = round(markers.first_time * markers.rate)  # the file begins where the analysis of the video began
    data = np.concatenate([markers.positions[..., :2], np.where(seen, 1.0, np.nan)], axis=-1)
    return markers.names, np.pad(data[:, None], ((max(first, 0), 0), (0, 0), (0, 0), (0, 0)), constant_values=np.nan)


def _is_hdf5(path: Path) -> bool:
    return path.is_file() and read_bytes(path, len(_HDF5)) == _HDF5


@contextmanager
def _hdf5(path: Path) -> Iterator[Any]:
    """The contents of an HDF5 file, `h5py.File`; FileError where they are damaged or of another form."""
    with extra("hdf5", "HDF5 files are read by the package h5py", ObservationError):
        import h5py
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, StopIteration, AttributeError,
            EOFError, IndexError) as error:  # fmt: skip
        raise FileError(f"damaged, or of another form ({error})", remedy=_EXPORT_AGAIN) from error


def _whole(dataset: Any) -> NDArray:
    if dataset.nbytes > _MAX_BYTES:
        raise ValueError(f"an array of {dataset.nbytes} bytes")
    return dataset[:]


def _holds(path: Path, text: bytes, name: str) -> bool:
    """Whether a table begins with a pattern, or an HDF5 file has something of a name in it or in a group of it."""
    if not _is_hdf5(path):
        return path.suffix.lower() == ".csv" and bool(re.match(text, read_bytes(path, 2**16)))
    try:
        with _hdf5(path) as file:
            return name in file or any(name in group.attrs for group in file.values())
    except (FileError, ObservationError):
        return False


DEEPLABCUT = FileFormat(
    "points of DeepLabCut (Mathis et al. 2018, Nature Neuroscience 21:1281)", (".csv", ".h5"),
    partial(_read_named, table=_deeplabcut),
    lambda path: _holds(path, rb"(?:\xef\xbb\xbf)?scorer,.*\r?\n(?:bodyparts|individuals),", "non_index_axes"),
)
SLEAP = FileFormat(
    "points of SLEAP (Pereira et al. 2022, Nature Methods 19:486)", (".csv", ".h5"), partial(_read_named, table=_sleap),
    lambda path: _holds(path, rb"(?=[^\n]*\bframe_idx\b)(?=[^\n]*\binstance\.score\b)[^\n]*\.x,", "node_names"),
)
SPORTS2D = FileFormat(
    "points in pixels of Sports2D (Pagnon 2024, JOSS 9:6849)", (".trc",), partial(_read_named, table=_sports2d),
    is_in_pixels,
)
