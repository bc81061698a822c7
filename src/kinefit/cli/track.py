"""`kinefit track`: a take file becomes a folder of results."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kinefit.cli import _results, _screen

if TYPE_CHECKING:
    from kinefit.readers.take.file import Take
    from kinefit.tracking.in_view import InView


def chosen_formats(ctx: click.Context, parameter: click.Parameter, value: str) -> tuple[str, ...]:
    """Formats of a list such as "bvh,csv"."""
    formats = tuple(dict.fromkeys(value.lower().replace(",", " ").split()))
    for name in formats:
        if name not in _results.NAMES:
            raise click.BadParameter(_results.no_format(name, _results.NAMES))
    return formats

PICTURES = ("full", "blurred", "none")

_EXAMPLES = """\b
Examples:
  kinefit track my_take/take.toml
  kinefit track take.toml --out results --no-overlays --formats bvh,csv
  kinefit track take.toml --realtime    each frame from those before it, as a live camera would give
  kinefit track take.toml --lag 0.1     the same a tenth of a second later, which is far smoother
  kinefit track take.toml --person moving      one of several people
  kinefit track take.toml -v            also how well every point of every camera fits
"""


@click.command(short_help="Track the person of a take file and write all results.", epilog=_EXAMPLES)
@click.argument("take", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Folder of results.  [default: TAKE-kinefit]")
@click.option("--overlays/--no-overlays", default=True, show_default=True, help="Draw the fit on every video.")
@click.option(
    "--formats", default=",".join(_results.USUAL), show_default=True, callback=chosen_formats, metavar="LIST",
    help="What to write; parquet, c3d and usd are there too.",
)
@click.option("--report/--no-report", default=True, show_default=True, help="Write report.html.")
@click.option(
    "--pictures", type=click.Choice(PICTURES), default="full", show_default=True,
    help="What report and overlays show of the videos: all, all but the person's face, nothing.",
)
@click.option("--contacts", is_flag=True, help="Hold soles still where they rest on a level floor.")
@click.option("--realtime", is_flag=True, help="Do not smooth over the whole take.")
@click.option(
    "--lag", type=float, metavar="SECONDS",
    help="Each frame from those before it and so many seconds after it, as a live session has it a little later.",
)
@click.option(
    "--person", metavar="WHO",
    help='Follow one of several people: "first", "moving", "largest", "nearest X Y Z" or a number.  '
    "[default: the take's, else all, each in a folder of their own]",
)
@click.option("--restart", is_flag=True, help="Begin anew where an earlier run was stopped; the default is to go on.")
@_screen.verbose_option
@click.pass_context
def track(
    ctx: click.Context, take: Path, out: Path | None, overlays: bool, formats: tuple[str, ...], report: bool,
    pictures: str, contacts: bool, realtime: bool, lag: float | None, person: str | None, restart: bool, verbose: bool,
) -> None:
    """Track the people of a take file and write all results.

    TAKE is one TOML file that names calibration, cameras, videos and keypoints: `kinefit init` writes a first one,
    `kinefit demo` leaves one to copy, docs/take-file.md explains it. Where it names no keypoints they are detected in
    the videos first (extra `detect`). Ctrl-C stops the tracking and writes the frames that are done; the same command
    then goes on from there, as it does after a crash. Meanwhile OUT/unfinished/so-far.csv grows.

    Where keypoints show several people, each has the same results in OUT/person-1, OUT/person-2 and so on.
    """
    from kinefit.readers.take.find import find_take

    if contacts and realtime:
        raise click.UsageError("--contacts needs the whole take, --realtime leaves it out.")
    if lag is not None and (contacts or realtime):
        other = "--contacts needs the whole take" if contacts else "--realtime knows of no later frame"
        raise click.UsageError(f"{other}, --lag SECONDS only of the frames so far ahead: choose one of both.")
    wanted = ctx.get_parameter_source("overlays") == click.core.ParameterSource.COMMANDLINE
    if pictures == "none" and overlays and wanted:
        raise click.UsageError("--overlays draws on the videos, --pictures none shows nothing of them: choose one.")
    take = find_take(take)
    out = out or take.with_name(f"{take.stem}-kinefit")
    code = run(
        take, out, overlays=overlays and pictures != "none", formats=formats, report=report, pictures=pictures,
        smooth=not realtime, contacts=contacts, lag=lag, verbose=verbose, wanted=overlays and wanted, restart=restart,
        person=person,
    )  # fmt: skip
    ctx.exit(code)


def run(
    path: Path, out: Path, *, overlays: bool, formats: tuple[str, ...], report: bool = True, smooth: bool = True,
    pictures: str = "full", contacts: bool = False, lag: float | None = None, verbose: bool = False,
    wanted: bool = False, restart: bool = False, person: str | None = None,
) -> int:  # fmt: skip
    """Track a take and write what comes of it; returns the exit code. Overlays that are `wanted` must be possible."""
    from kinefit.errors import KinefitError, TakeError
    from kinefit.preparing.take import prepared
    from kinefit.readers.take.checks import check_enough, check_take
    from kinefit.readers.take.file import read_take
    from kinefit.tracking.in_view import people_in_view

    take = read_take(path)
    if person is not None:
        take = replace(take, person=person)
        try:
            check_take(take)
        except KinefitError as error:  # of this option: the take alone is right
            raise type(error)(error.problem, place="--person", remedy=error.remedy) from None
    check_enough(take)
    if wanted and not (take.depth or any(camera.video for camera in take.cameras)):
        raise TakeError("overlays, but no video or depth to draw on", file=path, remedy="Leave --overlays out.")
    _results.check_folder(out)
    options: dict[str, Any] = {
        "overlays": overlays, "formats": formats, "report": report, "smooth": smooth, "pictures": pictures,
        "contacts": contacts, "lag": lag, "verbose": verbose, "restart": restart,
    }  # fmt: skip
    with _screen.bars() as step:
        take = prepared(take, step, _screen.note)
    view = people_in_view(take) if take.person is None else None
    people = len(view.people) if view else 0
    if people < 2:
        return _track_one(take, out, view, **options)
    code = 0
    for k in range(1, people + 1):
        folder = out / f"person-{k}"
        _screen.say(f"person {k} of {people}: {folder}", style="bold")
        folder.mkdir(parents=True, exist_ok=True)
        try:
            own = _track_one(replace(take, person=k, name=f"{take.name}-person-{k}"), folder, view, **options)
        except KinefitError as error:  # of one person: the others are tracked all the same
            _screen.tell_error(error)
            own = error.exit_code
        if own == _screen.INTERRUPTED:
            return own
        code = max(code, own)
    return code


def _track_one(
    take: Take, out: Path, view: InView | None, *, overlays: bool, formats: tuple[str, ...], report: bool,
    smooth: bool, pictures: str, contacts: bool, lag: float | None, verbose: bool, restart: bool,
) -> int:  # fmt: skip
    """Track one person of a take, and write what comes of it; returns the exit code."""
    from kinefit.cli._agreement import print_agreement
    from kinefit.cli._report import provenance, write_track_report
    from kinefit.cli._summary import print_files, print_summary
    from kinefit.errors import TrackingError
    from kinefit.multiview import followed
    from kinefit.tracking import cameras
    from kinefit.tracking.agreement import sentences
    from kinefit.tracking.checkpoint import Checkpoint, key_of
    from kinefit.tracking.take import settings_of, track_take
    from kinefit.tracking.video import TrackingInterrupted

    files: dict[str, Path] = {}
    notes: list[str] = []
    total = 0
    work = ExitStack()
    try:
        with work, _screen.bars() as step:
            unfinished = work.enter_context(Checkpoint(
                out / "unfinished", key_of(take, smooth=smooth, contacts=contacts, lag=lag), restart=restart
            ))  # fmt: skip
            if unfinished.resumed:
                _screen.note(f"going on with what an earlier run left in {unfinished.folder}; --restart begins anew")
            step("reading", 0, 0)
            try:
                motion, seen = track_take(
                    take, smooth=smooth, contacts=contacts, lag=lag, checkpoint=unfinished, view=view,
                    progress=lambda *told: (step("reading", 1, 1), step(*told))[1],
                )
                notes.extend([*seen.notes, *sentences(motion.provenance["contradictions"])])
                notes.extend(followed.sentences(motion.provenance, asked=take.person is not None))
                notes.extend(cameras.sentences(motion.provenance, settings_of(take).camera_std))
            except TrackingInterrupted as stopped:
                motion, total, overlays, report = stopped.motion, stopped.total, False, False
            motion = replace(motion, provenance=provenance(take, **motion.provenance))
            _results.write_results(motion, out, formats, step, files)
            if overlays:
                _results.write_overlays(motion, take, seen, out, step, files, blur=pictures == "blurred")
            if report:
                write_track_report(motion, take, seen, out, step, files, pictures, notes)
            if not total:
                unfinished.remove()
    except BaseException as error:
        if files:
            print_files(files)
        if verbose and isinstance(error, TrackingError):
            print_agreement(take)
        if files and isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt("What is listed is whole; nothing else is left.") from error
        raise
    for note in notes:
        _screen.say(f"note: {note}")
    print_summary(motion, points=verbose)
    print_files(files)
    if total:
        told = f"{len(motion)} of {total} frames are done and written; no video or report was begun."
        _screen.tell_interrupted(f"{told} The same command goes on.")
        return _screen.INTERRUPTED
    return 0
