"""Sensors against the videos: how far a frame is off, whether its correction is reliable, what corrects it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import command
from kinefit.findings import Edit, Finding
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.readers.take.file import Take
from kinefit.sensors.displaced import AXES, displacement

MISFIT_SIGMAS = 3.0
"""Standard deviations, per degree of freedom, from which a sensor does not fit: chance alone exceeds it in fewer than
one of 10^8 takes, and those of the benchmark without misfit reach half of it."""

MIN_MISFIT = np.radians(0.5), 0.015
"""[rad], [m] rotation and shift, of which one must be exceeded: smaller ones are common calibration errors. Two
cameras, each with errors of 0.1 degree about and 3 mm along each axis, measure a person at 4 m with an error of 8 mm,
and rarely 15 mm."""

POSE_SIGMAS = 0.1, float(np.radians(5.0)), 0.02
"""[m], [rad], [s] prior standard deviations of a sensor's stated pose, about its own origin, and of its clock."""

_MAX_COARSE_ERROR = float(np.radians(3.0)), 0.05
"""[rad], [m] by which a sensor that fits seems off by nearest points alone: a body's shapes are simple."""

_COVERAGE = 0.95  # share of errors within the error bars
_MONTE_CARLO_DRAWS = 4000  # for the error bars
_MIN_INVERTED_TURN = np.radians(150.0)  # of an upside-down camera
_MIN_CLOCK_ERROR = 0.01  # [s] that is reported: a person walks 1 cm


@dataclass(frozen=True, eq=False)
class SensorAlignment:
    """Correction that aligns a sensor's frame with the world of the videos.

    Parameters
    ----------
    sensor : name
    kind : "depth" or "markers"
    twist : (7,) [m, rad, s] correction: shift of the centre, rotation vector, and clock offset.
    covariance : (7, 7) of the correction
    centre : (3,) [m] of the rotation, the middle of the person's positions
    falls : bool, whether the correction clearly reduces the person's distance from the measurements.
    doubts : reasons not to apply the correction, although the sensor does not fit; empty if it may be applied.
    """

    sensor: str
    kind: str
    twist: NDArray
    covariance: NDArray
    centre: NDArray
    falls: bool = True
    doubts: tuple[str, ...] = ()

    @property
    def T(self) -> NDArray:
        """Correction T (4, 4): x_world = T x, for a point x placed by the sensor's stated frame."""
        return displacement(dict(zip(AXES, self.twist)), self.centre)

    @property
    def shift(self) -> float:
        """Shift [m] at the centre of the person's positions."""
        return float(np.linalg.norm(self.twist[:3]))

    @property
    def turn(self) -> float:
        """Rotation angle [rad]."""
        return float(np.linalg.norm(self.twist[3:6]))

    @property
    def is_near(self) -> bool:
        """Whether it stands where it is stated, as far as nearest points show that."""
        return not self.falls or (self.turn < _MAX_COARSE_ERROR[0] and self.shift < _MAX_COARSE_ERROR[1])

    @property
    def usable(self) -> bool:
        """Whether the stated pose is close enough for a person's surface to determine the true one."""
        return self.turn < MISFIT_SIGMAS * POSE_SIGMAS[1]

    @cached_property
    def bars(self) -> tuple[float, float]:
        """Error bars [m], [rad]: 95 % of the errors of shift and rotation are shorter."""
        z = np.random.default_rng(0).standard_normal((_MONTE_CARLO_DRAWS, 7)) @ np.linalg.cholesky(self.covariance).T
        shift, turn = (np.linalg.norm(z[:, part], axis=1) for part in (slice(3), slice(3, 6)))
        return float(np.quantile(shift, _COVERAGE)), float(np.quantile(turn, _COVERAGE))

    @property
    def deviations(self) -> float:
        """Distance of shift and rotation from zero, in standard deviations per degree of freedom; a number >= 0."""
        return per_freedom(self.twist, self.covariance)

    @property
    def misfit(self) -> bool:
        """Whether the sensor does not fit: significantly and by more than common errors, or with doubts."""
        is_large = self.turn > MIN_MISFIT[0] or self.shift > MIN_MISFIT[1]
        return bool(self.doubts) or (self.deviations > MISFIT_SIGMAS and is_large)


def per_freedom(twist: NDArray, covariance: NDArray) -> float:
    """Mahalanobis length, per degree of freedom, of shift and rotation of a twist (7,) with covariance (7, 7)."""
    moved, C = twist[:6], covariance[:6, :6]
    return float(np.sqrt(moved @ np.linalg.solve(C, moved) / 6.0))


def doubts_of(
    fit: SensorAlignment,
    origin: NDArray,
    halves: tuple[SensorAlignment, SensorAlignment],
    rivals: tuple[NDArray, ...] = (),
) -> tuple[str, ...]:
    """Reasons not to apply a sensor's correction, in words that follow "because"; empty if there are none.

    Parameters
    ----------
    fit : SensorAlignment, whose covariance includes the disagreement of the halves.
    origin : (3,) [m] of the sensor's frame: a camera's centre.
    halves : fits of two halves of the frames, without the systematic error of the surface.
    rivals : twists (7,) from the best solution to those of other starts that fit as well.
    """
    out = []
    shift, turn = fit.bars
    off = [(float(np.linalg.norm(r[:3])), float(np.linalg.norm(r[3:6]))) for r in rivals]
    far = [(s, t) for s, t in off if s > shift or t > turn]
    if far:
        s, t = max(far)
        amount = f"{np.degrees(t):.1f}° and {1e3 * s:.0f} mm"
        out.append(f"another pose, {amount} away, fits about as well")
    if not fit.falls:
        out.append("its measurements then lie no nearer to the person")
    moved = float(np.linalg.norm(se3.apply(fit.T, origin) - origin))
    if moved > MISFIT_SIGMAS * POSE_SIGMAS[0] or fit.turn > MISFIT_SIGMAS * POSE_SIGMAS[1]:
        limit = f"{1e2 * MISFIT_SIGMAS * POSE_SIGMAS[0]:.0f} cm or {np.degrees(MISFIT_SIGMAS * POSE_SIGMAS[1]):.0f}°"
        out.append(f"it would move by {1e2 * moved:.0f} cm and turn by {np.degrees(fit.turn):.0f}°: more than {limit}")
    a, b = halves
    between = per_freedom(a.twist - b.twist, a.covariance + b.covariance)
    if between > MISFIT_SIGMAS:
        out.append(f"two halves of the frames disagree by {between:.1f} standard deviations")
    elif not fit.misfit:
        out.append("the misfit is within the disagreement of two halves of the frames")
    return tuple(out)


