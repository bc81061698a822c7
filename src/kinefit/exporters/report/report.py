"""report.html: results, their uncertainty and the methods, in one file.

    write_report(motion, "report.html")

What moved, how sure that is and what to do come first, in five lines and a table of ranges; then the moving figure,
angles and cycles; then what the measurements do not tell, and what is doubtful. Angles are those of OpenSim in degrees,
with ±2 standard deviations; what nothing observes is said to be so. Cycles are shown only where the movement repeats.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_text
from kinefit.bodies.motion import Motion, Residuals
from kinefit.errors import ExportError, choices
from kinefit.exporters.pictures.drawing import draw_body, draw_residuals, drawn_points
from kinefit.exporters.report import angles
from kinefit.exporters.report import moments as doubt
from kinefit.exporters.report import page as p
from kinefit.exporters.report.cycles import Cycles, Norms, find_cycles, gait_numbers
from kinefit.exporters.report.figure import figure
from kinefit.exporters.report.fit import overall_median, point_table, quality_plot, sensor_fits, sensor_table
from kinefit.exporters.report.methods import lengths_table, methods
from kinefit.exporters.report.strides import Quantity
from kinefit.exporters.tables import curves, spoken
from kinefit.findings import listed, of_provenance
from kinefit.geometry.camera import Camera, ImageFrame, Rig

_BUDGET = 40  # pictures at 640 px: about 3 MB; more of them are made smaller

SESSION = {
    "subject": "Subject", "date": "Date of the recording", "movement": "Movement", "side": "Side", "visit": "Visit",
    "operator": "Operator", "notes": "Notes",
}  # fmt: skip
"""Entries of a take's `[session]`, as the page heads them."""


@checked
def write_report(
    motion: Motion,
    path: str | PathLike[str],
    *,
    rig: Rig | None = None,
    pictures: Pictures | None = None,
    files: Mapping[str, str] | None = None,
    findings: Iterable[tuple[str, str, str]] = (),
    norms: Norms | None = None,
    date: str | None = None,
) -> Path:
    """Write one self-contained HTML page about a motion.

    The first page fetches plotly.js, which draws the plots; where it cannot be fetched, the page says so and has none.

    Parameters
    ----------
    motion : Motion
        What was done is read from its `provenance`.
    path : path of the page
    rig : Rig, optional
        Cameras for the 3D figure, in the motion's world.
    pictures : {camera: {frame: (H, W, 3) uint8 RGB}}, optional
        Overlay pictures; those of the frames of `report_frames` find their place.
    files : {name: what it is}, optional
        Other results, as links relative to the page.
    findings : (severity, title, text), optional
        What else the reader should know first, such as what a check of the take found; severity as in `page.callout`.
    norms : {coordinate: (N, 3)}, optional
        Normative values, drawn as grey bands behind the cycles; see `read_norms`.
    date : str, optional
        Of the report; by default today's. The same motion and date give the same bytes.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    ExportError
        The motion has no frames, or the page cannot be written.
    """
    if not len(motion):
        raise ExportError("a motion without frames has nothing to report", file=path, remedy="Track the take first.")
    date = date or datetime.date.today().isoformat()
    moments, throughout, shown = doubt.doubtful_moments(motion), doubt.throughout_sentence(motion), pictures or {}
    cycles = find_cycles(motion)
    check_norms(motion, norms, path)
    width = round(640 * min(1.0, (_BUDGET / max(1, sum(map(len, shown.values())))) ** 0.5))
    sections = [
        *p.fault_sections(of_provenance(motion.provenance)),
        _summary(motion, moments, throughout, list(findings), date),
        p.section("Moving figure", figure(motion, rig), p.paragraph(
            "Drag to turn. Click, then use the wheel (or two fingers) to zoom. Blue is left, orange right. Parts "
            "that are grey and dashed are lost; translucent parts are uncertain. Cylinders shows the surfaces of the "
            "fit. Click a time on this page, or a plot over time, to move the figure to that time.", small=True)),
        p.section("Angles", *_angles(motion)),
        p.section("Cycles", *_cycles(motion, cycles, norms or {})),
        *([p.section("Limits", *limits)] if (limits := _limits(motion, throughout)) else []),
        p.section("Doubtful moments", *flagged(motion, moments, throughout, shown, width)),
        p.section("Fit to the measurements", *_fit(motion, moments)),
    ]  # fmt: skip
    if shown:
        about = "First, middle and last frame, and the one of lowest quality"
        sections.append(p.section("Images", p.folded(about, *_pictures(motion, shown, width))))
    sections.append(p.section("Methods", *methods(motion, date, len(moments))))
    if files:
        rows = [(p.file_link(name), about) for name, about in files.items()]
        sections.append(p.section("Files", p.table(["file", "what it is"], rows, first_left=2)))
    subtitle = f"Motion report, {date}. {len(motion)} frames at {motion.rate:g} Hz, {len(motion) / motion.rate:.2f} s."
    write_text(path, p.page(motion.name, sections, subtitle=subtitle))
    return Path(path)


