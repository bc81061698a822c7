"""What other distributions add to kinefit by entry points: records in tables of names, in addition to kinefit's own.

A record is imported when its name is used. Kinds of sensors are in the group `kinefit.sensors`, formats of motions in
`kinefit.exporters`, formats of files that are read in `kinefit.readers`.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from kinefit.errors import KinefitError, ObservationError, PluginError, check_choice

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

PLUGIN_COMMENT = "of the plug-in "
"""Begin of the comment that `kinefit init` writes after the name of a plug-in; its distribution follows."""


@dataclass(frozen=True)
class Plugin:
    """A record of another distribution, as its entry point names it; `str` names both in messages."""

    point: EntryPoint

    @property
    def distribution(self) -> str:
        """Name for `pip`."""
        return self.point.dist.name  # type: ignore[union-attr]

    @property
    def version(self) -> str:
        """Name and version of the distribution."""
        return f"{self.distribution} {self.point.dist.version}"  # type: ignore[union-attr]

    @property
    def package(self) -> str:
        """Package or module of the highest level in which the record is."""
        return self.point.module.partition(".")[0]

    @property
    def code_digest(self) -> bytes:
        """Digest of its version and, once it is imported, of its source."""
        digest, module = hashlib.sha256(self.version.encode()), sys.modules.get(self.point.module)
        file = Path(getattr(module, "__file__", None) or os.devnull)
        is_package = hasattr(sys.modules.get(self.package), "__path__")
        for source in sorted(file.parent.rglob("*.py")) if is_package else [file]:
            digest.update(source.read_bytes())
        return digest.digest()

    def __str__(self) -> str:
        return f"the plug-in {self.version} (entry point '{self.point.name}' of {self.point.group})"

    def error(self, problem: str, remedy: str | None = None, **more: Any) -> PluginError:
        """An error that names the plug-in; `problem` follows its name."""
        fix = f"Tell its author; without {self.distribution} (pip uninstall {self.distribution}) remove what names it."
        return PluginError(f"{self} {problem}", remedy=remedy or fix, **more)

    def raised(self, error: BaseException) -> str:
        """What it raised, and the line of its code; "" if none of its code was running."""
        found = ""
        for frame, line in traceback.walk_tb(error.__traceback__):
            if frame.f_globals.get("__name__", "").partition(".")[0] == self.package:
                code = frame.f_code
                found = f"in {code.co_qualname} ({Path(code.co_filename).name}, line {line})"
        return found and f"raised {type(error).__name__} {found}: {error}"

    def load(self) -> Any:
        """What its entry point names, imported now.

        Raises
        ------
        PluginError
            It cannot be imported, or needs a package which is not installed.
        """
        try:
            return self.point.load()
        except Exception as error:
            missing = (getattr(error, "name", None) or "").partition(".")[0]
            if isinstance(error, ModuleNotFoundError) and missing != self.package:
                remedy = f"Install it: pip install {missing}."
                raise self.error(f"needs the package '{missing}', which is not installed", remedy) from error
            raised = self.raised(error) or f"raised {type(error).__name__}: {error}"
            remedy = f"Install it again: pip install --force-reinstall {self.distribution}."
            raise self.error(f"cannot be imported: it {raised}", remedy) from error


@dataclass(frozen=True)
class Extension:
    """Base of the records that plug-ins can add.

    Parameters
    ----------
    summary : what it is, in a line
    plugin : the entry point of another distribution, set when it is loaded; None for a record of kinefit
    """

    summary: str
    plugin: Plugin | None = field(default=None, kw_only=True)

    @property
    def comment(self) -> str:
        """What follows its name where `kinefit init` writes it."""
        return self.summary if self.plugin is None else f"{PLUGIN_COMMENT}{self.plugin.version}: {self.summary}"

    def fault(self, name: str) -> str:
        """What is wrong with a record of this name of a plug-in, after the plug-in's name; "" if nothing."""
        return ""

    def call(self, part: str, *args: Any, valid: Callable[[Any], bool], what: str, **options: Any) -> Any:
        """Result of a part of the record; `valid` of it is True if it is `what` the part must return.

        Raises
        ------
        PluginError
            A part of a plug-in raised something else than a KinefitError, or returned something else.
        OSError
            The disk is full.
        """
        try:
            result = getattr(self, part)(*args, **options)
            result = list(result) if isinstance(result, Iterator) else result
        except KinefitError:
            raise
        except Exception as error:
            if self.plugin is None or getattr(error, "errno", None) == errno.ENOSPC:
                raise
            raised = self.plugin.raised(error) or f"raised {type(error).__name__}: {error}"
            raise self.plugin.error(raised, place=f"`{part}`") from error
        if self.plugin is not None and not valid(result):
            raise self.plugin.error(f"returned a {type(result).__name__} from `{part}`, not {what}", place=f"`{part}`")
        return result


