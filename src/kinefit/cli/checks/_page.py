"""The page of `kinefit check`: findings, and pictures that show them.

The pictures have points as detected and as the other cameras predict them, and errors by place.
"""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import UP_AXES
from kinefit.errors import KinefitError
from kinefit.exporters.pictures.drawing import DARK, MEASURED, draw_dot, draw_line
from kinefit.exporters.report import page as p
from kinefit.fitting.multiview.views import from_others
from kinefit.geometry.camera import Camera, ImageFrame
from kinefit.rigs.diagnostics.checks import Checked
from kinefit.takes.preparing.faces import shown_video

if TYPE_CHECKING:
    from kinefit.cli.checks._refine import Refined

_DOTS = 1500  # of the person's points in the plan
_EXPECTED, _BIAS = (90, 200, 255), (255, 90, 60)
_ARROW_SCALE = 10  # a bias of 2 px is drawn 20 px long
_MAP_CELLS = (6, 10)  # of the map of residuals, along the shorter and the longer side of the image
_MIN_CELL_POINTS = 15  # fewer give no mean worth an arrow
_CROP_MARGIN = 0.12  # of the person's size, shown around the person
_LINE_REFERENCE_PX = 1100  # longer side of the pictures for which the stated line widths hold


def check_page(check: Checked, refinement: Refined | None = None) -> str:
    """The whole page as text."""
    sections = [_findings(check)]
    if refinement is not None:
        sections.append(p.section("Refined calibration", p.bullets(refinement.summary_lines()), anchor="refined"))
    if check.biases:
        sections += [_cameras(check), _pictures(check), _plan(check)]
        sections += [_times(check)] if check.times.curves else []
    sections.append(_words())
    return p.page(f"Check of {check.name}", sections, subtitle=verdict(check))


def verdict(check: Checked) -> str:
    """One sentence: how many faults and doubts there are."""
    if check.observations is None and all(found.severity == "note" for found in check.findings):
        return "Nothing could be checked."
    count = {s: sum(found.severity == s for found in check.findings) for s in ("fault", "doubt", "note")}
    counts = [f"{n} {s}{'s' if n > 1 else ''}" for s, n in count.items() if n]
    if count["fault"]:
        rest = ": correct the faults before you use the results" if len(counts) > 1 else ""
        return f"{' and '.join(counts[:2])}{rest}."
    return f"No fault; {counts[0]}." if counts and count["doubt"] else "No fault and no doubt."


def _findings(check: Checked) -> p.Section:
    shown = [p.finding_callout(found) for found in check.findings if found.severity != "good"]
    good = [found.text for found in check.findings if found.severity == "good"]
    parts = shown or [p.callout("good", "The check found no faults and no doubts.")]
    if good:
        parts.append(p.folded(f"In order: {len(good)} checks passed", p.bullets(good), opened=not shown))
    return p.section("Findings", *parts, anchor="findings")


