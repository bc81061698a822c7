"""Cameras estimated from the people in view: Pose2Sim TOML, with clocks and sigmas in [metadata]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from kinefit._files import parse_toml, read_bytes
from kinefit.errors import FileError
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import read_calibration, write_calibration
from kinefit.readers.take.entries import CalibrationEntry

_KEY = "kinefit_found_from"


@dataclass(frozen=True, eq=False)
class FoundCameras:
    """A rig that was estimated from people.

    Parameters
    ----------
    rig : Rig [m]
    time_offsets : (C,) [s] to add to each camera's times, in the rig's order.
    position_sigma, rotation_sigma : float [m], [deg] standard deviations of a camera's pose.
    notes : sentences on the result and its uncertainty.
    made_from : {camera: text that identifies its keypoints and settings}: another text, another result; empty where
        the file is of a version that did not state it.
    height : float [m] of the person, which sets the scale; 0: unknown.
    """

    rig: Rig
    time_offsets: tuple[float, ...]
    position_sigma: float
    rotation_sigma: float
    notes: tuple[str, ...]
    made_from: Mapping[str, str]
    height: float = 0.0


def write_found(found: FoundCameras, path: str | PathLike[str]) -> None:
    """Write a rig that was estimated from people; raises as `write_calibration`."""
    write_calibration(
        found.rig, path,
        metadata={
            "time_offsets": list(found.time_offsets), "position_sigma": found.position_sigma,
            "rotation_sigma": found.rotation_sigma, "notes": list(found.notes), "height": found.height,
            _KEY: [found.made_from[name] for name in found.rig.names],
        },
    )  # fmt: skip


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
        rig, keys = read_calibration(path), metadata[_KEY]
        made_from = {} if isinstance(keys, str) else dict(zip(rig.names, map(str, keys), strict=True))
        offsets = tuple(float(t) for _, t in zip(rig, metadata["time_offsets"], strict=True))
        return FoundCameras(
            rig, offsets, float(metadata["position_sigma"]), float(metadata["rotation_sigma"]),
            tuple(map(str, metadata["notes"])), made_from, float(metadata.get("height", 0.0)),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
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
