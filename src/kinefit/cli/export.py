"""`kinefit export`: a motion file in another format."""

from __future__ import annotations

from pathlib import Path

import click

from kinefit.cli import _results, _screen

_SUFFIXES = {"csv": "-tables", "parquet": "-tables"}

_EXAMPLES = """\b
Examples:
  kinefit export take-kinefit/motion.npz --to bvh --unit m --up z
  kinefit export motion.npz --to trc --out walk.trc --unit mm
  kinefit export motion.npz --to parquet --out tables
"""


@click.command(short_help="Write a motion file in another format.", epilog=_EXAMPLES)
@click.argument("motion", type=click.Path(path_type=Path))
@click.option(
    "--to", "format", required=True, type=click.Choice([name for name in _results.NAMES if name != "motion"]),
    help="Format; csv and parquet are a folder of tables.",
)
@click.option("-o", "--out", type=click.Path(path_type=Path), help="File or folder.  [default: beside MOTION]")
@click.option("--unit", type=click.Choice(["mm", "cm", "m"]), help="Length, of bvh (default cm) and trc (m, mm).")
@click.option("--up", type=click.Choice(["x", "y", "z", "-x", "-y", "-z"]), help="Vertical axis, of bvh (default y).")
@_screen.verbose_option
def export(motion: Path, format: str, out: Path | None, unit: str | None, up: str | None, verbose: bool) -> None:
    """Write a motion file, as `kinefit track` leaves it, in another format."""
    options = {name: value for name, value in (("unit", unit), ("up", up)) if value}
    for name, formats in (("unit", ("bvh", "trc")), ("up", ("bvh",))):
        if name in options and format not in formats:
            raise click.UsageError(f"--{name} is of {' and '.join(formats)}, not of {format}.")
    from kinefit.readers.motion import read_motion

    recorded = read_motion(motion)
    out = out or motion.with_name(f"{motion.stem}{_SUFFIXES.get(format, '.' + format)}")
    _results.write_format(recorded, format, out, **options)
    _screen.say(f"{out}: {_results.ABOUT[format]}, {len(recorded)} frames")