_Record = TypeVar("_Record", bound=Extension)


@dataclass(frozen=True, eq=False)
class Extensions(Generic[_Record]):
    """Records of one class by name: kinefit's own, and those of plug-ins.

    Parameters
    ----------
    group : of entry points, `name = "module:record"`
    record : class
    what : what has such a name, for messages: "keypoint format"
    built_in : {name: record, or "module:record", which is imported when it is used}
    prefix : with which names of the entry points begin
    """

    group: str
    record: type[_Record]
    what: str
    built_in: Mapping[str, _Record | str] = field(default_factory=dict)
    prefix: str = ""

    def plugins(self, name: str) -> tuple[Plugin, ...]:
        """The plug-ins of a name; none of them is imported."""
        return installed(self.group).get(self.prefix + name, ())

    def names(self) -> tuple[str, ...]:
        """All names, kinefit's own first."""
        added = (point.removeprefix(self.prefix) for point in installed(self.group) if point.startswith(self.prefix))
        return tuple(dict.fromkeys([*self.built_in, *added]))

    def refuse_shadows(self, name: str, others: Iterable[str] = ()) -> None:
        """Refuse a plug-in with a name of kinefit, which `others` may be too, or of another plug-in.

        Raises
        ------
        PluginError
            With the names of both.
        """
        found = self.plugins(name)
        if found and name in (*others, *self.built_in):
            remedy = f"Remove it (pip uninstall {found[0].distribution}), or ask its author for another name."
            raise found[0].error(f"has the name of kinefit's own {self.what} '{name}'", remedy)
        if len(found) > 1:
            remedy = f"Remove one: pip uninstall {found[1].distribution}."
            raise found[0].error(f"has the same name as {found[1].version}", remedy)

    def get(self, name: str, error: type[KinefitError] = PluginError, **more: Any) -> _Record:
        """The record of a name, imported now.

        Raises
        ------
        `error`, with `more`
            A name that neither kinefit nor a plug-in has: what there is, and what to install.
        PluginError
            As `refuse_shadows`; a plug-in that cannot be imported, or whose record is wrong.
        """
        check_choice(self.what, name, self.names(), error, **{"remedy": install(self.what)} | more)
        record: _Record = _record(self, name)
        return record


def install(what: str, name: str = "", text: str = "") -> str:
    """Remedy for the name of something that is not known.

    Parameters
    ----------
    what : that it is the name of
    name, text : pattern of the name in a take file, and its text, in which `kinefit init` wrote the distribution
    """
    noted = re.search(rf"^{name}\s*#.*{PLUGIN_COMMENT}(\S+)", text, re.MULTILINE)
    pip = f": {sys.executable} -m pip install {noted[1]}" if noted else ""
    return f"Correct the name, or install the plug-in that adds this {what}{pip}."


@cache
def installed(group: str) -> dict[str, tuple[Plugin, ...]]:
    """{name: plug-ins} of the entry points of a group, of all distributions; none of them is imported."""
    from importlib.metadata import entry_points  # 0.03 s

    found: dict[str, tuple[Plugin, ...]] = {}
    for point in sorted(entry_points(group=group), key=lambda point: (point.name, point.value)):
        found[point.name] = (*found.get(point.name, ()), Plugin(point))
    return found


