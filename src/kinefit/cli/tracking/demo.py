"""`kinefit demo`: the main job on a real recording."""

from __future__ import annotations

from pathlib import Path

import click

from kinefit.cli import _screen


@click.command(short_help="Track a real person in four sample videos.", epilog="""\b
Examples:
  kinefit demo
  kinefit demo --out there --synthetic
""")  # fmt: skip
@click.option("-o", "--out", type=_screen.PATH, default=Path("kinefit-demo"), show_default=True, help="Folder.")
@click.option("--synthetic", is_flag=True, help="Use a simulated figure instead; nothing is downloaded.")
@_screen.verbose_option
@click.pass_context
def demo(ctx: click.Context, out: Path, synthetic: bool) -> None:
    """Track a real person in four sample videos, and write overlay videos and a report.

    The recording (51 MB) is downloaded once, through pip, and kept. If the download fails, a simulated figure is
    tracked instead.
    """
    from kinefit.batch.one import Choices
    from kinefit.cli.tracking.track import run
    from kinefit.errors import command

    _screen.check_folder(out)
    take = synthetic_take(out / "take") if synthetic else sample_take(out / "take")
    code = run(take, out, Choices())
    if code == 0:
        _screen.say(f"\nOpen {out / 'report.html'} in a browser, then play {out / 'overlays'}.")
        _screen.say("Next:")
        _screen.say(f"  {command('view', out / 'motion.npz', '--take', take)}")
        _screen.say(f"  {command('check', take)}")
        _screen.say("  kinefit init FOLDER      writes a take file for your own recording")
        _screen.say(f"  {command('export', out / 'motion.npz', '--to', 'bvh', '--unit', 'm', '--up', 'z')}")
        _screen.say("  kinefit --help")
    ctx.exit(code)


def sample_take(folder: Path) -> Path:
    """Write the sample recording as a take, with its credit shown; the drawn figure where it cannot be had."""
    from kinefit.assets import SAMPLE_CREDIT, write_sample_take
    from kinefit.errors import AssetError

    try:
        with _screen.bars() as step:
            take = write_sample_take(folder, lambda done, total: step("download MB", done // 10**6, total // 10**6))
    except AssetError as error:
        _screen.tell_error(error)
        _screen.note("The recording cannot be downloaded; a simulated figure is tracked instead.\n")
        return synthetic_take(folder)
    _screen.say(SAMPLE_CREDIT["title"], style="bold")
    for what in ("credit", "licence", "calibration", "keypoints"):
        _screen.say(f"  {what + ':':<13}{SAMPLE_CREDIT[what]}")
    return take


def synthetic_take(folder: Path) -> Path:
    """Write a take of a drawn figure."""
    from kinefit.simulation import write_synthetic_take

    _screen.say("A simulated figure that squats and waves, in four cameras", style="bold")
    with _screen.bars() as step:
        step("rendering", 0, 1)
        take = write_synthetic_take(folder)
        step("rendering", 1, 1)
    return take
