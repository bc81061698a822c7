"""Formats of the files of keypoints, markers and calibrations: kinefit's own, and those of plug-ins.

Other distributions name theirs in the entry point group `kinefit.readers`, as `keypoints.NAME`, `markers.NAME` or
`calibration.NAME`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kinefit.errors import KinefitError, PluginError
from kinefit.readers.plugins import Extension, Extensions, installed

GROUP = "kinefit.readers"
"""Group of the entry points by which other distributions add formats of files."""

_KINDS = ("keypoints.", "markers.", "calibration.")


@dataclass(frozen=True)
class FileFormat(Extension):
    """A format of files that are read into keypoints, markers or a rig.

    Parameters
    ----------
    suffixes : of such files, in lower case, ".csv"
    read : of keypoints (path, *, camera, rate) -> `Keypoints` of this camera and rate [Hz], in pixels of the file; of
        markers (path, *, unit) -> `Markers` [m], with the unit that the user states, or None; of a calibration
        (path, *, unit, image_size) -> `Rig` [m], with "auto" or the unit that the user states, and a function that
        gives (width, height) [px] or None for the name of a camera
    recognise : (path) -> whether a file is of this format; default: by its suffix
    has_all_cameras : whether a file of keypoints is of several cameras
    """

    suffixes: tuple[str, ...]
    read: Callable[..., Any]
    recognise: Callable[[Path], bool] | None = None
    has_all_cameras: bool = False

    def fault(self, name: str) -> str:
        """Suffixes that no file has."""
        wrong = [suffix for suffix in self.suffixes if suffix != Path(f"x{suffix}".lower()).suffix]
        return f"has the suffixes {self.suffixes!r}, not a tuple such as ('.csv',)" if wrong else ""


class FileFormats(Extensions[FileFormat]):
    """The formats of one kind of file."""

    def name_of(self, path: Path, faults: list[KinefitError] | None = None) -> str | None:
        """Name of the format that recognises a file, kinefit's own asked first; None if none does.

        Parameters
        ----------
        faults : filled with errors of plug-ins; then only formats with the suffix of the file are asked

        Raises
        ------
        PluginError
            Without `faults`: no format recognises the file, and one of a plug-in cannot be asked.
        """
        errors: list[KinefitError] = []
        for name in self.names():
            try:
                format = self.get(name)
                found = path.suffix.lower() in format.suffixes
                if format.recognise is not None and (found or faults is None):
                    found = format.call("recognise", path, valid=lambda one: type(one) is bool, what="a bool")
                if found:
                    return name
            except PluginError as error:
                errors.append(error)
        for name, plugins in installed(GROUP).items():
            if not name.startswith(_KINDS):
                remedy = f"Its author writes {', '.join(f'{kind}{name}' for kind in _KINDS)}."
                errors.append(plugins[0].error("has a name that states no kind of file", remedy))
        if faults is not None:
            faults += errors
        elif errors:
            raise errors[0]
        return None


KEYPOINTS = FileFormats(GROUP, FileFormat, "keypoint format", {
    "openpose": "kinefit.readers.keypoints:OPENPOSE", "mediapipe": "kinefit.readers.keypoints:MEDIAPIPE",
    "caliscope": "kinefit.readers.keypoints:CALISCOPE",
}, _KINDS[0])  # fmt: skip
"""Formats of keypoints, which take files name; the most informative confidence first."""

MARKERS = FileFormats(GROUP, FileFormat, "marker format", {
    "c3d": "kinefit.readers.markers:C3D", "trc": "kinefit.readers.markers:TRC",
}, _KINDS[1])  # fmt: skip
"""Formats of labelled or unlabelled markers."""

CALIBRATIONS = FileFormats(GROUP, FileFormat, "calibration format", {}, _KINDS[2])
"""Formats of calibrations of plug-ins; those of kinefit are recognised together, by `read_calibration`."""
