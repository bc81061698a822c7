"""How far every joint moved: lowest, highest, range and fastest, left beside right, each with its uncertainty.

What the measurements did not observe is left out of the numbers, and said to be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.exporters.curves import Curve, curves, spoken
from kinefit.exporters.report import page as p
from kinefit.exporters.report.angles import by_joint
from kinefit.motion import Motion

MAX_STD_DEG = 45.0
"""[deg] standard deviation beyond which an angle counts as not observed: ±2 of it are half a turn."""

_HEAD = ("lowest", "highest", "range", "fastest")

@dataclass(frozen=True)
class Extremes:
    """How far one coordinate moved, each with two standard deviations [deg, deg/s].

    Parameters
    ----------
    lowest, highest, span : (value, two standard deviations)
        Those of the span are of the difference: what both ends have in common is not in it, see `Motion.std_of`.
    fastest : largest speed; its deviation is NaN where the motion does not tell it. Of a greatest of many it is no
        interval of its own: that of noise alone is above zero, too.
    share : of the frames in which the coordinate was observed.
    ends : frames of the lowest and the highest value
    coordinate : its number in `Motion.dof_std`, None for a mixture of several
    """

    lowest: tuple[float, float]
    highest: tuple[float, float]
    span: tuple[float, float]
    fastest: tuple[float, float]
    share: float
    ends: tuple[int, int]
    coordinate: int | None


def extremes(curve: Curve, motion: Motion, tracked: NDArray) -> Extremes | None:
    """Of one angle [deg] of a motion over time; None where it was observed in no two frames.

    tracked : (F,) bool, frames in which somebody was seen.
    """
    known = tracked & (curve.std < MAX_STD_DEG)
    if known.sum() < 2:
        return None
    at = np.flatnonzero(known)
    low, high = (int(at[k]) for k in (np.argmin(curve.values[at]), np.argmax(curve.values[at])))
    span = float(curve.values[high] - curve.values[low])
    speed = np.abs(np.gradient(curve.values)) * motion.rate
    inside = known & np.roll(known, 1) & np.roll(known, -1)
    inside[[0, -1]] = False
    fastest = float(speed[inside].max()) if inside.any() else np.nan
    ends = [(float(curve.values[f]), float(2 * curve.std[f])) for f in (low, high)]
    share = float(known.mean())
    of_span = span, float(np.hypot(ends[0][1], ends[1][1]))
    if curve.coordinate is not None:
        of_span = span, 2.0 * float(np.degrees(motion.std_of((high, low), (curve.coordinate,) * 2, (1, -1))))
    return Extremes(ends[0], ends[1], of_span, (fastest, 2.0 * curve.speed_std), share, (low, high), curve.coordinate)


def ranges_of(motion: Motion) -> dict[str, dict[str, Extremes | None]]:
    """{coordinate without its side: {"left", "right", or "" of the body's middle: how far it moved}} of all angles.

    None stands for what was observed in no two frames.
    """
    tracked = motion.quality > 0
    out: dict[str, dict[str, Extremes | None]] = {}
    for rows in by_joint(curves(motion)).values():
        for stem, found in rows.items():
            of = {c.side: extremes(c, motion, tracked) for c in found if c.unit == "deg"}
            if of:
                out[stem] = of
    return out


def ranges_table(motion: Motion) -> p.Html:
    """Two tables: what the body has twice, left beside right, and its middle."""
    paired: list[tuple[str, ...]] = []
    single: list[tuple[str, ...]] = []
    for stem, of in ranges_of(motion).items():
        name = spoken(stem)
        name = name[0].upper() + name[1:]
        if "" in of:
            single.append((name, *_cells(of[""])))
        else:
            left, right = of.get("left"), of.get("right")
            paired.append((name, *_cells(left), *_cells(right), _difference(motion, left, right)))
    parts = []
    if paired:
        columns = [f"{side} {what}" for side in ("left", "right") for what in _HEAD]
        parts.append(p.table(["[°], [°/s]", *columns, "range, left minus right"], paired))
    if single:
        parts.append(p.table(["[°], [°/s]", *_HEAD], single))
    return p.joined(*parts)


def _cells(found: Extremes | None) -> tuple[str, ...]:
    if found is None:
        return ("not observed", "", "", "")
    part = "" if found.share > 0.995 else "*"
    speed, twice = found.fastest
    fastest = "–" if not np.isfinite(speed) else with_error(speed, twice) if np.isfinite(twice) else f"{speed:.0f}"
    return (*(with_error(*pair) for pair in (found.lowest, found.highest)), with_error(*found.span) + part, fastest)


def _difference(motion: Motion, left: Extremes | None, right: Extremes | None) -> str:
    if left is None or right is None:
        return "–"
    frames, coordinates = zip(*((f, side.coordinate) for side in (left, right) for f in side.ends[::-1]))
    std = motion.std_of(frames, coordinates, (1, -1, -1, 1))
    return with_error(left.span[0] - right.span[0], 2.0 * float(np.degrees(std)))


def with_error(value: float, twice: float) -> str:
    """A value with two standard deviations."""
    return f"{value:.0f} ± {twice:.0f}".replace("-0 ", "0 ").replace("-", "−")
