"""The doubtful moments on the page, each with its cause and pictures; which frames a report shows, and how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion, Residuals
from kinefit.exporters.pictures.drawing import draw_body, draw_residuals, drawn_points
from kinefit.exporters.report import moments as doubt
from kinefit.exporters.report import page as p
from kinefit.geometry.camera import Camera, ImageFrame

Pictures = Mapping[str, Mapping[int, NDArray[np.uint8]]]

MOMENTS = 6  # doubtful moments that have pictures
_MARGIN = 0.25  # of the person's box that is kept around it
_MAX_TIMELINE_ROWS = 12
_TIMELINE_ROW_PX = 24
_MAX_TABLE_MOMENTS = 200
_WARNING, _BAD = "#e0a100", "#d0441c"


def flagged(
    motion: Motion, moments: Sequence[doubt.Moment], throughout: str, pictures: Pictures, width: int
) -> list[p.Html]:
    """Parts of the section on doubtful moments, with `throughout_sentence`; pictures at most `width` px wide."""
    if not motion.residuals and not moments:
        return [p.callout("note", "This motion has no measurements, so doubtful moments are not known.")]
    if not moments:
        text = "None: no end of a segment is probably more than 5 cm off"
        if throughout:
            return [p.callout("note", f"{text} for a moment only. In most frames these are: {throughout}.")]
        return [p.callout("good", f"{text}.")]
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


def time_line(motion: Motion, moments: Sequence[doubt.Moment]) -> p.Html:
    """When what is doubtful: one row for each part of the body, the worst first; a click moves the 3D figure there."""
    rows: dict[str, list[doubt.Moment]] = {}
    for m in moments:
        rows.setdefault(doubt.spoken_segments(motion.body, m.segments), []).append(m)
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
                traces.append(p.line(x, [name] * len(x), name, p.Stroke(colour, 12), hover=f"{name} %{{x:.2f}} s"))
    layout = {
        "margin": {"l": 10, "r": 12, "t": 30, "b": 40}, "yaxis": {"type": "category", "automargin": True},
        "xaxis": {"title": "time [s]", "range": [float(motion.times[0]), float(motion.times[-1])]},
    }  # fmt: skip
    height = _TIMELINE_ROW_PX * len(shown) + 86
    return p.plot(traces, layout, height=height, label="when which part of the body is doubtful", seeks=True)


def _when(motion: Motion, m: doubt.Moment) -> p.Html:
    return p.joined(p.moment(motion.times[m.worst], doubt.span(motion, m)), f" {doubt.place(motion, m)}")


def report_frames(motion: Motion) -> dict[int, str]:
    """{frame: what it is}: first, middle, last, the one of lowest quality, and those of the worst doubtful moments."""
    if not len(motion):
        return {}
    out: dict[int, str] = {0: "first", len(motion) // 2: "middle", len(motion) - 1: "last"}
    out.setdefault(int(np.argmin(motion.quality)), "lowest quality")
    for m in doubt.doubtful_moments(motion)[:MOMENTS]:
        out.setdefault(m.worst, "doubtful")
    return out


def close_up(
    image: NDArray[np.uint8],
    motion: Motion,
    frame: int,
    camera: Camera,
    *,
    image_frame: ImageFrame | None = None,
    residuals: Residuals | None = None,
) -> NDArray[np.uint8]:
    """The part of a picture (H, W, 3) uint8 RGB that shows the person, with the fit and the keypoints drawn on it."""
    image_frame = image_frame or ImageFrame.identity()
    out = np.array(image, order="C")
    draw_body(out, motion, frame, camera, image_frame)
    if residuals is not None and residuals.unit == "px":
        draw_residuals(out, residuals, frame, image_frame)
    uv = image_frame.from_calibration(camera.project(drawn_points(motion, frame)))
    uv = uv[np.isfinite(uv).all(axis=1)]
    size = np.array([out.shape[1], out.shape[0]], float)
    if not len(uv) or np.any(uv.max(axis=0) < 0) or np.any(uv.min(axis=0) > size):
        return out
    low, high = np.clip(uv.min(axis=0), 0, size), np.clip(uv.max(axis=0), 0, size)
    pad = _MARGIN * max(high - low)
    (left, top), (right, bottom) = np.clip(low - pad, 0, size).astype(int), np.clip(high + pad, 0, size).astype(int)
    return out[top:bottom, left:right] if right - left > 16 and bottom - top > 16 else out
