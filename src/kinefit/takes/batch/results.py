"""Write the results of one motion into a folder: formats, overlay videos, a montage, the report with provenance."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinefit.errors import ExportError, located
from kinefit.readers.plugins import PLUGIN_COMMENT, Extension, Extensions

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from kinefit.bodies.motion import Motion, Residuals
    from kinefit.readers.take.file import Take
    from kinefit.readers.take.load import Observations
    from kinefit.readers.videos.video import Video

Step = Callable[[str, int, int], None]
"""Called with the name of the work, the number of steps done, and the number of all steps (0: unknown)."""


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
_JOINTS = ("kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh", "vrm", "unity", "unreal")
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
    _own("fbx", "motion.fbx", "animated figure for Unreal, Unity, Maya, MotionBuilder", ("cm", "m", "mm"), ("y", "z"),
         _JOINTS, _RESTS, why="kinefit writes FBX with y or z up"),
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
    _own("forces", "forces.mot", "ground forces of plates for OpenSim; with mot where there are plates", why=_OPENSIM),
    _own("osim", "body.osim", "the fitted body for OpenSim", why=_OPENSIM),
]))  # fmt: skip
"""All formats of motions, by name."""

DEFAULT_FORMATS = ("motion", "csv", "bvh", "glb", "trc", "mot", "osim")
"""Formats that are written by default."""

_OTHER_RESULTS = {
    "overlays": "videos with the fitted skeleton",
    "markers": "markers as measured, for OpenSim beside body.osim",
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
        format = FORMATS.get(name, ExportError)
        if format.plugin is not None and (other := own.setdefault(format.file, name)) != name:
            raise format.plugin.error(f"writes {format.file}, the file of the format '{other}'")


def description(name: str) -> str:
    """Use of a kind of result, in a line, or the plug-in that writes it, which is not imported."""
    if plugins := FORMATS.plugins(name):
        return f"{PLUGIN_COMMENT}{plugins[0].version}"
    return FORMATS.get(name).summary if name in FORMATS.built_in else _OTHER_RESULTS.get(name, name)


def write_format(motion: Motion, name: str, path: Path, **options: Any) -> None:
    """Write a motion in one of `FORMATS`, with options of its exporter; a plug-in's file appears whole or not at all.

    Raises
    ------
    ExportError
        The system refuses to write it.
    PluginError
        A plug-in raises an error, or writes nothing.
    """
    from kinefit._files import writing

    format = FORMATS.get(name)
    if format.plugin is None:
        format.write(motion, path, **options)
        return
    with located(path), writing(path) as temporary:
        format.call("write", motion, temporary, valid=lambda _: True, what="", **options)
        if not (temporary.is_file() and temporary.stat().st_size):
            raise format.plugin.error("wrote nothing", place="`write`")


_PACKAGES = ("kinefit", "numpy", "numba", "opencv-python-headless", "av")


def silent(*_: object) -> None:
    """Report nothing: in place of a `Step` or a function for sentences."""


def write_results(motion: Motion, folder: Path, formats: Iterable[str], step: Step, files: dict[str, Path]) -> None:
    """Write a motion in several formats; written files are added to `files`."""
    from kinefit._mapped import release

    formats = tuple(dict.fromkeys([*formats, *["forces"] * bool(motion.plates and "mot" in formats)]))
    for number, format in enumerate(formats):
        step("results", number, len(formats))
        path = folder / FORMATS.get(format).file
        write_format(motion, format, path)
        files[format] = path
        for residuals in motion.residuals.values():
            release(residuals.values, residuals.weights, residuals.measured)
    step("results", len(formats), len(formats))


def write_overlays(
    motion: Motion, take: Take, seen: Observations, folder: Path, step: Step, files: dict[str, Path], *,
    skin: bool = False,
) -> None:  # fmt: skip
    """Write overlay videos of all cameras and depth sensors, and a montage; written files are added to `files`.

    With `skin` the body's skin is drawn on the videos of cameras, too.
    """
    import numpy as np

    from kinefit.exporters import depth_picture, draw_overlay, write_depth_overlay, write_montage, write_overlay
    from kinefit.exporters.pictures.overlay import frames_of

    if not (seen.videos or seen.depth) or seen.rig is None:
        return
    pictures, middle = {}, motion.times[len(motion) // 2]
    for name, colour, offset, given in _shown_videos(motion, take, seen):
        shown = colour.frame_at(float(np.clip(middle - offset, 0.0, colour.times[-1]))) or 0
        at = motion.frame_at(colour.times[shown] + offset)
        pictures[name] = draw_overlay(colour.read(shown), motion, at, seen.rig[name], skin=skin, **given)
        bar, count = f"overlay {name}", len(frames_of(motion, colour.times + offset))
        step(bar, 0, count)
        write_overlay(
            motion, seen.rig[name], colour, folder / "overlays" / f"{name}.mp4", time_offset=offset,
            progress=lambda done: step(bar, done, count), skin=skin, **given,  # noqa: B023
        )  # fmt: skip
        files["overlays"] = folder / "overlays"
    for video in seen.depth:
        camera, shown = seen.rig[video.sensor], video.nearest(float(middle))
        at = motion.frame_at(float(video.times[shown]))
        pictures[video.sensor] = depth_picture(video.frame(shown).depth, motion, at, camera, label=video.sensor)
        bar, count = f"overlay {video.sensor}", len(frames_of(motion, video.times))
        step(bar, 0, count)
        write_depth_overlay(
            motion, camera, video, folder / "overlays" / f"{video.sensor}.mp4",
            progress=lambda done: step(bar, done, count),  # noqa: B023
        )  # fmt: skip
        files["overlays"] = folder / "overlays"
    write_montage(pictures, folder / "montage.png")
    files["montage"] = folder / "montage.png"


def _shown_videos(
    motion: Motion, take: Take, seen: Observations
) -> Iterator[tuple[str, Video, float, dict[str, Any]]]:
    """Each camera's name, video, time offset [s], and what drawing on it needs."""
    from kinefit.takes.preparing.faces import shown_video

    for name in seen.videos:
        offset = next(entry.time_offset for entry in take.cameras if entry.name == name)
        with shown_video(take, seen, name) as video:
            yield name, video, offset, {"image_frame": seen.images[name], "residuals": _residuals(motion, name)}


