"""`kinefit gait`: the gait record of a person's walks; `kinefit movements`: jumps, squats, rises, counted and timed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kinefit.cli import _screen
from kinefit.errors import located

if TYPE_CHECKING:
    from kinefit.exporters.gait.record import GaitRecord


_CONTENTS = {
    "csv": "all strides and steps", "parquet": "the same", "json": "means, symmetry, variability",
    "page": "both sides on one page",
}  # fmt: skip


@click.command(short_help="Strides, steps and symmetry of a person's walks.", epilog="""\b
Examples:
  kinefit gait walk-kinefit
  kinefit gait monday/*-kinefit --out monday/gait --report
  kinefit gait walk-kinefit/motion.npz --report --reference adults.csv
""")  # fmt: skip
@click.argument("motions", metavar="MOTION...", nargs=-1, required=True, type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, metavar="FOLDER", help="[default: the folder of the first MOTION]")
@click.option("--report", is_flag=True, help="Write gait.html, too: both sides on one page.")
@click.option(
    "--reference", type=_screen.PATH, metavar="CSV",
    help="With --report: bands behind the curves, with the columns coordinate, percent, mean and sd.",
)
@_screen.quiet_options
@_screen.verbose_option
def gait(motions: tuple[Path, ...], out: Path | None, report: bool, reference: Path | None, as_json: bool) -> None:
    """Put the walks of one person together: fitted motions of `kinefit track` or `kinefit markers fit`.

    Every number has its standard deviation. Single strides and steps count, those in turns apart from the others.
    """
    if reference is not None and not report:
        raise click.UsageError("--reference needs --report: its bands stand on that page.")
    from kinefit.exporters.gait.files import summary, write_gait, write_gait_page
    from kinefit.exporters.gait.record import gait_record
    from kinefit.exporters.report.cycles import read_norms
    from kinefit.readers.motion import find_motion, read_motion

    files = list(dict.fromkeys(map(find_motion, motions)))
    folder = out or files[0].parent
    _screen.check_folder(folder)
    norms = read_norms(reference) if reference else None
    record = gait_record({_name(file, files): read_motion(file) for file in files})
    written = write_gait(record, folder)
    if report:
        written["page"] = write_gait_page(record, folder / "gait.html", norms=norms)
    if as_json:
        _screen.print_json({**summary(record), "files": {name: str(path) for name, path in written.items()}})
        return
    _print(record)
    for name, path in written.items():
        _screen.say(f"{path}: {_CONTENTS[name]}")


def _name(file: Path, files: list[Path]) -> str:
    """Name of a trial: the folder of a motion.npz, else the file's; the whole path where another has the same."""
    names = [one.resolve().parent.name if one.name == "motion.npz" else one.stem for one in files]
    name = names[files.index(file)]
    return name if names.count(name) == 1 else str(file)


def _print(record: GaitRecord) -> None:
    """Print the notes and a table of the record's walk."""
    from kinefit.exporters.report.report import value_and_error

    for note in record.notes:
        _screen.note(note)
    walk = record.walk
    rows = []
    for name, left, right, (share, std) in record.compared(walk):
        each = [cell for found in (left, right) for cell in (value_and_error(found, 1.0), f"{len(found.values)}")]
        rows.append([name, *each, f"{share:+.0f} ± {std:.0f}" if share == share else ""])
    turned = sum(one.walk != walk for one in record.stretches)
    _screen.print_table((f"{walk}, mean ± σ", "left", "n", "right", "n", "L−R [%]"), rows)
    if turned:
        _screen.say(f"{turned} strides and steps in turns are in the files alone.")


@click.command(short_help="Count and time jumps, squats and rises from a seat.", epilog="""\b
Examples:
  kinefit movements squats-kinefit
  kinefit movements jump-kinefit/motion.npz --out jump.csv
""")  # fmt: skip
@click.argument("motion", type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, metavar="CSV", help="[default: movements.csv next to MOTION]")
@_screen.verbose_option
def movements(motion: Path, out: Path | None) -> None:
    """Find jumps, squats and rises from a seat in a fitted motion, each with its times and standard deviations."""
    from kinefit._files import writing
    from kinefit.exporters.movements import find_movements, movement_table
    from kinefit.exporters.tables import to_csv
    from kinefit.readers.motion import find_motion, read_motion

    file = find_motion(motion)
    target = out or file.with_name("movements.csv")
    _screen.check_file(target)
    with located(file):
        found = find_movements(read_motion(file))
    with writing(target) as temporary:
        to_csv([movement_table(found)], temporary)
    counts = {kind: sum(one.kind == kind for one in found) for kind in dict.fromkeys(one.kind for one in found)}
    _screen.say(", ".join(f"{kind}: {count}" for kind, count in counts.items()) or "no jump, squat or rise from a seat")
    for one in found:
        values = ", ".join(f"{name} {value:.3g} ± {std:.2g}" for name, (value, std) in one.values.items())
        _screen.say(f"  {one.start:.2f} to {one.stop:.2f} s, {one.kind}: {values}")
    _screen.say(f"{target}: one row each")
