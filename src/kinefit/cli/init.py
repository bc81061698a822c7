"""`kinefit init`: a first take file from what lies in a folder, and a first pose from joints clicked in images."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kinefit.cli import _screen
from kinefit.errors import TakeError, TrackingError, choices, command

if TYPE_CHECKING:
    from kinefit.bodies import Body
    from kinefit.readers.landmarks.annotations import Clicks
    from kinefit.readers.take.file import Take
    from kinefit.readers.take.load import Observations

_COLOURS = {"sure": "green", "likely": "cyan", "guess": "yellow", "open": "bold red"}


def _joint_clicks(
    clicked: bool, points: Path | None, step: int | None, body: str | None, browser: bool
) -> Callable[[Path], None] | None:
    """Write the first pose into a take file, from joints that are clicked or stand in a file; None without them."""
    if clicked and points is not None:
        raise click.UsageError("--click and --points exclude each other: give one.")
    if step is not None and not clicked:
        raise click.UsageError("--step needs --click; a file of --points has its own step.")
    if body is not None and not (clicked or points):
        raise click.UsageError("--body needs --click or --points; without them, write body into the take file.")
    if not clicked and points is None:
        return None
    return lambda out: start_from_clicks(out, points, step, body or "humanoid", browser)


@click.command(short_help="Write a take file for the recording in a folder.", epilog="""\b
Examples:
  kinefit init my_recording
  kinefit init my_recording --out takes/monday.toml
  kinefit init my_recording --click                   the first pose from joints that you click
  kinefit init my_recording --points clicks.json      the first pose from clicks in a file
""")  # fmt: skip
@click.argument("folder", type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, help="Take file.  [default: FOLDER/take.toml]")
@click.option("--force", is_flag=True, help="Overwrite an existing take file.")
@click.option("--click", "clicked", is_flag=True, help="Click joints in images, in the browser.")
@click.option("--points", type=_screen.PATH, metavar="JSON", help="JSON file of clicked joints.")
@click.option("--step", type=click.IntRange(min=0), help="With --click: step of the images.  [default: the first]")
@click.option("--body", metavar="BODY", help="Body for the clicks: of the catalogue, or a file.  [default: humanoid]")
@click.option(
    "--hide-faces", is_flag=True,
    help="Write copies of the videos with detected faces blurred; the take uses the copies.",
)
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open the page of --click.")
@_screen.verbose_option
@_screen.gathered("click_joints", _joint_clicks, "clicked", "points", "step", "body", "browser")
def init(
    folder: Path, out: Path | None, force: bool, click_joints: Callable[[Path], None] | None, hide_faces: bool
) -> None:
    """Write a take file for the recording in FOLDER: calibration, videos, keypoints, markers.

    All entries are guessed from names and contents of files. Each is printed with its confidence, which also stands as
    a comment in the file. Check the lines marked guess or open, then run kinefit check. No other file is changed; with
    --hide-faces, copies of the videos are written next to the take file.
    """
    from kinefit._files import write_text
    from kinefit.readers.guess.folder import guess_take

    out = out or folder / "take.toml"
    if out.exists() and not force:
        remedy = f"Use it: {command('check', out)}. Or give another file with --out, or overwrite it with --force."
        raise TakeError("the take file already exists", file=out, remedy=remedy)
    if folder.is_dir():
        _screen.check_file(out)
    guess = guess_take(folder, beside=out.absolute().parent)
    write_text(out, guess.text)
    show(guess.notes)
    if hide_faces:
        from kinefit.takes.preparing.faces import hide_in_copies

        with _screen.bars() as progress:
            copies = hide_in_copies(out, progress, _screen.note)
        _screen.say(f"{len(copies)} copies with blurred faces: {copies[0].parent}. The originals are unchanged.")
    if click_joints is not None:
        click_joints(out)
    asked = any(note.about == "rate" and note.sure == "open" for note in guess.notes)
    alone = any(note.about == "cameras" and note.sure == "open" for note in guess.notes)
    bare = any(note.about == "intrinsics" and note.sure == "open" for note in guess.notes)
    lacking = ["rate (frames per second)"] * asked + ["a second camera, [[depth]] or [[markers]]"] * alone
    lacking += ["the intrinsics of the depth camera"] * bare
    first = f"Add {' and '.join(lacking)} to it. Then" if lacking else "Next"
    _screen.say(f"\n{out}: written. {first}:\n  {command('check', out)}\n  {command('track', out)}")


def write_first_take(folder: Path) -> Path:
    """The take file of a folder that has none: guessed, shown, with the person's height where somebody answers."""
    from kinefit._files import write_text
    from kinefit.readers.guess.folder import OPEN_HEIGHT, guess_take

    guess, out = guess_take(folder), folder / "take.toml"
    text = guess.text
    if sys.stdin.isatty() and "[calibration]" not in text:  # lengths then hang on the height alone
        asked = "Height of the person, in metres or centimetres; Enter where you do not know it"
        known = lambda answer: _screen.HEIGHT.convert(answer, None, None) if answer.strip() not in ("", "0") else 0.0
        height = click.prompt(asked, default="", show_default=False, value_proc=known)
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


