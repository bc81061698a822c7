"""Angles over time with their error bars and over the cycle, one plot for each joint, left and right together."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.exporters.curves import Curve, curves
from kinefit.exporters.report.cycles import PERCENT, Cycles, normalised
from kinefit.exporters.report.names import DIGITS, FINGER_JOINTS, NAMES
from kinefit.exporters.report.norms import Norms
from kinefit.exporters.report.page import CENTRE_COLOUR, LEFT_COLOUR, RIGHT_COLOUR, Html, plot
from kinefit.motion import Motion

MAX_CURVE_POINTS = 1000  # points of a curve; the page is about as many pixels wide
_COLOURS = {"left": LEFT_COLOUR, "right": RIGHT_COLOUR, "": CENTRE_COLOUR}
_ROW, _GREY = 190, "#8a949e"  # [px] height of one plot

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


def joint_plots(motion: Motion) -> dict[str, Html]:
    """{joint: plot} of all coordinates over time with bands of ±2 standard deviations."""
    out = {}
    for joint, rows in by_joint(curves(motion)).items():
        traces: list[dict] = []
        ranges = []
        for row, sides in enumerate(rows.values()):
            for curve in sides:
                traces += _over_time(curve, motion.times, row, sides[0].side in ("left", "right"))
            ranges.append(_range(sides))
        out[joint] = _stacked(traces, list(rows.values()), "time [s]", ranges, seeks=True)
    return out


def cycle_plots(motion: Motion, cycles: Cycles, norms: Norms | None = None) -> dict[str, Html]:
    """{joint: plot} of all coordinates over the cycle: mean, ±1 standard deviation, few cycles singly; norms behind."""
    spans = {side.name: side.spans for side in cycles.sides}
    other = next(iter(spans))  # of the middle of the body: the cycles of this side
    marks = {s.name: float(np.nanmean(s.toe_off)) for s in cycles.sides if np.isfinite(s.toe_off).any()}
    out = {}
    found = [c for c in curves(motion) if not c.name.endswith(("_tx", "_tz"))]  # the way over ground is no cycle
    for joint, rows in by_joint(found).items():
        traces: list[dict] = []
        shown: dict[str, list[Curve]] = {}
        for stem, sides in rows.items():
            usable = [c for c in sides if c.side in spans or not c.side or "both" in spans]
            if not usable:
                continue
            wanted = dict.fromkeys((*(c.name for c in usable), stem))
            traces += [_norm(norms[name], len(shown)) for name in wanted if norms and name in norms]
            for curve in usable:
                side = curve.side if curve.side in spans else other
                values = normalised(curve.values, spans[side])
                traces += _over_cycle(curve, values, len(shown), "" if side == "both" else side + " ")
            shown[stem] = usable
        if shown:
            of = {c.side or other for sides in shown.values() for c in sides}
            lines = [_mark(at, _COLOURS[side]) for side, at in marks.items() if side in of]
            out[joint] = _stacked(traces, list(shown.values()), "cycle [%]", [None] * len(shown), shapes=lines)
    return out


def thinned(values: NDArray, most: int = MAX_CURVE_POINTS) -> NDArray:
    """Frames that keep the shape of a curve (F,): the lowest and highest value of each of `most` / 2 equal parts."""
    if len(values) <= most:
        return np.arange(len(values))
    parts = np.array_split(np.arange(len(values)), most // 2)
    ends = [p[k] for p in parts for k in (np.argmin(values[p]), np.argmax(values[p]))]
    return np.unique([0, *ends, len(values) - 1])


def by_joint(found: list[Curve]) -> dict[str, dict[str, list[Curve]]]:
    """{joint: {name without the side: curves}}, in the order of interest, with the joints' names in words."""
    order = {joint: number for number, joint in enumerate(_JOINTS)}
    out: dict[str, dict[str, list[Curve]]] = {}
    for curve in sorted(found, key=lambda c: order.get(c.joint, len(order))):
        out.setdefault(_JOINTS.get(curve.joint, curve.joint), {}).setdefault(curve.stem, []).append(curve)
    return out


def _over_time(curve: Curve, times: NDArray, row: int, legend: bool) -> list[dict]:
    at = thinned(curve.values)
    ends = np.append(at[1:], len(curve.values))
    std = np.array([curve.std[a:b].max() for a, b in zip(at, ends)]) if len(at) < len(curve.std) else curve.std
    t, values, known = times[at], curve.values[at], np.isfinite(std)
    name, colour = curve.side or "middle", _COLOURS[curve.side]
    axes = _axes(row)
    band_t, band = _band(t, values, np.where(known, 2 * std, np.nan))
    out: list[dict] = []
    if len(band_t):
        out.append(_filled(band_t, band, colour, name, axes))
    half_width = np.where(known, 2 * std, 0)
    line = {"x": t, "mode": "lines" if len(t) > 2 else "markers", "name": name, "legendgroup": name, **axes}
    if known.any():
        out.append(line | {
            "y": np.where(known, values, np.nan), "line": {"color": colour, "width": 1.8}, "customdata": half_width,
            "hovertemplate": f"{name} %{{y:.4~g}} ± %{{customdata:.2~g}} {curve.unit}<extra></extra>",
            "showlegend": legend and row == 0,
        })  # fmt: skip
    if not known.all():
        near = ~known
        near[:-1] |= ~known[1:]
        near[1:] |= ~known[:-1]
        dash = {"left": "dot", "right": "dash"}.get(curve.side, "dot")
        out.append(line | {
            "y": np.where(near, values, np.nan), "line": {"color": _GREY, "width": 1.4, "dash": dash},
            "hovertemplate": f"{name} %{{y:.4~g}} {curve.unit}, not observed<extra></extra>", "showlegend": False,
        })  # fmt: skip
    return out


