"""`kinefit calibrate`: cameras from a board, from a bar with two targets, or from the people in view."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kinefit.cli import _screen
from kinefit.cli._screen import CommandGroup

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from kinefit.rigs.bar.calibrate import BarCalibration
    from kinefit.rigs.bar.targets import BarViews
    from kinefit.rigs.board.calibrate import BoardCalibration

_EXAMPLES = """\b
Examples:
  kinefit calibrate board videos/ --board charuco:5x7:0.04:0.03 --floor 12
  kinefit calibrate board left.mp4 right.mp4 --board checkerboard:9x6:0.025 -o stereo.toml
  kinefit calibrate board pictures/ --board checkerboard:9x6:0.025 --interiors-only
  kinefit calibrate board videos/ --board charuco:5x7:0.04:0.03:5X5_100 --interiors lenses.toml
  kinefit calibrate bar videos/ --length 0.9
"""


@click.group(
    cls=CommandGroup, epilog=_EXAMPLES, short_help="Calibrate cameras with a board, a bar, or from people in view."
)
def calibrate() -> None:
    """Calibrate cameras: with a board in view, with a bar that is waved, or from the people in view alone."""


@calibrate.command(short_help="Intrinsics and extrinsics from a checkerboard or ChArUco board.", epilog=_EXAMPLES)
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
    from kinefit.readers.calibration.read import read_calibration, write_calibration
    from kinefit.rigs.board.calibrate import calibrate_board
    from kinefit.rigs.board.detection import Board
    from kinefit.rigs.board.sources import camera_sources, find_boards

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
    from kinefit.readers.videos.video import Video

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


_RESIDUAL_SCALE = 200  # a residual of 0.1 px is drawn 20 px long


def _length(length: float, length_sigma: float | None) -> tuple[float, float]:
    """Length of a bar and its standard deviation [m], checked."""
    from kinefit.rigs.bar.calibrate import LENGTH_SIGMA, check_bar

    sigma = LENGTH_SIGMA if length_sigma is None else length_sigma
    check_bar(length, sigma)
    return length, sigma


@calibrate.command(short_help="Intrinsics, poses and scale from a bar with two targets.", epilog="""\b
Examples:
  kinefit calibrate bar videos/ --length 0.9
  kinefit calibrate bar left.mp4 right.mp4 --length 0.5 --floor 12,80 -o room.toml
  kinefit calibrate bar centroids.csv --length 0.9 --size 1920x1080
  kinefit calibrate bar videos/ --length 0.9 --interiors lenses.toml --distance cam01:cam03:4.21