def trust_sentence(motion: Motion, moments: Sequence[doubt.Moment]) -> str:
    """One sentence on how far the motion can be trusted."""
    parts = []
    for unit, shown_unit in (("px", "px"), ("m", "mm")):
        names = [name for name, r in motion.residuals.items() if r.unit == unit and np.isfinite(r.norms).any()]
        if names:
            parts.append(f"fits {listed(names, 6)} to a median of {overall_median(motion, unit):.1f} {shown_unit}")
    start = " and ".join(parts) or "has no measurements to compare it with"
    if not moments:
        return f"The motion {start}; no doubtful moment."
    return f"The motion {start}; doubtful moments: {doubt.doubt_sentence(motion, moments)}."


def _summary(
    motion: Motion, moments: Sequence[doubt.Moment], throughout: str, findings: Sequence[tuple[str, ...]], date: str
) -> p.Section:
    """Results, their confidence and what to do, in five lines and one table of ranges."""
    found, session = angles.all_ranges(motion), motion.provenance.get("session")
    sure = [one for one in found if one.is_sure]
    severity, trust = _trust(motion, moments, throughout)
    facts = {}
    if isinstance(session, Mapping):
        facts = {SESSION.get(key, str(key)): str(value) for key, value in session.items() if value}
    people = motion.provenance.get("people")
    if isinstance(people, Mapping):
        facts["Person"] = f"{people['followed']} of {people['in view']} in view"
    tall = f", {motion.body.stature:.2f} m tall," if motion.body.stature else ""
    seen = float(np.mean(motion.quality > 0))
    lines = {
        "Recorded": f"{len(motion) / motion.rate:.2f} s, {len(motion)} frames at {motion.rate:g} Hz. "
                    f"The person{tall} was tracked in {100 * seen:.0f} % of them.",
        "Moved most": _moved_most(sure), "Left and right": _sides(found), "How sure": p.inline(trust),
        "What to do": _what_to_do(motion, moments),
    }  # fmt: skip
    least = [one.name for one in found if not one.is_sure]
    heads = ("range of motion [°]", "left", "right", "middle", "left minus right")
    shared = motion.lasting is not None
    about = (
        "± is two standard deviations: nineteen of twenty such intervals hold the true value. Of a range it is that of "
        "the difference of its ends" + (", without the errors that both have in common." if shared else
        ", as if their errors were independent: an upper bound. This motion does not tell what errors they share.")
    )  # fmt: skip
    more = (
        "*: observed in only some of the frames. An angle with a standard deviation above 45° counts as not observed. "
        "± of the fastest speed is from the covariance of adjacent frames after smoothing; nine tenths of the frames "
        "have less."
    )
    return p.section(
        "Summary", *([p.facts(facts)] if facts else []),
        p.callout(severity, "In short", *(p.paragraph(p.strong(f"{name}: "), text) for name, text in lines.items())),
        *(p.callout(*finding) for finding in findings),
        *([p.table(heads, [one.row for one in sure])] if sure else []),
        *([f"Moved less than their error bars: {listed(least, 60)}."] if least else []), p.paragraph(about, small=True),
        p.folded("Lowest, highest, fastest of every angle", angles.ranges_table(motion), p.paragraph(more, small=True)),
        p.folded("Lengths of the body", lengths_table(motion)),
    )  # fmt: skip


def _trust(motion: Motion, moments: Sequence[doubt.Moment], throughout: str) -> tuple[str, str]:
    """How far the motion can be trusted: severity of a box, and the sentence."""
    poor = float(np.mean(motion.quality < doubt.POORLY_SUPPORTED * (1.0 - doubt.unmarked(motion).mean(axis=1))))
    unobserved = float(np.mean(motion.quality <= 0))
    wrong = unobserved > 0.1 or poor > 0.5 or of_provenance(motion.provenance)
    severity = "bad" if wrong else "warning" if moments or throughout else "good"
    parts = [trust_sentence(motion, moments)]
    if throughout:
        parts.append(f" Uncertain in most frames, at the far end (2 σ): {throughout}.")
    if moments:
        parts += [" See ", p.link("doubtful-moments", "where and why"), "."]
    if unobserved:
        parts.append(f" In {100 * unobserved:.0f} % of the frames no person was observed.")
    return severity if motion.residuals else "note", p.joined(*parts)