_INSIDE = 1e-6  # [rad] or [m] from a joint's limits, that rounding does not cross them
_MAX_CLICK_ERROR_M = 0.1  # [m] of a clicked joint from the pose: the worst of those clicked with care is 2 to 5 cm off
_MAX_LISTED_JOINTS = 4  # joints that a warning names
BODY = "clicked-body.npz"
CLICKS = "clicks.json"


def start_from_clicks(out: Path, points: Path | None, step: int | None, body: str, browser: bool) -> None:
    """Put body and pose of clicked joints into a take file that was just written.

    Parameters
    ----------
    out : the take file
    points : clicks as JSON; None: they are clicked in the browser
    step : of the images that are shown; the first where None
    body : name or file of the body
    """
    from kinefit.bodies import load_body
    from kinefit.readers.landmarks.annotations import read_clicks
    from kinefit.readers.take.file import read_take
    from kinefit.readers.take.load import load_observations
    from kinefit.takes.missing import last_found

    take = last_found(read_take(out))
    seen, generic = load_observations(take), load_body(body)
    if seen.rig is None or (not seen.videos and points is None):
        remedy = "Add [calibration] and videos, or leave out --click."
        raise TakeError("--click needs videos of calibrated cameras; the take has none", file=out, remedy=remedy)
    if points is not None:
        _screen.say(_started(out, take, seen, generic, read_clicks(points)))
        return
    _ask(out, take, seen, generic, seen.frames[0] if step is None else step, browser)


def _ask(out: Path, take: Take, seen: Observations, body: Body, step: int, browser: bool) -> None:
    """Show the page until its clicks give a start."""
    import webbrowser

    from kinefit.fitting.initialization.from_points import clickable
    from kinefit.readers.landmarks.annotations import clicks_of
    from kinefit.studio.viewers.clicks import ClickPage

    def taken(clicks: Any) -> str:
        return _started(out, take, seen, body, [clicks_of(clicks)])

    page = ClickPage(_pictures(take, seen, step), clickable(body), taken, step=step)
    try:
        _screen.say(f"Click the joints at {page.url} ; Ctrl-C ends without a [start].")
        if browser:
            webbrowser.open(page.opening())
        while not page.done.wait(0.5):
            pass
    finally:
        page.close()
    _screen.say(f"{out}: [start] written from the clicks in {out.with_name(CLICKS)}")


