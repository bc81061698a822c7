"""`kinefit check --refine`: cameras and other sensors set right, and the files that say so."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from kinefit.calibration.check.sensor_verdicts import alignment_line, marker_lines, misfits, moved_cameras
from kinefit.calibration.check.sensors import fit_sensors
from kinefit.cli import _screen
from kinefit.diagnostics.keypoints import Check
from kinefit.diagnostics.sensor_fit import SensorAlignment, marker_index
from kinefit.errors import FileError, TakeError, command
from kinefit.geometry.camera import Rig

if TYPE_CHECKING:
    from kinefit.calibration.refine.result import Refinement


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
        """Sensors of which it is sure where they belong: they alone are moved."""
        return tuple(fit for fit in self.sensors if not fit.doubts)

    def summary_lines(self) -> list[str]:
        """The result in plain words, a line each."""
        stay = "The videos' cameras stay as they are: they have no fault."
        if self.moved:
            stay = f"{stay[:-1]}, and {' and '.join(f.sensor for f in self.moved)} is moved to fit them."
        lines = self.cameras.summary_lines() if self.cameras is not None else [stay]
        return [*lines, *(alignment_line(fit) for fit in self.sensors)]


def refined_of(
    found: Check, step: _screen.Step, points: Path | None, *, focal: bool, distortion: bool, time_offsets: bool
) -> Refined:
    """The cameras with keypoints refined, and other sensors against them.

    Where other sensors do not fit and the cameras have no fault, the cameras stay: a person's few steps place a sensor
    better than all cameras anew.

    Raises
    ------
    CalibrationError
        Faults that must be fixed first; what `refine` raises.
    """
    wrong, asked = misfits(found.sensors), focal or distortion or time_offsets or points is not None
    if wrong and not asked:
        return Refined(None, wrong)
    cameras = _refine(found, step, points, focal=focal, distortion=distortion, time_offsets=time_offsets)
    assert found.take is not None and found.observations is not None
    return Refined(cameras, misfits(fit_sensors(found.take, found.observations, cameras.rig, progress=step)))


def _refine(
    found: Check, step: _screen.Step, points: Path | None, *, focal: bool, distortion: bool, time_offsets: bool
) -> Refinement:
    from kinefit.bodies import load_body
    from kinefit.calibration.refine.refine import refine
    from kinefit.errors import CalibrationError
    from kinefit.readers.static_points import read_static_points

    seen, take = found.observations, found.take
    if found.views is None or not found.biases or seen is None or take is None:
        raise CalibrationError(
            "--refine needs a recording without faults",
            remedy="Correct the faults listed above first.",
        )
    static = read_static_points(points, found.views.rig.names) if points else None
    sigma = min(entry.sigma for entry in take.keypoints)
    return refine(
        found.views.rig, [k for k in seen.keypoints if k.camera in found.views.rig], load_body(take.body), focal=focal,
        distortion=distortion, time_offsets=time_offsets, static_points=static, height=take.height, up=take.up,
        sigma=sigma,
        progress=step,
    )  # fmt: skip


def write_refined(found: Check, refined: Refined, path: Path) -> Path | None:
    """Write the refined calibration beside the old one, and a copy of the take at `path` that uses it.

    Returns the copy; None where nothing changes.

    Raises TakeError where the form of [calibration] cannot be changed.
    """
    from kinefit.exporters.atomic import write_text
    from kinefit.exporters.take_text import quoted, with_keys
    from kinefit.readers.calibration.write import write_calibration_like
    from kinefit.readers.take.file import read_take

    assert found.take is not None and found.take.calibration is not None and found.observations is not None
    take, old, text = found.take, found.take.calibration, path.read_text("utf-8")
    markers = {marker_index(fit.sensor): marker_lines(fit, take) for fit in refined.moved if fit.kind == "markers"}
    moved = moved_cameras(refined.moved, take, found.observations.rig or Rig(()))
    rig = Rig((*(refined.cameras.rig if refined.cameras is not None else ()), *moved))
    new = free_name(old.file)
    if len(rig):
        write_calibration_like(rig, old.file, new, unit=old.unit)
        _screen.say(f"Written: {new}\n")
    for line in refined.summary_lines():
        _screen.say(line)
    if not len(rig) and not markers:
        _screen.say(f"Next:\n  {command('track', path)}")
        return None
    changed: list[str] = []
    if len(rig):
        file = _relative(new, path.absolute().parent)
        changed.append(f'file = "{file}" in [calibration]')
        text = with_keys(text, "calibration", None, {"file": quoted(file)})
    for number, lines in markers.items():
        changed.append(f"{' and '.join(lines)} in [[markers]] {number + 1}")
        text = with_keys(text, "markers", number, dict(line.split(" = ") for line in lines))
    late = refined.cameras.time_offsets if refined.cameras is not None else {}
    for number, entry in enumerate(take.cameras):
        if abs(late.get(entry.name, 0.0)) > 1e-5:
            value = f"{entry.time_offset + late[entry.name]:.6f}"
            changed.append(f"time_offset = {value} in [[camera]] {entry.name}")
            text = with_keys(text, "camera", number, {"time_offset": value})
    beside = free_name(path)
    write_text(beside, text)
    try:
        read_take(beside)
    except FileError as error:  # [calibration] twice: the take has it in another form
        beside.unlink()
        remedy = f"Write it yourself: {'; '.join(changed)}."
        raise TakeError("the refined file cannot be written into [calibration]", file=path, remedy=remedy) from error
    _screen.say(f"\nWritten: {beside}, a copy of {path.name} with {', '.join(changed)}.")
    _screen.say(f"Next:\n  {command('track', beside)}")
    return beside


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
