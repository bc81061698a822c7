"""Angles over time with their error bars and over the cycle, one plot for each joint, left and right together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.lasting_errors import common
from kinefit.bodies.motion import Motion
from kinefit.exporters.report import page as p
from kinefit.exporters.report.cycles import PERCENT, Cycles, Norms, normalised
from kinefit.exporters.tables import DIGITS, FINGER_JOINTS, NAMES, Curve, curves, spoken

_COLOURS = {"left": p.LEFT_COLOUR, "right": p.RIGHT_COLOUR, "": p.CENTRE_COLOUR}
_GREY = "#8a949e"

# In the humanoid's order of interest; a joint that is not here keeps its own name and comes last.
_JOINTS = {
    "hip": "Hip", "knee": "Knee", "ankle": "Ankle", "mtp": "Toes", "pelvis": "Pelvis", "back": "Lower back",
    "thoracic": "Upper back", "neck": "Neck", "sternoclavicular": "Collarbone", "shoulder": "Shoulder",
    "elbow": "Elbow and forearm", "wrist": "Wrist", "jaw": "Jaw", "eye": "Eyes",
    **{f"{digit}_{joint}": word for digit, word in DIGITS.items() for joint in FINGER_JOINTS},
}  # fmt: skip

_POSITIVE = {
    "hip_flexion": "thigh forward", "hip_adduction": "towards the middle", "hip_rotation": "inwards",
    "knee_angle": "flexion", "ankle_angle": "toes up", "subtalar_angle": "inversion", "mtp_angle": "toes up",
    **{f"{part}_extension": "backward" for part in ("lumbar", "thorax", "neck")},
    **{f"{part}_bending": "to the right" for part in ("lumbar", "thorax", "neck")},
    **{f"{part}_rotation": "to the left" for part in ("lumbar", "thorax", "neck", "pelvis")},
    "clav_prot": "shoulder forward", "clav_elev": "shoulder up", "arm_flex": "forward", "arm_add": "towards the middle",
    "arm_rot": "inwards", "elbow_flex": "flexion", "pro_sup": "pronation", "wrist_flex": "flexion",
    "wrist_dev": "towards the little finger", "pelvis_tilt": "backward", "pelvis_list": "right side down",
    "jaw_opening": "down", "eye_abduction": "outwards", "eye_elevation": "up",
    **{f"{digit}_mcp_dev": "towards the little finger" for digit in DIGITS},
    **{f"thumb_{joint}_abd": "away from the palm" for joint in FINGER_JOINTS},
}  # fmt: skip

MAX_STD_DEG = 45.0
"""[deg] standard deviation beyond which an angle counts as not observed: ±2 of it are half a turn."""

_HEAD = ("lowest", "highest", "range", "fastest")


def joint_plots(motion: Motion) -> dict[str, p.Html]:
    """{joint: plot} of all coordinates over time with bands of ±2 standard deviations."""
    out = {}
    for joint, rows in by_joint(curves(motion)).items():
        traces: list[dict] = []
        ranges = []
        for row, sides in enumerate(rows.values()):
            for curve in sides:
                traces += _over_time(curve, motion.times, row, sides[0].side in ("left", "right"))
            ranges.append(_range(sides))
        out[joint] = _stacked(traces, list(rows.values()), ranges, "time [s]", seeks=True)
    return out


def cycle_plots(trials: Sequence[tuple[Motion, Cycles]], norms: Norms | None = None) -> dict[str, p.Html]:
    """{joint: plot} of all coordinates over the cycles of motions of one body, put together; norms behind.

    Each with its mean, ±1 standard deviation, and, where they are few, single cycles.
    """
    sides = list(dict.fromkeys(side.name for _, cycles in trials for side in cycles.sides))
    other = sides[0]  # of the middle of the body: the cycles of this side
    every_side = [side for _, cycles in trials for side in cycles.sides]
    toe_off = {name: np.concatenate([s.toe_off for s in every_side if s.name == name]) for name in sides}
    marks = {name: float(np.nanmean(at)) for name, at in toe_off.items() if np.isfinite(at).any()}
    every = [({c.name: c for c in curves(motion)}, cycles) for motion, cycles in trials]

    def over_cycles(name: str, side: str) -> NDArray:
        return np.concatenate([
            normalised(of[name].values, s.spans) for of, cycles in every for s in cycles.sides if s.name == side
        ])  # fmt: skip

    out = {}
    found = [c for c in every[0][0].values() if not c.name.endswith(("_tx", "_tz"))]  # the way over ground is no cycle
    for joint, rows in by_joint(found).items():
        traces: list[dict] = []
        shown: dict[str, list[Curve]] = {}
        for stem, found_sides in rows.items():
            usable = [c for c in found_sides if c.side in sides or not c.side or "both" in sides]
            if not usable:
                continue
            wanted = dict.fromkeys((*(c.name for c in usable), stem))
            for percent, mean, sd in (norms[name].T for name in wanted if norms and name in norms):
                traces += p.band(percent, mean, sd, "norm", _GREY, len(shown))
            for curve in usable:
                side = curve.side if curve.side in sides else other
                label = "" if side == "both" else side + " "
                traces += _over_cycle(curve, over_cycles(curve.name, side), len(shown), label)
            shown[stem] = usable
        if shown:
            of = {c.side or other for usable in shown.values() for c in usable}
            lines = [p.mark("x", at, p.Stroke(_COLOURS[side], 1.2, "dash")) for side, at in marks.items() if side in of]
            out[joint] = _stacked(traces, list(shown.values()), [None] * len(shown), "cycle [%]", marks=lines)
    return out


def by_joint(found: list[Curve]) -> dict[str, dict[str, list[Curve]]]:
    """{joint: {name without the side: curves}}, in the order of interest, with the joints' names in words."""
    order = {joint: number for number, joint in enumerate(_JOINTS)}
    out: dict[str, dict[str, list[Curve]]] = {}
    for curve in sorted(found, key=lambda c: order.get(c.joint, len(order))):
        out.setdefault(_JOINTS.get(curve.joint, curve.joint), {}).setdefault(curve.stem, []).append(curve)
    return out


