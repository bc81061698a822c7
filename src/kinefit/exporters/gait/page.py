"""gait.html: the gait record of one person on one page, left beside right."""

from __future__ import annotations

import datetime
from os import PathLike
from pathlib import Path

import numpy as np

from kinefit._arguments import checked
from kinefit._files import write_text
from kinefit.bodies.masses import segment_masses
from kinefit.exporters.gait.forces import force_plots
from kinefit.exporters.gait.record import SIDES, GaitRecord, straight_cycles
from kinefit.exporters.report import page as p
from kinefit.exporters.report.angles import cycle_plots
from kinefit.exporters.report.cycles import Norms
from kinefit.exporters.report.report import SESSION, cells, check_norms
from kinefit.exporters.report.strides import Quantity
from kinefit.findings import listed

_OPEN_JOINTS = ("Pelvis", "Hip", "Knee", "Ankle")  # joints whose curves stand open

_FORCES = "Of feet that stand alone on force plates, from contact to toe-off, each step a line."

_DEFINITIONS = (
    "A stride lasts from one contact of a foot to its next. Stance lasts from contact to toe-off. It and double "
    "support are per cent of the stride.",
    "A step is named after the foot that lands. Its length is along the stride, between heels that stand; its width is "
    "the other heel's distance from the stride.",
    "Foot progression is positive with the toes out.",
    "A walk is straight where the pelvis turns by less than 20° from contact to contact.",
    "Left minus right is followed by its share of the mean of both sides, which is zero of a symmetric walk.",
    "± is two standard deviations of the mean's error. SD is the standard deviation of single strides and steps.",
)  # fmt: skip


@checked
def write_gait_page(
    record: GaitRecord, path: str | PathLike[str], *, norms: Norms | None = None, date: str | None = None
) -> Path:
    """Write the page: numbers of both sides, their symmetry, and curves of angles over the cycle.

    Parameters
    ----------
    record : GaitRecord
    path : of the page
    norms : {coordinate: (N, 3)}, optional
        Reference values, drawn as grey bands behind the cycles; see `read_norms`.
    date : of the page; default: today's

    Raises
    ------
    ExportError
        A reference of a coordinate that the body does not have, or the page cannot be written.
    """
    motion, date = record.walks[0].motion, date or datetime.date.today().isoformat()
    check_norms(motion, norms, path)
    session = motion.provenance.get("session") or {}
    facts = {SESSION.get(key, key): str(value) for key, value in session.items() if value and key in SESSION}
    if motion.body.stature:
        facts["Stature"] = f"{motion.body.stature:.2f} m"
    walked = listed([walk.name for walk in record.walks], 8)
    subject = f" of {session['subject']}" if session.get("subject") else ""
    masses = segment_masses(motion.body)
    if np.isfinite(masses.std):
        doubt = f" ± {2.0 * masses.std:.0f}, by the stature" if masses.std else ""
        facts["Mass"] = f"{masses.masses.sum():.1f}{doubt} kg"
    forces = force_plots(walk.motion for walk in record.walks)
    sections = [
        p.section("Gait", p.facts(facts), *(p.callout("note", note) for note in record.notes), *_numbers(record)),
        p.section("Curves over the cycle", *_curves(record, norms)),
        *([p.section("Ground forces", p.paragraph(_FORCES), *forces)] if forces else []),
        p.section("How it is measured", p.bullets(_DEFINITIONS)),
    ]
    write_text(path, p.page(f"Gait record{subject}", sections, subtitle=f"{date}. {walked}."))
    return Path(path)


def _numbers(record: GaitRecord) -> list[p.Html]:
    """A table of the record's walk."""
    heads = [head for side in SIDES for head in (f"{side}, mean ± 2 σ", "SD", "n")]
    columns = ["", *heads, "left − right", "of the mean"]
    rows = []
    for name, left, right, share in record.compared(record.walk):
        each = [cell for found in (left, right) for cell in (*cells(found), f"{len(found.values)}")]
        rows.append([name, *each, *_difference(name, left, right, share)])
    counts = listed([f"{record.count('stride', side, record.walk)} {side}" for side in SIDES])
    steps = sum(record.count("step", side, record.walk) for side in SIDES)
    turned = sum(one.walk != record.walk for one in record.stretches)
    how = "straight" if record.walk == "straight" else "in a turn"
    text = f"Strides: {counts}, and {steps} single step{'' if steps == 1 else 's'}, walking {how}."
    more = f" {turned} strides and steps in turns are in the tables alone." if turned else ""
    return [p.paragraph(text + more), p.table(columns, rows)]


def _difference(name: str, left: Quantity, right: Quantity, share: tuple[float, float]) -> tuple[str, str]:
    """Left minus right, and that in per cent of their mean, each with two standard deviations."""
    if not (np.isfinite(left.mean) and np.isfinite(right.mean)):
        return "–", "–"
    value, twice = left.mean - right.mean, 2.0 * float(np.hypot(left.std, right.std))
    digits = 3 if "[m]" in name or "[m/s]" in name or "[s]" in name else 1
    percent = f"{share[0]:+.1f} ± {2.0 * share[1]:.1f} %" if np.isfinite(share[0]) else "–"
    return f"{value:+.{digits}f} ± {twice:.{digits}f}", percent


def _curves(record: GaitRecord, norms: Norms | None) -> list[p.Html]:
    """Plots of the joints, those of the leg and the pelvis open."""
    trials = straight_cycles(record)
    if not trials:
        return [p.callout("note", "No stride: curves need two contacts of one foot.")]
    plots = cycle_plots(trials, norms)
    text = (
        "From contact to contact of a foot (0–100 %). The thick line is the mean, thin ones are single strides. The "
        "band is ±1 standard deviation between strides, if there are three or more. The dashed vertical line is "
        "toe-off. Rotation of the pelvis is relative to its mean heading."
    )
    parts = [p.paragraph(text)]
    if norms:
        parts.append(p.paragraph("The grey band is the mean ±1 standard deviation of the reference given."))
    for name in _OPEN_JOINTS:
        parts += [p.heading(name), plots.pop(name)] if name in plots else []
    return [*parts, *([p.folded("Other joints", p.chooser("Joint", plots))] if plots else [])]
