"""Cycles of a repeated movement: strides between contacts of the feet, other movements by how they repeat."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_table
from kinefit.bodies.motion import MarkerEvent, Motion
from kinefit.errors import FileError
from kinefit.exporters.report.feet import MIN_STRIDE_S, Feet, foot_event, foot_events, peaks, smoothed
from kinefit.exporters.report.strides import Quantity, stride_quantities

PERCENT = np.arange(101.0)
_MAX_STRIDE_S = 3.0  # [s] of a stride: people who hardly walk take 2.5 s
_EXACT_S = 0.03  # [s] standard deviation of contacts, above which a single stride may be none
_EVEN = 0.25  # coefficient of variation of the durations above which a movement is not a repeated one
_MIN_CORRELATION = 0.75  # coefficient of multiple correlation; 0.75 and more is called good (Garofalo et al. 2009)
_GAIT = ("hip_flexion", "knee_angle")  # the curves that must be alike; every lower limb here has them


@dataclass(frozen=True, eq=False)
class Side:
    """The cycles of one side of the body.

    Parameters
    ----------
    name : "left", "right", or "both" for a movement that is no gait.
    spans : (N, 2) int, first frame and frame of the next start.
    toe_off : (N,) [%] of each cycle, NaN where none was found; empty where the movement is no gait.
    times : (N, 2) [s] of the same ends, of strides between frames, too.
    """

    name: str
    spans: NDArray
    toe_off: NDArray
    times: NDArray


@dataclass(frozen=True, eq=False)
class Cycles:
    """Cycles of a motion.

    Parameters
    ----------
    kind : "gait" or "repeated movement"
    sides : those with cycles, of a movement that is no gait two or more.
    likeness : float, Kadaba's coefficient of multiple correlation of the curves over the cycles, 0..1; NaN of one.
    feet : of gait, both feet's events.
    """

    kind: str
    sides: tuple[Side, ...]
    likeness: float
    feet: Feet | None = None

    @property
    def events(self) -> tuple[MarkerEvent, ...]:
        """Contacts and toe-offs, in the order of their times, named as marker systems do; none of other movements."""
        found = [
            MarkerEvent(label, float(time), foot.side.capitalize(), icon=1 + (label == "Foot Off"))
            for foot in ((self.feet.left, self.feet.right) if self.feet else ())
            for label, times in (("Foot Strike", foot.contacts), ("Foot Off", foot.offs)) for time in times
        ]  # fmt: skip
        return tuple(sorted(found, key=lambda event: event.time))


def find_cycles(motion: Motion) -> Cycles | None:
    """The cycles of a motion, None where it does not clearly repeat itself.

    Cycles last about as long (coefficient of variation at most 25 %) and look alike (coefficient of multiple
    correlation at least 0.75). One stride is enough where the feet stand at both ends of it. Cycles with a frame in
    which no person was seen are left out.
    """
    if len(motion) < 3 or len(motion) / motion.rate < 2 * MIN_STRIDE_S:
        return None
    return find_gait(motion) or _repeated(motion)


def normalised(values: NDArray, spans: NDArray) -> NDArray:
    """Curves (N, 101, ...) over 0..100 % of the spans (N, 2) of values (F, ...), linear between frames."""
    start, stop = spans[:, :1], spans[:, 1:]
    at = start + PERCENT / 100 * (stop - start)
    low = np.minimum(at.astype(int), len(values) - 2)
    share = (at - low).reshape(*at.shape, *(1,) * (values.ndim - 1))
    return values[low] * (1 - share) + values[low + 1] * share


def likeness(curves: NDArray) -> float:
    """Coefficient of multiple correlation 0..1 of cycles (N, T) (Kadaba et al. 1989, J. Orthop. Res. 7:849-860).

    1 where all curves are the same, 0 where they have nothing in common (or do not move). For (N, T, D) that of D
    curves together, each about its own mean, so that those which move most count most.
    """
    curves = curves.reshape(*curves.shape[:2], -1)
    N, T, _ = curves.shape
    if N < 2:
        return 0.0
    within = np.sum((curves - curves.mean(axis=0)) ** 2) / (T * (N - 1))
    total = np.sum((curves - curves.mean(axis=(0, 1))) ** 2) / (T * N - 1)
    return float(np.sqrt(max(0.0, 1 - within / total))) if total > 1e-12 else 0.0


def gait_numbers(motion: Motion, cycles: Cycles) -> dict[str, list[Quantity]]:
    """{what it is [unit]: of each side} of cycles: of gait those of `stride_quantities`, else the cycle's time."""
    found = []
    for side in cycles.sides:
        if cycles.feet is None:
            times = np.diff(side.times, axis=1).ravel()
            found.append({"cycle time [s]": Quantity(times, np.full(len(times), 1.0 / (np.sqrt(6.0) * motion.rate)))})
        else:
            found.append(stride_quantities(motion, cycles.feet, side.name, side.times))
    names = dict.fromkeys(name for of in found for name in of)
    none = Quantity(np.zeros(0), np.zeros(0))
    return {name: [of.get(name, none) for of in found] for name in names}


