"""`kinefit check --refine`: cameras and other sensors set right, and the files that say so."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kinefit._files import write_text
from kinefit.bodies import load_body
from kinefit.cli import _screen
from kinefit.errors import CalibrationError, FileError, TakeError, command
from kinefit.exporters.take_text import edited, quoted
from kinefit.findings import Edit, in_words
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.write import write_calibration_like
from kinefit.readers.landmarks.annotations import read_static_points
from kinefit.readers.take.file import read_take
from kinefit.rigs.diagnostics.checks import Checked
from kinefit.rigs.refine.refine import refine
from kinefit.rigs.refine.result import Refinement
from kinefit.rigs.sensors import fit_sensors
from kinefit.sensors.alignment import SensorAlignment, alignment_line, marker_edits, misfits, moved_cameras
from kinefit.takes.batch.results import Step


@dataclass(frozen=True, eq=False)
class Refined:
    """What a refinement found.

    Parameters
    ----------
    cameras : Refinement of the cameras with keypoints; None where they stay as they are.
    sensors : depth cameras and marker systems that do not fit.
    """

    cameras: Refinement | None
    sensors: tuple[SensorAlignment, ...]

    @property
    def moved(self) -> tuple[SensorAlignment, ...]:
        """Sensors whose corrected pose is certain: these alone are moved."""
        return tuple(fit for fit in self.sensors if not fit.doubts)

    def summary_lines(self) -> list[str]:
        """The result in plain words, a line each."""
        stay = "The videos' cameras stay as they are: they have no fault."
        if self.moved:
            stay = f"{stay[:-1]}, and {' and '.join(f.sensor for f in self.moved)} is moved to fit them."
        lines = self.cameras.summary_lines() if self.cameras is not None else [stay]
        return [*lines, *(alignment_line(fit) for fit in self.sensors)]


def refined_of(found: Checked, step: Step, *, points: Path | None, **lenses_and_clocks: Any) -> Refined:
    """The cameras with keypoints refined, and other sensors against them.

    Where other sensors do not fit and the cameras have no fault, the cameras stay: a person's few steps place a sensor
    better than all cameras anew. `lenses_and_clocks`: whether to refine "focal", "distortion" and "time_offsets" too.

    Raises
    ------
    CalibrationError
        Faults that must be fixed first; what `refine` raises.
    """
    wrong = misfits(found.sensors)
    if wrong and points is None and not any(lenses_and_clocks.values()):
        return Refined(None, wrong)
    if not found.biases:
        raise CalibrationError(
            "--refine needs a recording without faults", remedy="Correct the faults listed above first."
        )
    rig, seen, take = found.views.rig, found.observations, found.take
    cameras = refine(
        rig, [k for k in seen.keypoints if k.camera in rig], load_body(take.body), height=take.height, up=take.up,
        static_points=read_static_points(points, rig.names) if points else None,
        sigma=min(entry.sigma for entry in take.keypoints), progress=step, **lenses_and_clocks,
    )  # fmt: skip
    return Refined(cameras, misfits(fit_sensors(take, seen, cameras.rig, progress=step)))


def write_refined(found: Checked, refined: Refined, path: Path) -> Path | None:
    """Write the refined calibration next to the old one, and a copy of the take at `path` that uses it.

    Returns the copy; None where nothing changes.

    Raises TakeError where the form of [calibration] cannot be changed.
    """
    take, old, edits = found.take, found.take.calibration, list[Edit]()
    assert old is not None
    moved = moved_cameras(refined.moved, take, found.observations.rig or Rig(()))
    rig = Rig((*(refined.cameras.rig if refined.cameras is not None else ()), *moved))
    if len(rig):
        new = free_name(old.file)
        write_calibration_like(rig, old.file, new, unit=old.unit)
        _screen.say(f"Written: {new}\n")
        edits.append(Edit("calibration", "file", quoted(_relative(new, path.absolute().parent))))
    edits += [edit for fit in refined.moved if fit.kind == "markers" for edit in marker_edits(fit, take)]
    for line in refined.summary_lines():
        _screen.say(line)
    if not edits:
        _screen.say(f"Next:\n  {command('track', path)}")
        return None
    late = refined.cameras.time_offsets if refined.cameras is not None else {}
    for entry in take.cameras:
        if abs(late.get(entry.name, 0.0)) > 1e-5:
            edits.append(Edit("camera", "time_offset", f"{entry.time_offset + late[entry.name]:.6f}", entry.name))
    copy = free_name(path)
    write_text(copy, edited(path.read_text("utf-8"), edits))
    try:
        read_take(copy)
    except FileError as error:  # [calibration] twice: the take has it in another form
        copy.unlink()
        remedy = f"Write it yourself: {in_words(edits, ' in ')}."
        raise TakeError("the refined file cannot be written into [calibration]", file=path, remedy=remedy) from error
    _screen.say(f"\nWritten: {copy}, a copy of {path.name} with {in_words(edits, ' in ')}.")
    _screen.say(f"Next:\n  {command('track', copy)}")
    return copy


def _relative(path: Path, folder: Path) -> str:
    path = path.absolute()
    return (path.relative_to(folder) if path.is_relative_to(folder) else path).as_posix()


def free_name(path: Path) -> Path:
    """The name with "_refined" before its endings, numbered where that is taken."""
    stem, dot, endings = path.name.partition(".") if path.is_file() else (path.name, "", "")
    number, candidate = 1, path.with_name(f"{stem}_refined{dot}{endings}")
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{stem}_refined{number}{dot}{endings}")
    return candidate