def _norm(values: NDArray, row: int) -> dict:
    return _filled(*_band(*values.T), _GREY, "norm", _axes(row))


def _over_cycle(curve: Curve, values: NDArray, row: int, of: str) -> list[dict]:
    name, colour, axes = curve.side or "middle", _COLOURS[curve.side], _axes(row)
    mean, out = values.mean(axis=0), []
    if len(values) >= 3:
        sd = values.std(axis=0, ddof=1)
        out.append(_filled(*_band(PERCENT, mean, sd), colour, name, axes))
    if len(values) <= 8:
        for cycle in values:
            out.append({
                "x": PERCENT, "y": cycle, "mode": "lines", "line": {"color": colour, "width": 0.8}, "opacity": 0.45,
                "hoverinfo": "skip", "showlegend": False, "legendgroup": name, **axes,
            })  # fmt: skip
    unseen = not np.isfinite(curve.std).mean() > 0.5
    line = {"color": _GREY if unseen else colour, "width": 2.2, **({"dash": "dot"} if unseen else {})}
    label = f"{name}, {len(values)} {'' if of.strip() == curve.side else of}cycles"
    out.append({
        "x": PERCENT, "y": mean, "mode": "lines", "name": label, "line": line,
        "hovertemplate": f"{name} %{{y:.4~g}} {curve.unit}<extra></extra>", "legendgroup": name,
        "showlegend": row == 0, **axes,
    })  # fmt: skip
    return out


def _band(x: NDArray, middle: NDArray, half: NDArray) -> tuple[NDArray, NDArray]:
    """Outline of a band as closed polygons, one for each run of finite halves, with NaN between them."""
    known = np.flatnonzero(np.isfinite(half))
    xs: list[Any] = []
    ys: list[Any] = []
    for part in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        if len(part):
            there, back = part, part[::-1]
            xs += [x[there], x[back], [np.nan]]
            ys += [middle[there] + half[there], middle[back] - half[back], [np.nan]]
    return (np.concatenate(xs)[:-1], np.concatenate(ys)[:-1]) if xs else (np.zeros(0), np.zeros(0))


def _filled(x: NDArray, y: NDArray, colour: str, name: str, axes: dict) -> dict:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return {
        "x": x, "y": y, "mode": "none", "fill": "toself", "fillcolor": f"rgba({red},{green},{blue},0.17)",
        "hoverinfo": "skip", "showlegend": False, "legendgroup": name, **axes,
    }  # fmt: skip


def _range(sides: list[Curve]) -> list[float]:
    """Of the vertical axis: all values with their usual bands, but a band may not squeeze the curve to a line."""
    low, high = min(c.values.min() for c in sides), max(c.values.max() for c in sides)
    least = 10.0 if sides[0].unit == "deg" else 0.05
    stds = np.concatenate([c.std for c in sides])
    finite = stds[np.isfinite(stds)]
    band = 2 * float(np.percentile(finite, 90)) if len(finite) else 0.0
    pad = max(0.08 * (high - low), 0.3 * least, min(1.15 * band, max(2 * (high - low), 2 * least)))
    return [low - pad, high + pad]


def _axes(row: int) -> dict[str, str]:
    return {"xaxis": "x", "yaxis": f"y{row + 1}" if row else "y"}


def _mark(at: float, colour: str) -> dict:
    return {
        "type": "line", "xref": "x", "yref": "paper", "x0": at, "x1": at, "y0": 0, "y1": 1,
        "line": {"color": colour, "width": 1.2, "dash": "dash"},
    }  # fmt: skip


def _stacked(
    traces: list[dict], rows: list[list[Curve]], x: str, ranges: list[Any], *, seeks: bool = False, shapes: Any = ()
) -> Html:
    """Plots one below the other on one x axis, each with its name above it."""
    n, notes = len(rows), []
    height = _ROW * n + 78
    gap = 34 / (_ROW * n)
    tall = (1 - gap * (n - 1)) / n
    layout: dict[str, Any] = {"margin": {"l": 52, "r": 12, "t": 62, "b": 42}, "shapes": list(shapes)}
    for row, sides in enumerate(rows):
        top = 1 - row * (tall + gap)
        layout[f"yaxis{row + 1}" if row else "yaxis"] = {
            "domain": [max(0.0, top - tall), top], "anchor": "x", "title": sides[0].unit,
            **({"range": ranges[row]} if ranges[row] else {}),
        }  # fmt: skip
        unseen = [c.side or "all of it" for c in sides if not np.isfinite(c.std).any()]
        stem = sides[0].stem
        text = NAMES.get(stem, stem) + (f"  {stem}" if stem in NAMES else "")
        text += f"  + {_POSITIVE[sides[0].stem]}" if sides[0].stem in _POSITIVE else ""
        text += f"  (not observed: {' and '.join(unseen)})" if unseen else ""
        notes.append({
            "text": text, "x": 0, "xref": "paper", "xanchor": "left", "y": top, "yref": "paper", "yanchor": "bottom",
            "showarrow": False, "font": {"size": 12.5, "weight": 600},  # a part in bold would be a style of its element
        })  # fmt: skip
    layout["xaxis"] = {"title": x, "anchor": f"y{n}" if n > 1 else "y"}
    layout |= {"annotations": notes, "legend": {"orientation": "h", "x": 0, "xanchor": "left", "y": 1 + 32 / height,
               "yanchor": "bottom"}}  # fmt: skip
    label = ", ".join(sides[0].stem for sides in rows)
    traces = sorted(traces, key=lambda trace: "fill" not in trace)  # bands below all lines
    return plot(traces, layout, height=height, label=f"{label} over {x.split()[0]}", seeks=seeks)
