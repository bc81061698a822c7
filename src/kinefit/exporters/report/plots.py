"""What plots are made of, as plotly.js takes it: lines, bands, marks, and rows of them on one x axis."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.exporters.report.page import Html, plot

MAX_CURVE_POINTS = 1000  # points of a curve; the page is about as many pixels wide
_ROW_PX, _GAP_PX, _HEAD_PX = 190, 34, 62  # height of one row, of the gap to the next, of legend and names above


def line(
    x: ArrayLike, y: ArrayLike, name: str, colour: str, width: float, *, hover: str = "", dash: str = "", row: int = 0,
    legend: bool = False, **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """A line in a row, of single points where it has no more than two; without `hover` it says nothing of itself."""
    return {
        "x": x, "y": y, "mode": "lines" if np.size(x) > 2 else "markers", "name": name, "legendgroup": name,
        "line": {"color": colour, "width": width, **({"dash": dash} if dash else {})}, "showlegend": legend,
        **({"hovertemplate": f"{hover}<extra></extra>"} if hover else {"hoverinfo": "skip"}), **_axes(row), **more,
    }  # fmt: skip


def band(x: NDArray, middle: NDArray, half: NDArray, name: str, colour: str, row: int = 0) -> list[dict[str, Any]]:
    """A band about a line: closed polygons, one for each run of finite halves; nothing where there is none."""
    known = np.flatnonzero(np.isfinite(half))
    xs: list[NDArray] = []
    ys: list[NDArray] = []
    for part in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        xs += [x[part], x[part[::-1]], np.full(1, np.nan)]
        ys += [(middle + half)[part], (middle - half)[part[::-1]], np.full(1, np.nan)]
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    trace = {
        "x": np.concatenate(xs)[:-1], "y": np.concatenate(ys)[:-1], "mode": "none", "fill": "toself",
        "fillcolor": f"rgba({red},{green},{blue},0.17)", "hoverinfo": "skip", "showlegend": False, "legendgroup": name,
        **_axes(row),
    }  # fmt: skip
    return [trace] if len(known) else []


def mark(along: str, at: float, colour: str, width: float, dash: str) -> dict[str, Any]:
    """A straight line across a plot at a place on its axis "x" (of all rows) or "y"."""
    other = "y" if along == "x" else "x"
    place = {f"{along}ref": along, f"{along}0": at, f"{along}1": at, f"{other}ref": "paper", f"{other}0": 0}
    return {"type": "line", **place, f"{other}1": 1, "line": {"color": colour, "width": width, "dash": dash}}


def stacked(
    traces: Iterable[dict[str, Any]], rows: Sequence[dict[str, Any]], x: str, label: str, *, names: Sequence[str] = (),
    marks: Iterable[dict[str, Any]] = (), seeks: bool = False,
) -> Html:  # fmt: skip
    """Rows of plots one below the other on one x axis: what differs of their y axes, and their names above them."""
    n, notes = len(rows), []
    height = _ROW_PX * n + _HEAD_PX + 16
    gap = _GAP_PX / (_ROW_PX * n)
    tall = (1 - gap * (n - 1)) / n
    layout: dict[str, Any] = {"margin": {"l": 52, "r": 12, "t": _HEAD_PX, "b": 42}, "shapes": list(marks)}
    for k, row in enumerate(rows):
        top = 1 - k * (tall + gap)
        layout[f"yaxis{k + 1}" if k else "yaxis"] = {"domain": [max(0.0, top - tall), top], "anchor": "x", **row}
        notes += [{
            "text": text, "x": 0, "xref": "paper", "xanchor": "left", "y": top, "yref": "paper", "yanchor": "bottom",
            "showarrow": False, "font": {"size": 12.5, "weight": 600},  # a part in bold would be a style of its element
        } for text in names[k : k + 1]]  # fmt: skip
    legend = {"orientation": "h", "x": 0, "xanchor": "left", "y": 1 + 32 / height, "yanchor": "bottom"}
    layout |= {"xaxis": {"title": x, "anchor": f"y{n}" if n > 1 else "y"}, "annotations": notes, "legend": legend}
    below_lines = sorted(traces, key=lambda trace: "fill" not in trace)  # bands first
    return plot(below_lines, layout, height=height, label=label, seeks=seeks)


def thinned(values: NDArray, most: int = MAX_CURVE_POINTS) -> NDArray:
    """Frames that keep the shape of a curve (F,): the lowest and highest value of each of `most` / 2 equal parts."""
    if len(values) <= most:
        return np.arange(len(values))
    parts = np.array_split(np.arange(len(values)), most // 2)
    ends = [p[k] for p in parts for k in (np.argmin(values[p]), np.argmax(values[p]))]
    return np.unique([0, *ends, len(values) - 1])


def _axes(row: int) -> dict[str, str]:
    return {"xaxis": "x", "yaxis": f"y{row + 1}" if row else "y"}
