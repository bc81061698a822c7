"""Findings on sensors that do not fit the videos, and the entries of a take that correct them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from kinefit.diagnostics.sensor_fit import MISFIT_SIGMAS, SensorAlignment, marker_index
from kinefit.errors import command
from kinefit.findings import Finding
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.readers.take.entries import MarkersEntry
from kinefit.readers.take.file import Take

_MIN_INVERTED_TURN = np.radians(150.0)  # of an upside-down camera
_MIN_CLOCK_ERROR = 0.01  # [s] that is reported: a person walks 1 cm


def misfits(fits: Iterable[SensorAlignment]) -> tuple[SensorAlignment, ...]:
    """The alignments that significantly do not fit."""
    return tuple(f for f in fits if f.misfit)


def sensor_findings(fits: Sequence[SensorAlignment], take: Take) -> list[Finding]:
    """A fault for each sensor that does not fit, a doubt for each clock offset, "good" for all others."""
    out, wrong, file = [], misfits(fits), take.path.name
    for fit in fits:
        shift = f"{np.degrees(fit.turn):.2f} ± {np.degrees(fit.bars[1]):.2f}° and {amount(fit)}"
        evidence = f"{fit.deviations:.0f} standard deviations; ± holds 95 % of errors, including the surface's own."
        if fit.kind == "depth" and fit.turn > _MIN_INVERTED_TURN:
            turn = f"{np.degrees(fit.turn):.0f} degrees"
            text = f"{fit.sensor} hangs upside down, or its pose is wrong: it fits the person turned by {turn}."
            remedy = "Correct its pose in the calibration, or turn its images by 180 degrees; `track` excludes it."
            out.append(Finding("fault", "sensor", text, (fit.sensor,), remedy=remedy))
        elif fit in wrong and fit.doubts:
            may = "does not fit the videos" if fit.falls else "may not fit the videos"
            text = f"{fit.sensor} {may}: it seems off by {shift} at the person."
            unsure = f"Its correct pose is uncertain, because {'; '.join(fit.doubts)}."
            remedy = "Calibrate it together with the videos, or record a person who walks and turns nearer to it."
            out.append(Finding("fault" if fit.falls else "doubt", "sensor", text, (fit.sensor,), unsure, remedy))
        elif fit in wrong and fit.kind == "depth":
            text = f"{fit.sensor} does not fit the videos: its pose in the calibration is off by {shift} at the person."
            refine = command("check", take.path, "--refine")
            remedy = f"To move it run {refine} (or calibrate it together with the videos)."
            out.append(Finding("fault", "sensor", text, (fit.sensor,), evidence, remedy))
        elif fit in wrong:
            text = f"{fit.sensor} does not fit the videos: its frame is off by {shift} at the person."
            remedy = f"Write {' and '.join(marker_lines(fit, take))} into [[markers]] of {file}."
            out.append(Finding("fault", "sensor", text, (fit.sensor,), evidence, remedy))
        else:
            shift = f"{np.degrees(fit.turn):.2f}° and {1e3 * fit.shift:.0f} mm at the person"
            out.append(Finding("good", "sensor", f"{fit.sensor} fits the videos to {shift}."))
        late, std = fit.twist[6], float(np.sqrt(fit.covariance[6, 6]))
        if abs(late) > max(MISFIT_SIGMAS * std, _MIN_CLOCK_ERROR):
            text = f"The clock of {fit.sensor} is off by {1e3 * late:+.0f} ± {1e3 * std:.0f} ms against the videos."
            entry = next((e for e in take.depth if e.name == fit.sensor), None) or marker_entry(fit, take)
            table = "depth" if fit.kind == "depth" else "markers"
            remedy = f"Write time_offset = {entry.time_offset + late:.4f} into [[{table}]] of {file}."
            out.append(Finding("doubt", "sensor", text, (fit.sensor,), remedy=remedy))
    return out


def amount(fit: SensorAlignment) -> str:
    """Text of the shift [mm] with its error bar."""
    return f"{1e3 * fit.shift:.1f} ± {1e3 * fit.bars[0]:.1f} mm"


def alignment_line(fit: SensorAlignment) -> str:
    """Line of text on a sensor's correction, or on the reasons against one."""
    if fit.doubts:
        return f"{fit.sensor}: not refined, because {'; '.join(fit.doubts)}."
    turn, bar = np.degrees(fit.turn), np.degrees(fit.bars[1])
    return f"{fit.sensor}: turned {turn:.2f} ± {bar:.2f}°, moved {amount(fit)} at the person (95 %)"


def moved_cameras(fits: Iterable[SensorAlignment], take: Take, rig: Rig) -> Rig:
    """The depth cameras at their corrected poses, named as in the calibration.

    Parameters
    ----------
    rig : Rig with the depth cameras under their sensors' names
    """
    out, of = [], {entry.name: entry.camera or entry.name for entry in take.depth}
    for fit in fits:
        if fit.kind == "depth":
            camera = rig[fit.sensor]
            placed = camera.with_pose(camera.T_camera_world @ se3.inverse(fit.T))
            out.append(replace(placed, name=of[fit.sensor]))
    return Rig(tuple(out))


def marker_entry(fit: SensorAlignment, take: Take) -> MarkersEntry:
    """The [[markers]] entry of a marker system in the take."""
    return take.markers[marker_index(fit.sensor)]


def marker_lines(fit: SensorAlignment, take: Take) -> tuple[str, str]:
    """The two lines of [[markers]] that correct a marker system's pose."""
    T = fit.T @ marker_entry(fit, take).T_world_file
    turn, shift = np.degrees(se3.log_so3(T[:3, :3])), T[:3, 3]
    numbers = lambda values, digits: ", ".join(f"{v:.{digits}f}" for v in values)
    return f"shift = [{numbers(shift, 5)}]", f"turn = [{numbers(turn, 4)}]"
