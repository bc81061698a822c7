"""`kinefit markers`: from points without names to a labelled take, and a body that moves."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kinefit.cli import _screen
from kinefit.cli._screen import CommandGroup

if TYPE_CHECKING:
    from kinefit.cli.markers._fit import MarkerFitOptions
    from kinefit.findings import Finding
    from kinefit.markers.take.takes import TakeIdentification
    from kinefit.observations import Markers

MOST_DOUBTS = 12
"""Doubtful spans that are printed; the table has all."""

_unit = click.option("--unit", metavar="UNIT", help="Unit of the file, if it states none or a wrong one: mm, cm, m.")


@click.group(cls=CommandGroup, short_help="Label the markers of a take, fit a body to them, check labels.", epilog="""\b
Examples:
  kinefit markers learn labelled.c3d -o anna.json         learn how Anna's markers lie on her segments
  kinefit markers set labelled.c3d -o lab.toml            write a marker set for labels that the catalogue lacks
  kinefit markers identify walk.c3d anna.json             label the points of an unlabelled take
  kinefit markers fit walk-named.c3d                      fit a body: joint angles, .mot, BVH, GLB
  kinefit markers fit walk.c3d --subject anna.json        label and fit in one command
  kinefit markers audit walk-named.c3d                    find swapped labels of a labelled take
""")  # fmt: skip
def markers() -> None:
    """Label the markers of a take (C3D, TRC), fit a body to them, check labels."""


@markers.command(epilog="""\b
Examples:
  kinefit markers learn range_of_motion.c3d --name Anna
  kinefit markers learn static.c3d walk.c3d squat.c3d -o anna.json
  kinefit markers learn static.c3d --frame 100 --set cmu_41
""")  # fmt: skip
@click.argument("takes", nargs=-1, required=True, type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, help="Subject file to write.  [default: NAME.json]")
@click.option("--name", help="Name of the subject.  [default: name of the first take]")
@click.option("--set", "marker_set", metavar="NAME", help="Marker set of the catalogue, or a file.  [default: the set "
              "that has the labels]")  # fmt: skip
@click.option("--no-set", is_flag=True, help="Find segments and joints from the motion alone.")
@click.option("--frame", type=int, help="Learn from the set and this frame alone (from 0; -1: the most complete).")
@_unit
@_screen.verbose_option
def learn(
    takes: tuple[Path, ...], out: Path | None, name: str | None, marker_set: str | None, no_set: bool,
    frame: int | None, unit: str | None,
) -> None:  # fmt: skip
    """Learn a subject's markers from labelled takes, best from a take in which every joint moves."""
    from kinefit.cli.markers._fit import learn_files
    from kinefit.markers.model.model import save_model

    if no_set and (marker_set or frame is not None):
        raise click.UsageError("--no-set learns from the motion alone: leave out --set and --frame.")
    if out is not None:
        _screen.check_file(out)
    model, findings = learn_files(takes, name=name, marker_set="" if no_set else marker_set, frame=frame, unit=unit)
    out = out or Path(f"{model.name}.json")
    save_model(model, out)
    _screen.say(f"{model.name}: {len(model)} markers in {len(model.segments)} segments")
    for s, (segment, members) in enumerate(zip(model.names, model.segments, strict=True)):
        joint = next((j for j in model.joints if j.child == s), None)
        on = "" if joint is None else f" on {model.names[joint.parent]}"
        _screen.say(f"  {segment}{on}: {', '.join(model.labels[m] for m in members)}")
    if findings:
        _screen.say("\nNot determined by these takes:")
        for f in findings:
            _screen.say(f"  {f}")
    _screen.say(f"\nWritten: {out}")


@markers.command("set", epilog="""\b
Examples:
  kinefit markers set range_of_motion.c3d -o lab.toml
  kinefit markers learn range_of_motion.c3d --set lab.toml -o anna.json
""")  # fmt: skip
@click.argument("takes", nargs=-1, required=True, type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, help="Marker set to write.  [default: TAKE.toml]")
@click.option("--name", help="Name of the set.  [default: name of the file]")
@_unit
@_screen.verbose_option
def write_set(takes: tuple[Path, ...], out: Path | None, name: str | None, unit: str | None) -> None:
    """Write a draft of a marker set for labels that the catalogue does not have.

    TAKES are labelled takes of one subject with moving joints. The command pairs left and right labels, places labels
    with known words on the humanoid's landmarks, and assigns every marker to the segment that it moves with. Check the
    file before you learn with it.
    """
    from kinefit.cli.markers._fit import write_first_set

    out = out or Path(f"{takes[0].stem}.toml")
    _screen.check_file(out)
    found = write_first_set(takes, out, name=name, unit=unit)
    for segment, labels in found.segments.items():
        _screen.say(f"  {segment}: {', '.join(labels)}")
    if not found.placed:
        _screen.say("Too few labels have known words: the groups are markers that moved together. Give each group the")
        _screen.say("name of its body part and its parent; add [places] and [markers] to fit a body.")
    _screen.say(f"{len(found.paired)} pairs of left and right, {len(found.placed)} markers placed on the humanoid")
    _screen.say(f"\nWritten: {out}")
    _screen.say(f"Next: check it, then kinefit markers learn {takes[0].name} --set {out}")