def _over_time(curve: Curve, times: NDArray, row: int, legend: bool) -> list[dict]:
    at = p.thinned(curve.values)
    ends = np.append(at[1:], len(curve.values))
    std = np.array([curve.std[a:b].max() for a, b in zip(at, ends)]) if len(at) < len(curve.std) else curve.std
    t, values, known = times[at], curve.values[at], np.isfinite(std)
    name, colour = curve.side or "middle", _COLOURS[curve.side]
    out = p.band(t, values, np.where(known, 2 * std, np.nan), name, colour, row)
    if known.any():
        out.append(p.line(
            t, np.where(known, values, np.nan), name, p.Stroke(colour, 1.8), row=row, legend=legend and row == 0,
            hover=f"{name} %{{y:.4~g}} ± %{{customdata:.2~g}} {curve.unit}", customdata=np.where(known, 2 * std, 0),
        ))  # fmt: skip
    if not known.all():
        near = ~known
        near[:-1] |= ~known[1:]
        near[1:] |= ~known[:-1]
        out.append(p.line(
            t, np.where(near, values, np.nan), name, p.Stroke(_GREY, 1.4, "dash" if curve.side == "right" else "dot"),
            row=row, hover=f"{name} %{{y:.4~g}} {curve.unit}, not observed",
        ))  # fmt: skip
    return out


def _over_cycle(curve: Curve, values: NDArray, row: int, of: str) -> list[dict]:
    name, colour, mean = curve.side or "middle", _COLOURS[curve.side], values.mean(axis=0)
    out = p.band(PERCENT, mean, values.std(axis=0, ddof=1), name, colour, row) if len(values) >= 3 else []
    if len(values) <= 8:
        out += [p.line(PERCENT, cycle, name, p.Stroke(colour, 0.8), row=row, opacity=0.45) for cycle in values]
    unseen = not np.isfinite(curve.std).mean() > 0.5
    label = f"{name}, {len(values)} {'' if of.strip() == curve.side else of}cycles"
    return [*out, p.line(
        PERCENT, mean, label, p.Stroke(_GREY, 2.2, "dot") if unseen else p.Stroke(colour, 2.2), row=row,
        legend=row == 0, hover=f"{name} %{{y:.4~g}} {curve.unit}", legendgroup=name,
    )]  # fmt: skip


