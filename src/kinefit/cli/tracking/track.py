"""`kinefit track`: a take file becomes a folder of results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kinefit.cli import _screen
from kinefit.errors import AssetError, KinefitError, TrackingError, command
from kinefit.takes.batch.results import DEFAULT_FORMATS, FORMATS

if TYPE_CHECKING:
    from kinefit.readers.take.file import Take
    from kinefit.takes.batch.one import Choices, TrackedPerson
    from kinefit.takes.batch.summary import Row
    from kinefit.takes.in_view import InView


def chosen_formats(ctx: click.Context, parameter: click.Parameter, value: str) -> tuple[str, ...]:
    """Formats of a list such as "bvh,csv"."""
    formats = tuple(dict.fromkeys(value.lower().replace(",", " ").split()))
    for name in formats:
        if name not in FORMATS.names():
            raise click.BadParameter(_screen.no_format(name, FORMATS.names()))
    return formats


PICTURES = ("full", "blurred", "none")


def _choices(**chosen: Any) -> Choices:
    """What is made of a take; refuses choices that exclude each other."""
    from kinefit.takes.batch.one import Choices

    if chosen["pictures"] == "blurred":
        _screen.note("--pictures blurred is outdated: use --hide-faces, which blurs all detected faces.")
        chosen |= {"pictures": "full", "hide_faces": True}
    chosen["smooth"] = not chosen.pop("realtime")
    choices = Choices(**chosen)
    if choices.contacts and not choices.smooth:
        raise click.UsageError("--contacts needs the whole take, which --realtime does not use: give one of them.")
    if choices.lag is not None and (choices.contacts or not choices.smooth):
        other = "--contacts needs the whole take" if choices.contacts else "--realtime uses no later frames"
        raise click.UsageError(f"{other}, --lag SECONDS uses that many seconds of later frames: give one of them.")
    if choices.overlay_skin and not choices.draws:
        raise click.UsageError("--overlay-skin draws on overlays; --no-overlays and --pictures none write none.")
    if choices.pictures == "none" and _needs_overlays(choices):
        raise click.UsageError("--overlays shows the videos, --pictures none does not: give one of them.")
    return choices


def _needs_overlays(choices: Choices) -> bool:
    """Whether overlays were asked for in so many words."""
    return choices.overlay_skin or (choices.overlays and _screen.is_stated("overlays"))


def choices_options(command: Callable) -> Callable:
    """Add the options that say what is made of a take, given to the command as `Choices`, `choices`."""
    options = (
        click.option("--overlays/--no-overlays", default=True, show_default=True, help="Write videos with the fit."),
        click.option("--overlay-skin", is_flag=True, help="Draw the person's skin on the videos, too."),
        click.option(
            "--formats", default=",".join(DEFAULT_FORMATS), show_default=True, callback=chosen_formats,
            metavar="LIST",
            help=f"Formats to write. Others: {', '.join(sorted({*FORMATS.names()} - {*DEFAULT_FORMATS}))}.",
        ),
        click.option("--report/--no-report", default=True, show_default=True, help="Write report.html."),
        click.option(
            "--pictures", type=click.Choice(PICTURES), default="full", show_default=True,
            help="Video images in report and overlays: all, or none. To hide only faces: --hide-faces.",
        ),
        _screen.hide_faces_option,
        click.option("--contacts", is_flag=True, help="Keep soles still while they rest on the floor. Always on with "
            "one camera, and with cameras calibrated from the people in view."),
        click.option("--realtime", is_flag=True, help="Estimate each frame only from earlier frames (no smoothing)."),
        click.option(
            "--lag", type=float, metavar="SECONDS",
            help="Estimate each frame from earlier frames and this many seconds of later frames, like a live session "
            "with a delay.",
        ),
        click.option(
            "--person", metavar="WHO",
            help='Track one of several people: "first", "moving", "largest", "nearest X Y Z" or a number.  '
            "[default: person of the take; else all people, each in a folder]",
        ),
        click.option(
            "--restart", is_flag=True, help="Track all frames again.  [default: continue an interrupted run]"
        ),
    )  # fmt: skip
    command = _screen.gathered(
        "choices", _choices, "overlays", "overlay_skin", "formats", "report", "pictures", "contacts", "realtime", "lag",
        "person", "restart", "hide_faces",
    )(command)
    for option in reversed(options):
        command = option(command)
    return command


@click.command(short_help="Track the person of a take file and write all results.", epilog="""\b
Examples:
  kinefit track my_take/take.toml
  kinefit track my_videos               a folder that has only the videos of one to eight cameras
  kinefit track take.toml --out results --no-overlays --formats bvh,csv
  kinefit track take.toml --realtime    filter: estimate each frame only from earlier frames
  kinefit track take.toml --lag 0.1     filter with 0.1 s of later frames: far smoother
  kinefit track take.toml --person moving      track one of several people
  kinefit track take.toml -v            also print the residual of every point in every camera
