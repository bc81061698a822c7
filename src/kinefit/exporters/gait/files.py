"""The gait record in files: one table of all strides and steps, a summary, and gait.html, left beside right."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_text, writing
from kinefit.bodies.masses import segment_masses
from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.exporters.gait.plates import GRAVITY
from kinefit.exporters.gait.record import SIDES, WALKS, GaitRecord, headings, straight_cycles
from kinefit.exporters.report import page as p
from kinefit.exporters.report.angles import cycle_plots
from kinefit.exporters.report.cycles import Norms
from kinefit.exporters.report.feet import footing
from kinefit.exporters.report.report import SESSION, cells, check_norms
from kinefit.exporters.report.strides import QUANTITIES, Quantity
from kinefit.exporters.tables import Table, parquet_writer, quantity_table, to_csv
from kinefit.findings import listed

_DIGITS = 6  # that count, of numbers in the summary


def write_gait(record: GaitRecord, folder: str | PathLike[str]) -> dict[str, Path]:
    """Write gait.csv, gait.json and, where pyarrow is installed, gait.parquet.

    The tables have a row for every stride and single step, with each quantity and its standard deviation, NaN (in CSV
    nothing) where it was not seen. The summary has what `summary` returns.

    Returns
    -------
    {"csv", "parquet", "json": file}

    Raises
    ------
    ExportError
        A file cannot be written.
    """
    folder, table = Path(folder), stride_table(record)
    out = {"csv": folder / "gait.csv"}
    with writing(out["csv"]) as file:
        to_csv([table], file)
    if find_spec("pyarrow"):
        out["parquet"] = folder / "gait.parquet"
        with writing(out["parquet"]) as file:
            parquet_writer(folder, {"trials": ", ".join(walk.name for walk in record.walks)})([table], file)
    out["json"] = folder / "gait.json"
    write_text(out["json"], json.dumps(summary(record), indent=1, ensure_ascii=False) + "\n")
    return out


def stride_table(record: GaitRecord) -> Table:
    """Columns (rows,): trial, kind, side, walk, start and stop [s], each quantity with its standard deviation."""
    return quantity_table(record.stretches, ("trial", "kind", "side", "walk", "start", "stop"), QUANTITIES)


def summary(record: GaitRecord) -> dict[str, Any]:
    """The record as JSON has it.

    Returns
    -------
    {"trials": names, "notes": sentences, "stature_m", "mass_kg", "mass_std_kg": of the person, "straight", "turning":
    {"strides", "steps": {side: number}, "quantities": {quantity: {"left", "right", "both": {"mean", "std": of the
    mean's error, "sd": of strides, "cv_percent", "n"}, "symmetry_percent": {"value", "std"}}}}}
    """
    body = record.walks[0].motion.body
    masses = segment_masses(body)
    out: dict[str, Any] = {
        "trials": [walk.name for walk in record.walks], "notes": list(record.notes),
        "stature_m": _rounded(body.stature) if body.stature else None,
        "mass_kg": _rounded(float(masses.masses.sum())), "mass_std_kg": _rounded(masses.std),
    }  # fmt: skip
    for walk in WALKS:
        counts = {f"{kind}s": {side: record.count(kind, side, walk) for side in SIDES} for kind in ("stride", "step")}
        both, quantities = record.quantities("both", walk), {}
        for name, left, right, (share, std) in record.compared(walk):
            entry = {side: _entry(q) for side, q in zip((*SIDES, "both"), (left, right, both[name])) if len(q.values)}
            if np.isfinite(share):
                entry["symmetry_percent"] = {"value": _rounded(share), "std": _rounded(std)}
            quantities[name] = entry
        out[walk] = {**counts, "quantities": quantities}
    return out


def _entry(of: Quantity) -> dict[str, Any]:
    variation = 100.0 * of.spread / abs(of.mean or np.nan)
    numbers = {"mean": of.mean, "std": of.std, "sd": of.spread, "cv_percent": variation}
    return {name: _rounded(value) for name, value in numbers.items()} | {"n": len(of.values)}


def _rounded(value: float) -> float | None:
    return float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None


PERCENT = np.linspace(0.0, 100.0, 101)
"""Of stance, from contact to toe-off, at which forces are given."""

_COLOURS = {"left": p.LEFT_COLOUR, "right": p.RIGHT_COLOUR}


@dataclass(frozen=True, eq=False)
class StepForces:
    """The ground's force on a foot that stands alone on plates, from contact to toe-off.

    Parameters
    ----------
    side : "left" or "right"
    vertical, forward : (101,) [body weights] at `PERCENT`; forward is where the pelvis faces in the middle of stance
    """

    side: str
    vertical: NDArray
    forward: NDArray


def step_forces(motion: Motion) -> list[StepForces]:
    """Forces of all whole steps on the plates of a motion, in the order of their contacts."""
    weight = GRAVITY * float(segment_masses(motion.body).masses.sum())
    upright, facing = rotation_between_up(motion.up, "y"), headings(motion)
    plates, out = {plate.name: plate for plate in motion.plates}, list[StepForces]()
    for step in found.steps if (found := footing(motion)) else ():
        if not np.isfinite([step.contact, step.off]).all():
            continue
        times = step.contact + (step.off - step.contact) * PERCENT / 100.0
        force = np.sum([plates[name].at(times).force for name in step.plate.split(", ")], axis=0)
        heading = np.interp(times[len(times) // 2], motion.times, facing)
        ahead = np.array([np.cos(heading), 0.0, -np.sin(heading)]) @ upright
        out.append(StepForces(step.side, force @ upright[1] / weight, force @ ahead / weight))
    return out


def force_plots(motions: Iterable[Motion]) -> list[p.Html]:
    """A plot of the vertical and one of the forward force over stance, every step a line; none without such steps."""
    steps = [step for motion in motions if motion.plates for step in step_forces(motion)]
    out = []
    for what, text in (("vertical", "Vertical force"), ("forward", "Force forward (braking is negative)")):
        lines, sides = [], set[str]()
        for step in steps:
            lines.append(p.line(
                PERCENT, getattr(step, what), step.side, p.Stroke(_COLOURS[step.side], 1.5),
                legend=step.side not in sides,
            ))  # fmt: skip
            sides.add(step.side)
        axes = {"xaxis": {"title": {"text": "stance [%]"}}, "yaxis": {"title": {"text": "body weights"}}}
        out += [p.paragraph(f"{text}."), p.plot(lines, axes, label=text)] if lines else []
    return out


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
