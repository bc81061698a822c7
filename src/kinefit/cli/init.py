"""`kinefit init`: a first take file from what lies in a folder."""

from __future__ import annotations

from pathlib import Path

import click

from kinefit.cli import _screen

_EXAMPLES = """\b
Examples:
  kinefit init my_recording
  kinefit init my_recording --out takes/monday.toml
"""
_COLOURS = {"sure": "green", "likely": "cyan", "guess": "yellow", "open": "bold red"}


@click.command(short_help="Write a first take file from what lies in a folder.", epilog=_EXAMPLES)
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Take file.  [default: FOLDER/take.toml]")
@click.option("--force", is_flag=True, help="Replace a take file that is there.")
@_screen.verbose_option
def init(folder: Path, out: Path | None, force: bool, verbose: bool) -> None:
    """Write a first take file from what lies in FOLDER: calibration, videos, keypoints, markers.

    Everything is guessed from names and contents, and reported with how sure it is, here and as comments in the file.
    Nothing else is changed. Look at what is a guess or open, then run kinefit check.
    """
    from kinefit.cli._results import check_file
    from kinefit.errors import TakeError, command
    from kinefit.exporters.atomic import write_text
    from kinefit.readers.guess.folder import guess_take

    out = out or folder / "take.toml"
    if out.exists() and not force:
        remedy = f"Use it: {command('check', out)}. Name another file by --out, or replace it by --force."
        raise TakeError("there is a take file already", file=out, remedy=remedy)
    if folder.is_dir():
        check_file(out)
    guess = guess_take(folder, beside=out.absolute().parent)
    write_text(out, guess.text)
    _show(guess.notes)
    asked = any(note.about == "rate" and note.sure == "open" for note in guess.notes)
    alone = any(note.about == "cameras" and note.sure == "open" for note in guess.notes)
    lacking = ["its rate, in frames a second,"] * asked + ["a second camera, [[depth]] or [[markers]]"] * alone
    first = f"Write {' and '.join(lacking)} into it. Then" if lacking else "Next"
    _screen.say(f"\n{out}: written. {first}:\n  {command('check', out)}\n  {command('track', out)}")


def _show(notes: tuple) -> None:
    from rich.text import Text

    console = _screen.console()
    wide = max((len(note.about) for note in notes), default=0)
    for note in notes:
        line = Text.assemble((f"{note.sure:<7}", _COLOURS[note.sure]), f" {note.about:<{wide}}  {note.told}")
        console.print(line, soft_wrap=True)
    open_ones = sum(note.sure == "open" for note in notes)
    guesses = sum(note.sure == "guess" for note in notes)
    if open_ones or guesses:
        _screen.say(f"\n{guesses} guesses to look at, {open_ones} open for you to decide: see the file's comments.")
