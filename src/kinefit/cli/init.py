"""`kinefit init`: a first take file from what lies in a folder."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from kinefit.cli import _screen

_EXAMPLES = """\b
Examples:
  kinefit init my_recording
  kinefit init my_recording --out takes/monday.toml
  kinefit init my_recording --click                   the first pose from joints that you click
  kinefit init my_recording --points clicks.json      the same from a file
"""
_COLOURS = {"sure": "green", "likely": "cyan", "guess": "yellow", "open": "bold red"}


@click.command(short_help="Write a first take file from what lies in a folder.", epilog=_EXAMPLES)
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Take file.  [default: FOLDER/take.toml]")
@click.option("--force", is_flag=True, help="Replace a take file that is there.")
@click.option("--click", "clicked", is_flag=True, help="Ask for joints in one image of each camera, in the browser.")
@click.option("--points", type=click.Path(path_type=Path), metavar="JSON", help="Joints that were clicked before.")
@click.option("--step", type=click.IntRange(min=0), help="With --click: frame of the images.  [default: the first]")
@click.option("--body", metavar="BODY", help="Body that is clicked: of the catalogue, or a file.  [default: humanoid]")
@click.option(
    "--hide-faces", is_flag=True,
    help="Write copies of the videos with everybody's face hidden, as far as it is found; the take names these.",
)
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open the page of --click.")
@_screen.verbose_option
def init(
    folder: Path, out: Path | None, force: bool, clicked: bool, points: Path | None, step: int | None,
    body: str | None, browser: bool, hide_faces: bool,
) -> None:
    """Write a first take file from what lies in FOLDER: calibration, videos, keypoints, markers.

    Everything is guessed from names and contents, and reported with how sure it is, here and as comments in the file.
    Nothing else is changed; with --hide-faces, copies of the videos are written beside the file. Look at what is a
    guess or open, then run kinefit check.
    """
    if clicked and points is not None:
        raise click.UsageError("--click asks for joints, --points has them: name one.")
    if step is not None and not clicked:
        raise click.UsageError("--step is of --click; a file of --points has its own.")
    if body is not None and not (clicked or points):
        raise click.UsageError("--body is of --click and --points; else write it into the take file.")
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
    show(guess.notes)
    if hide_faces:
        from kinefit.preparing.ingest import hide_in_copies

        with _screen.bars() as progress:
            copies = hide_in_copies(out, progress, _screen.note)
        _screen.say(f"{len(copies)} videos with faces hidden: {copies[0].parent}. The originals are as they were.")
    if clicked or points is not None:
        from kinefit.cli._clicks import start_from_clicks

        start_from_clicks(out, points, step, body or "humanoid", browser)
    asked = any(note.about == "rate" and note.sure == "open" for note in guess.notes)
    alone = any(note.about == "cameras" and note.sure == "open" for note in guess.notes)
    lacking = ["its rate, in frames a second,"] * asked + ["a second camera, [[depth]] or [[markers]]"] * alone
    first = f"Write {' and '.join(lacking)} into it. Then" if lacking else "Next"
    _screen.say(f"\n{out}: written. {first}:\n  {command('check', out)}\n  {command('track', out)}")


def write_first_take(folder: Path) -> Path:
    """The take file of a folder that has none: guessed, shown, with the person's height where somebody answers."""
    from kinefit.exporters.atomic import write_text
    from kinefit.readers.guess.folder import OPEN_HEIGHT, guess_take

    guess, out = guess_take(folder), folder / "take.toml"
    text = guess.text
    if sys.stdin.isatty() and "[calibration]" not in text:  # lengths then hang on the height alone
        asked = "Height of the person in metres; 0 where you do not know it"
        height = click.prompt(asked, type=click.FloatRange(0.0, 2.8))
        text = text.replace(f"# {OPEN_HEIGHT}", f"height = {height:g}") if height else text
    write_text(out, text)
    show(guess.notes)
    _screen.say(f"{out}: written, and used from now on.")
    return out


def show(notes: tuple) -> None:
    """Print what was guessed, a line each."""
    from rich.text import Text

    console = _screen.console()
    wide = max((len(note.about) for note in notes), default=0)
    for note in notes:
        line = Text.assemble((f"{note.sure:<7}", _COLOURS[note.sure]), f" {note.about:<{wide}}  {note.text}")
        console.print(line, soft_wrap=True)
    open_ones = sum(note.sure == "open" for note in notes)
    guesses = sum(note.sure == "guess" for note in notes)
    if open_ones or guesses:
        _screen.say(f"\n{guesses} guesses to look at, {open_ones} open for you to decide: see the file's comments.")