""")  # fmt: skip
@click.argument("sources", nargs=-1, required=True, type=_screen.PATH, metavar="VIDEO_FOLDER_OR_CSV...")
@click.option("--length", type=float, required=True, metavar="M", help="Distance of the targets' centres.")
@click.option("--length-sigma", type=float, metavar="M", help="Standard deviation of the length.  [default: 0.0001]")
@click.option("-o", "--out", type=_screen.PATH, default=Path("calibration.toml"), show_default=True,
              help="File to write, Pose2Sim TOML; with it a table of parameters and an image of the coverage.")
@click.option("--interiors", type=_screen.PATH, metavar="FILE", help="Calibration with the intrinsics.")
@click.option("--floor", metavar="FRAMES", help="Frames in which the bar lies on the floor, in two directions: 12,80.")
@click.option("--distance", metavar="A:B:M", help="Measured distance between the lenses of two cameras, as a check.")
@click.option("--size", metavar="WxH", help="Image size for the centroids of a CSV file.")
@click.option("--max-frames", type=click.IntRange(12), default=400, show_default=True,
              help="Frames of each camera to search, spread over the recording.")
@click.option("--overwrite", is_flag=True, help="Overwrite an existing OUT.")
@_screen.verbose_option
@_screen.gathered("length", _length, "length", "length_sigma")
@_screen.gathered("images", dict, "size", "max_frames")
def bar(
    sources: tuple[Path, ...], length: tuple[float, float], out: Path, interiors: Path | None, floor: str | None,
    distance: str | None, images: dict[str, Any], overwrite: bool,
) -> None:
    """Intrinsics, camera poses and scale from a bar with two bright targets, waved through the volume.

    Give a video for each camera, named like the camera, or folders of images. The videos must be synchronised: equal
    frame numbers mean equal times. Or give a CSV file of centroids: camera,frame,u,v, with two rows for each image.
    """
    from kinefit.readers.calibration.read import read_calibration, write_calibration
    from kinefit.rigs.bar.calibrate import calibrate_bar

    on_floor, known = _frames(floor), _distance(distance)
    written = [out, out.with_suffix(".csv"), out.with_suffix(".png")]
    for file in written:
        _screen.check_new(file, overwrite)
    kept = read_calibration(interiors, exteriors=False) if interiors else None
    with _screen.bars() as step:
        seen = _seen(sources, kept, on_floor, step, **images)
        step("calibrating", 0, 1)
        result = calibrate_bar(
            seen, length[0], interiors=kept, floor=on_floor, known_distance=known, length_sigma=length[1],
        )  # fmt: skip
        step("calibrating", 1, 1)
    write_calibration(result.rig, out)
    _write_table(result, written[1])
    _write_picture(result, written[2])
    _tell_bar(result, known is not None)
    _screen.say(f"Written: {out}, {written[1].name} (all parameters), {written[2].name} (coverage)")


def _seen(
    sources: tuple[Path, ...], kept: object, include: tuple[int, ...], step: _screen.Step, *, size: str | None,
    max_frames: int,
) -> dict[str, BarViews]:
    from kinefit.geometry.camera import Rig
    from kinefit.rigs.bar.calibrate import check_cameras
    from kinefit.rigs.bar.targets import find_bars, read_centroids
    from kinefit.rigs.board.sources import camera_sources

    if not any(path.suffix.lower() == ".csv" for path in sources):
        if size is not None:
            raise click.BadParameter("use it only with a CSV file of centroids", param_hint="--size")
        views = camera_sources(sources)
        check_cameras(views)
        return find_bars(views, max_frames=max_frames, include=include, progress=step)
    if len(sources) > 1:
        raise click.BadParameter("give one CSV file that holds all cameras", param_hint="VIDEO_FOLDER_OR_CSV")
    if size is not None:
        given = re.fullmatch(r"(\d+)[xX](\d+)", size)
        if given is None:
            raise click.BadParameter(f"'{size}' is not an image size; write it as 1920x1080", param_hint="--size")
        return read_centroids(sources[0], (int(given[1]), int(given[2])))
    if not isinstance(kept, Rig):
        problem = "a CSV file needs the image size: give 1920x1080, or --interiors"
        raise click.BadParameter(problem, param_hint="--size")
    return read_centroids(sources[0], {camera.name: camera.size for camera in kept})


def _frames(floor: str | None) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in floor.split(",")) if floor else ()
    except ValueError:
        raise click.BadParameter(f"'{floor}' is not two frames; write them as 12,80", param_hint="--floor") from None


def _distance(text: str | None) -> tuple[str, str, float] | None:
    if text is None:
        return None
    try:
        a, b, metres = text.rsplit(":", 2)
        return a, b, float(metres)
    except ValueError:
        raise click.BadParameter(f"'{text}' is not A:B:M; write cam01:cam03:4.21", param_hint="--distance") from None


def _write_table(result: BarCalibration, file: Path) -> None:
    """A row a parameter: camera, name, value, standard deviation, what it rests on."""
    from kinefit._files import write_rows

    rows: list[tuple[str, ...]] = [("camera", "parameter", "unit", "value", "std", "from")]
    for name, report in result.cameras.items():
        for parameter, value, std in zip(report.names, report.values, report.std):
            unit = "px" if parameter in ("fx", "fy", "cx", "cy") else "m" if parameter in "xyz" else ""
            unit = "rad" if parameter in ("rx", "ry", "rz") else unit
            origin = "given" if not std else "assumption" if parameter in report.assumed else "recording"
            rows.append((name, parameter, unit, f"{value:.9g}", f"{std:.4g}", origin))
    write_rows(file, rows)


def _write_picture(result: BarCalibration, file: Path) -> None:
    """Where in each image targets were, and what is left of them, magnified."""
    import cv2
    import numpy as np

    from kinefit._files import write_image

    panels = []
    for c, camera in enumerate(result.rig):
        scale = 640 / camera.size[0]
        panel = np.full((round(camera.size[1] * scale), 640, 3), 32, np.uint8)
        uv, left = (a[:, c].reshape(-1, 2) for a in (result.uv, result.residuals))
        fine = np.isfinite(left).all(axis=1)
        for at, off in zip(scale * uv[fine], scale * _RESIDUAL_SCALE * left[fine]):
            cv2.line(panel, _at(at), _at(at + off), (60, 140, 255), 1, cv2.LINE_AA)
            cv2.circle(panel, _at(at), 2, (90, 240, 255), -1, cv2.LINE_AA)
        report = result.cameras[camera.name]
        title = f"{camera.name}: {report.used} points, {report.rms_px:.2f} px, residuals x {_RESIDUAL_SCALE}"
        panels.append(_titled(panel, title))
    height = max(len(panel) for panel in panels)
    panels = [np.pad(panel, ((0, height - len(panel)), (4, 4), (0, 0))) for panel in panels]
    columns = min(len(panels), 2 if len(panels) < 5 else 3)
    panels += [np.zeros_like(panels[0])] * (-len(panels) % columns)
    picture = np.vstack([np.hstack(panels[k : k + columns]) for k in range(0, len(panels), columns)])
    write_image(file, picture)


def _titled(panel: NDArray, text: str) -> NDArray:
    import cv2
    import numpy as np

    out = np.vstack([np.zeros((28, panel.shape[1], 3), np.uint8), panel])
    cv2.putText(out, text, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (230, 230, 230), 1, cv2.LINE_AA)
    return out


def _at(uv: NDArray) -> tuple[int, int]:
    return round(float(uv[0])), round(float(uv[1]))


def _tell_bar(result: BarCalibration, checked: bool) -> None:
    rows = []
    for camera in result.rig:
        report = result.cameras[camera.name]
        lens = report.std_of("fx") > 0
        place = 1e3 * sum(report.std_of(axis) ** 2 for axis in "xyz") ** 0.5
        rows.append((
            camera.name, f"{camera.matrix[0, 0]:.1f}", f"{report.std_of('fx'):.2f}" if lens else "given",
            f"{max(report.std_of('cx'), report.std_of('cy')):.2f}" if lens else "given",
            f"{report.used} of {report.places}",
            f"{100 * report.coverage:.0f} %", f"{report.rms_px:.3f}", f"{place:.1f}",
        ))  # fmt: skip
    heads = ("camera", "focal px", "± px", "centre ± px", "bars", "image covered", "rms px", "position ± mm")
    _screen.print_table(heads, rows, title=f"bar of {result.length:g} m")
    _screen.say(
        f"Target detection: sigma {result.sigma_px:.3f} px. Bar length: scatter {1e3 * result.scatter:.2f} mm over "
        f"{len(result.frames)} frames. Rejected: {result.left_out} outliers, {result.ambiguous} in which the two "
        "targets cannot be distinguished."
    )
    for (a, b), distance in result.rig.distances.items():
        _screen.say(f"{a} to {b}: {distance:.4f} m")
    _screen.say(result.world)
    for line in result.advice:
        _screen.say(f"To improve: {line}")
    if not checked:
        _screen.say(
            "The scale follows from --length and was not checked: a length that is 1 % too long makes everything 1 % "
            "too large. Measure the distance between two lenses with a tape, and give it with --distance."
        )


@calibrate.command(short_help="Estimate camera poses from the people in view.", epilog="""\b
Examples:
  kinefit calibrate people take.toml --height 1.78
  kinefit calibrate people take.toml --focal --time-offsets -o cameras.toml
""")  # fmt: skip
@click.argument("take", type=_screen.PATH)
@click.option("-o", "--out", type=_screen.PATH, help="File to write.  [default: TAKE-people.toml]")
@click.option(
    "--height", type=_screen.HEIGHT, metavar="M",
    help="Stature of the person, which sets the scale.  [default: the take's]",
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
    from kinefit.readers.calibration.read import write_calibration
    from kinefit.readers.take.file import find_take, read_take
    from kinefit.rigs.people.calibrate import calibrate_people
    from kinefit.takes.preparing.take import with_detections
    from kinefit.takes.track import load_keypoints

    take = find_take(take, wanted=("calibrate", "people"))
    out = out or take.with_name(f"{take.stem}-people.toml")
    _screen.check_new(out, remedy="Give another file with --out.")
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
