"""`kinefit batch`: many take files become folders of results and one summary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kinefit.cli import _results, _screen
from kinefit.cli.tracking.track import choices_options

if TYPE_CHECKING:
    from kinefit.batch.one import Choices
    from kinefit.batch.summary import Row

_EXAMPLES = """\b
Examples:
  kinefit batch 'sessions/**/take.toml' --workers 4
  kinefit batch sessions --out study --no-overlays --formats motion,csv
  kinefit batch 'sessions/**/take.toml' --cluster tcp://host:8786

\b
Exit codes: 0 where all takes are done, 2 where some have failed (the others are done all the same).
"""


@click.command(short_help="Track many takes in parallel, with one summary.", epilog=_EXAMPLES)
@click.argument("patterns", nargs=-1, required=True, metavar="PATTERN...")
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), default=Path("kinefit-batch"), show_default=True,
    help="Folder of all results.",
)
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Number of processes.  [default: 1]")
@click.option("--cluster", metavar="ADDRESS", help="Scheduler of a Dask cluster, used instead of this machine.")
@click.option(
    "--retries", type=click.IntRange(min=0), default=2, show_default=True,
    help="How often a take is repeated if its worker process ends abnormally.",
)
@click.option(
    "--time-limit", type=click.FloatRange(min=0, min_open=True), default=120.0, show_default=True, metavar="MINUTES",
    help="A take that makes no progress for so long is stopped and reported as failed; not on a cluster.",
)
@choices_options
@_screen.verbose_option
@click.pass_context
def batch(
    ctx: click.Context, patterns: tuple[str, ...], out: Path, workers: int | None, cluster: str | None, retries: int,
    time_limit: float, choices: Choices, wanted: bool,
) -> None:
    """Track every take that PATTERN matches, like `kinefit track`, and write summary.html over all of them.

    Put a pattern in quotes. A folder stands for every take.toml in it and below. A take that fails does not stop the
    others: the summary has its error. After an interruption, the same command tracks only the remaining takes.
    """
    from kinefit.batch.many import find_takes, track_takes

    if cluster is not None and workers is not None:
        raise click.UsageError("--workers (processes on this machine) and --cluster exclude each other: give one.")
    found = find_takes(patterns)
    _results.check_folder(out)
    if found.left_out:
        _screen.note(f"{len(found.left_out)} matching TOML files are no takes, and skipped: {_listed(found.left_out)}")
    try:
        with _screen.bars() as step:
            step("takes", 0, len(found.takes))

            def tell(done: int, total: int, ended: tuple[Row, ...]) -> None:
                for row in ended:
                    _screen.say(_line(row), style="" if row.status == "done" else "red")
                step("takes", done, total)

            rows = track_takes(
                found, out, choices=choices, workers=workers or 1, cluster=cluster, retries=retries,
                time_limit=time_limit, progress=tell,
            )
    except KeyboardInterrupt as stopped:
        raise KeyboardInterrupt(f"Finished takes are in {out}; run the same command to continue.") from stopped
    bad = len({row.take for row in rows if row.status != "done"})
    _screen.say(f"{len(found.takes) - bad} of {len(found.takes)} takes are done: {out / 'summary.html'}")
    ctx.exit(2 if bad else 0)


def _line(row: Row) -> str:
    who = f"{row.take}{f', person {row.person}' if row.person else ''}"
    if row.quality is None:
        return f"{row.status:<6} {who}: {row.error}"
    return f"{row.status:<6} {who}: {row.frames} frames, quality {row.quality:.2f}"


def _listed(files: tuple[Path, ...]) -> str:
    return ", ".join(file.name for file in files[:5]) + (f" and {len(files) - 5} more" if len(files) > 5 else "")