@cache
def _record(of: Extensions[Any], name: str) -> Any:
    of.refuse_shadows(name)
    if name in of.built_in:
        own = of.built_in[name]
        return resolve_name(own) if isinstance(own, str) else own
    plugin = of.plugins(name)[0]
    record = plugin.load()
    if not isinstance(record, of.record):
        raise plugin.error(f"is no {of.record.__name__}")
    from kinefit._arguments import checked  # and NumPy, which help does without

    try:
        record = checked(type(record))(**vars(record) | {"plugin": plugin})
    except ObservationError as error:
        raise plugin.error(f"has a wrong record, {error.problem}", error.remedy) from error
    if fault := record.fault(name):
        raise plugin.error(fault)
    return record


_KINDS_OF_FILES = ("keypoints.", "markers.", "calibration.")  # with which names of entry points begin


@dataclass(frozen=True)
class FileFormat(Extension):
    """A format of files that are read into keypoints, markers or a rig.

    Parameters
    ----------
    suffixes : ends of the names of such files, in lower case, ".csv"
    read : of keypoints (path, *, camera, rate) -> `Keypoints` of this camera and rate [Hz], in pixels of the file; of
        markers (path, *, unit) -> `Markers` [m], with the unit that the user states, or None; of a calibration
        (path, *, unit, image_size) -> `Rig` [m], with "auto" or the unit that the user states, and a function that
        gives (width, height) [px] or None for the name of a camera
    recognise : (path) -> whether a file is of this format; default: by the end of its name
    has_all_cameras : whether a file of keypoints is of several cameras
    """

    suffixes: tuple[str, ...]
    read: Callable[..., Any]
    recognise: Callable[[Path], bool] | None = None
    has_all_cameras: bool = False


class FileFormats(Extensions[FileFormat]):
    """The formats of one kind of file."""

    def names(self) -> tuple[str, ...]:
        """All names, kinefit's own first; warns of plug-ins of no kind of file."""
        for point, plugins in installed(self.group).items():
            if not point.startswith(_KINDS_OF_FILES):
                problem = f"{plugins[0]} is ignored: its name begins with none of {', '.join(_KINDS_OF_FILES)}"
                warnings.warn(problem, stacklevel=2)
        return super().names()

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
        errors = [] if faults is None else faults
        for name in self.names():
            try:
                format = self.get(name)
                found = path.name.lower().endswith(format.suffixes)
                if format.recognise is not None and (found or faults is None):
                    found = format.call("recognise", path, valid=lambda one: type(one) is bool, what="a bool")
                if found:
                    return name
            except PluginError as error:
                errors.append(error)
        if errors and faults is None:
            raise errors[0]
        return None


KEYPOINTS = FileFormats("kinefit.readers", FileFormat, "keypoint format", {
    "openpose": "kinefit.readers.landmarks.keypoints:OPENPOSE",
    "alphapose": "kinefit.readers.landmarks.results:ALPHAPOSE",
    "mmpose": "kinefit.readers.landmarks.results:MMPOSE",
    "mediapipe": "kinefit.readers.landmarks.keypoints:MEDIAPIPE",
    "deeplabcut": "kinefit.readers.landmarks.results:DEEPLABCUT",
    "sleap": "kinefit.readers.landmarks.results:SLEAP",
    "freemocap": "kinefit.readers.landmarks.keypoints:FREEMOCAP",
    "caliscope": "kinefit.readers.landmarks.keypoints:CALISCOPE",
    "sports2d": "kinefit.readers.landmarks.results:SPORTS2D",
}, _KINDS_OF_FILES[0])  # fmt: skip
"""Formats of keypoints, which take files name; the most informative confidence first."""

MARKERS = FileFormats("kinefit.readers", FileFormat, "marker format", {
    "c3d": "kinefit.readers.markers:C3D", "trc": "kinefit.readers.markers:TRC",
}, _KINDS_OF_FILES[1])  # fmt: skip
"""Formats of labelled or unlabelled markers."""

CALIBRATIONS = FileFormats("kinefit.readers", FileFormat, "calibration format", {}, _KINDS_OF_FILES[2])
"""Formats of calibrations of plug-ins; those of kinefit are recognised together, by `read_calibration`."""
