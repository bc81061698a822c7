"""Cameras estimated from the people in view: Pose2Sim TOML, with clocks and sigmas in [metadata]."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Annotated, Any

import msgspec

from kinefit._files import parse_toml, read_bytes
from kinefit.errors import FileError
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import read_calibration, write_calibration
from kinefit.readers.take.entries import CalibrationEntry

_KEY = "kinefit_found_from"


class FoundCameras(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A rig that was estimated from people; what is not the rig stands in [metadata] of its file.

    Parameters
    ----------
    rig : Rig [m]
    time_offsets : (C,) [s] to add to each camera's times, in the rig's order.
    position_sigma, rotation_sigma : float [m], [deg] standard deviations of a camera's pose.
    notes : sentences on the result and its uncertainty.
    made_from : (C,) texts that identify each camera's keypoints and settings: another text, another result; one text
        where the file is of a version that did not state them.
    height : float [m] of the person, which sets the scale; 0: unknown.
    """

    rig: Rig
    time_offsets: tuple[float, ...]
    position_sigma: Annotated[float, msgspec.Meta(ge=0.0)]
    rotation_sigma: Annotated[float, msgspec.Meta(ge=0.0)]
    notes: tuple[str, ...]
    made_from: tuple[str, ...] | str = msgspec.field(name=_KEY)
    height: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0

    def __post_init__(self) -> None:
        of_each = self.time_offsets, self.time_offsets if isinstance(self.made_from, str) else self.made_from
        if any(len(one) != len(self.rig) for one in of_each):
            raise ValueError(f"it is not of {len(self.rig)} cameras")


def write_found(found: FoundCameras, path: str | PathLike[str]) -> None:
    """Write a rig that was estimated from people; raises as `write_calibration`."""
    metadata = msgspec.structs.asdict(found)
    write_calibration(metadata.pop("rig"), path, metadata=metadata | {_KEY: metadata.pop("made_from")})


def read_found(path: str | PathLike[str]) -> FoundCameras | None:
    """Read a file of `write_found`; None where there is no file.

    Raises
    ------
    FileError, CalibrationError
        A file of something else; one of `write_found` that was damaged.
    """
    path = Path(path)
    if not path.is_file():
        return None
    remedy = "Delete it: it is made again. A calibration of your own has another name, which [calibration] states."
    if (metadata := _metadata(path)) is None:
        raise FileError("no whole file of cameras that were found from people", file=path, remedy=remedy)
    try:
        return msgspec.convert({**metadata, "rig": read_calibration(path)}, FoundCameras)
    except msgspec.ValidationError as error:
        raise FileError(f"its [metadata] is not whole: {error}", file=path, remedy=remedy) from error


def found_notes(entry: CalibrationEntry | None) -> tuple[str, ...]:
    """Notes on a take's calibration if it was estimated from people; else empty."""
    metadata = _metadata(entry.file) if entry is not None else None
    return () if metadata is None else tuple(map(str, metadata.get("notes", ())))


def _metadata(path: Path) -> dict[str, Any] | None:
    """[metadata] of a file of `write_found`; None for any other."""
    if path.suffix != ".toml" or not path.is_file():
        return None
    content = read_bytes(path)
    if _KEY.encode() not in content:
        return None
    metadata = parse_toml(content.decode("utf-8", "replace"), path).get("metadata")
    return metadata if isinstance(metadata, dict) and _KEY in metadata else None