def marker_index(sensor: str) -> int:
    """Index of a sensor among the take's [[markers]]."""
    number = sensor.removeprefix("markers").strip()
    return int(number) - 1 if number else 0


def misfits(fits: Iterable[SensorAlignment]) -> tuple[SensorAlignment, ...]:
    """The alignments that significantly do not fit."""
    return tuple(f for f in fits if f.misfit)


def sensor_findings(fits: Sequence[SensorAlignment], take: Take) -> list[Finding]:
    """A fault for each sensor that does not fit, a doubt for each clock offset, "good" for all others."""
    out = []
    for fit in fits:
        own, refine = (fit.sensor,), command("check", take.path, "--refine")
        shift = " and ".join(_amounts(fit))
        evidence = f"{fit.deviations:.0f} standard deviations; ± holds 95 % of errors, including the surface's own."
        if fit.kind == "depth" and fit.turn > _MIN_INVERTED_TURN:
            turn = f"{np.degrees(fit.turn):.0f} degrees"
            text = f"{fit.sensor} hangs upside down, or its pose is wrong: it fits the person turned by {turn}."
            remedy = "Correct its pose in the calibration, or turn its images by 180 degrees; `track` excludes it."
            found = Finding("fault", "sensor", text, own, remedy=remedy)
        elif fit.misfit and fit.doubts:
            may = "does not fit the videos" if fit.falls else "may not fit the videos"
            text = f"{fit.sensor} {may}: it seems off by {shift} at the person."
            unsure = f"Its correct pose is uncertain, because {'; '.join(fit.doubts)}."
            remedy = "Calibrate it together with the videos, or record a person who walks and turns nearer to it."
            found = Finding("fault" if fit.falls else "doubt", "sensor", text, own, unsure, remedy)
        elif fit.misfit and fit.kind == "depth":
            text = f"{fit.sensor} does not fit the videos: its pose in the calibration is off by {shift} at the person."
            remedy = f"To move it run {refine} (or calibrate it together with the videos)."
            found = Finding("fault", "sensor", text, own, evidence, remedy)
        elif fit.misfit:
            text = f"{fit.sensor} does not fit the videos: its frame is off by {shift} at the person."
            found = Finding("fault", "sensor", text, own, evidence, edits=marker_edits(fit, take))
        else:
            shift = f"{np.degrees(fit.turn):.2f}° and {1e3 * fit.shift:.0f} mm at the person"
            found = Finding("good", "sensor", f"{fit.sensor} fits the videos to {shift}.")
        out.append(found)
        late, std = fit.twist[6], float(np.sqrt(fit.covariance[6, 6]))
        if abs(late) > max(MISFIT_SIGMAS * std, _MIN_CLOCK_ERROR):
            text = f"The clock of {fit.sensor} is off by {1e3 * late:+.0f} ± {1e3 * std:.0f} ms against the videos."
            entries = [e for e in take.depth if e.name == fit.sensor] or take.markers[marker_index(fit.sensor) :]
            place = fit.sensor if fit.kind == "depth" else marker_index(fit.sensor)
            edit = Edit(fit.kind, "time_offset", f"{entries[0].time_offset + late:.4f}", place)
            out.append(Finding("doubt", "sensor", text, own, edits=(edit,)))
    return out


def _amounts(fit: SensorAlignment) -> tuple[str, str]:
    """Texts of the rotation [deg] and of the shift [mm] with their error bars."""
    shift, turn = fit.bars
    return f"{np.degrees(fit.turn):.2f} ± {np.degrees(turn):.2f}°", f"{1e3 * fit.shift:.1f} ± {1e3 * shift:.1f} mm"


def alignment_line(fit: SensorAlignment) -> str:
    """Line of text on a sensor's correction, or on the reasons against one."""
    if fit.doubts:
        return f"{fit.sensor}: not refined, because {'; '.join(fit.doubts)}."
    turn, shift = _amounts(fit)
    return f"{fit.sensor}: turned {turn}, moved {shift} at the person (95 %)"


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


def marker_edits(fit: SensorAlignment, take: Take) -> tuple[Edit, Edit]:
    """The two lines of [[markers]] that correct a marker system's pose."""
    number = marker_index(fit.sensor)
    T = fit.T @ take.markers[number].T_world_file
    values = {"shift": (T[:3, 3], 5), "turn": (np.degrees(se3.log_so3(T[:3, :3])), 4)}
    shift, turn = (
        Edit("markers", key, f"[{', '.join(f'{v:.{digits}f}' for v in part)}]", number)
        for key, (part, digits) in values.items()
    )
    return shift, turn
