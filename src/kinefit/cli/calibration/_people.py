"""`kinefit calibrate people`: where the cameras stand, from the people in view alone."""

from __future__ import annotations

from pathlib import Path

import click

from kinefit.cli import _screen

_EXAMPLES = """\b
Examples:
  kinefit calibrate people take.toml --height 1.78
  kinefit calibrate people take.toml --focal --time-offsets -o cameras.toml
"""


@click.command(short_help="Estimate camera poses from the people in view.", epilog=_EXAMPLES)
@click.argument("take", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), help="File to write.  [default: TAKE-people.toml]")
@click.option(
    "--height", type=float, metavar="M", help="Stature of the person, which sets the scale.  [default: the take's]"
)
@click.option("--focal", is_flag=True, help="Estimate the focal lengths too.")
@click.option("--time-offsets", is_flag=True, help="Estimate the time offset of each camera too.")
@_screen.verbose_option
def people(
    take: Path, out: Path | None, height: float | None, focal: bool, time_offsets: bool
) -> None:
    """Estimate camera poses from the people in view.

    The calibration of TAKE gives the intrinsics of its cameras. Its camera poses are not used.
    """
    from statistics import median

    from kinefit.bodies import load_body
    from kinefit.calibration.people.calibrate import calibrate_people
    from kinefit.cli._results import check_new
    from kinefit.preparing.take import with_detections
    from kinefit.readers.calibration.read import write_calibration
    from kinefit.readers.take.file import find_take, read_take
    from kinefit.takes.track import load_keypoints

    take = find_take(take, wanted=("calibrate", "people"))
    out = out or take.with_name(f"{take.stem}-people.toml")
    check_new(out, remedy="Give another file with --out.")
    entry = read_take(take)
    with _screen.bars() as step:
        entry = with_detections(entry, step, _screen.note)
        step("reading", 0, 0)
        seen = load_keypoints(entry, exteriors=False)
        step("reading", 1, 1)
        assert seen.rig is not None
        found = calibrate_people(
            tuple(seen.rig), seen.keypoints, load_body(entry.body), height=height or entry.height, focal=focal,
            time_offsets=time_offsets, up=entry.up, progress=step,
            sigma=median(source.sigma for source in entry.keypoints),
        )  # fmt: skip
    write_calibration(found.rig, out)
    for line in found.summary_lines():
        _screen.say(line)
    _screen.say(f"Written: {out}")
