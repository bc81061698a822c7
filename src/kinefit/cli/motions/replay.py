"""`kinefit replay`: a motion on a slope, carried along, seen by a new camera."""

from __future__ import annotations

from pathlib import Path

import click

from kinefit.cli import _screen


@click.command(short_help="Move a motion down a slope; render it from a new camera.", epilog="""\b
Examples:
  kinefit replay motion.npz -o ride.mp4 --speed 6               a video on a slope of 30 degrees
  kinefit replay motion.npz -o ride.npz --speed 6 --gain 1.5    a motion; show it with kinefit view ride.npz
""")  # fmt: skip
@click.argument("source", metavar="MOTION", type=_screen.PATH)
@click.option("-o", "--out", required=True, type=_screen.PATH, help="Video (.mp4) or motion (.npz).")
@click.option("--slope", type=float, default=30.0, show_default=True, help="[deg] Slope of the floor.")
@click.option("--heading", type=float, default=0.0, show_default=True, help="[deg] Direction of the fall line.")
@click.option("--speed", type=float, default=4.0, show_default=True, help="[m/s] Initial speed down the slope.")
@click.option("--gain", type=float, default=0.0, show_default=True, help="[m/s²] Acceleration down the slope.")
@click.option("--azimuth", type=float, default=100.0, show_default=True, help="[deg] Camera from the fall line.")
@_screen.verbose_option
def replay(
    source: Path, out: Path, slope: float, heading: float, speed: float, gain: float, azimuth: float
) -> None:
    """Place a motion on a slope, move it downhill, and write it as a video or a motion."""
    from kinefit.exporters.motion_file import write_motion
    from kinefit.readers.motion import read_motion
    from kinefit.simulation.replay import film, replayed

    _screen.check_file(out, "--out")
    found = source / "motion.npz" if source.is_dir() else source
    moved = replayed(read_motion(found), slope=slope, heading=heading, speed=speed, gain=gain)
    if out.suffix.lower() == ".npz":
        write_motion(moved, out)
    else:
        film(moved, out, slope=slope, heading=heading, azimuth=azimuth)
    _screen.say(f"{out}: {len(moved)} frames")
