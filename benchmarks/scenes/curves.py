"""Curves over one axis as an SVG picture, without any library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

COLOURS = ("#1b6ca8", "#d1495b", "#2a9d5c", "#8e5ea2", "#c98b1b")
_WIDTH, _HEIGHT, _LEFT, _TOP, _GAP = 460, 260, 56, 34, 66


def curves(
    path: str | Path, panels: Sequence[tuple[str, Sequence[tuple[ArrayLike, ArrayLike, str, str]]]], *,
    x: str, y: str, legend: Mapping[str, str],
) -> None:
    """Write panels side by side.

    Parameters
    ----------
    panels : title, and curves (x, y, colour, dash pattern such as "4 3" or "")
    x, y : names of the axes, with units.
    legend : text -> "colour dashes"
    """  # fmt: skip
    out, total = [], len(panels) * (_WIDTH + _GAP) + 20
    for k, (title, lines) in enumerate(panels):
        left = k * (_WIDTH + _GAP) + _LEFT
        xs, ys = (np.concatenate([np.ravel(line[i]) for line in lines]) for i in (0, 1))
        ticks = [_ticks(float(np.nanmin(v)), float(np.nanmax(v))) for v in (xs, ys)]
        place = lambda a, b: (
            left + (a - ticks[0][0]) / (ticks[0][-1] - ticks[0][0]) * _WIDTH,  # noqa: B023
            _TOP + (ticks[1][-1] - b) / (ticks[1][-1] - ticks[1][0]) * _HEIGHT,  # noqa: B023
        )
        out.append(_text(left, _TOP - 12, title, "start", 14))
        for value in ticks[0]:
            u, _ = place(value, ticks[1][0])
            out.append(f'<line x1="{u:.1f}" y1="{_TOP}" x2="{u:.1f}" y2="{_TOP + _HEIGHT}" stroke="#ddd"/>')
            out.append(_text(u, _TOP + _HEIGHT + 16, f"{value:g}", "middle"))
        for value in ticks[1]:
            _, v = place(ticks[0][0], value)
            out.append(f'<line x1="{left}" y1="{v:.1f}" x2="{left + _WIDTH}" y2="{v:.1f}" stroke="#ddd"/>')
            out.append(_text(left - 6, v + 4, f"{value:g}", "end"))
        out.append(_text(left + _WIDTH / 2, _TOP + _HEIGHT + 34, x, "middle"))
        middle = _TOP + _HEIGHT / 2
        out.append(_text(left - 40, middle, y, "middle", turn=f' transform="rotate(-90 {left - 40} {middle})"'))
        for a, b, colour, dashes in lines:
            points = [place(p, q) for p, q in zip(np.ravel(a), np.ravel(b)) if np.isfinite(q)]
            told = " ".join(f"{u:.1f},{v:.1f}" for u, v in points)
            style = f'stroke="{colour}" stroke-width="1.6" stroke-dasharray="{dashes}"'
            out.append(f'<polyline points="{told}" fill="none" {style}/>')
    at = _LEFT
    for text, style in legend.items():
        colour, _, dashes = style.partition(" ")
        v = _TOP + _HEIGHT + 56
        line = f'stroke="{colour}" stroke-width="2" stroke-dasharray="{dashes}"'
        out.append(f'<line x1="{at}" y1="{v - 4}" x2="{at + 28}" y2="{v - 4}" {line}/>')
        out.append(_text(at + 34, v, text, "start"))
        at += 60 + 7 * len(text)
    size = f'width="{total}" height="{_TOP + _HEIGHT + 70}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">'
    Path(path).write_text("\n".join([head, '<rect width="100%" height="100%" fill="white"/>', *out, "</svg>", ""]))


def _text(u: float, v: float, text: str, anchor: str, size: int = 12, turn: str = "") -> str:
    return f'<text x="{u:.1f}" y="{v:.1f}" font-size="{size}" text-anchor="{anchor}"{turn}>{text}</text>'


def _ticks(low: float, high: float) -> np.ndarray:
    """Round values from below the lowest to above the highest."""
    step = 10.0 ** np.floor(np.log10(max(high - low, 1e-9)))
    for part in (0.2, 0.25, 0.5, 1.0):
        if (high - low) / (step * part) <= 8:
            step *= part
            break
    return np.arange(np.floor(low / step), np.ceil(high / step) + 1) * step
