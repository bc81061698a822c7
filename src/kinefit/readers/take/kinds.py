"""Kinds of sensors that a take file can name: one record a kind, in one list, and in plug-ins of other distributions.

A kind is a table of the take file (`[[tracker]]`), the reading of an entry into a recording, and the sensor that fits
the body to it. Kinds of kinefit stand in `BUILT_IN`, and are imported when a take names them. Other distributions name
theirs in the entry point group `kinefit.sensors`.
"""

from __future__ import annotations

import hashlib
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from kinefit.bodies import Body
from kinefit.errors import KinefitError, PluginError, TakeError
from kinefit.findings import Finding
from kinefit.observations.videos import SensorRecording

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

BUILT_IN = {
    "silhouette": "kinefit.sensors.kinds.silhouettes:SILHOUETTES",
    "region": "kinefit.sensors.kinds.silhouettes:REGIONS",
    "lines": "kinefit.sensors.kinds.lines:KIND",
    "surface_points": "kinefit.sensors.kinds.surface_points:KIND",
    "tracker": "kinefit.sensors.kinds.trackers:KIND",
}
"""{table of a take file: where its kind stands}, in the order in which they are read."""

PLUGIN_COMMENT = "of the plug-in "
"""Begin of the comment that `kinefit init` writes beside the name of a plug-in's table; its distribution follows."""

GROUP = "kinefit.sensors"
"""Group of the entry points by which other distributions add kinds: `table = "module:kind"`."""


class WrongEntryError(TakeError, ValueError):
    """Keys of an entry that do not agree."""


def refuse(wrong: object, problem: str, remedy: str) -> None:
    """Raise WrongEntryError if something is wrong."""
    if wrong:
        raise WrongEntryError(problem, remedy=remedy)


class TakeEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the tables of a take file: its fields are the keys, their types and bounds the checks.

    A `Path` is absolute once it is read, and has to exist. `Annotated[float, Meta(gt=0, description="Give metres.")]`
    bounds a number; the description is the remedy in the error. `__post_init__` calls `refuse` on keys that do not
    agree.
    """

    def _uses(self, given: str, only: Mapping[str, Sequence[str]]) -> None:
        """Refuse keys that mean nothing with the entry's format; `only`: {key: formats}."""
        for key, formats in only.items():
            odd = getattr(self, key) not in (None, ()) and given not in formats
            refuse(odd, f"'{key}' has no use with format = \"{given}\"", f"Remove it; it is for {', '.join(formats)}.")

    def _ordered(self, *keys: str) -> None:
        """Refuse ranges (first, last) that are none."""
        for key in keys:
            value = getattr(self, key) or ()
            for one in value if value and isinstance(value[0], tuple) else (value,):
                refuse(one and not one[0] < one[1], f"{key} has {list(one)}", "Give the lesser number first.")


@dataclass(frozen=True)
class Proposal:
    """An entry that `kinefit init` writes for files of a folder.

    Parameters
    ----------
    entry : {key: value} of the table; a `Path` is written relative to the take file
    reason : why, as the comment beside the first key
    used : False for an entry that is written as a comment
    """

    entry: Mapping[str, Any]
    reason: str
    used: bool = True


@dataclass(frozen=True)
class Plugin:
    """A kind of another distribution, as its entry point names it; `str` names both in messages."""

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
        """Package or module of the highest level in which the kind is."""
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
        fix = f"Tell its author; without {self.distribution} (pip uninstall {self.distribution}) remove the table."
        return PluginError(f"{self} {problem}", remedy=remedy or fix, **more)

    def raised(self, error: BaseException) -> str:
        """What it raised, and the line of its code; "" if none of its code was running."""
        found = ""
        for frame, line in traceback.walk_tb(error.__traceback__):
            if frame.f_globals.get("__name__", "").partition(".")[0] == self.package:
                code = frame.f_code
                found = f"in {code.co_qualname} ({Path(code.co_filename).name}, line {line})"
        return found and f"raised {type(error).__name__} {found}: {error}"