def camera_rows(check: Checked) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of the table of cameras."""
    columns = [
        "camera", "bias u, v [px]", "±", "against the others", "spread", "outliers", "late [frames]",
        "left/right swapped", "volume in view",
    ]  # fmt: skip
    rows = []
    for k, b in enumerate(check.biases):
        c, late = check.times.cameras.index(b.camera), "-"
        if np.isfinite(check.times.offsets[c]):
            late = f"{check.times.frames[c]:+.2f} ± {check.times.std[c] * check.times.rate:.2f}"
        sides = str(int(check.views.swapped[:, check.views.rig.index(b.camera)].sum()))
        rows.append([
            b.camera, _pair(b.bias), _number(b.std.max()), _pair(b.alone), _number(b.spread), _share(b.outliers), late,
            sides, _share(check.coverage[k].volume),
        ])  # fmt: skip
    return columns, rows


def _pair(values: NDArray) -> str:
    return f"{values[0]:+.1f}, {values[1]:+.1f}" if np.isfinite(values).all() else "-"


def _number(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "-"


def _share(value: float) -> str:
    return f"{100 * value:.0f} %" if np.isfinite(value) else "-"


def _cameras(check: Checked) -> p.Section:
    columns, rows = camera_rows(check)
    caption = (
        "Bias: median of the projected points of the person minus their keypoints. Outliers: keypoints that agree "
        "with no other camera."
    )
    return p.section("Cameras", p.table(columns, rows), p.paragraph(caption, small=True), anchor="cameras")


def _pictures(check: Checked) -> p.Section:
    """Of every camera one frame with its points, and a map of the mean errors."""
    pictures, maps = [], []
    for b in check.biases:
        c = check.views.rig.index(b.camera)
        seen = np.isfinite(check.views.uv[:, :, c]).all(-1).sum(axis=1)
        middle = np.abs(np.arange(len(seen)) - len(seen) / 2)
        frame = int(np.argmax(seen - 1e-3 * middle))
        ground, image = _ground(check, check.views.rig.cameras[c], frame)
        others = image.from_calibration(from_others(check.views.at(np.array([frame])), c)[0])
        bias = b.alone if np.isfinite(b.alone).all() else b.bias
        points = _points(ground, image.from_calibration(check.views.uv[frame, :, c]), others, bias)
        caption = f"{b.camera}, frame {frame}: {_pair(bias)} px against the other cameras"
        pictures.append(p.picture(points, caption=caption))
        maps.append(p.picture(_map(check, c, ground, image), caption=f"{b.camera}: median error by place"))
    first = (
        "One frame of each camera. Yellow rings: detected keypoints. Blue dots: the same points as predicted from the "
        f"other cameras. Red arrow: the bias against the other cameras, {_ARROW_SCALE} times as long."
    )
    second = (
        f"Median of projected minus detected points in each part of the image, {_ARROW_SCALE} times as long. "
        "Parallel arrows: the camera was rotated or moved. Radial arrows: wrong focal length. Curved arrows: wrong "
        "distortion."
    )
    return p.section(
        "Images", first, p.gallery(pictures), p.paragraph(second), p.gallery(maps), anchor="pictures"
    )


def _ground(check: Checked, camera: Camera, frame: int) -> tuple[NDArray, ImageFrame]:
    """A frame of the camera's video (grey where there is none), and how it relates to the calibration's picture."""
    seen = check.observations
    if seen is not None and camera.name in seen.videos:
        step = frame + seen.frames[0] - check.frames_late.get(camera.name, 0)
        offset = next(entry.time_offset for entry in check.take.cameras if entry.name == camera.name)
        try:
            with shown_video(check.take, seen, camera.name) as video:
                time = float(np.clip(step / seen.rate - offset, 0.0, video.times[-1]))
                return np.array(video.read(video.frame_at(time) or 0)), seen.images[camera.name]
        except KinefitError:
            pass
    return np.full((camera.size[1], camera.size[0], 3), 70, np.uint8), ImageFrame.identity()


def _points(ground: NDArray, seen: NDArray, others: NDArray, bias: NDArray) -> NDArray:
    """The part of an image about the person with points (K, 2) [px] as detected and as predicted, and the bias."""
    scale, out = max(ground.shape) / _LINE_REFERENCE_PX, (ground * 0.75).astype(np.uint8)
    for both in np.stack([seen, others], axis=1):
        draw_line(out, both, _EXPECTED, max(1, round(1.5 * scale)))
    for uv, expected in zip(seen, others, strict=True):
        draw_dot(out, expected, 4.5 * scale, DARK, -1)
        draw_dot(out, expected, 3.5 * scale, _EXPECTED, -1)
        draw_dot(out, uv, 6 * scale, DARK, max(1, round(4 * scale)))
        draw_dot(out, uv, 6 * scale, MEASURED, max(1, round(2 * scale)))
    person = seen[np.isfinite(seen).all(-1)]
    start = np.median(person, axis=0) if len(person) else np.array(out.shape[1::-1]) / 2
    end = start + _ARROW_SCALE * bias
    _arrow(out, start, end, 3 * scale)
    shown = np.array([*person, start, end])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = max(40.0, _CROP_MARGIN * float(np.max(high - low)))
    (left, top), (right, bottom) = (np.maximum(np.rint([low - margin, high + margin]), [[0], [1]])).astype(int)
    return out[top:bottom, left:right]


def _map(check: Checked, c: int, ground: NDArray, image: ImageFrame) -> NDArray:
    """An image with the median error in each of its parts."""
    camera, scale = check.views.rig.cameras[c], max(ground.shape) / _LINE_REFERENCE_PX
    uv = check.views.uv[:, :, c].reshape(-1, 2)
    error = camera.project(check.x_world.reshape(-1, 3)) - uv
    fine = np.linalg.norm(error, axis=-1) < check.views.limit
    uv, error, size = uv[fine], error[fine], np.array(camera.size)
    cells = np.where(size == size.max(), _MAP_CELLS[1], _MAP_CELLS[0])
    cell = np.ravel_multi_index(np.clip((uv / size * cells).astype(int), 0, cells - 1).T, cells)
    out = (ground * 0.4).astype(np.uint8)
    for here in (cell == k for k in np.flatnonzero(np.bincount(cell) >= _MIN_CELL_POINTS)):
        start = image.from_calibration(np.median(uv[here], axis=0))
        draw_dot(out, start, 3 * scale, _EXPECTED, -1)
        _arrow(out, start, start + _ARROW_SCALE * np.median(error[here], axis=0), 2 * scale)
    return out


def _arrow(out: NDArray, start: NDArray, end: NDArray, width: float) -> None:
    length = float(np.linalg.norm(end - start))
    tip = min(0.5, 4 * width / max(length, 1.0) + 0.1)
    a, b = np.clip(np.rint([start, end]), -20000, 20000).astype(int).tolist()
    for colour, thick in ((DARK, width + 3), (_BIAS, width)) if length > 1 else ():
        cv2.arrowedLine(out, a, b, colour, max(1, round(thick)), cv2.LINE_AA, tipLength=tip)


def _plan(check: Checked) -> p.Section:
    """The cameras and the person from above and from the side."""
    axis = np.array(UP_AXES[check.up])
    across = np.array(UP_AXES["x" if abs(axis[0]) < 0.5 else "y"])
    along = np.cross(axis, across)
    x = check.x_world[np.isfinite(check.x_world).all(-1)]
    x = x[np.unique(np.linspace(0, len(x) - 1, _DOTS).astype(int))]
    reach = float(np.median([np.linalg.norm(camera.centre_world - np.median(x, axis=0)) for camera in check.views.rig]))
    plots = []
    for title, a, b, name in (("From above", across, along, "y"), ("From the side", across, axis, "height")):
        traces: list[dict[str, Any]] = [{
            "x": x @ a, "y": x @ b, "mode": "markers", "type": "scatter", "name": "the person's points",
            "marker": {"size": 3, "color": "#9aa6b2", "opacity": 0.35}, "hoverinfo": "skip",
        }]  # fmt: skip
        for camera in check.views.rig:
            width, height = camera.size
            ends = [camera.ray(np.array([u, height / 2])) for u in (0.0, width - 1.0)]
            outline = camera.centre_world + 0.45 * reach * np.stack([ends[0], np.zeros(3), ends[1]])
            bad = any(found.severity == "fault" for found in check.of(camera.name))
            colour = p.RIGHT_COLOUR if bad else p.LEFT_COLOUR
            traces.append(p.line(outline @ a, outline @ b, camera.name, p.Stroke(colour, 1)))
            traces.append({
                "x": outline[1:2] @ a, "y": outline[1:2] @ b, "mode": "markers+text", "type": "scatter",
                "text": [camera.name], "textposition": "top center", "showlegend": False,
                "marker": {"size": 11, "color": colour, "symbol": "square"}, "hoverinfo": "text",
            })  # fmt: skip
        layout = {
            "xaxis": {"title": "x [m]"}, "yaxis": {"title": f"{name} [m]", "scaleanchor": "x"},
            "showlegend": False, "hovermode": "closest",
        }  # fmt: skip
        plot = p.plot(traces, layout, height=420, label=f"Cameras and person {title.lower()}")
        plots.append(p.Html(f"<div>{p.heading(title)}{plot}</div>"))
    note = "Lines: rays through the middle of the image's left and right side. Orange: cameras with a fault."
    return p.section(
        "Where the cameras stand", p.gallery(plots, size="large"), p.paragraph(note, small=True), anchor="plan"
    )


def _times(check: Checked) -> p.Section:
    traces = [
        p.line(shifts, cost, f"{a} - {b}", p.Stroke(colour, 1.6), hover=f"{a} - {b} %{{y:.1f}} px", legend=True)
        for ((a, b), (shifts, cost)), colour in zip(check.times.curves.items(), cycle(p.SERIES))
    ]
    layout = {
        "xaxis": {"title": "shift of the second camera [frames]"},
        "yaxis": {"title": "distance of the rays [px]", "rangemode": "tozero"},
    }
    text = (
        "Distance between the rays of two cameras when one camera is shifted in time. Synchronised cameras have the "
        "minimum at 0. A flat line means too little motion to decide."
    )
    return p.section(
        "Time", text, p.plot(traces, layout, height=340, label="Distance of the rays by shift in time"), anchor="time"
    )


def _words() -> p.Section:
    return p.section("How this was found", p.bullets([
        "Bias: one person's points are triangulated robustly from all cameras that agree. The bias of a camera is the "
        "median of its residuals; its standard error counts each keypoint once.",
        "Which camera moved: normal equations of all cameras' shifts, rotations and scales, with the points "
        "eliminated, give the share of the disagreement that one or two cameras alone explain.",
        "Time: whole frames from the distance of rays, fractions from the points' speeds. Standard errors: jackknife "
        "over tenths of the recording.",
        "A detector's error is alike in many frames and differs between views: biases of a few pixels are normal.",
    ]), anchor="how")  # fmt: skip