def _moved_most(sure: Sequence[angles.AngleRange]) -> str:
    """The three largest ranges of those that are twice their error bars."""
    each = [(span, f"{side} {one.name}".strip(), twice) for one in sure for side, (span, twice) in one.sides.items()]
    most = sorted((one for one in each if one[0] > 2.0 * one[2]), reverse=True)[:3]
    if not most:
        return "no angle moved by twice its error bar."
    return listed([f"{name} ({angles.with_error(span, twice)}°)" for span, name, twice in most]) + "."


def _sides(found: Sequence[angles.AngleRange]) -> str:
    """Ranges of left and right that differ by more than the error bar."""
    differ = [(one.name, one.difference) for one in found if one.difference is not None]
    apart = [(name, pair) for name, pair in differ if abs(pair[0]) > pair[1]]
    if not differ:
        return "no angle was observed on both sides."
    if not apart:
        least = min(twice for _, (_, twice) in differ)
        return f"no range differs by more than its error bar; the least difference that would count is {least:.0f}°."
    return "ranges differ in " + listed([f"{name} ({angles.with_error(*pair)}°)" for name, pair in apart], 6) + "."


def _what_to_do(motion: Motion, moments: Sequence[doubt.Moment]) -> str:
    """The first remedy."""
    faults = [fault.remedy for fault in of_provenance(motion.provenance) if fault.remedy]
    if faults:
        return faults[0]
    if any(f.is_shifted for f in sensor_fits(motion)):
        return "run kinefit check on the take: the calibration or the image size does not fit (see Limits)."
    if moments:
        return "look at the doubtful moments before you use what happens in them."
    if not motion.provenance.get("session"):
        return "nothing. The subject, the date and the movement are not stated: write them into [session] of the take."
    return "nothing."


def _limits(motion: Motion, throughout: str) -> list[p.Html]:
    """What the measurements do not determine, and what disagrees."""
    parts = []
    shifted = [f for f in sensor_fits(motion) if f.is_shifted]
    if shifted:
        shifts = ", ".join(f"{f.name} ({f.shift[0]:+.1f}, {f.shift[1]:+.1f}) px" for f in shifted)
        text = (
            "A large part of the residuals is the same shift in every frame. This points to the calibration or the "
            "image size, not to the person: run kinefit check on the take."
        )
        parts.append(p.callout("warning", f"Constant shift in {shifts}.", text))
    if throughout:
        parts.append(p.callout("note", f"Uncertain in most frames, at the far end (2 σ): {throughout}."))
    bare = np.flatnonzero(2 * doubt.unmarked(motion).sum(axis=0) > len(motion))
    text = "No measurement observes them. Their values come from the prior and are no results."
    if len(bare):
        names = doubt.spoken_segments(motion.body, [motion.body.tree.segments[s] for s in bare], 20)
        parts.append(p.callout("note", f"Not observed, as they have no markers: {names}.", text))
    angles_of_bare = {motion.body.tree.coordinates[d] for d in np.flatnonzero(np.isin(motion.body.tree.owners, bare))}
    blind = [name for name in doubt.never_observed(motion) if name not in angles_of_bare]
    if blind:
        most = len(blind) > 0.5 * len(motion.body.dof_names)
        title = f"Not observed: {listed([spoken(name) for name in blind], 8)}."
        parts.append(p.callout("bad" if most else "note", title, text))
    shared = doubt.shared_by_prior(motion)
    if shared:
        each = [f"{spoken(name)} (±{2 * std:.0f}°)" for name, std in shared.items()]
        title = f"Shares from the reference pose: {listed(each, 8)}."
        text = (
            "Their sum is measured, their shares are not: points at joint centres do not determine the rotation of the "
            "segment between them. The reference pose sets the shares; ± (two standard deviations) is how far people "
            "differ from it. Changes within a take are more certain than the values. Markers on the front and the back "
            "of the pelvis would determine the shares."
        )
        parts.append(p.callout("note", title, text))
    return parts


def _angles(motion: Motion) -> list[p.Html]:
    return [
        p.paragraph(
            "Names and signs are those of OpenSim's Rajagopal model. The band is ±2 standard deviations of the "
            "measurement; a grey dashed line without a band was not observed in that time."
        ),
        p.chooser("Joint", angles.joint_plots(motion)),
    ]


