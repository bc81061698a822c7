"""How well a motion fits what the sensors saw: over time, by sensor, by point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import SHOWN_UNITS, Motion, Residuals, known_median
from kinefit.exporters.report import page as p
from kinefit.exporters.report.moments import POORLY_SUPPORTED, Moment
from kinefit.findings import runs_of

_SHIFTED = 0.5  # of the median residual: a constant shift above makes up most of what a camera is off by


@dataclass(frozen=True, eq=False)
class SensorFit:
    """One sensor in numbers, in `unit` ("px", or "mm" of markers); NaN where it saw nothing.

    `seen` and `left_out` are shares (of all points, of those seen), `shift` (N,) the median residual along each axis.
    """

    name: str
    unit: str
    count: int
    median: float
    most: float  # 95 % of the residuals are smaller
    seen: float
    left_out: float
    shift: NDArray
    swapped: int

    @property
    def is_shifted(self) -> bool:
        """Whether a constant shift is much of what this camera is off by."""
        return self.unit == "px" and len(self.shift) == 2 and bool(np.linalg.norm(self.shift) > _SHIFTED * self.median)


def sensor_fits(motion: Motion) -> tuple[SensorFit, ...]:
    """Every sensor of a motion in numbers."""
    return tuple(_fit(name, r) for name, r in motion.residuals.items())


def overall_median(motion: Motion, unit: str = "px") -> float:
    """Median residual of all points, or else surfaces, of a unit ("px", or "m", shown in mm); NaN without any."""
    own = [r for r in motion.residuals.values() if r.unit == unit]
    chosen = [r for r in own if r.of_points] or own
    return SHOWN_UNITS[unit][0] * known_median(np.concatenate([*(r.norms.ravel() for r in chosen), np.zeros(0)]))


def sensor_table(motion: Motion, fits: Sequence[SensorFit]) -> p.Html:
    """One row a sensor."""
    columns = ["sensor", "median", "95 % below", "shift u or x", "v or y", "z", "points seen", "rejected"]
    columns.append("left/right swaps")
    flat = all(len(f.shift) < 3 for f in fits)
    rows = []
    for f in fits:
        shift = [f"{v:+.1f}" for v in f.shift] + ["–"] * (3 - len(f.shift))
        swaps = runs_of(np.asarray(motion.residuals[f.name].swapped, bool), round(0.1 * motion.rate))
        links = [p.moment(motion.times[a], f"{motion.times[a]:.2f} s") for a, _ in swaps[:6]]
        more = " …" if len(swaps) > 6 else ""
        swapped = p.joined(f"{f.swapped} frames: ", p.Html(", ".join(links)), more) if swaps else "–"
        rows.append(
            [f.name, value_text(f.median, f.unit), value_text(f.most, f.unit), *(shift[:2] if flat else shift),
             f"{100 * f.seen:.0f} %", f"{100 * f.left_out:.1f} %", swapped]
        )  # fmt: skip
    if flat:
        columns.remove("z")
        columns[3:5] = ["shift u", "v"]
    return p.table(columns, rows)


def point_table(motion: Motion) -> p.Html:
    """Median residual of every point in every sensor, the darker the larger; the share left out where it is much."""
    sensors = dict(motion.residuals)
    names = list(dict.fromkeys(name for r in sensors.values() for name in r.names))
    medians = {sensor: point_medians(r) for sensor, r in sensors.items()}
    left_out = {
        sensor: dict(zip(r.names, r.rejected.sum(axis=0) / np.maximum(np.isfinite(r.norms).sum(axis=0), 1)))
        for sensor, r in sensors.items()
    }
    largest = {
        unit: max((v for s, r in sensors.items() if r.unit == unit for v in medians[s].values() if v > 0), default=1.0)
        for unit in SHOWN_UNITS
    }
    rows = []
    for name in names:
        cells: list[str] = [name]
        for sensor, r in sensors.items():
            value, share = medians[sensor].get(name, np.nan), left_out[sensor].get(name, 0.0)
            text = f"{value:.1f}" if np.isfinite(value) else "–"
            cells.append(p.shaded(text + (f" ({100 * share:.0f} %)" if share >= 0.05 else ""), value / largest[r.unit]))
        rows.append(cells)
    heads = [f"{s} [{SHOWN_UNITS[r.unit][1]}]" for s, r in sensors.items()]
    caption = "Median residual of every point; in brackets the share rejected as outliers, if it is 5 % or more."
    return p.table(["point", *heads], rows, caption=caption)


def quality_plot(motion: Motion, moments: Sequence[Moment]) -> p.Html:
    """Quality and every sensor's residual over time, doubtful moments shaded; a click moves the 3D figure."""
    times, at, half = motion.times, p.thinned(motion.quality), 0.5 / motion.rate
    hover = "quality %{y:.2f}"
    traces = [p.line(times[at], motion.quality[at], "quality", p.Stroke("#4d4d4d", 1.8), hover=hover)]
    units = list(dict.fromkeys(r.unit for r in motion.residuals.values()))
    for k, (name, r) in enumerate(motion.residuals.items()):
        factor, unit = SHOWN_UNITS[r.unit]
        level = factor * np.array([known_median(norms) for norms in r.norms])
        known = np.flatnonzero(np.isfinite(level))
        whole = len(level) <= p.MAX_CURVE_POINTS or not len(known)
        at = np.arange(len(level)) if whole else known[p.thinned(level[known])]
        hover, row = f"{name} %{{y:.1f}} {unit}", 1 + units.index(r.unit)
        colour = p.SERIES[k % len(p.SERIES)]
        traces.append(p.line(times[at], level[at], name, p.Stroke(colour, 1.4), hover=hover, row=row, legend=True))
    axes: list[dict[str, Any]] = [{"title": "quality", "range": [0, 1.03]}]
    axes += [{"title": f"residual [{SHOWN_UNITS[unit][1]}]", "rangemode": "tozero"} for unit in units]
    marks: list[dict[str, Any]] = [
        {"type": "rect", "xref": "x", "yref": "paper", "y0": 0, "y1": 1, "x0": times[m.start] - half,
         "x1": times[m.stop - 1] + half, "fillcolor": "rgba(224,161,0,0.25)", "line": {"width": 0}, "layer": "below"}
        for m in moments[:100]
    ]  # fmt: skip
    marks.append(p.mark("y", POORLY_SUPPORTED, p.Stroke("#a87600", 1, "dot")))
    return p.stacked(traces, axes, "time [s]", "quality and residuals over time", marks=marks, seeks=True)


def _fit(name: str, r: Residuals) -> SensorFit:
    factor, unit = SHOWN_UNITS[r.unit]
    seen, rejected = np.isfinite(r.norms), r.rejected
    found, used = factor * r.norms[seen], seen & ~rejected
    shift = factor * np.median(r.values[used], axis=0) if used.any() else np.full(r.values.shape[-1], np.nan)
    return SensorFit(
        name, unit, len(found), known_median(found), float(np.percentile(found, 95)) if len(found) else np.nan,
        float(seen.mean()) if seen.size else 0.0, float(rejected.sum() / max(len(found), 1)), shift,
        int(np.sum(r.swapped)),
    )


def point_medians(r: Residuals) -> dict[str, float]:
    """Point -> median residual as shown [px, mm], NaN where it was not seen."""
    return {name: SHOWN_UNITS[r.unit][0] * known_median(norms) for name, norms in zip(r.names, r.norms.T)}


def value_text(value: float, unit: str) -> str:
    """A residual in words."""
    return f"{value:.1f} {unit}" if np.isfinite(value) else "no data"