def _method(method: str, **constants: float | None) -> Callable[..., TakeIdentification]:
    """The identifier, or SAPM with its constants."""
    from kinefit.markers.take.takes import identify_take
    from kinefit.papers.unlabelled_markers import sapm_take

    given: dict[str, Any] = {name: value for name, value in constants.items() if value is not None}
    if given and method != "sapm":
        raise click.UsageError(f"--{' and --'.join(given)}: only for SAPM, add --method sapm.")
    return partial(sapm_take, **given) if method == "sapm" else identify_take


@markers.command(epilog="""\b
Examples:
  kinefit markers identify walk.c3d anna.json
  kinefit markers identify dance.c3d anna.json bob.json -o dance-named.c3d
  kinefit markers identify walk.trc anna.json --no-fill --rest
  kinefit markers identify walk.c3d anna.json --method sapm --beta 0.6
""")  # fmt: skip
@click.argument("take", type=_screen.PATH)
@click.argument("subjects", nargs=-1, required=True, type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, help="Labelled take, .c3d or .trc.  [default: TAKE-named]")
@click.option("--fill/--no-fill", default=True, show_default=True, help="Fill gaps of up to half a second.")
@click.option("--rest", is_flag=True, help='Also write unassigned points, as "*1", "*2" ...')
@click.option("--method", type=click.Choice(["identifier", "sapm"]), default="identifier", show_default=True,
              help="The identifier, or the published SAPM for comparison: every frame anew, less reliable.")
@click.option("--epsilon", type=click.FloatRange(0, 1, min_open=True), metavar="E",
              help="SAPM: tolerated distortion, as a share of a segment's mean distance.  [default: 0.1]")
@click.option("--beta", type=click.FloatRange(0, 1, max_open=True), metavar="B",
              help="SAPM: share of a segment's points that a match must exceed.  [default: 0.8]")
@_unit
@_screen.verbose_option
@_screen.gathered("method", _method, "method", "epsilon", "beta")
def identify(
    take: Path, subjects: tuple[Path, ...], out: Path | None, fill: bool, rest: bool,
    method: Callable[..., TakeIdentification], unit: str | None,
) -> None:  # fmt: skip
    """Label the points of an unlabelled take.

    SUBJECTS are files of `kinefit markers learn`, one for each person in the take. Existing labels of the take are
    ignored. Points without a certain label stay unlabelled. The worst doubtful frames are printed; a table lists all.
    """
    from kinefit.cli.markers._fit import identify_file
    from kinefit.markers.take.takes import TakeSettings

    settings = TakeSettings() if fill else TakeSettings(fill=0.0)
    with _screen.bars() as step:
        labelled, found, files = identify_file(
            take, list(subjects), out, settings=settings, unit=unit, rest=rest, step=step, method=method,
        )  # fmt: skip
    _tell(labelled, found)
    _screen.say("\nWritten:")
    _screen.say(f"  {files['markers']}  labelled markers")
    _screen.say(f"  {files['doubts']}  doubtful frames, worst first")


def _tell(labelled: Markers, found: dict[str, TakeIdentification]) -> None:
    """Doubtful frames first, then how much has a name."""
    doubts = sorted(((d.confidence, name, d) for name, f in found.items() for d in f.doubts), key=lambda row: row[0])
    _screen.say("doubtful frames: none" if not doubts else "doubtful frames, worst first:")
    for _, name, d in doubts[:MOST_DOUBTS]:
        _screen.say(f"  {name + ' ' if len(found) > 1 else ''}{d.text}")
    if len(doubts) > MOST_DOUBTS:
        _screen.say(f"  and {len(doubts) - MOST_DOUBTS} more")
    for name, f in found.items():
        seen = f.column >= 0
        never = [label for m, label in enumerate(f.labels) if not seen[:, m].any()]
        _screen.say(
            f"{name}: {len(labelled)} frames at {labelled.rate:g} Hz, {100 * seen.mean():.1f} % of the labels named, "
            f"{100 * f.filled.mean():.1f} % filled, {f.ghosts} points unassigned"
        )
        if never:
            _screen.say(f"  never found: {', '.join(never)}")


@markers.command(epilog="""\b
Examples:
  kinefit markers fit walk-named.c3d
  kinefit markers fit walk.c3d --subject anna.json --static static.c3d
  kinefit markers fit walk.trc --height 1.78 --formats mot,osim
""")  # fmt: skip
@click.argument("take", type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, help="Folder of results.  [default: TAKE-kinefit]")
@click.option("--subject", "subjects", multiple=True, type=_screen.PATH,
              help="Label the points first, with this file of `learn`; repeat for more people.")  # fmt: skip
