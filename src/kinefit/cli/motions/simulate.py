"""`kinefit simulate`: what sensors would have seen of a known motion."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kinefit.cli import _results, _screen

if TYPE_CHECKING:
    from kinefit.motion import Motion

_SENSORS = ("tof", "kinect", "stereo", "colour", "keypoints")
_EXAMPLES = """\b
Examples:
  kinefit simulate walk.bvh -o walk --sensor kinect
  kinefit simulate motion.npz -o seen --sensor tof --sensor stereo --azimuth 30
  kinefit simulate 02_01.amc --asf 02.asf -o seen --frames 100:200 --body humanoid10
  kinefit track seen/take.toml
"""


def _frames(ctx: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int | None] | None:
    if value is None:
        return None
    first, colon, last = value.partition(":")
    try:
        return int(first or 0), int(last) if last else None if colon else int(first) + 1
    except ValueError:
        raise click.BadParameter("give FIRST:LAST, the last not included.") from None


@click.command(short_help="Render what depth, stereo and colour cameras would have seen of a motion.", epilog=_EXAMPLES)
@click.argument("motion", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), required=True, help="Folder of the take.")
@click.option(
    "--sensor", "sensors", type=click.Choice(_SENSORS), multiple=True, default=("kinect",), show_default=True,
    help="May be given more than once.",
)  # fmt: skip
@click.option("--body", help="Catalogue name or body file.  [default: the motion's, or humanoid]")
@click.option("--asf", type=click.Path(path_type=Path), help="Skeleton of an .amc file; needed there.")
@click.option("--rate", type=click.FloatRange(min=0, min_open=True), help="Frames a second.  [default: at most 30]")
@click.option("--frames", callback=_frames, help="FIRST:LAST at that rate, the last not included.  [default: all]")
@click.option("--distance", type=click.FloatRange(0.1, 50), help="[m]  [default: as near as all of it is in view]")
@click.option("--azimuth", type=float, default=0.0, show_default=True, help="[deg] 90: from the person's left.")
@click.option("--height", type=float, default=1.2, show_default=True, help="[m] of the sensors above the floor.")
@click.option("--no-room", is_flag=True, help="No floor, walls and table.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of all errors.")
@_screen.verbose_option
def simulate(
    motion: Path, out: Path, sensors: tuple[str, ...], body: str | None, asf: Path | None, rate: float | None,
    frames: tuple[int, int | None] | None, distance: float | None, azimuth: float, height: float, no_room: bool,
    seed: int,
) -> None:  # fmt: skip
    """Render what sensors in front of a person would have seen of a MOTION (.npz of kinefit, .bvh or .amc).

    The folder then holds a take for kinefit track, and the truth beside it.
    """
    import math

    from kinefit.errors import command
    from kinefit.exporters import write_csv, write_motion
    from kinefit.simulation import cut, write_recording

    _results.check_folder(out)
    with _screen.bars() as step:
        known = _known(motion, body, asf, rate, step)
        known = cut(known, *frames) if frames else known

        def truth(folder: Path) -> None:
            write_motion(known, folder / "truth" / "motion.npz")
            write_csv(known, folder / "truth")

        take = write_recording(
            known, out, sensors, distance=distance, azimuth=math.radians(azimuth), height=height, room=not no_room,
            seed=seed, step=step, beside=truth, body=Path(body).resolve() if body and body.endswith(".toml") else None,
        )  # fmt: skip
    _screen.say(f"{take}: {len(known)} frames at {known.rate:g} Hz of the body {known.body.name}")
    _screen.say(f"{out / 'truth'}: motion.npz, joints.csv and more: what they should find")
    _screen.say(f"Next:\n  {command('track', take)}")


def _known(path: Path, body: str | None, asf: Path | None, rate: float | None, step: _screen.Step) -> Motion:
    """The motion on the body and at the rate asked for."""
    from kinefit.bodies import load_body
    from kinefit.readers.motion import read_motion
    from kinefit.readers.skeletons.amc import read_amc
    from kinefit.readers.skeletons.bvh import read_bvh
    from kinefit.simulation import on_body, resampled, retarget

    suffix = path.suffix.lower()
    if suffix not in (".npz", ".bvh", ".amc"):
        raise click.BadParameter(f"'{path.name}' ends neither in .npz, .bvh nor .amc.", param_hint="MOTION")
    if (asf is not None) != (suffix == ".amc"):
        raise click.UsageError("An .amc file needs its skeleton, --asf FILE; others take none.")
    chosen = load_body(body) if body else None
    if suffix == ".npz":
        known = read_motion(path)
        known = resampled(known, rate or 30.0) if rate or known.rate > 30.0 else known
    else:
        skeleton = read_amc(asf, path) if asf else read_bvh(path)
        step("retargeting", 0, 0)
        known = retarget(skeleton, rate=rate or min(skeleton.rate, 30.0))
        step("retargeting", len(known), len(known))
    if chosen is not None and chosen.name != known.body.name:
        known = on_body(known, chosen)
    return known