@dataclass(frozen=True, kw_only=True)
class SensorKind:
    """A kind of sensor: its table of a take file, its files, and how a body is fitted to it.

    Parameters
    ----------
    table : name of the table, "insole" for `[[insole]]`; that of the entry point
    summary : what it is, in a line
    entry : subclass of `TakeEntry`, the keys of the table
    read : (entry, name of the sensor, `TakeCameras` of the take) -> `SensorRecording` of this name
    sensor : (entry, recording, body) -> `Sensor` of this name; default: frames are of a class that kinefit tracks, such
        as `LineFrame`, with the name of their camera as their sensor
    sigma : (entry) -> {sensor: standard deviation [m] or [px]} of such frames
    check : (entry, recording, body) -> findings of `kinefit check`
    propose : (files of a folder) -> `Proposal` of each entry that `kinefit init` writes
    label : name of the sensor of a single entry, "insole"; of several "insole 2"; default: the table
    finds_pose : whether it shows where the body is, so that it needs no start
    shows_everybody : whether it shows all people in view, and not the tracked person alone
    replaces_keypoints : whether videos beside it are not searched for keypoints, where the take names none
    records : classes, besides its measurements, that a checkpoint has to store
    plugin : the entry point of another distribution; None for a kind of kinefit
    """

    table: str
    summary: str
    entry: type[TakeEntry]
    read: Callable[[Any, str, Any], SensorRecording]
    sensor: Callable[[Any, Any, Body], Any] | None = None
    sigma: Callable[[Any], Mapping[str, float]] = lambda _: {}
    check: Callable[[Any, Any, Body], Iterable[Finding]] | None = None
    propose: Callable[[Sequence[Path]], Iterable[Proposal]] | None = None
    label: str = ""
    finds_pose: bool = False
    shows_everybody: bool = False
    replaces_keypoints: bool = False
    records: tuple[type, ...] = ()
    plugin: Plugin | None = None

    @property
    def comment(self) -> str:
        """What stands beside the table's name where `kinefit init` writes it."""
        return self.summary if self.plugin is None else f"{PLUGIN_COMMENT}{self.plugin.version}: {self.summary}"

    def call(self, part: str, *args: Any, valid: Callable[[Any], bool], what: str) -> Any:
        """Result of a part of the kind; `valid` of it is True if it is `what` the part must return.

        Raises
        ------
        PluginError
            A part of a plug-in raised something else than a KinefitError, or returned something else.
        """
        try:
            result = getattr(self, part)(*args)
            result = list(result) if isinstance(result, Iterator) else result
        except KinefitError:
            raise
        except Exception as error:
            if self.plugin is None:
                raise
            raised = self.plugin.raised(error) or f"raised {type(error).__name__}: {error}"
            raise self.plugin.error(raised, place=f"`{part}`") from error
        if self.plugin is not None and not valid(result):
            raise self.plugin.error(f"returned a {type(result).__name__} from `{part}`, not {what}", place=f"`{part}`")
        return result


@contextmanager
def naming_plugins(sensors: Iterable[tuple[str, SensorKind]], file: Path) -> Iterator[None]:
    """Context in which sensors of plug-ins run: an error of theirs, or about their rows, names the plug-in.

    Parameters
    ----------
    sensors : name and kind of each sensor
    file : the take

    Raises
    ------
    PluginError
        Code of a plug-in raised an error, or a sensor of one broke the rules of sensors.
    """
    of_plugins = [(name, kind.table, kind.plugin) for name, kind in sensors if kind.plugin is not None]
    try:
        yield
    except PluginError:
        raise
    except KinefitError as error:
        for name, table, plugin in of_plugins:
            if f"sensor '{name}'" in error.problem:
                more: dict[str, Any] = {"file": file, "place": f"[[{table}]]"}
                raise plugin.error(f"failed: {error.problem}", error.remedy, **more) from error
        raise
    except Exception as error:
        for _, table, plugin in of_plugins:
            if raised := plugin.raised(error):
                raise plugin.error(raised, file=file, place=f"[[{table}]]") from error
        raise


@cache
def plugins() -> dict[str, tuple[Plugin, ...]]:
    """{table: the plug-ins that name it} of all installed distributions; none of them is imported."""
    from importlib.metadata import entry_points  # 0.03 s

    found: dict[str, tuple[Plugin, ...]] = {}
    for point in sorted(entry_points(group=GROUP), key=lambda point: (point.name, point.value)):
        found[point.name] = (*found.get(point.name, ()), Plugin(point))
    return found


def kind_names() -> tuple[str, ...]:
    """Tables of all kinds, built-in ones first."""
    return tuple(dict.fromkeys([*BUILT_IN, *plugins()]))


def kinds_of(take: Any) -> list[SensorKind]:
    """The kinds of the sensors of a take."""
    return [kind_of(table) for table in take.sensors]


def refuse_shadows(table: str, tables: Iterable[str]) -> None:
    """Refuse a plug-in with the name of a built-in table, or of another plug-in.

    Raises
    ------
    PluginError
        With the names of both.
    """
    found = plugins().get(table, ())
    if found and table in (*tables, *BUILT_IN):
        remedy = f"Remove it (pip uninstall {found[0].distribution}), or ask its author for another name."
        raise found[0].error(f"has the name of kinefit's own table [[{table}]]", remedy)
    if len(found) > 1:
        remedy = f"Remove one: pip uninstall {found[1].distribution}."
        raise found[0].error(f"has the same name as {found[1].version}", remedy)


@cache
def kind_of(table: str) -> SensorKind:
    """The kind of a table, imported now.

    Raises
    ------
    PluginError
        A plug-in that cannot be imported, that needs a package which is not installed, or that is no kind.
    """
    if table in BUILT_IN:
        module, _, name = BUILT_IN[table].partition(":")
        kind: SensorKind = getattr(import_module(module), name)
        return kind
    refuse_shadows(table, ())
    plugin = plugins()[table][0]
    try:
        kind = plugin.point.load()
    except Exception as error:
        missing = (getattr(error, "name", None) or "").partition(".")[0]
        if isinstance(error, ModuleNotFoundError) and missing != plugin.package:
            remedy = f"Install it: pip install {missing}."
            raise plugin.error(f"needs the package '{missing}', which is not installed", remedy) from error
        raised = plugin.raised(error) or f"raised {type(error).__name__}: {error}"
        remedy = f"Install it again: pip install --force-reinstall {plugin.distribution}."
        raise plugin.error(f"cannot be imported: it {raised}", remedy) from error
    if not (isinstance(kind, SensorKind) and isinstance(kind.entry, type) and issubclass(kind.entry, TakeEntry)):
        raise plugin.error("is no SensorKind with an entry of class TakeEntry")
    if kind.table != table:
        raise plugin.error(f"has the table '{kind.table}', not '{table}' as its entry point")
    return replace(kind, plugin=plugin)
