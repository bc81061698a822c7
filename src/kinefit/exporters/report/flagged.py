"""The doubtful moments on the page: a time line of all, then each with its cause and, folded, its pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.exporters.report import page as p
from kinefit.exporters.report.moments import Moment, listed, place, span, spoken_segments
from kinefit.exporters.report.pictures import MOMENTS
from kinefit.motion import Motion

Pictures = Mapping[str, Mapping[int, NDArray[np.uint8]]]

_MAX_TIMELINE_ROWS = 12
_TIMELINE_ROW_PX = 24
_MAX_TABLE_MOMENTS = 200
_WARNING, _BAD = "#e0a100", "#d0441c"


def flagged(motion: Motion, moments: Sequence[Moment], pictures: Pictures, width: int) -> list[p.Html]:
    """Parts of the section on doubtful moments; pictures at most `width` px wide."""
    if not motion.residuals and not moments:
        return [p.callout("note", "This motion has no measurements, so doubtful moments are not known.")]
    if not moments:
        text = "None: no end of a segment is probably more than 8 cm off, except where it is so in most frames."
        return [p.callout("good", text)]
    out = [time_line(motion, moments)]
    for m in moments[:MOMENTS]:
        shots = [
            p.picture(frames[m.worst], caption=f"{camera}, frame {m.worst}", width=width)
            for camera, frames in pictures.items() if m.worst in frames
        ]  # fmt: skip
        severity = "bad" if motion.quality[m.worst] <= 0 else "warning"
        seen = [p.folded("Images", p.gallery(shots, size="small"))] if shots else []
        out.append(p.callout(severity, _when(motion, m), " ".join(m.what + m.causes), *seen))
    if len(moments) > MOMENTS:
        rest = moments[MOMENTS : MOMENTS + _MAX_TABLE_MOMENTS]
        rows = [(_when(motion, m), " ".join(m.what), " ".join(m.causes) or "–") for m in rest]
        more = f"{len(moments) - MOMENTS} more, less severe"
        out.append(p.folded(more, p.table(["when", "what", "why"], rows, first_left=3)))
    return out


def time_line(motion: Motion, moments: Sequence[Moment]) -> p.Html:
    """When what is doubtful: one row for each part of the body, the worst first; a click moves the 3D figure there."""
    rows: dict[str, list[Moment]] = {}
    for m in moments:
        rows.setdefault(listed(spoken_segments(motion.body, m.segments)) or "whole body", []).append(m)
    shown = list(rows)[:_MAX_TIMELINE_ROWS]
    traces = []
    for name in reversed(shown):  # plots grow upwards
        for bad, colour in ((False, _WARNING), (True, _BAD)):
            x: list[float] = []
            for m in rows[name]:
                if (motion.quality[m.worst] <= 0) == bad:
                    half = 0.5 / motion.rate
                    x += [motion.times[m.start] - half, motion.times[m.stop - 1] + half, np.nan]
            if x:
                traces.append({
                    "x": x, "y": [name] * len(x), "mode": "lines", "line": {"color": colour, "width": 12},
                    "hovertemplate": f"{name} %{{x:.2f}} s<extra></extra>", "showlegend": False,
                })  # fmt: skip
    layout = {
        "margin": {"l": 10, "r": 12, "t": 30, "b": 40}, "yaxis": {"type": "category", "automargin": True},
        "xaxis": {"title": "time [s]", "range": [float(motion.times[0]), float(motion.times[-1])]},
    }  # fmt: skip
    height = _TIMELINE_ROW_PX * len(shown) + 86
    return p.plot(traces, layout, height=height, label="when which part of the body is doubtful", seeks=True)


def _when(motion: Motion, m: Moment) -> p.Html:
    return p.joined(p.moment(motion.times[m.worst], span(motion, m)), f" {place(motion, m)}")