def _residuals(motion: Motion, camera: str) -> Residuals | None:
    """Residuals of a camera's first detector; None if it has none."""
    labels = [label for label in motion.residuals if label == camera or label.startswith(f"{camera} ")]
    return motion.residuals[labels[0]] if labels else None


def write_track_report(
    motion: Motion, take: Take, seen: Observations, folder: Path, step: Step, files: dict[str, Path],
    pictures: str = "full", notes: Iterable[str] = (),
) -> None:  # fmt: skip
    """Write report.html into a folder of results, with links to `files`; it is added to them.

    Parameters
    ----------
    pictures : "full" or "none"
    notes : sentences for the user
    """
    from kinefit.exporters.report.cycles import read_norms
    from kinefit.exporters.report.report import write_report

    norms = read_norms(take.session.norms) if take.session.norms else None
    shown = {} if pictures == "none" else take_pictures(motion, take, seen, step)
    step("report", 0, 1)
    links = {path.relative_to(folder).as_posix(): description(name) for name, path in files.items()}
    files["report"] = write_report(
        motion, folder / "report.html", rig=seen.rig, pictures=shown, files=links, norms=norms,
        findings=[("warning", f"{note.rstrip('.')}.", "") for note in notes],
    )
    step("report", 1, 1)


def take_pictures(
    motion: Motion, take: Take, seen: Observations, step: Step
) -> dict[str, dict[int, NDArray[np.uint8]]]:
    """{camera: {frame: image (H, W, 3) of the person with the fit drawn on it}} of the frames that a report shows.

    Frames outside a camera's video are omitted.
    """
    from kinefit.exporters.report.report import close_up, report_frames

    out: dict[str, dict[int, NDArray[np.uint8]]] = {}
    if seen.rig is None:
        return out
    frames = sorted(report_frames(motion))
    for number, (name, video, offset, given) in enumerate(_shown_videos(motion, take, seen)):
        step("images", number, len(seen.videos))
        for frame in frames:
            shown = video.frame_at(motion.times[frame] - offset)
            if shown is not None:
                picture = close_up(video.read(shown), motion, frame, seen.rig[name], **given)
                out.setdefault(name, {})[frame] = picture
    step("images", len(seen.videos), len(seen.videos))
    return out


def provenance(take: Take, **more: Any) -> dict[str, Any]:
    """Provenance of a tracked take, for `Motion.provenance`: files, standard deviations, versions.

    `more` are further entries, such as smoothing={...} or tracking={...}.
    """
    from kinefit.readers.take.kinds import plugins_of

    out: dict[str, Any] = {
        "kinefit": metadata.version("kinefit"),
        "python": platform.python_version(),
        "packages": {name: version for name in _PACKAGES if (version := _version(name))},
        "take": take.path.name,
    }
    if take.calibration is not None:
        out["calibration"] = {"file": take.calibration.file.name, "unit": take.calibration.unit}
        if take.calibration.file.is_file():
            out["calibration"]["sha256"] = hashlib.sha256(take.calibration.file.read_bytes()).hexdigest()
    out["cameras"] = [
        {"name": c.name, "video": c.video.name if c.video else None, "image": c.image, "rotation": c.rotation,
         "time_offset": c.time_offset}
        for c in take.cameras
    ]  # fmt: skip
    if plugins := plugins_of(take):
        out["plugins"] = [plugin.version for plugin in plugins]
    out["keypoints"] = [
        {"camera": k.camera, "file": k.file.name if k.file else None, "format": k.format, "set": k.set,
         "accuracy": k.sigma}
        for k in take.keypoints
    ]  # fmt: skip
    if take.height:
        out["height"] = take.height
    if take.mass:
        out["mass"] = take.mass
    if take.session.stated:
        out["session"] = take.session.stated
    return out | more


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