def _range(sides: list[Curve]) -> list[float]:
    """Of the vertical axis: all values with their error bands, but a band may not squeeze the curve to a line."""
    low, high = min(c.values.min() for c in sides), max(c.values.max() for c in sides)
    least = 10.0 if sides[0].unit == "deg" else 0.05
    stds = np.concatenate([c.std for c in sides])
    finite = stds[np.isfinite(stds)]
    width = 2 * float(np.percentile(finite, 90)) if len(finite) else 0.0
    pad = max(0.08 * (high - low), 0.3 * least, min(1.15 * width, max(2 * (high - low), 2 * least)))
    return [low - pad, high + pad]


def _stacked(traces: list[dict], rows: list[list[Curve]], ranges: list[Any], x: str, **more: Any) -> p.Html:
    names = []
    for sides in rows:
        unseen = [c.side or "all of it" for c in sides if not np.isfinite(c.std).any()]
        stem = sides[0].stem
        text = NAMES.get(stem, stem) + (f"  {stem}" if stem in NAMES else "")
        text += f"  + {_POSITIVE[stem]}" if stem in _POSITIVE else ""
        names.append(text + (f"  (not observed: {' and '.join(unseen)})" if unseen else ""))
    axes = [{"title": sides[0].unit, **({"range": of} if of else {})} for sides, of in zip(rows, ranges)]
    label = f"{', '.join(sides[0].stem for sides in rows)} over {x.split()[0]}"
    return p.stacked(traces, axes, x, label, names=names, **more)


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
    terms : frames, coordinates and weights of the span in `Motion.std_of`
    """

    lowest: tuple[float, float]
    highest: tuple[float, float]
    span: tuple[float, float]
    fastest: tuple[float, float]
    share: float
    ends: tuple[int, int]
    terms: tuple[NDArray, NDArray, NDArray]


def extremes(curve: Curve, motion: Motion, tracked: NDArray) -> Extremes | None:
    """Of one angle [deg] of a motion over time; None where it was observed in no two frames.

    tracked : (F,) bool, frames in which somebody was seen and the segments on both sides of the joint are not lost.
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
    count = len(curve.coordinates)
    weights = np.concatenate([curve.slopes[high], -curve.slopes[low]])
    terms = np.repeat([high, low], count), np.tile(curve.coordinates, 2), weights
    fast, share = (fastest, 2.0 * curve.speed_std), float(known.mean())
    return Extremes(ends[0], ends[1], (span, 2.0 * motion.std_of(*terms)), fast, share, (low, high), terms)


def ranges_of(motion: Motion) -> dict[str, dict[str, Extremes | None]]:
    """{coordinate without its side: {"left", "right", or "" of the body's middle: how far it moved}} of all angles.

    None stands for what was observed in no two frames.
    """
    tree, believed = motion.body.tree, (motion.quality > 0)[:, None] & ~motion.lost

    def tracked(curve: Curve) -> NDArray:
        segment = int(tree.owners[curve.coordinates[0] - 6]) if curve.coordinates[0] >= 6 else 0
        return np.asarray(believed[:, segment] & believed[:, max(int(tree.parents[segment]), 0)])

    out: dict[str, dict[str, Extremes | None]] = {}
    for rows in by_joint(curves(motion)).values():
        for stem, found in rows.items():
            of = {c.side: extremes(c, motion, tracked(c)) for c in found if c.unit == "deg"}
            if of:
                out[stem] = of
    return out


@dataclass(frozen=True)
class RangeChange:
    """How far one angle moved in two takes.

    Parameters
    ----------
    before, after : None where it was not observed
    change : range after minus range before, with two standard deviations [deg]; None where one was not observed.
        What the prior leaves open of lengths, landmarks and cameras is in both takes of a person the same error.
    """

    before: Extremes | None
    after: Extremes | None
    change: tuple[float, float] | None

    @property
    def is_clear(self) -> bool:
        """Whether the change is larger than its two standard deviations."""
        return self.change is not None and abs(self.change[0]) > self.change[1]