@click.option("--static", type=_screen.PATH, help="Labelled static trial of the same subject.")
@click.option("--body", default="humanoid", show_default=True, help="Body of the catalogue, or a body file.")
@click.option("--set", "marker_set", metavar="NAME", help="Marker set.  [default: the set that has the labels]")
@click.option("--height", type=_screen.HEIGHT, metavar="M", help="Height of the subject, barefoot [m].")
@click.option("--mass", type=click.FloatRange(2, 700), metavar="KG", help="Mass of the subject.  [default: by height]")
@click.option("--up", type=click.Choice(["x", "y", "z"]), help="Vertical axis.  [default: estimated]")
@click.option("--sides", type=click.Choice(["labelled", "exchanged", "mirrored-x", "mirrored-y", "mirrored-z"]),
              help="How left and right are read: exchanged labels, a world with one axis negated, or as labelled "
              "without a check.  [default: as labelled, checked]")
@click.option("--limits/--no-limits", default=True, show_default=True, help="Keep joint angles within their limits.")
@click.option("--smooth/--no-smooth", default=True, show_default=True, help="Fit all frames together, or each alone.")
@click.option("--formats", metavar="LIST",
              help="Formats to write.  [default: motion,csv,bvh,glb,trc,mot,osim,markers,report]")  # fmt: skip
@_unit
@_screen.verbose_option
@_screen.gathered(
    "options", "kinefit.cli.markers._fit:MarkerFitOptions",
    "static", "body", "marker_set", "height", "mass", "up", "sides", "limits", "smooth",
)  # fmt: skip
def fit(
    take: Path, out: Path | None, subjects: tuple[Path, ...], options: MarkerFitOptions, formats: str | None,
    unit: str | None,
) -> None:  # fmt: skip
    """Fit a body to markers: size and marker offsets from all frames, then joint angles."""
    from kinefit.cli._summary import print_files, print_summary
    from kinefit.cli.markers._fit import WRITTEN, fit_file, identify_file

    out = out or take.with_name(f"{take.stem}-kinefit")
    chosen = WRITTEN if formats is None else tuple(part.strip().lower() for part in formats.split(",") if part.strip())
    _screen.check_folder(out)
    with _screen.bars() as step:
        source = take
        if subjects:
            target = out / f"{take.stem}-named.c3d"
            labelled, named, files = identify_file(take, list(subjects), target, unit=unit, step=step)
            source, unit = files["markers"], None
        notes: list[Finding] = []
        found = fit_file(source, out, options, unit=unit, formats=chosen, step=step, notes=notes)
    if subjects:
        _tell(labelled, named)
    for note in notes:
        _screen.tell_finding(note)
    for motion, _ in found.values():
        print_summary(motion, points=_screen.is_verbose())
    for written in (*([files] if subjects else []), *(w for _, w in found.values())):
        print_files(written)


@markers.command(epilog="""\b
Examples:
  kinefit markers audit walk.c3d squat.c3d
  kinefit markers audit walk.c3d --subject anna.json
""")  # fmt: skip
@click.argument("takes", nargs=-1, required=True, type=_screen.PATH)
@click.option("--subject", type=_screen.PATH, help="File of `kinefit markers learn`, to find swaps of whole takes.")
@click.option("--set", "marker_set", metavar="NAME", help="Marker set.  [default: the set that has the labels]")
@click.option("--strict", is_flag=True, help="End with exit code 2 if a label is wrong.")
@_unit
@_screen.verbose_option
@click.pass_context
def audit(
    ctx: click.Context, takes: tuple[Path, ...], subject: Path | None, marker_set: str | None, strict: bool,
    unit: str | None,
) -> None:  # fmt: skip
    """Find swapped labels, exchanged sides, a mirrored world, and markers off their segment, in labelled takes."""
    from kinefit.bodies.marker_sets import load_marker_set
    from kinefit.cli.markers._fit import check_labels, read_file
    from kinefit.markers.audit.audit import audit_take
    from kinefit.markers.model.model import load_model

    model = load_model(subject) if subject else None
    known = load_marker_set(marker_set) if marker_set else None
    wrong = False
    for take in takes:
        markers = read_file(take, unit)
        findings = audit_take(markers, model=model, marker_set=known)
        labels = check_labels(markers, marker_set)
        faults = [f for f in labels if f.severity == "fault"]
        wrong = wrong or bool(faults) or any(f.kind in ("swapped", "throughout") for f in findings)
        _screen.say(f"{take}: {'no wrong labels found' if not (findings or faults) else ''}".rstrip())
        for f in (*labels, *findings):
            _screen.say(f"  {f}")
    if strict and wrong:
        ctx.exit(2)
