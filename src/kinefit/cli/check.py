"""`kinefit check`: what is wrong with a recording, in plain words and on a page."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kinefit.cli import _screen

if TYPE_CHECKING:
    from kinefit.calibration.check.check import Check
    from kinefit.calibration.refine.result import Refinement

_EXAMPLES = """\b
Examples:
  kinefit check take.toml                    findings, and a page with images
  kinefit check take.toml --refine           a better calibration too, beside the old one
  kinefit check take.toml --refine --take    and a copy of the take that uses it
"""
_PRINTED = ("camera", "bias u, v [px]", "±", "spread", "late [frames]", "l/r exchanged")
_STYLES = {"fault": "bold red", "doubt": "yellow", "note": "cyan", "good": "green"}


@click.command(short_help="Find out what is wrong with a recording; refine its calibration.", epilog=_EXAMPLES)
@click.argument("take", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Page to write.  [default: TAKE-check.html]")
@click.option("--refine", is_flag=True, help="Write a refined calibration beside the old one, never over it.")
@click.option("--focal", is_flag=True, help="With --refine: focal lengths too.")
@click.option("--distortion", is_flag=True, help="With --refine: lens distortion too.")
@click.option("--time-offsets", is_flag=True, help="With --refine: time offsets too.")
@click.option(
    "--points", type=click.Path(path_type=Path),
    help="With --refine: TOML of static points, [name] and camera = [u, v] px in the calibration's image.",
)
@click.option("--take", "copy", is_flag=True, help="With --refine: write a copy of the take file that uses it.")
@click.option("--strict", is_flag=True, help="Exit code 2 where there is a fault.")
@_screen.verbose_option
@click.pass_context
def check(
    ctx: click.Context, take: Path, out: Path | None, refine: bool, focal: bool, distortion: bool, time_offsets: bool,
    points: Path | None, copy: bool, strict: bool, verbose: bool,
) -> None:  # fmt: skip
    """Find out what is wrong with a recording, how sure that is, and what would fix it.

    TAKE is the recording's take file. Looked at are the calibration (which camera moved, lens, unit, poses), the order
    of the cameras, their steps in time, pictures scaled or letterboxed after the calibration, left and right, floor and
    up, and what each camera sees.
    """
    if (focal or distortion or time_offsets or copy or points) and not refine:
        raise click.UsageError("--focal, --distortion, --time-offsets, --points and --take only go with --refine.")
    from kinefit.calibration.check.check import check_take
    from kinefit.cli._check_page import check_page
    from kinefit.cli._detecting import with_detections
    from kinefit.errors import KinefitError
    from kinefit.exporters.atomic import write_text
    from kinefit.readers.take.file import read_take

    entry, out = read_take(take), out or take.with_name(f"{take.stem}-check.html")
    refined: Refinement | None = None
    failed: KinefitError | None = None
    with _screen.bars() as step:
        try:
            entry = with_detections(entry, step)
        except KinefitError as error:  # the rest can be checked without
            _screen.note(f"note: no keypoints: {error}")
        found = check_take(entry, progress=step)
        if refine:
            try:
                refined = _refine(found, step, points, focal=focal, distortion=distortion, time_offsets=time_offsets)
            except KinefitError as error:
                failed = error
    _print(found, verbose)
    write_text(out, check_page(found, refinement=refined, up=entry.up))
    _screen.say(f"\nWritten: {out}")
    if failed is not None:
        raise failed
    if refined is not None:
        _write_refined(found, refined, take, copy=copy)
    if strict and found.faults:
        ctx.exit(2)


def _refine(
    found: Check, step: _screen.Step, points: Path | None, *, focal: bool, distortion: bool, time_offsets: bool
) -> Refinement:
    from kinefit.bodies import load_body
    from kinefit.calibration.refine.refine import refine
    from kinefit.errors import CalibrationError
    from kinefit.readers.static_points import read_static_points

    seen, take = found.observations, found.take
    if found.views is None or not found.biases or seen is None or take is None:
        raise CalibrationError(
            "the calibration cannot be refined before the faults are fixed",
            remedy="Mend what is named as a fault first.",
        )
    static = read_static_points(points, found.views.rig.names) if points else None
    accuracy = min(entry.sigma for entry in take.keypoints)
    return refine(
        found.views.rig, [k for k in seen.keypoints if k.camera in found.views.rig], load_body(take.body), focal=focal,
        distortion=distortion, time_offsets=time_offsets, static_points=static, height=take.height, up=take.up,
        accuracy=accuracy,
        progress=step,
    )  # fmt: skip


def _print(found: Check, verbose: bool) -> None:
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    from kinefit.cli._check_page import camera_rows, verdict

    _screen.say(f"\n{found.name}: {verdict(found)}")
    for one in found.findings:
        if one.severity == "good" and not verbose:
            continue
        _screen.console().print(
            Text.assemble("\n", (f"{one.severity}: ", _STYLES[one.severity]), one.text), soft_wrap=True
        )
        if one.confidence:
            _screen.say(f"   how sure: {one.confidence}")
        if one.remedy:
            _screen.say(f"   try: {one.remedy}")
    good = [one for one in found.findings if one.severity == "good"]
    if good and not verbose:
        _screen.say(f"\nin order: {', '.join(dict.fromkeys(one.kind for one in good))} (-v says more)")
    columns, rows = camera_rows(found)
    if rows:
        shown = [at for at, name in enumerate(columns) if name in _PRINTED]
        table = Table(*(escape(columns[at]) for at in shown), box=None, pad_edge=False)
        for row in rows:
            table.add_row(*(row[at] for at in shown))
        _screen.say()
        _screen.console().print(table)


def _write_refined(found: Check, refined: Refinement, path: Path, *, copy: bool) -> None:
    from kinefit.exporters.atomic import write_text
    from kinefit.readers.calibration.write import write_calibration_like

    assert found.take is not None and found.take.calibration is not None
    old = found.take.calibration
    new = free_name(old.file)
    write_calibration_like(refined.rig, old.file, new, unit=old.unit)
    _screen.say(f"Written: {new}\n")
    for line in refined.told():
        _screen.say(line)
    told = _relative(new, path.absolute().parent)
    _screen.say(f'\nTo use it, write file = "{told}" into [calibration] of {path.name}.')
    entries = {entry.name: entry.time_offset for entry in found.take.cameras}
    offsets = {name: entries[name] + late for name, late in refined.time_offsets.items() if abs(late) > 1e-5}
    for name, value in offsets.items():
        _screen.say(f"And time_offset = {value:.5f} into [[camera]] {name}.")
    if copy:
        beside = free_name(path)
        write_text(beside, with_calibration(path.read_text("utf-8"), told, offsets))
        _screen.say(f"Written: {beside}")


def _relative(path: Path, folder: Path) -> str:
    path = path.absolute()
    return (path.relative_to(folder) if path.is_relative_to(folder) else path).as_posix()


def free_name(path: Path) -> Path:
    """The name with "_refined" before its endings, numbered where that is taken."""
    stem, dot, endings = path.name.partition(".") if path.is_file() else (path.name, "", "")
    number, candidate = 1, path.with_name(f"{stem}_refined{dot}{endings}")
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{stem}_refined{number}{dot}{endings}")
    return candidate


def with_calibration(text: str, file: str, offsets: dict[str, float]) -> str:
    """The text of a take file with another calibration file, and time offsets [s] of some cameras."""
    quoted = '"' + file.replace("\\", "\\\\").replace('"', '\\"') + '"'
    text = re.sub(
        r"(?ms)(^\[calibration\][^\[]*?^\s*file\s*=\s*)(\"[^\"\n]*\"|'[^'\n]*')", lambda m: m[1] + quoted, text
    )
    for name, value in offsets.items():
        head = rf"^\[\[camera\]\][^\[]*?^\s*name\s*=\s*[\"']{re.escape(name)}[\"'][^\n]*\n"
        tables = re.split(r"(?m)(?=^\[)", text)
        for i, table in enumerate(tables):
            if re.search("(?ms)" + head, table):
                table = re.sub(r"(?m)^\s*time_offset\s*=[^\n]*\n", "", table)
                tables[i] = re.sub("(?ms)" + head, lambda m: f"{m[0]}time_offset = {value:.6f}\n", table)  # noqa: B023
        text = "".join(tables)
    return text
