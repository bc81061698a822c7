"""Marker models, and their files: JSON, lengths in metres, angles in radians."""

from __future__ import annotations

from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_bytes, record_of, write_bytes
from kinefit.errors import FileError, ObservationError
from kinefit.geometry.se3 import exp_so3, log_so3


@dataclass(frozen=True, eq=False)
class MarkerJoint:
    """The joint of two marker segments.

    Parameters
    ----------
    parent, child : int, indices of segments
    in_parent, in_child : (3,) [m]
        The joint in each segment's frame, which is that of the model's reference positions.
    spread : float [m]
        Standard deviation of the difference of both in training: skin motion and fitting errors.
    marker : int or None
        The marker that both segments share at the joint (P5 2: "joint"); None for a virtual joint.
    exercised : float [rad]
        Range of the joint in training; 0 for a model of one frame.
    ranges : 3 floats [rad]
        Ranges about three orthogonal axes, the largest first.
    turn, give : (3, 3), (3, 3) [rad²], or None without training motion
        Centre of the child's turns in the parent's frame, and their covariance about it in the child's axes.
    """

    parent: int
    child: int
    in_parent: NDArray
    in_child: NDArray
    spread: float = 0.01
    marker: int | None = None
    exercised: float = 0.0
    ranges: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: NDArray | None = None
    give: NDArray | None = None


@dataclass(frozen=True, eq=False)
class MarkerModel:
    """A subject's markers as a tree of nearly rigid segments.

    Parameters
    ----------
    name : str of the subject
    labels : (M,)
    reference : (M, 3) [m] positions in one frame, or each segment's mean shape fitted to one; all finite
    segments : (k,) int each, markers of a segment, the root first; a marker at a joint may be in two
    names : of the segments
    joints : MarkerJoint, one for each segment but the root; parents come before children
    mean, deviation : (M, M) [m]
        Distances and their standard deviations in training; prior deviations in a model of one frame.
    low, high : (M, M) [m]
        Least and largest distance in training. Across joints that training did not exercise (all, in a model of one
        frame) widened towards what the segment tree allows. Equal to `mean` within segments of one frame.
    gaps : labels visible in less than a tenth of the training frames

    Raises
    ------
    ObservationError
        A label appears twice, or shapes disagree.
    """

    name: str
    labels: tuple[str, ...]
    reference: NDArray
    segments: tuple[tuple[int, ...], ...]
    names: tuple[str, ...]
    joints: tuple[MarkerJoint, ...]
    mean: NDArray
    deviation: NDArray
    low: NDArray
    high: NDArray
    gaps: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        count = len(self.labels)
        duplicates = sorted({n for n in self.labels if self.labels.count(n) > 1})
        if duplicates:
            raise ObservationError(f"labels appear twice: {', '.join(duplicates)}", remedy="Name every marker once.")
        if np.shape(self.reference) != (count, 3) or not np.isfinite(self.reference).all():
            raise ObservationError(
                f"reference positions of shape {np.shape(self.reference)}, or not finite, for {count} labels",
                remedy="Give a frame in which every marker is visible.",
            )
        for table in ("mean", "deviation", "low", "high"):
            if np.shape(getattr(self, table)) != (count, count):
                raise ObservationError(f"`{table}` is not {count} x {count}", remedy="Give one value a pair of labels.")
        if len(self.joints) != max(len(self.segments) - 1, 0) or len(self.names) != len(self.segments):
            raise ObservationError(
                f"{len(self.segments)} segments, {len(self.names)} names, {len(self.joints)} joints",
                remedy="Give a name for each segment, and a joint for each but the root.",
            )

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def parents(self) -> tuple[int, ...]:
        """(S,) parent of each segment, -1 for the root."""
        found = {j.child: j.parent for j in self.joints}
        return tuple(found.get(s, -1) for s in range(len(self.segments)))


FORMAT = "kinefit marker model 1"
_TABLES = ("mean", "deviation", "low", "high")
_UPPER = np.triu_indices(3)


Vector = tuple[float, float, float]
_Length = Annotated[float, msgspec.Meta(ge=0.0)]


class _JointEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    parent: int
    child: int
    in_parent: Vector
    in_child: Vector
    spread: _Length
    marker: str | None = None
    exercised: float = 0.0
    ranges: Vector = (0.0, 0.0, 0.0)
    turn: Vector | None = None
    give: tuple[float, float, float, float, float, float] | None = None


