"""`kinefit simulate`: what sensors would have seen of a known motion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kinefit.cli import _results, _screen

if TYPE_CHECKING:
    from kinefit.motion import Motion
    from kinefit.observations.recordings import SkeletonMotion

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
        raise click.BadParameter("give FIRST:LAST, without the frame LAST.") from None


@click.command(short_help="Simulate depth, stereo and colour cameras for a motion.", epilog=_EXAMPLES)
@click.argument("motion", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), required=True, help="Folder for the take.")
@click.option(
    "--sensor", "sensors", type=click.Choice(_SENSORS), multiple=True, default=("kinect",), show_default=True,
    help="Sensor to simulate; repeat for several.",
)  # fmt: skip
@click.option("--body", help="Body of the catalogue, or a file.  [default: the motion's, or humanoid]")
@click.option("--asf", type=click.Path(path_type=Path), help="Skeleton (.asf) of an .amc file.")
@click.option("--rate", type=click.FloatRange(min=0, min_open=True), help="Frames per second.  [default: at most 30]")
@click.option("--frames", callback=_frames, help="FIRST:LAST at this rate, without LAST.  [default: all]")
@click.option("--distance", type=click.FloatRange(0.1, 50), help="[m] to the sensors.  [default: nearest full view]")
@click.option("--azimuth", type=float, default=0.0, show_default=True, help="[deg] 90: at the person's left.")
@click.option("--height", type=float, default=1.2, show_default=True, help="[m] of the sensors above the floor.")
@click.option("--no-room", is_flag=True, help="Leave out floor, walls and table.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of all noise.")
@_screen.verbose_option
def simulate(
    motion: Path, out: Path, sensors: tuple[str, ...], body: str | None, asf: Path | None, rate: float | None,
    frames: tuple[int, int | None] | None, distance: float | None, azimuth: float, height: float, no_room: bool,
    seed: int,
) -> None:  # fmt: skip
    """Simulate the sensors in front of a person who performs MOTION (.npz of kinefit, .bvh or .amc).

    The folder gets a take for kinefit track, and the true motion in truth/.
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
    _screen.say(f"{out / 'truth'}: the true motion (motion.npz, joints.csv and more)")
    _screen.say(f"Next:\n  {command('track', take)}")


def _known(path: Path, body: str | None, asf: Path | None, rate: float | None, step: _screen.Step) -> Motion:
    """The motion on the body and at the rate asked for."""
    from kinefit.bodies import load_body
    from kinefit.readers.motion import read_motion
    from kinefit.simulation import on_body, resampled, retarget

    check_recording(path, asf, (".npz", ".bvh", ".amc"), "MOTION")
    chosen = load_body(body) if body else None
    if path.suffix.lower() == ".npz":
        known = read_motion(path)
        known = resampled(known, rate or 30.0) if rate or known.rate > 30.0 else known
    else:
        skeleton = read_skeleton(path, asf)
        step("retargeting", 0, 0)
        known = retarget(skeleton, rate=rate or min(skeleton.rate, 30.0))
        step("retargeting", len(known), len(known))
    if chosen is not None and chosen.name != known.body.name:
        known = on_body(known, chosen)
    return known


def check_recording(path: Path, asf: Path | None, endings: Sequence[str], name: str) -> None:
    """Raise click's errors for a recorded motion of another ending, or an .amc without its skeleton."""
    if path.suffix.lower() not in endings:
        known = f"{', '.join(endings[:-1])} or {endings[-1]}"
        raise click.BadParameter(f"'{path.name}' is not a {known} file.", param_hint=name)
    if (asf is not None) != (path.suffix.lower() == ".amc"):
        raise click.UsageError("An .amc file needs its skeleton: give --asf FILE. With other files, leave out --asf.")


def read_skeleton(path: Path, asf: Path | None, **options: Any) -> SkeletonMotion:
    """The skeleton and motion of a .bvh file, or of an .amc file with its .asf."""
    from kinefit.readers.skeletons.acclaim import read_amc
    from kinefit.readers.skeletons.bvh import read_bvh

    return read_amc(asf, path, **options) if asf else read_bvh(path, **options)
