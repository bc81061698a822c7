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
  kinefit init my_recording --points clicks.json      the first pose from clicks in a file
"""
_COLOURS = {"sure": "green", "likely": "cyan", "guess": "yellow", "open": "bold red"}


@click.command(short_help="Write a take file for the recording in a folder.", epilog=_EXAMPLES)
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Take file.  [default: FOLDER/take.toml]")
@click.option("--force", is_flag=True, help="Overwrite an existing take file.")
@click.option("--click", "clicked", is_flag=True, help="Click joints in images, in the browser.")
@click.option("--points", type=click.Path(path_type=Path), metavar="JSON", help="JSON file of clicked joints.")
@click.option("--step", type=click.IntRange(min=0), help="With --click: step of the images.  [default: the first]")
@click.option("--body", metavar="BODY", help="Body for the clicks: of the catalogue, or a file.  [default: humanoid]")
@click.option(
    "--hide-faces", is_flag=True,
    help="Write copies of the videos with detected faces blurred; the take uses the copies.",
)
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open the page of --click.")
@_screen.verbose_option
def init(
    folder: Path, out: Path | None, force: bool, clicked: bool, points: Path | None, step: int | None,
    body: str | None, browser: bool, hide_faces: bool,
) -> None:
    """Write a take file for the recording in FOLDER: calibration, videos, keypoints, markers.

    All entries are guessed from names and contents of files. Each is printed with its confidence, which also stands as
    a comment in the file. Check the lines marked guess or open, then run kinefit check. No other file is changed; with
    --hide-faces, copies of the videos are written next to the take file.
    """
    if clicked and points is not None:
        raise click.UsageError("--click and --points exclude each other: give one.")
    if step is not None and not clicked:
        raise click.UsageError("--step needs --click; a file of --points has its own step.")
    if body is not None and not (clicked or points):
        raise click.UsageError("--body needs --click or --points; without them, write body into the take file.")
    from kinefit._files import write_text
    from kinefit.cli._results import check_file
    from kinefit.errors import TakeError, command
    from kinefit.readers.guess.folder import guess_take

    out = out or folder / "take.toml"
    if out.exists() and not force:
        remedy = f"Use it: {command('check', out)}. Or give another file with --out, or overwrite it with --force."
        raise TakeError("the take file already exists", file=out, remedy=remedy)
    if folder.is_dir():
        check_file(out)
    guess = guess_take(folder, beside=out.absolute().parent)
    write_text(out, guess.text)
    show(guess.notes)
    if hide_faces:
        from kinefit.preparing.ingest import hide_in_copies

        with _screen.bars() as progress:
            copies = hide_in_copies(out, progress, _screen.note)
        _screen.say(f"{len(copies)} copies with blurred faces: {copies[0].parent}. The originals are unchanged.")
    if clicked or points is not None:
        from kinefit.cli._clicks import start_from_clicks

        start_from_clicks(out, points, step, body or "humanoid", browser)
    asked = any(note.about == "rate" and note.sure == "open" for note in guess.notes)
    alone = any(note.about == "cameras" and note.sure == "open" for note in guess.notes)
    lacking = ["rate (frames per second)"] * asked + ["a second camera, [[depth]] or [[markers]]"] * alone
    first = f"Add {' and '.join(lacking)} to it. Then" if lacking else "Next"
    _screen.say(f"\n{out}: written. {first}:\n  {command('check', out)}\n  {command('track', out)}")


def write_first_take(folder: Path) -> Path:
    """The take file of a folder that has none: guessed, shown, with the person's height where somebody answers."""
    from kinefit._files import write_text
    from kinefit.readers.guess.folder import OPEN_HEIGHT, guess_take

    guess, out = guess_take(folder), folder / "take.toml"
    text = guess.text
    if sys.stdin.isatty() and "[calibration]" not in text:  # lengths then hang on the height alone
        asked = "Height of the person in metres; 0 where you do not know it"
        height = click.prompt(asked, type=click.FloatRange(0.0, 2.8))
        text = text.replace(f"# {OPEN_HEIGHT}", f"height = {height:g}") if height else text
    write_text(out, text)
    show(guess.notes)
    _screen.say(f"{out}: written. Later runs of track use it.")
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
        _screen.say(f"\nCheck {guesses} guesses and {open_ones} open entries: see the comments in the file.")