def _pictures(take: Take, seen: Observations, step: int) -> dict[str, bytes]:
    """JPEG of every image that cameras took at a step."""
    import cv2

    from kinefit.takes.preparing.faces import shown_video

    if not seen.frames[0] <= step < seen.frames[1]:
        problem = f"step {step} is outside the recording's steps {seen.frames[0]} to {seen.frames[1] - 1}"
        raise TakeError(problem, file=take.path, remedy="Give one of these steps with --step.")
    out = {}
    for entry in take.cameras:
        if entry.name in seen.videos:
            with shown_video(take, seen, entry.name) as video:
                frame = video.frame_at(step / seen.rate - entry.time_offset)
                if frame is None:  # its first or last image would be of another time
                    continue
                picture = cv2.cvtColor(video.read(frame), cv2.COLOR_RGB2BGR)
            out[entry.name] = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
    if len(out) < 2:
        problem = f"{len(out)} of {len(seen.videos)} cameras have an image at step {step}; --click needs two"
        raise TakeError(problem, file=take.path, remedy="With --step, give a step at which two cameras recorded.")
    return out


def _started(out: Path, take: Take, seen: Observations, body: Body, steps: Sequence[Clicks]) -> str:
    """Write body and start of the first step, and the clicks of all, to which the take file refers; what to tell."""
    import numpy as np

    from kinefit._files import regular, write_text
    from kinefit.bodies.serial import save_body
    from kinefit.fitting.initialization.from_points import check_landmarks, clicked_points, clicked_start
    from kinefit.readers.landmarks.annotations import clicks_text

    assert seen.rig is not None
    clicks = steps[0]
    unknown = [camera for of in steps for camera in of.points if camera not in seen.rig.names]
    if unknown:
        raise TrackingError(choices("camera of the take", unknown[0], seen.rig.names))
    every = [name for of in clicks.points.values() for name in of]
    check_landmarks(body, (name for step in steps for of in step.points.values() for name in of))
    once = [name for name in dict.fromkeys(every) if every.count(name) == 1]
    names = clicks.names
    uv = np.full((len(names), len(seen.rig), 2), np.nan)
    for c, camera in enumerate(seen.rig.names):
        places = clicks.places(camera)
        uv[:, c] = seen.images[camera].to_calibration(places) if camera in seen.images else places
    x_world, covariance = clicked_points(seen.rig, names, uv)
    fitted, state, left = clicked_start(body, names, x_world, covariance)
    save_body(fitted, out.with_name(BODY))
    tree, R = fitted.tree, state.T_world_root[:3, :3]
    angles = np.clip(state.angles, tree.lower + _INSIDE, tree.upper - _INSIDE)
    written = ", ".join(
        f"{name} = {value if slides else np.degrees(value):.6f}"
        for name, value, slides in zip(tree.coordinates, angles, tree.prismatic)
    )
    vectors = {"at": state.T_world_root[:3, 3], "forward": R[:, 0], "upward": R[:, 1]}
    lines = [f"{key} = [{', '.join(f'{v:.6f}' for v in vector)}]" for key, vector in vectors.items()]
    text = re.sub(r"\n\[start\]  # clicked\n.*?(?=\n\[|\Z)", "", regular(out).read_text("utf-8"), flags=re.S)
    text = re.sub(r"(?m)^body = .*$", f'body = "{BODY}"  # {body.name} of the clicked lengths', text, count=1)
    head = ["[start]  # clicked", f"step = {clicks.step}", f'clicks = "{CLICKS}"']
    start = "\n".join([*head, *lines, f"angles = {{ {written} }}"])
    write_text(out.with_name(CLICKS), clicks_text(steps))
    write_text(out, f"{text.rstrip()}\n\n{start}\n")
    known = np.isfinite(x_world).all(axis=1).sum()
    text = f"{known} points triangulated, {100 * left:.1f} cm from the pose (median)."
    if once:
        text += f" Not used, as clicked in one image only: {', '.join(once)}."
    off = np.linalg.norm(fitted.positions(state, fitted.landmarks.select(names)) - x_world, axis=1)
    if np.nanmax(off) > _MAX_CLICK_ERROR_M:
        worst = np.argsort(-np.nan_to_num(off))[:_MAX_LISTED_JOINTS].tolist()
        text += " Warning: no pose of this body fits the clicks; the largest errors are "
        text += ", ".join(f"{names[n]} ({100 * off[n]:.0f} cm)" for n in worst)
        text += ". Check whether left and right are swapped, in the same way in every image."
    return text