@checked
def range_changes(before: Motion, after: Motion) -> dict[tuple[str, str], RangeChange]:
    """How the range of motion of every angle changed from one take to another.

    Parameters
    ----------
    before, after : of one person, or of two; whether of one is tested by lengths and landmarks that both measured

    Returns
    -------
    {(coordinate without its side, side): RangeChange}
        Of all angles of the first motion; the side is "left", "right" or "" of the body's middle.
    """
    later, shared = ranges_of(after), None
    if before.lasting is not None and after.lasting is not None:
        shared = common(before.lasting, after.lasting)
    found = {(stem, side): one for stem, of in ranges_of(before).items() for side, one in of.items()}
    out = {}
    for (stem, side), a in found.items():
        b = later.get(stem, {}).get(side)
        change = None
        if a and b:
            alike = 4.0 * _covariance(shared, before, a, after, b)
            change = b.span[0] - a.span[0], float(np.sqrt(max(a.span[1] ** 2 + b.span[1] ** 2 - 2.0 * alike, 0.0)))
        out[stem, side] = RangeChange(a, b, change)
    return out


def _covariance(shared: NDArray | None, before: Motion, a: Extremes, after: Motion, b: Extremes) -> float:
    """[deg²] of the ranges of one angle in two takes."""
    if shared is None:
        return 0.0
    first, second = (
        one.terms[2] @ motion.lasting.at(*one.terms[:2])[0]  # type: ignore[union-attr]
        for motion, one in ((before, a), (after, b))
    )
    return float(first @ shared @ second)


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
            paired.append((name, *_cells(of.get("left")), *_cells(of.get("right"))))
    parts = []
    if paired:
        columns = [f"{side} {what}" for side in ("left", "right") for what in _HEAD]
        parts.append(p.table(["[°], [°/s]", *columns], paired))
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


@dataclass(frozen=True)
class AngleRange:
    """How far one angle moved on both sides, or of the body's middle, each with two standard deviations [deg].

    Parameters
    ----------
    name : of the angle, in words
    sides : {"left", "right", or "": (range, two standard deviations)} of those that were observed
    difference : left minus right; None where one of them was not observed
    """

    name: str
    sides: Mapping[str, tuple[float, float]]
    difference: tuple[float, float] | None

    @property
    def is_sure(self) -> bool:
        """Whether the angle moved by more than the error bar on any side."""
        return any(span > twice for span, twice in self.sides.values())

    @property
    def row(self) -> tuple[str, ...]:
        """Its name, and the ranges of left, right and middle and left minus right in words, "" where there is none."""
        each = (*map(self.sides.get, ("left", "right", "")), self.difference)
        return self.name[0].upper() + self.name[1:], *(with_error(*pair) if pair else "" for pair in each)


def all_ranges(motion: Motion) -> list[AngleRange]:
    """Ranges of all angles that were observed."""
    out = []
    for stem, of in ranges_of(motion).items():
        sides = {side: found.span for side, found in of.items() if found is not None}
        if sides:
            out.append(AngleRange(spoken(stem), sides, _difference(motion, of.get("left"), of.get("right"))))
    return out


def _difference(motion: Motion, left: Extremes | None, right: Extremes | None) -> tuple[float, float] | None:
    """AngleRange of the left side minus that of the right, with two standard deviations [deg]."""
    if left is None or right is None:
        return None
    frames, coordinates, weights = map(np.concatenate, zip(left.terms, right.terms))
    weights[len(left.terms[2]) :] *= -1.0
    return left.span[0] - right.span[0], 2.0 * motion.std_of(frames, coordinates, weights)


def with_error(value: float, twice: float) -> str:
    """A value with two standard deviations."""
    return f"{value:.0f} ± {twice:.0f}".replace("-0 ", "0 ").replace("-", "−")
