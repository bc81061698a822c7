"""Formats in which motions are written: kinefit's own, and those of plug-ins.

Other distributions name theirs in the entry point group `kinefit.exporters`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinefit._files import writing
from kinefit.errors import ExportError, PluginError, located
from kinefit.readers.plugins import Extension, Extensions

if TYPE_CHECKING:
    from kinefit.motion import Motion


@dataclass(frozen=True)
class MotionFormat(Extension):
    """A format in which motions are written.

    Parameters
    ----------
    file : its file among results, "motion.dae"; of kinefit's own formats also a folder
    write : (motion, path, **options) -> None; writes a `Motion` to a path with the ending of `file`, which is that of
        the result once the function has returned
    unit, up, names, rest : values of the option of that name, the default first; none: `write` has no such option
    why : reason for which there is no more choice
    """

    file: str
    write: Callable[..., None]
    unit: tuple[str, ...] = ()
    up: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    rest: tuple[str, ...] = ()
    why: str = field(default="", kw_only=True)

    @property
    def ending(self) -> str:
        """End of the names of its files, ".bvh"; "" if it is a folder."""
        return Path(self.file).suffix

    def fault(self, name: str) -> str:
        """A file without an ending, or in a folder."""
        named = self.ending and Path(self.file).name == self.file
        return "" if named else f"has the file {self.file!r}, not a name with an ending such as 'motion.dae'"


OPTIONS = ("unit", "up", "names", "rest")
"""Options of formats."""

_UNITS, _RESTS, _UPS = ("m", "cm", "mm"), ("body", "t"), ("x", "y", "z", "-x", "-y", "-z")
_Y_UPS, _Z_UPS = ("y", "x", "z", *_UPS[3:]), ("z", "x", "y", *_UPS[3:])
_JOINTS = ("kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh")
_BVH, _HANIM = ((first, *(name for name in _JOINTS if name != first)) for first in ("bvh", "hanim"))
_OPENSIM = "OpenSim files are in metres, y up, with the names of the body's coordinates"


def _own(name: str, file: str, summary: str, *choices: Any, why: str = "") -> tuple[str, MotionFormat]:
    """Name and record of a format that `exporters.write_NAME` writes; choices of `OPTIONS`."""

    def write(motion: Motion, path: Path, **options: Any) -> None:
        from kinefit import exporters

        getattr(exporters, f"write_{name}")(motion.body if name == "osim" else motion, path, **options)

    return name, MotionFormat(summary, file, write, *choices, why=why)


FORMATS = Extensions("kinefit.exporters", MotionFormat, "format", dict([
    _own("motion", "motion.npz", "all results, for kinefit view, kinefit export and kinefit.read_motion"),
    _own("csv", "tables", "tables of angles, joint centres, landmarks, quality, residuals", _UNITS, _UPS, _JOINTS),
    _own("parquet", "tables", "the same tables as Parquet", _UNITS, _UPS, _JOINTS),
    _own("bvh", "motion.bvh", "animated skeleton for animation programs", ("cm", "m", "mm"), _Y_UPS, _BVH, _RESTS),
    _own("glb", "motion.glb", "animated figure for browsers and game engines", (), (), _JOINTS, _RESTS,
         why="GLB is in metres and y up by its specification"),
    _own("usd", "motion.usdc", "animated figure for film and simulation programs", _UNITS, ("y", "z"), _JOINTS,
         _RESTS, why="USD supports only y and z up"),
    _own("c3d", "motion.c3d", "joint centres and landmarks for motion laboratories", ("mm", "cm", "m"), _UPS,
         _JOINTS),
    _own("trc", "motion.trc", "landmarks over time for OpenSim", _UNITS, _Y_UPS,
         why="TRC has landmarks, with their H-Anim names"),
    _own("x3d", "motion.x3d", "animated H-Anim figure for browsers and archives", (), (), _HANIM, _RESTS,
         why="X3D is in metres and y up by its standard"),
    _own("nwb", "motion.nwb", "joint centres with confidence for neuroscience", (), _UPS, _JOINTS,
         why="kinefit writes NWB in metres"),
    _own("mcap", "motion.mcap", "joint states and transforms for ROS 2", (), _Z_UPS, _JOINTS, why="ROS is in metres"),
    _own("rrd", "motion.rrd", "joints, error bars and angles for the viewer of Rerun", (), _UPS, _JOINTS,
         why="kinefit writes RRD in metres"),
    _own("jsonl", "motion.jsonl", "poses as JSON lines, as kinefit live sends them; for the Blender add-on", (), _UPS,
         why="JSON lines are in metres, with the names of the body's segments"),
    _own("mot", "motion.mot", "angles over time for OpenSim", why=_OPENSIM),
    _own("osim", "body.osim", "the fitted body for OpenSim", why=_OPENSIM),
]))  # fmt: skip
"""All formats of motions, by name."""

DEFAULT_FORMATS = ("motion", "csv", "bvh", "glb", "trc", "mot", "osim")
"""Formats that are written by default."""

_OTHER_RESULTS = {
    "overlays": "videos with the fitted skeleton",
    "montage": "one image of all cameras",
    "report": "results with error bars and findings, as a page for the browser",
}


def check_formats(names: Iterable[str]) -> None:
    """Import formats, before anything is computed.

    Raises
    ------
    ExportError
        A format that there is not.
    PluginError
        A plug-in that cannot be imported, or whose file is another format's.
    """
    own = {format.file: name for name, format in FORMATS.built_in.items() if not isinstance(format, str)}
    for name in names:
        FORMATS.check(name, ExportError)
        format = FORMATS.get(name)
        if format.plugin is not None and (other := own.setdefault(format.file, name)) != name:
            raise format.plugin.error(f"writes {format.file}, the file of the format '{other}'")


def description(name: str) -> str:
    """Use of a kind of result, in a line; of a plug-in that fails, why; another name as it is."""
    if name not in FORMATS.names():
        return _OTHER_RESULTS.get(name, name)
    try:
        return FORMATS.get(name).summary
    except PluginError as error:
        return error.problem


def write_format(motion: Motion, name: str, path: Path, **options: Any) -> None:
    """Write a motion in one of `FORMATS`, with options of its exporter; a plug-in's file appears whole or not at all.

    Raises
    ------
    ExportError
        The system refuses to write it.
    PluginError
        A plug-in raises an error, or writes nothing.
    """
    format = FORMATS.get(name)
    if format.plugin is None:
        format.write(motion, path, **options)
        return
    with located(path), writing(path) as temporary:
        format.call("write", motion, temporary, valid=lambda _: True, what="", **options)
        if not (temporary.is_file() and temporary.stat().st_size):
            raise format.plugin.error("wrote nothing", place="`write`")
