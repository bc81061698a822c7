"""`kinefit movements`: jumps, squats and rises from a seat, counted and timed."""

from __future__ import annotations

from pathlib import Path

import click

from kinefit.cli import _screen
from kinefit.errors import located


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
    from kinefit.exporters.movements.found import find_movements, movement_table
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