class _Segment(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    name: str
    markers: Annotated[list[str], msgspec.Meta(min_length=1)]


class _ModelFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    format: str
    name: str
    labels: list[str]
    reference: list[Vector]
    segments: Annotated[list[_Segment], msgspec.Meta(min_length=1)]
    joints: list[_JointEntry]
    distances: dict[str, list[list[_Length]]]
    gaps: list[str] = []


def save_model(model: MarkerModel, path: str | PathLike[str]) -> None:
    """Write a marker model atomically.

    Raises
    ------
    ExportError
        The file cannot be written.
    """
    joints = [
        vars(j) | {
            "marker": None if j.marker is None else model.labels[j.marker],
            "turn": None if j.turn is None else log_so3(j.turn),
            "give": None if j.give is None else j.give[_UPPER],
        }
        for j in model.joints
    ]  # fmt: skip
    record = {
        "format": FORMAT, "name": model.name, "labels": model.labels, "reference": model.reference,
        "segments": [{"name": n, "markers": [model.labels[m] for m in s]} for n, s in zip(model.names, model.segments)],
        "joints": joints, "gaps": model.gaps,
        "distances": {key: [row[i + 1 :] for i, row in enumerate(getattr(model, key)[:-1])] for key in _TABLES},
    }  # fmt: skip
    write_bytes(path, msgspec.json.format(msgspec.json.encode(record, enc_hook=_rounded), indent=1) + b"\n")


def load_model(path: str | PathLike[str]) -> MarkerModel:
    """Read a marker model.

    Raises
    ------
    FileError
        The file is missing, is no marker model, or contradicts itself; names the place in the file.
    """
    path = Path(path)
    remedy = "Make one with `kinefit markers learn`."
    record = record_of(read_bytes(path), _ModelFile, "a marker model", path, remedy)
    if record.format != FORMAT:
        raise FileError(f"format '{record.format}'", file=path, place="format", remedy=f"This reads '{FORMAT}'.")
    try:
        return _model(record)
    except (ObservationError, ValueError, IndexError, KeyError) as error:
        raise FileError(f"contradicts itself: {error}", file=path, remedy=remedy) from error


def _model(record: _ModelFile) -> MarkerModel:
    number = {label: i for i, label in enumerate(record.labels)}
    count, segments = len(record.labels), len(record.segments)
    if unknown := {m for s in record.segments for m in s.markers} - set(number):
        raise ValueError(f"segments with labels that are not listed: {', '.join(sorted(unknown))}")
    reached = {0}
    for joint in record.joints:
        if joint.parent not in reached or not 0 < joint.child < segments or joint.child in reached:
            raise ValueError(f"joint of segments {joint.parent} and {joint.child}: parents come before children")
        reached.add(joint.child)
    tables = {key: np.zeros((count, count)) for key in _TABLES}
    for key, table in tables.items():
        values = np.concatenate([*record.distances[key], []])
        if len(values) != count * (count - 1) // 2:
            raise ValueError(f"`distances.{key}` has not one finite distance for each pair of labels")
        table[np.triu_indices(count, 1)] = values
        table += table.T
    joints = tuple(
        MarkerJoint(
            j.parent, j.child, np.array(j.in_parent), np.array(j.in_child), j.spread,
            None if j.marker is None else number[j.marker], j.exercised, j.ranges,
            None if j.turn is None else exp_so3(np.array(j.turn)), None if j.give is None else _symmetric(j.give),
        )
        for j in record.joints
    )  # fmt: skip
    return MarkerModel(
        record.name, tuple(record.labels), np.array(record.reference, float).reshape(-1, 3),
        tuple(tuple(number[m] for m in s.markers) for s in record.segments), tuple(s.name for s in record.segments),
        joints, **tables, gaps=tuple(record.gaps),
    )  # fmt: skip


def _symmetric(upper: tuple[float, ...]) -> NDArray:
    """Symmetric (3, 3) from its upper half; raises ValueError if it is not positive definite."""
    out = np.zeros((3, 3))
    out[_UPPER] = upper
    out += np.triu(out, 1).T
    if np.linalg.eigvalsh(out)[0] <= 0:
        raise ValueError("`give` of a joint is not a covariance")
    return out


def _rounded(values: NDArray) -> Any:
    """Rounded to a thousandth of a millimetre: markers are measured to a tenth."""
    return np.round(values, 6).tolist()
