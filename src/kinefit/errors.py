"""Every error that kinefit raises for a user's input: what is wrong, where, and what would work."""

from __future__ import annotations

from os import PathLike


class KinefitError(Exception):
    """Base of all errors raised for a user's input.

    Parameters
    ----------
    problem : str
        What is wrong, in one sentence.
    file : path, optional
        The file at fault.
    place : str, optional
        Where in it: a line, a key, a frame, a camera.
    remedy : str, optional
        What would work.
    """

    exit_code = 2

    def __init__(
        self,
        problem: str,
        *,
        file: str | PathLike[str] | None = None,
        place: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.problem, self.file, self.place, self.remedy = problem, file, place, remedy
        where = ", ".join(str(part) for part in (file, place) if part)
        text = f"{where}: {problem}" if where else problem
        super().__init__(f"{text.rstrip('.')}. {remedy}" if remedy else text)


class FileError(KinefitError):
    """A file is missing, truncated, or not what it claims to be."""


class CalibrationError(KinefitError):
    """A camera or calibration cannot be used as it is."""


class TakeError(KinefitError):
    """A take file names something that is not there or contradicts itself."""


class BodyError(KinefitError):
    """A body file, or a name asked of a body, is wrong."""


class ObservationError(KinefitError):
    """Measurements have the wrong shape, unit, rate or content."""


class TrackingError(KinefitError):
    """A motion cannot be found in the measurements given."""


class ExportError(KinefitError):
    """A result cannot be written (full disk, no permission, missing extra)."""


class AssetError(KinefitError):
    """A pinned package with sample data cannot be fetched or is not the one expected."""


def choices(kind: str, name: str, valid: object) -> str:
    """Sentence that names an unknown thing and lists what exists: for messages."""
    listed = ", ".join(str(v) for v in valid) or "none"  # type: ignore[attr-defined]
    return f"no {kind} '{name}'; there are: {listed}"
