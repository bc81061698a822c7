"""`kinefit check`: what is wrong with a recording, in plain words and on a page."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kinefit.cli import _screen
from kinefit.errors import KinefitError

if TYPE_CHECKING:
    from kinefit.cli.checks._refine import Refined
    from kinefit.findings import Edit
    from kinefit.rigs.diagnostics.checks import Checked
    from kinefit.takes.batch.results import Step

_EXAMPLES = """\b
Examples:
  kinefit check take.toml                    findings, and a page with images
  kinefit check take.toml --fix              writes the lines that correct it into the take, checks again
  kinefit check take.toml --refine           also a refined calibration, and a take file that uses it
"""
_PRINTED = ("camera", "bias u, v [px]", "±", "spread", "late [frames]", "left/right swapped")


@click.command(short_help="Find faults of a recording; refine its calibration.", epilog=_EXAMPLES)
@click.argument("take", type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, help="HTML page to write.  [default: TAKE-check.html]")
@click.option("--refine", is_flag=True, help="Write a refined calibration and a take that uses it, as new files.")
@click.option("--focal", is_flag=True, help="With --refine: refine focal lengths too.")
@click.option("--distortion", is_flag=True, help="With --refine: refine lens distortion too.")
@click.option("--time-offsets", is_flag=True, help="With --refine: refine time offsets too.")
@click.option(
    "--points", type=_screen.PATH,
    help="With --refine: TOML file of static points: [NAME], then CAMERA = [u, v] px in the calibration's image.",
)
@click.option("--fix", is_flag=True, help="Write what corrects faults into the take, then check again.")
@_screen.hide_faces_option
@click.option("--strict", is_flag=True, help="End with exit code 2 if there is a fault.")
@_screen.quiet_options
@_screen.verbose_option
@_screen.gathered("also", dict, "focal", "distortion", "time_offsets", "points")
def check(
    take: Path, out: Path | None, refine: bool, also: dict[str, Any], fix: bool, strict: bool, hide_faces: bool,
    as_json: bool,
) -> None:  # fmt: skip
    """Find faults of a recording, with their confidence and how to correct them.

    TAKE is the recording's take file. The check covers the calibration (moved cameras, lenses, unit, poses), the order
    of the cameras, their clocks, images scaled or letterboxed after the calibration, left and right, floor and
    vertical, the view of each camera, and whether depth cameras and marker systems fit the videos.
    """
    if any(also.values()) and not refine:
        raise click.UsageError("--focal, --distortion, --time-offsets and --points need --refine.")
    if (points := also["points"]) and not points.is_file():
        raise click.BadParameter(f"no such file: {points}", param_hint="--points")
    from kinefit._files import write_text
    from kinefit.cli.checks._page import check_page
    from kinefit.cli.checks._refine import refined_of, write_refined
    from kinefit.findings import as_records, fixes, in_words, ranked
    from kinefit.readers.take.file import find_take
    from kinefit.takes.batch.corrections import write_edits

    take = find_take(take, wanted=("check",))
    out = out or take.with_name(f"{take.stem}-check.html")
    _screen.check_file(out)
    refined: Refined | None = None
    failed: KinefitError | None = None
    fixed: list[Edit] = []
    kept: list[Path] = []
    with _screen.bars() as step:
        found, content = _checked(take, hide_faces, step)
        while fix and failed is None and (wanted := fixes(found.findings, fixed)):
            try:
                kept.append(write_edits(take, wanted, over=content))
            except KinefitError as error:
                failed = error
            else:
                fixed += wanted
                found, content = _checked(take, hide_faces, step)
        if refine and failed is None:
            try:
                refined = refined_of(found, step, **also)
            except KinefitError as error:
                failed = error
    if fixed:
        _screen.say(f"Written into {take}: {in_words(fixed, ' in ')}.")
        _screen.say(f"The file as it was is {kept[0]}.")
    elif fix and failed is None:
        _screen.say("Nothing is written: no fault has a certain correction that is a line of the take.")
    _print(found)
    write_text(out, check_page(found, refined))
    _screen.say(f"\nWritten: {out}")
    used = write_refined(found, refined, take) if refined is not None else None
    if as_json:
        _screen.print_json({
            "take": str(take), "faults": len(found.faults), "findings": as_records(ranked(found.findings)),
            "page": str(out), "refined": str(used) if used else None, "fixed": [asdict(edit) for edit in fixed],
        })  # fmt: skip
    if failed is not None:
        raise failed
    if strict and found.faults:
        click.get_current_context().exit(2)


def _checked(take: Path, hide_faces: bool, step: Step) -> tuple[Checked, bytes]:
    """The check of a take, and the content of its file."""
    from kinefit.readers.take.file import read_take
    from kinefit.takes.check import check_take

    entry, content = read_take(take), take.read_bytes()
    entry = replace(entry, hide_faces=entry.hide_faces or hide_faces)
    return check_take(entry, progress=step, tell=_screen.note), content


def _print(found: Checked) -> None:
    from kinefit.cli.checks._page import camera_rows, verdict

    _screen.say(f"\n{found.name}: {verdict(found)}")
    good = {one.kind: None for one in found.findings if one.severity == "good" and not _screen.is_verbose()}
    for one in found.findings:
        if one.severity != "good" or not good:
            _screen.tell_finding(one)
    if good:
        _screen.say(f"\nin order: {', '.join(good)} (-v lists them)")
    columns, rows = camera_rows(found)
    if rows:
        shown = [at for at, name in enumerate(columns) if name in _PRINTED]
        _screen.say()
        _screen.print_table([columns[at] for at in shown], ([row[at] for at in shown] for row in rows))
