"""Kinds of sensors that a take file can name: one record a kind, in one list, and in plug-ins of other distributions.

A kind is a table of the take file (`[[tracker]]`), the reading of an entry into a recording, and the sensor that fits
the body to it. Kinds of kinefit stand in `BUILT_IN`, and are imported when a take names them. Other distributions name
theirs in the entry point group `kinefit.sensors`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from kinefit.bodies import Body
from kinefit.errors import KinefitError, PluginError, TakeError
from kinefit.findings import Finding
from kinefit.observations.videos import SensorRecording
from kinefit.readers.plugins import CALIBRATIONS, KEYPOINTS, MARKERS, Extension, Extensions, Plugin

BUILT_IN = {
    "silhouette": "kinefit.sensors.kinds.silhouettes:SILHOUETTES",
    "region": "kinefit.sensors.kinds.silhouettes:REGIONS",
    "lines": "kinefit.sensors.kinds.lines:KIND",
    "surface_points": "kinefit.sensors.kinds.surface_points:KIND",
    "tracker": "kinefit.sensors.kinds.poses:TRACKERS",
    "pose": "kinefit.sensors.kinds.poses:POSES",
}
"""{table of a take file: where its kind stands}, in the order in which they are read."""


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
    reason : why, as the comment after the first key
    used : False for an entry that is written as a comment
    """

    entry: Mapping[str, Any]
    reason: str
    used: bool = True


@dataclass(frozen=True, kw_only=True)
class SensorKind(Extension):
    """A kind of sensor: its table of a take file, its files, and how a body is fitted to it.

    Parameters
    ----------
    table : name of the table, "insole" for `[[insole]]`; that of the entry point
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
    replaces_keypoints : whether videos of the same take are not searched for keypoints, where the take names none
    records : classes, besides its measurements, that a checkpoint has to store
    """

    table: str
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

    def fault(self, name: str) -> str:
        """An entry of another class, or another table than `name`."""
        if not (isinstance(self.entry, type) and issubclass(self.entry, TakeEntry)):
            return "is no SensorKind with an entry of class TakeEntry"
        return "" if self.table == name else f"has the table '{self.table}', not '{name}' as its entry point"


KINDS = Extensions("kinefit.sensors", SensorKind, "table", BUILT_IN)
"""All kinds by the names of their tables."""


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
    try:
        yield
    except PluginError:
        raise
    except Exception as error:
        for name, kind in sensors:
            more: dict[str, Any] = {"file": file, "place": f"[[{kind.table}]]"}
            if kind.plugin is None:
                continue
            if isinstance(error, KinefitError) and f"sensor '{name}'" in error.problem:
                raise kind.plugin.error(f"failed: {error.problem}", error.remedy, **more) from error
            if not isinstance(error, KinefitError) and (raised := kind.plugin.raised(error)):
                raise kind.plugin.error(raised, **more) from error
        raise


def kinds_of(take: Any) -> list[SensorKind]:
    """The kinds of the sensors of a take."""
    return [KINDS.get(table) for table in take.sensors]


def plugins_of(take: Any) -> list[Plugin]:
    """Plug-ins of the kinds of a take, and those that know its files."""
    found = [KINDS.plugins(table) for table in take.sensors]
    found += [KEYPOINTS.plugins(entry.format) for entry in take.keypoints]
    found += [MARKERS.plugins(MARKERS.name_of(entry.file) or "") for entry in take.markers]
    with suppress(PluginError):  # which reading the calibration raises, if kinefit itself cannot
        found += [CALIBRATIONS.plugins((take.calibration and CALIBRATIONS.name_of(take.calibration.file)) or "")]
    return list(dict.fromkeys(plugin for plugins in found for plugin in plugins))
