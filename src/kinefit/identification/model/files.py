"""Marker models in files: JSON, lengths in metres, angles in radians."""

from __future__ import annotations

import os
from contextlib import suppress
from os import PathLike
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular
from kinefit.errors import ExportError, FileError, ObservationError
from kinefit.geometry.se3 import exp_so3, log_so3
from kinefit.identification.model.model import MarkerJoint, MarkerModel

FORMAT = "kinefit marker model 1"
_TABLES = ("mean", "deviation", "low", "high")
_UPPER = np.triu_indices(3)


class _JointEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    parent: int
    child: int
    in_parent: tuple[float, float, float]
    in_child: tuple[float, float, float]
    spread: float
    marker: str | None = None
    exercised: float = 0.0
    ranges: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] | None = None
    give: tuple[float, float, float, float, float, float] | None = None


class _Segment(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    name: str
    markers: list[str]


class _ModelFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    format: str
    name: str
    labels: list[str]
    reference: list[tuple[float, float, float]]
    segments: list[_Segment]
    joints: list[_JointEntry]
    distances: dict[str, list[list[float]]]
    gaps: list[str] = []


def save_model(model: MarkerModel, path: str | PathLike[str]) -> None:
    """Write a marker model atomically.

    Raises
    ------
    ExportError
        The file cannot be written.
    """
    upper = np.triu_indices(len(model), 1)
    rows = np.split(np.arange(len(upper[0])), np.cumsum(np.arange(len(model) - 1, 1, -1)))
    record = _ModelFile(
        format=FORMAT, name=model.name, labels=list(model.labels), reference=_rounded(model.reference),
        segments=[
            _Segment(name=n, markers=[model.labels[m] for m in s]) for n, s in zip(model.names, model.segments)
        ],
        joints=[
            _JointEntry(
                parent=int(j.parent), child=int(j.child), in_parent=tuple(_rounded(j.in_parent)),
                in_child=tuple(_rounded(j.in_child)), spread=float(j.spread),
                marker=None if j.marker is None else model.labels[j.marker], exercised=float(j.exercised),
                ranges=tuple(float(r) for r in j.ranges),  # type: ignore[arg-type]
                turn=None if j.turn is None else tuple(_rounded(log_so3(j.turn))),
                give=None if j.give is None else tuple(_rounded(j.give[_UPPER])),
            )
            for j in model.joints
        ],
        distances={key: [_rounded(getattr(model, key)[upper][row]) for row in rows] for key in _TABLES},
        gaps=list(model.gaps),
    )
    target = Path(path)
    temporary = target.with_name(f".{target.name}-{os.getpid()}")
    try:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n")
        os.replace(temporary, target)
    except OSError as error:
        remedy = "Choose an existing folder with write permission and free space."
        raise ExportError(f"cannot be written ({error.strerror or error})", file=target, remedy=remedy) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def load_model(path: str | PathLike[str]) -> MarkerModel:
    """Read a marker model.

    Raises
    ------
    FileError
        The file is missing, is no marker model, or contradicts itself; names the place in the file.
    """
    path = Path(path)
    remedy = "Make one with `kinefit markers learn`."
    try:
        record = msgspec.json.decode(regular(path).read_bytes(), type=_ModelFile)
    except OSError as error:
        raise FileError(f"cannot be read ({error.strerror or error})", file=path, remedy=remedy) from error
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at `$")
        place = place.strip(".`")
        raise FileError(f"not a marker model: {problem}", file=path, place=place or None, remedy=remedy) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FileError(f"not valid JSON ({error})", file=path, remedy=remedy) from error
    if record.format != FORMAT:
        raise FileError(f"format '{record.format}'", file=path, place="format", remedy=f"This reads '{FORMAT}'.")
    try:
        return _model(record)
    except (ObservationError, ValueError, IndexError, KeyError) as error:
        raise FileError(f"contradicts itself: {error}", file=path, remedy=remedy) from error


def _model(record: _ModelFile) -> MarkerModel:
    number = {label: i for i, label in enumerate(record.labels)}
    count, segments = len(record.labels), len(record.segments)
    unknown = {m for s in record.segments for m in s.markers} - set(number)
    if unknown or not segments or not all(s.markers for s in record.segments):
        raise ValueError(f"segments without markers, or with labels that are not listed: {', '.join(sorted(unknown))}")
    reached = {0}
    for joint in record.joints:
        if joint.parent not in reached or not 0 < joint.child < segments or joint.child in reached:
            raise ValueError(f"joint of segments {joint.parent} and {joint.child}: parents come before children")
        turn = joint.turn or (0.0, 0.0, 0.0)
        if not joint.spread >= 0 or not np.isfinite([*joint.in_parent, *joint.in_child, joint.spread, *turn]).all():
            raise ValueError(f"joint of segments {joint.parent} and {joint.child}: a number is not finite")
        reached.add(joint.child)
    upper = np.triu_indices(count, 1)
    tables: dict[str, NDArray] = {}
    for key in _TABLES:
        values = np.array([v for row in record.distances[key] for v in row], float)
        if values.shape != upper[0].shape or not np.isfinite(values).all() or (values < 0).any():
            raise ValueError(f"`distances.{key}` has not one finite distance for each pair of labels")
        tables[key] = np.zeros((count, count))
        tables[key][upper] = values
        tables[key] += tables[key].T
    joints = tuple(
        MarkerJoint(
            j.parent, j.child, np.array(j.in_parent), np.array(j.in_child), j.spread,
            None if j.marker is None else number[j.marker], j.exercised, j.ranges,
            None if j.turn is None else exp_so3(np.array(j.turn)), None if j.give is None else _symmetric(j.give),
        )
        for j in record.joints
    )
    return MarkerModel(
        record.name, tuple(record.labels), np.array(record.reference, float).reshape(-1, 3),
        tuple(tuple(number[m] for m in s.markers) for s in record.segments), tuple(s.name for s in record.segments),
        joints, tables["mean"], tables["deviation"], tables["low"], tables["high"], tuple(record.gaps),
    )


def _symmetric(upper: tuple[float, ...]) -> NDArray:
    """Symmetric (3, 3) from its upper half; raises ValueError if it is not positive definite."""
    out = np.zeros((3, 3))
    out[_UPPER] = upper
    out = out + np.triu(out, 1).T
    if not np.isfinite(out).all() or np.linalg.eigvalsh(out)[0] <= 0:
        raise ValueError("`give` of a joint is not a covariance")
    return out


def _rounded(values: NDArray) -> list:
    """Rounded to a thousandth of a millimetre: markers are measured to a tenth."""
    return np.round(np.asarray(values, float), 6).tolist()
