"""`kinefit calibrate`: cameras from a board, from a bar with two targets, or from the people in view."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kinefit.cli import _screen
from kinefit.cli._screen import CommandGroup

if TYPE_CHECKING:
    from kinefit.calibration.board.calibrate import BoardCalibration

_WAYS = {
    "board": "kinefit.cli.calibration.calibrate", "bar": "kinefit.cli.calibration._bar",
    "people": "kinefit.cli.calibration._people",
}  # fmt: skip

_EXAMPLES = """\b
Examples:
  kinefit calibrate board videos/ --board charuco:5x7:0.04:0.03 --floor 12
  kinefit calibrate board left.mp4 right.mp4 --board checkerboard:9x6:0.025 -o stereo.toml
  kinefit calibrate board pictures/ --board checkerboard:9x6:0.025 --interiors-only
  kinefit calibrate board videos/ --board charuco:5x7:0.04:0.03:5X5_100 --interiors lenses.toml
  kinefit calibrate bar videos/ --length 0.9
"""


class _Ways(CommandGroup):
    """Subcommands that are imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the order of use."""
        return list(_WAYS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Import a subcommand."""
        return getattr(import_module(_WAYS[name]), name) if name in _WAYS else None


@click.group(cls=_Ways, epilog=_EXAMPLES, short_help="Calibrate cameras with a board, a bar, or from people in view.")
def calibrate() -> None:
    """Calibrate cameras: with a board in view, with a bar that is waved, or from the people in view alone."""


@click.command(short_help="Intrinsics and extrinsics from a checkerboard or ChArUco board.", epilog=_EXAMPLES)
@click.argument("sources", nargs=-1, required=True, type=_screen.PATH, metavar="VIDEO_OR_FOLDER...")
@click.option(
    "--board", "spec", required=True, metavar="SPEC",
    help="checkerboard:9x6:0.025 (inner corners; side of a square in m) or charuco:5x7:0.04:0.03[:DICTIONARY] "
    "(squares; sides of a square and of a marker in m).",
)
@click.option("-o", "--out", type=_screen.PATH, default=Path("calibration.toml"), show_default=True,
              help="File to write, Pose2Sim TOML.")
@click.option("--interiors", type=_screen.PATH, metavar="FILE", help="Calibration with the intrinsics.")
@click.option("--interiors-only", is_flag=True, help="Estimate only intrinsics; cameras may see the board one by one.")
@click.option("--floor", metavar="FRAME", help="Frame (12) or time (3.5s) with the board face up on the floor.")
@click.option("--max-frames", type=click.IntRange(4), default=200, show_default=True,
              help="Frames of each camera to search, spread over the recording.")
@click.option("--overwrite", is_flag=True, help="Overwrite an existing OUT.")
@_screen.verbose_option
def board(
    sources: tuple[Path, ...], spec: str, out: Path, interiors: Path | None, interiors_only: bool, floor: str | None,
    max_frames: int, overwrite: bool,
) -> None:
    """Intrinsics and extrinsics from a checkerboard or ChArUco board.

    Give a video for each camera, named like the camera, a folder of videos, or folders of images. The videos must be
    synchronised: equal frame numbers mean equal times. The side of a square gives the scale; the board on the floor
    (--floor) gives the origin and the vertical.
    """
    from kinefit.calibration.board.calibrate import calibrate_board
    from kinefit.calibration.board.detection import Board
    from kinefit.calibration.board.sources import camera_sources, find_boards
    from kinefit.readers.calibration.read import read_calibration, write_calibration

    described = Board.parse(spec)
    found = camera_sources(sources)
    _screen.check_new(out, overwrite)
    kept = read_calibration(interiors, exteriors=False) if interiors else None
    frame = _frame(floor, found)
    with _screen.bars() as step:
        described, seen = find_boards(
            found, described, max_frames=max_frames, include=() if frame is None else (frame,), progress=step
        )
        step("calibrating", 0, 1)
        result = calibrate_board(seen, described, interiors=kept, floor=frame, exteriors=not interiors_only)
        step("calibrating", 1, 1)
    write_calibration(result.rig, out)
    _tell(result)
    _screen.say(f"Written: {out}")


def _frame(floor: str | None, sources: dict) -> int | None:
    """Frame number of "12" or "3.5s"."""
    from kinefit.readers.video import Video

    if floor is None:
        return None
    try:
        if not floor.endswith("s"):
            return int(floor)
        seconds = float(floor[:-1])
    except ValueError:
        raise click.BadParameter(f"'{floor}' is not a frame or time; write 12 or 3.5s", param_hint="--floor") from None
    rates = [0.0]
    for source in sources.values():
        if isinstance(source, dict):
            raise click.BadParameter("images in folders have no times; give a frame number", param_hint="--floor")
        with Video(source) as video:
            rates.append(video.rate)
    return round(seconds * max(rates))


def _tell(result: BoardCalibration) -> None:
    rows = []
    for camera in result.rig:
        report = result.cameras[camera.name]
        rows.append((
            camera.name, f"{camera.matrix[0, 0]:.1f}", f"{report.focal_std_px:.1f}" if report.focal_std_px else "given",
            f"{report.used} of {report.views}", f"{100 * report.coverage:.0f} %", f"{report.rms_px:.2f}",
            f"{report.own_rms_px:.2f}", f"{1e3 * report.position_std:.1f}" if report.position_std < 1e3 else "-",
        ))  # fmt: skip
    heads = ("camera", "focal px", "± px", "views", "image covered", "rms px", "lens alone px", "position ± mm")
    _screen.print_table(heads, rows, title=f"{result.board}")
    for (a, b), distance in result.rig.distances.items() if result.shared else ():
        _screen.say(f"{a} to {b}: {distance:.3f} m, {result.shared.get((a, b), 0)} frames agree")
    if result.jitter[0] > 5e-4:
        shift, turn = 1e3 * result.jitter[0], 57.3 * result.jitter[1]
        _screen.say(
            f"The cameras disagree on the board's pose by {shift:.1f} mm and {turn:.2f} degrees: their clocks differ "
            "while the board moved, or the board is not flat. Hold it still for a moment in each place."
        )
    _screen.say(result.world)
    for line in result.advice:
        _screen.say(f"To improve: {line}")