def find_gait(motion: Motion) -> Cycles | None:
    """The strides of a motion, as of `find_cycles`, None where it is no gait."""
    feet = foot_events(motion)
    if feet is None:
        return None
    sides, alike = [], []
    for foot in (feet.left, feet.right):
        frames = np.rint(np.interp(foot.contacts, motion.times, np.arange(len(motion)))).astype(int)
        spans, exact = _usable(motion, frames), {*frames[foot.contact_std < _EXACT_S].tolist()}
        columns = [d for d, c in enumerate(motion.body.tree.coordinates) if c in [f"{g}_{foot.side[0]}" for g in _GAIT]]
        if not len(spans) or not columns or not _even(spans) or (len(spans) == 1 and not exact.issuperset(spans[0])):
            continue
        curves = normalised(np.unwrap(motion.angles[:, columns], axis=0), spans)
        if len(spans) > 1:
            alike.append(float(np.mean([likeness(curves[..., c]) for c in range(len(columns))])))
        times = foot.contacts[np.searchsorted(frames, spans)]
        sides.append(Side(foot.side, spans, _toe_off(times, foot.offs), times))
    if min(alike, default=1.0) < _MIN_CORRELATION or not take_turns(feet):
        return None
    return Cycles("gait", tuple(sides), float(np.mean(alike)) if alike else np.nan, feet) if sides else None


def events_of(motion: Motion) -> tuple[MarkerEvent, ...]:
    """Contacts and toe-offs found in a walk, and the other events of the recording; all of those where it is no gait.

    In the order of their times.
    """
    if (gait := find_gait(motion)) is None:
        return motion.events
    others = (event for event in motion.events if foot_event(event) is None)
    return tuple(sorted((*gait.events, *others), key=lambda event: event.time))


def _repeated(motion: Motion) -> Cycles | None:
    """Cycles between the peaks of the movement's main course: the first principal component of the angles seen."""
    seen = np.isfinite(motion.dof_std[:, 6:]).mean(axis=0) > 0.5
    angles = np.unwrap(motion.angles[:, seen & ~motion.body.tree.prismatic], axis=0)
    if not angles.size:
        return None
    centred = angles - angles.mean(axis=0)
    course = smoothed(centred @ np.linalg.svd(centred, full_matrices=False)[2][0], motion.rate)
    extent = float(np.ptp(course))
    if extent < np.radians(20.0):  # all angles together: less is swaying or noise
        return None
    found = []
    for sign in (1.0, -1.0):  # from one extreme posture to the same again
        tops = peaks(sign * course, 0.5 * extent, round(MIN_STRIDE_S * motion.rate))
        for starts in (tops, tops[::2], tops[1::2]):  # a movement may come to its extreme twice in a cycle
            spans = _usable(motion, starts, longest=np.inf)
            if len(spans) >= 2 and _even(spans):
                found.append((likeness(normalised(angles, spans)), spans))
    if not found or max(found, key=lambda item: item[0])[0] < _MIN_CORRELATION:
        return None
    best = max(found, key=lambda item: (item[0], len(item[1])))
    return Cycles("repeated movement", (Side("both", best[1], np.zeros(0), motion.times[best[1]]),), best[0])


def _usable(motion: Motion, starts: NDArray, longest: float = _MAX_STRIDE_S) -> NDArray:
    spans = np.stack([starts[:-1], starts[1:]], axis=1) if len(starts) > 1 else np.zeros((0, 2), int)
    return np.array(
        [s for s in spans if s[1] - s[0] <= longest * motion.rate and np.all(motion.quality[s[0] : s[1] + 1] > 0)], int
    ).reshape(-1, 2)


def _even(spans: NDArray) -> bool:
    durations = np.diff(spans, axis=1).ravel()
    return bool(np.std(durations) <= _EVEN * np.mean(durations))


def take_turns(feet: Feet) -> bool:
    """Whether the feet take turns: between two strikes of one foot lies one of the other, nowhere near the ends.

    A leg without its other one, which was not measured, does.
    """
    left, right = feet.left.contacts, feet.right.contacts
    if not all(feet.observed):
        return bool(len(left) or len(right))
    if not len(left) or not len(right):
        return False
    for one, other in ((left, right), (right, left)):
        for start, stop in pairwise(one):
            between = (other[(other > start) & (other < stop)] - start) / (stop - start)
            if len(between) != 1 or not 0.25 < between[0] < 0.75:
                return False
    return True


def _toe_off(times: NDArray, offs: NDArray) -> NDArray:
    """(N,) [%] of strides (N, 2) [s]; NaN where there is none, or more than one."""
    out = np.full(len(times), np.nan)
    for k, (start, stop) in enumerate(times):
        within = offs[(offs > start) & (offs < stop)]
        if len(within) == 1:
            out[k] = 100 * (within[0] - start) / (stop - start)
    return out


COLUMNS = ("coordinate", "percent", "mean", "sd")

Norms = dict[str, NDArray]
"""{coordinate: (N, 3) percent of the cycle, mean [deg], standard deviation [deg]}, percent ascending."""


def read_norms(path: str | PathLike[str]) -> Norms:
    """Read normative values: a CSV with the columns coordinate, percent, mean and sd.

    A coordinate is named as in the tables of angles, with its side or, for both, without (`knee_angle`).

    Raises
    ------
    FileError
        The file is missing or no such table; the message names the line.
    """
    path = Path(path)
    remedy = "Give a CSV with the columns coordinate, percent (0 to 100), mean and sd (not negative) [deg]."
    names, values = read_table(path, COLUMNS[1:], remedy, text=COLUMNS[0])
    if not names:
        raise FileError("has no line of values", file=path, remedy=remedy)
    percent, _, sd = values.T
    wrong = ~(np.isfinite(values).all(axis=1) & (percent >= 0.0) & (percent <= 100.0) & (sd >= 0.0))
    if wrong.any():
        line = f"line {int(np.argmax(wrong)) + 2}"
        raise FileError("is no normative value", file=path, place=line, remedy=remedy)
    of = np.array(names)
    return {name: np.array(sorted(values[of == name].tolist())) for name in dict.fromkeys(names)}