""")  # fmt: skip
@click.argument("take", type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, help="Folder of results.  [default: TAKE-kinefit]")
@choices_options
@_screen.quiet_options
@_screen.verbose_option
@click.pass_context
def track(
    ctx: click.Context, take: Path, out: Path | None, choices: Choices, as_json: bool
) -> None:  # fmt: skip
    """Track the people of a take file and write all results.

    TAKE is a take file: a TOML file that names calibration, cameras, videos and keypoints (docs/take-file.md). It may
    also be a folder of videos; its take file is then written as by `kinefit init`. If the take has no keypoints, they
    are detected in the videos first (extra `detect`). If it has no calibration, the cameras are calibrated from the
    people in view.

    Ctrl-C stops the tracking and writes the finished frames. The same command continues from there, also after a
    crash. OUT/unfinished/so-far.csv has the frames tracked so far.

    Faults of the inputs (a moved camera, a wrong unit, vertical, focal length or clock, swapped names, mirrored images)
    are printed first and head report.html, each with what to do. `kinefit check` examines them in more detail.

    If the keypoints show several people, the results of each are in OUT/person-1, OUT/person-2 and so on.
    """
    from kinefit.cli.init import write_first_take
    from kinefit.readers.take.file import find_take, takes_in

    take = write_first_take(take) if take.is_dir() and not takes_in(take) else find_take(take)
    out = out or take.with_name(f"{take.stem}-kinefit")
    people: list[dict[str, Any]] = []
    code = run(take, out, choices, wanted=_needs_overlays(choices), results=people)
    if as_json:
        _screen.print_json({"take": str(take), "folder": str(out), "exit_code": code, "people": people})
    ctx.exit(code)


def run(
    path: Path, out: Path, choices: Choices, *, wanted: bool = False, results: list[dict[str, Any]] | None = None
) -> int:  # fmt: skip
    """Track a take and write what comes of it; returns the exit code. Overlays that are `wanted` must be possible.

    `results` is filled with a record of each person, for --json.
    """
    results = [] if results is None else results
    from kinefit.takes.batch.one import asked_take, check_drawable, of_motion, people_of
    from kinefit.takes.batch.summary import Row, failed, write_people_report

    take = asked_take(path, choices)
    if wanted:
        check_drawable(take, skin=choices.overlay_skin)
    _screen.check_folder(out)
    with _screen.bars() as step:
        view, people = people_of(take, out, step, _screen.note)
    if len(people) == 1:
        return _track_one(*people[0], choices, view, results)[0]
    code, rows = 0, []
    for k, (person, folder) in enumerate(people, 1):
        _screen.say(f"person {k} of {len(people)}: {folder}", style="bold")
        folder.mkdir(parents=True, exist_ok=True)
        row = Row(take=take.name, person=k, folder=folder.name)
        try:
            own, done = _track_one(person, folder, choices, view, results)
            rows.append(of_motion(row, done.motion, done.notes))
        except KinefitError as error:  # of one person: the others are tracked all the same
            _screen.tell_error(error)
            own = error.exit_code
            rows.append(failed(row, str(error)))
        if own == _screen.INTERRUPTED:
            return own
        code = max(code, own)
    if choices.report:
        page = write_people_report(rows, out, pictures=choices.draws)
        _screen.say(f"all people: {page}", style="bold")
    return code


def _track_one(
    take: Take, out: Path, choices: Choices, view: InView | None, results: list[dict[str, Any]]
) -> tuple[int, TrackedPerson]:  # fmt: skip
    """Track one person of a take, write and print the results; returns the exit code and the tracked person."""
    from kinefit.cli._summary import as_record, print_files, print_summary
    from kinefit.findings import of_provenance
    from kinefit.takes.batch.one import track_person

    files: dict[str, Path] = {}
    try:
        with _screen.bars() as step:
            done = track_person(take, out, choices, view=view, step=step, tell=_screen.note, files=files)
    except BaseException as error:
        if files:
            print_files(files)
        if _screen.is_verbose() and isinstance(error, TrackingError):
            _print_agreement(take)
        if files and isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt("The files listed are complete; no others were written.") from error
        raise
    for found in of_provenance(done.motion.provenance):
        _screen.tell_finding(found)
    for note in done.notes:
        _screen.say(f"note: {note}")
    results.append(as_record(done.motion, done.notes, files))
    print_summary(done.motion, points=_screen.is_verbose())
    print_files(files)
    if done.total:
        text = f"{len(done.motion)} of {done.total} frames are tracked and written, without videos and report."
        _screen.tell_interrupted(f"{text} Run the same command to continue.")
        return _screen.INTERRUPTED, done
    return 0, done


def _print_agreement(take: Take) -> None:
    """Print, for every two cameras, how far the points that both saw miss each other."""
    from itertools import combinations

    from kinefit.fitting.multiview.views import make_views, pair_misses
    from kinefit.readers.take.load import load_observations

    seen = load_observations(take)
    if seen.rig is None or len({k.camera for k in seen.keypoints}) < 2:
        return
    views = make_views(seen.rig, seen.keypoints)
    misses = pair_misses(views)
    rows = [
        (f"{views.rig.names[a]} - {views.rig.names[b]}", f"{misses[a, b]:.1f} px" if misses[a, b] >= 0.0 else "-")
        for a, b in combinations(range(len(views.rig)), 2)
    ]  # fmt: skip
    _screen.say("\nA pair with a far larger error has a wrong calibration, differing clocks, or another person.")
    _screen.print_table(("cameras", "median reprojection error"), rows)


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
    from kinefit.takes.batch.one import Choices

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
    from kinefit.readers.assets import SAMPLE_CREDIT, write_sample_take

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


@click.command(short_help="Track many takes in parallel, with one summary.", epilog="""\b
Examples:
  kinefit batch 'sessions/**/take.toml' --workers 4
  kinefit batch sessions --out study --no-overlays --formats motion,csv
  kinefit batch 'sessions/**/take.toml' --cluster tcp://host:8786

\b
Exit codes: 0 where all takes are done, 2 where some have failed (the others are done all the same).
""")  # fmt: skip
@click.argument("patterns", nargs=-1, required=True, metavar="PATTERN...")
@click.option(
    "-o", "--out", type=_screen.PATH, default=Path("kinefit-batch"), show_default=True,
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
    time_limit: float, choices: Choices,
) -> None:
    """Track every take that PATTERN matches, like `kinefit track`, and write summary.html over all of them.

    Put a pattern in quotes. A folder stands for every take.toml in it and below. A take that fails does not stop the
    others: the summary has its error. After an interruption, the same command tracks only the remaining takes.
    """
    from kinefit.takes.batch.many import find_takes, track_takes

    if cluster is not None and workers is not None:
        raise click.UsageError("--workers (processes on this machine) and --cluster exclude each other: give one.")
    found = find_takes(patterns)
    _screen.check_folder(out)
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
