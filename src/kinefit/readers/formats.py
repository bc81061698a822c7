"""Formats of the files of keypoints, markers and calibrations: kinefit's own, and those of plug-ins.

Other distributions name theirs in the entry point group `kinefit.readers`, as `keypoints.NAME`, `markers.NAME` or
`calibration.NAME`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kinefit.errors import PluginError
from kinefit.readers.plugins import Extension, Extensions, installed

GROUP = "kinefit.readers"
"""Group of the entry points by which other distributions add formats of files."""

_KINDS = ("keypoints.", "markers.", "calibration.")


@dataclass(frozen=True, kw_only=True)
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
        """Suffixes that are none, or parts that are no functions."""
        plain = isinstance(self.suffixes, tuple) and all(isinstance(s, str) and s == s.lower() for s in self.suffixes)
        if not plain or not all(suffix.startswith(".") for suffix in self.suffixes):
            return f"has the suffixes {self.suffixes!r}, not a tuple such as ('.csv',)"
        parts = [self.read] if self.recognise is None else [self.read, self.recognise]
        return "" if all(map(callable, parts)) else "has a `read` or `recognise` that is no function"

    def recognises(self, path: Path) -> bool:
        """Whether a file is of this format."""
        if self.recognise is None:
            return path.suffix.lower() in self.suffixes
        return self.call("recognise", path, valid=lambda found: isinstance(found, bool), what="True or False")


class FileFormats(Extensions[FileFormat]):
    """The formats of one kind of file."""

    def _usable(self, faults: list[PluginError]) -> Iterator[tuple[str, FileFormat]]:
        """All formats that can be imported, kinefit's own first; errors of the others are added to `faults`."""
        for name in self.names():
            try:
                yield name, self.get(name)
            except PluginError as error:
                faults.append(error)
        for name, plugins in installed(GROUP).items():
            if not name.startswith(_KINDS):
                remedy = f"Its author writes {', '.join(f'{kind}{name}' for kind in _KINDS)}."
                faults.append(plugins[0].error("has a name that states no kind of file", remedy))

    def name_of(self, path: Path, *, by_suffix: bool = False) -> str | None:
        """Name of the format that recognises a file, kinefit's own asked first; None if none does.

        `by_suffix`: only formats with the suffix of the file are asked.

        Raises
        ------
        PluginError
            No format recognises the file, and one of a plug-in cannot be asked.
        """
        faults: list[PluginError] = []
        for name, format in self._usable(faults):
            try:
                if (path.suffix.lower() in format.suffixes or not by_suffix) and format.recognises(path):
                    return name
            except PluginError as error:
                faults.append(error)
        if faults:
            raise faults[0]
        return None

    def recognised(self, path: Path) -> FileFormat | None:
        """The format that recognises a file, as `name_of`."""
        name = self.name_of(path)
        return None if name is None else self.get(name)


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