def check_norms(motion: Motion, norms: Norms | None, path: str | PathLike[str]) -> None:
    """Raise ExportError for normative values of coordinates that the body does not have."""
    stems = {name for c in curves(motion) for name in (c.name, c.stem)}
    unknown = [name for name in norms or {} if name not in stems]
    if unknown:
        raise ExportError(choices("normative coordinate", unknown[0], sorted(stems)), file=path)


def _cycles(motion: Motion, cycles: Cycles | None, norms: Norms) -> list[p.Html]:
    if cycles is None:
        text = (
            "No two cycles of similar duration and shape were found: neither strides nor another repeated "
            "movement."
        )
        return [p.callout("note", "This take has no repeated cycle.", text)]
    counts = listed([f"{len(s.spans)} {'' if s.name == 'both' else s.name + ' '}cycles" for s in cycles.sides])
    if cycles.kind == "gait":
        text = (
            f"Gait: {counts}, from contact to contact of a foot (0–100 %). A foot stands from where its heel or ball "
            "gets slow over the ground until its toes leave it. The dashed vertical line is toe-off. "
        )
    else:
        text = f"A repeated movement: {counts}, from one extreme posture to the next of the same kind. "
    text += (
        "The thick line is the mean, thin ones are single cycles. The band is ±1 standard deviation between cycles, "
        "if there are three or more."
    )
    if np.isfinite(cycles.likeness):
        text += f" The cycles' coefficient of multiple correlation is {cycles.likeness:.2f}."
    parts = [p.paragraph(text), gait_table(motion, cycles)]
    if norms:
        parts.append(p.paragraph("The grey band is the normative mean ±1 standard deviation of the table given."))
    return [*parts, p.chooser("Joint", angles.cycle_plots([(motion, cycles)], norms))]


def gait_table(motion: Motion, cycles: Cycles) -> p.Html:
    """Numbers of cycles: means with two standard deviations of their errors, and how much single cycles differ."""
    sides = [side.name for side in cycles.sides]
    heads = [head for side in sides for head in (f"{side}, mean ± 2 σ", "SD of cycles")]
    numbers = gait_numbers(motion, cycles)
    rows = [(name, *(cell for of in each for cell in cells(of))) for name, each in numbers.items()]
    return p.table(["", *heads], rows)


def cells(of: Quantity) -> tuple[str, str]:
    """The mean with two standard deviations of its error, and how much single cycles differ."""
    return value_and_error(of), f"{of.spread:.{_digits(of.mean)}f}" if np.isfinite(of.spread) else "–"


def value_and_error(of: Quantity, sigmas: float = 2.0) -> str:
    """The mean with so many standard deviations of its error."""
    if not np.isfinite(of.mean):
        return "–"
    if not np.isfinite(of.std):
        return f"{of.mean:.{_digits(of.mean)}f}, not observed"
    digits = max(_digits(of.mean), _digits(sigmas * of.std, count=1))
    return f"{of.mean:.{digits}f} ± {sigmas * of.std:.{digits}f}"


def _digits(value: float, count: int = 3) -> int:
    """Digits behind the point, of so many that count; six at most."""
    return min(6, max(0, count - 1 - int(np.floor(np.log10(max(abs(value), 1e-9))))))


def _fit(motion: Motion, moments: Sequence[doubt.Moment]) -> list[p.Html]:
    text = "Quality is the share of the body that its measurements support: less than half below the dotted line."
    parts = [p.paragraph(text), quality_plot(motion, moments)]
    if not motion.residuals:
        return [*parts, p.callout("note", "This motion has no measurements, so there are no residuals.")]
    fits, names = sensor_fits(motion), {name for r in motion.residuals.values() for name in r.names}
    about = (
        "Residuals are measured minus fitted. A shift is the median residual along an axis: far from zero, it points "
        "to the calibration. Rejected points are outliers."
    )
    return [*parts, p.heading("Sensors"), p.paragraph(about), sensor_table(motion, fits), p.heading("Points"),
            p.folded("Every point in every sensor", point_table(motion), opened=len(names) <= 40)]  # fmt: skip


def _pictures(motion: Motion, pictures: Pictures, width: int) -> list[p.Html]:
    names = {frame: what for frame, what in report_frames(motion).items() if what != "doubtful"}
    out = [p.paragraph("The fitted skeleton on the video; rings are keypoints, red crosses rejected ones.")]
    for camera, frames in pictures.items():
        shots = [
            p.picture(frames[f], caption=f"{what}: frame {f}, {motion.times[f]:.2f} s", width=width)
            for f, what in sorted(names.items()) if f in frames
        ]  # fmt: skip
        if shots:
            out += [p.heading(camera), p.gallery(shots, size="small")]
    return out


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
