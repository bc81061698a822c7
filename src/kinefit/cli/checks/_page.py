"""The page of `kinefit check`: findings, and pictures that show them."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from kinefit.cli.checks._pictures import pair, picture_section
from kinefit.diagnostics.keypoints import Check
from kinefit.exporters.report import page as p
from kinefit.exporters.report.page import finding_callout
from kinefit.exporters.report.plots import line
from kinefit.geometry.camera import Camera
from kinefit.motion import UP_AXES

if TYPE_CHECKING:
    from kinefit.cli.checks._refine import Refined

_DOTS = 1500  # of the person's points in the plan


def check_page(check: Check, *, refinement: Refined | None = None, up: str = "z") -> str:
    """The whole page as text."""
    sections = [_findings(check)]
    if refinement is not None:
        sections.append(p.section("Refined calibration", p.bullets(refinement.summary_lines()), anchor="refined"))
    if check.biases and check.views is not None:
        sections.append(_cameras(check))
        sections.append(picture_section(check))
        sections.append(_plan(check, up))
    if check.times is not None and check.times.curves:
        sections.append(_times(check))
    sections.append(_words())
    return p.page(f"Check of {check.name}", sections, subtitle=verdict(check))


def verdict(check: Check) -> str:
    """One sentence: how many faults and doubts there are."""
    count = {s: sum(found.severity == s for found in check.findings) for s in ("fault", "doubt", "note")}
    counts = [f"{n} {s}{'s' if n > 1 else ''}" for s, n in count.items() if n]
    if count["fault"]:
        rest = ": correct the faults before you use the results" if len(counts) > 1 else ""
        return f"{' and '.join(counts[:2])}{rest}."
    return f"No fault; {counts[0]}." if counts and count["doubt"] else "No fault and no doubt."


def _findings(check: Check) -> p.Section:
    shown = [finding_callout(found) for found in check.findings if found.severity != "good"]
    good = [found.text for found in check.findings if found.severity == "good"]
    parts = shown or [p.callout("good", "The check found no faults and no doubts.")]
    if good:
        parts.append(p.folded(f"In order: {len(good)} checks passed", p.bullets(good), opened=not shown))
    return p.section("Findings", *parts, anchor="findings")


def camera_rows(check: Check) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of the table of cameras."""
    columns = [
        "camera", "bias u, v [px]", "±", "against the others", "spread", "outliers", "late [frames]",
        "left/right swapped", "volume in view",
    ]  # fmt: skip
    rows = []
    for b in check.biases:
        late, sides = "-", "-"
        if check.times is not None and b.camera in check.times.cameras:
            c = check.times.cameras.index(b.camera)
            if np.isfinite(check.times.offsets[c]):
                late = f"{check.times.frames[c]:+.2f} ± {check.times.std[c] * check.times.rate:.2f}"
        if check.views is not None:
            sides = str(int(check.views.swapped[:, check.views.rig.index(b.camera)].sum()))
        seen = next((c.volume for c in check.coverage if c.camera == b.camera), np.nan)
        rows.append([
            b.camera, pair(b.bias), _number(b.std.max()), pair(b.alone), _number(b.spread), _share(b.outliers), late,
            sides, _share(seen),
        ])  # fmt: skip
    return columns, rows


def _number(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "-"


def _share(value: float) -> str:
    return f"{100 * value:.0f} %" if np.isfinite(value) else "-"


def _cameras(check: Check) -> p.Section:
    columns, rows = camera_rows(check)
    caption = (
        "Bias: median of the projected points of the person minus their keypoints. Outliers: keypoints that agree "
        "with no other camera."
    )
    return p.section("Cameras", p.table(columns, rows), p.paragraph(caption, small=True), anchor="cameras")


def _plan(check: Check, up: str) -> p.Section:
    """The cameras and the person from above and from the side."""
    assert check.views is not None and check.x_world is not None
    axis = np.array(UP_AXES[up])
    across = np.array(UP_AXES["x" if abs(axis[0]) < 0.5 else "y"])
    along = np.cross(axis, across)
    x = check.x_world[np.isfinite(check.x_world).all(-1)]
    x = x[np.unique(np.linspace(0, len(x) - 1, _DOTS).astype(int))]
    reach = float(np.median([np.linalg.norm(camera.centre_world - np.median(x, axis=0)) for camera in check.views.rig]))
    plots = []
    for title, a, b, names in (
        ("From above", across, along, ("x", "y")),
        ("From the side", across, axis, ("x", "height")),
    ):
        traces: list[dict[str, Any]] = [{
            "x": x @ a, "y": x @ b, "mode": "markers", "type": "scatter", "name": "the person's points",
            "marker": {"size": 3, "color": "#9aa6b2", "opacity": 0.35}, "hoverinfo": "skip",
        }]  # fmt: skip
        for camera in check.views.rig:
            corners = [camera.centre_world + 0.45 * reach * camera.ray(np.array(uv)) for uv in _sides(camera)]
            outline = np.stack([corners[0], camera.centre_world, corners[1]])
            bad = any(found.severity == "fault" for found in check.of(camera.name))
            colour = p.RIGHT_COLOUR if bad else p.LEFT_COLOUR
            traces.append(line(outline @ a, outline @ b, camera.name, colour, 1))
            traces.append({
                "x": [float(camera.centre_world @ a)], "y": [float(camera.centre_world @ b)], "mode": "markers+text",
                "type": "scatter", "text": [camera.name], "textposition": "top center", "showlegend": False,
                "marker": {"size": 11, "color": colour, "symbol": "square"}, "hoverinfo": "text",
            })  # fmt: skip
        layout = {
            "xaxis": {"title": f"{names[0]} [m]"}, "yaxis": {"title": f"{names[1]} [m]", "scaleanchor": "x"},
            "showlegend": False, "hovermode": "closest",
        }  # fmt: skip
        plot = p.plot(traces, layout, height=420, label=f"Cameras and person {title.lower()}")
        plots.append(p.Html(f"<div>{p.heading(title)}{plot}</div>"))
    note = "Lines: rays through the middle of the image's left and right side. Orange: cameras with a fault."
    return p.section(
        "Where the cameras stand", p.gallery(plots, size="large"), p.paragraph(note, small=True), anchor="plan"
    )


def _sides(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    width, height = camera.size
    return (0.0, height / 2), (width - 1.0, height / 2)


def _times(check: Check) -> p.Section:
    assert check.times is not None
    traces = [
        line(shifts, cost, f"{a} - {b}", colour, 1.6, hover=f"{a} - {b} %{{y:.1f}} px", legend=True)
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
