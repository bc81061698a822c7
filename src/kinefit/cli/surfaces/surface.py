"""`kinefit surface`: two or more photographs or videos of a surface to points, a mesh and strain."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kinefit.cli import _screen

if TYPE_CHECKING:
    from kinefit.cli.surfaces._measure import Wanted


@click.command(short_help="Measure a surface without a body: points, mesh, strain.", epilog="""\b
Examples:
  kinefit surface calib.toml left=left.png right=right.png            points, mesh, standard deviations
  kinefit surface calib.toml 201=states/201 202=states/202 --gauge 5  folders: states of one surface; strain over 5 mm
  kinefit surface calib.toml a=a.mp4 b=b.mp4 --window 21              videos: the surface is tracked
  kinefit surface before.png after.png --flat 0.05 --gauge 5          one camera, a flat plate, 0.05 mm per pixel
  kinefit surface side.mp4 --flat 1.2 --bright 10                     one video; spheres on skin, up to 10 px wide
""")  # fmt: skip
@click.argument("calibration", type=_screen.PATH)
@click.argument("views", nargs=-1, metavar="CAMERA=PATH...")
@click.option("-o", "--out", type=_screen.PATH, default=Path("surface"), help="Output folder.")
@click.option("--unit", default="auto", help="Calibration's unit: m, cm, mm, or metres.  [default: as it states]")
@click.option("--window", default="13", show_default=True, help="Side of the matched windows [px], odd; or 'texture'.")
@click.option("--step", type=click.IntRange(1), default=6, show_default=True, help="Grid spacing [px].")
@click.option("--mask", type=_screen.PATH, help="PNG mask of the first image, black outside the surface.")
@click.option(
    "--seeds", type=_screen.PATH,
    help="CSV of known points: u and v in each camera, in the order of the views.  [default: found automatically]",
)  # fmt: skip
@click.option("--least", type=click.FloatRange(0, 1), help="Smallest correlation of a match.  [default: 0.8]")
@click.option("--gauge", type=click.FloatRange(min=0, min_open=True), help="Gauge length of the strain [mm].")
@click.option("--incremental", is_flag=True, help="Refer each state to the previous state, not to the first.")
@click.option("--still", type=click.IntRange(1), help="State without motion: its strain is the noise floor.")
@click.option("--smooth", type=click.FloatRange(0, 5), default=0.0, help="Gaussian blur [px], for aliased texture.")
@click.option(
    "--flat", type=click.FloatRange(min=0, min_open=True), metavar="MM",
    help="One camera that faces a flat surface; MM is the width of a pixel on it, in mm.",
)  # fmt: skip
@click.option(
    "--motion", type=_screen.PATH,
    help="Videos: motion.npz, or its folder, of the body in view; it predicts where lost points reappear.",
)  # fmt: skip
@click.option(
    "--bounds", type=(float, float), metavar="M/S M/S²",
    help="Videos: largest speed and acceleration of a path; a path ends where it exceeds them.",
)  # fmt: skip
@click.option(
    "--bright", type=click.IntRange(3), metavar="PX",
    help="Videos: track bright points (retroreflective spheres), at most PX wide, by their centroids.",
)  # fmt: skip
@click.option("--reach", type=click.IntRange(1), metavar="PX", help="Videos: half side of search boxes.  [default: 8]")
@click.option("--neighbours", is_flag=True, help="Videos: also reject points whose neighbours were rejected.")
@click.option("--field", type=click.Choice(["odd", "even"]), help="Interlaced images: use only these lines.")
@_screen.verbose_option
@_screen.gathered(
    "wanted", "kinefit.cli.surfaces._measure:Wanted",
    "out", "window", "step", "mask", "seeds", "least", "gauge", "incremental", "still", "smooth", "motion", "bounds",
    "bright", "reach", "neighbours", "field",
)  # fmt: skip
def surface(
    calibration: Path, views: tuple[str, ...], unit: str, flat: float | None, wanted: Wanted
) -> None:  # fmt: skip
    """Measure a surface with two or more cameras: points with standard deviations, mesh, displacement, strain.

    CALIBRATION is any calibration file that kinefit reads. Each CAMERA=PATH gives one of its cameras with its
    photograph, its folder of photographs (states, in the order of their names) or its video. The grid of points lies on
    the first image of the first camera.

    With --flat there is no calibration: all arguments are photographs, before and after, or there is one video. With
    --motion one camera is enough: its points lie on the body.
    """
    from kinefit.cli.surfaces import _measure
    from kinefit.errors import ObservationError

    _screen.check_folder(wanted.out)
    videos_alone = ("motion", "bounds", "bright", "reach", "neighbours")
    of_videos = [f"--{name}" for name in videos_alone if _screen.is_stated(name)]
    for name in ("motion", "seeds", "least", "window", "step"):
        if _screen.is_stated(name) and wanted.bright is not None:
            raise ObservationError(f"--{name} needs texture, --bright has none", remedy="Leave out one of them.")
    one_video = flat is not None and not views and calibration.suffix.lower() not in _measure.PHOTOGRAPHS
    if one_video and (wanted.motion or wanted.seeds) is not None:
        raise ObservationError("--motion and --seeds need a calibration", remedy="Leave them out, or leave out --flat.")
    if of_videos and flat is not None and not one_video:
        raise ObservationError(f"{of_videos[0]} needs videos; --flat has photographs", remedy="Leave out one of them.")
    if flat is not None and not one_video:
        lines = _measure.measure_one_camera([calibration, *map(Path, views)], flat, wanted)
    else:
        if one_video:
            rig, paths = _measure.flat_video(calibration, flat or 0.0)
        else:
            rig, paths = _measure.read_views(calibration, unit, views, 1 if wanted.motion is not None else 2)
        if of_videos and not paths.videos:
            problem = f"{of_videos[0]} needs videos; the views are photographs"
            raise ObservationError(problem, remedy="Leave it out, or give videos.")
        with _screen.bars() as progress:
            measure = _measure.measure_videos if paths.videos else _measure.measure_photographs
            lines = measure(rig, paths, wanted, progress)
    for line in lines:
        _screen.say(line)
    _screen.say(f"\nWritten: {wanted.out}")
