"""What `kinefit surface` reads, measures and writes."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._pictures import read_picture
from kinefit.errors import FileError, ObservationError, TrackingError, shortened
from kinefit.exporters.surface_files import (
    point_columns,
    write_field_picture,
    write_paths_csv,
    write_point_picture,
    write_points_csv,
    write_surface_vtk,
)
from kinefit.geometry.camera import Rig
from kinefit.photogrammetry.fields import field_camera, field_of
from kinefit.photogrammetry.flat import measure_flat
from kinefit.photogrammetry.least_squares_matching import windows_by_texture
from kinefit.photogrammetry.region_growing import LEAST_CORRELATION, Grid, Seeds
from kinefit.photogrammetry.spline_image import SplineImage
from kinefit.photogrammetry.states import measure_states, rigid_motion, surface_strain
from kinefit.photogrammetry.surface import Surface
from kinefit.photogrammetry.surface_tracking import SurfaceTracker, SurfaceTracking
from kinefit.photogrammetry.trajectories import Trajectories, uniform
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.image_folders import images_in
from kinefit.readers.video import Video, check_rates

_PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Wanted:
    """Options of the command."""

    out: Path
    window: str
    step: int
    mask: Path | None
    seeds: Path | None
    least: float | None
    gauge: float | None
    incremental: bool
    still: int | None
    field: str | None
    smooth: float

    def side_of_all(self) -> int:
        """Side of the windows [px], of all."""
        if not self.window.isdigit():
            problem = f"a window of '{self.window}'"
            raise ObservationError(problem, remedy="Give an odd number of pixels; or 'texture' for photographs.")
        return int(self.window)

    def side(self, first: SplineImage, second: SplineImage, grid: Grid) -> int | NDArray:
        """Side of the windows [px], of all or of each place."""
        if self.window == "texture":
            return windows_by_texture(first, second, np.nan_to_num(grid.points))
        return self.side_of_all()


@dataclass(frozen=True)
class Views:
    """Photographs of each camera, one a state; or a video of each."""

    names: tuple[str, ...]
    photographs: tuple[tuple[Path, ...], ...]
    videos: tuple[Path, ...]


def read_views(calibration: Path, unit: str, views: Sequence[str]) -> tuple[Rig, Views]:
    """Cameras that are named, and their files; a calibration that states no image size has that of the first view.

    Raises
    ------
    ObservationError
        Fewer than two views, one without a name, photographs beside videos, or other numbers of photographs.
    FileError
        A file or folder that is not there or holds no image.
    """
    names, photographs, videos = [], [], []
    for view in views:
        name, sign, path = view.partition("=")
        if not sign or not path:
            raise ObservationError(f"a view '{view}'", remedy="Write CAMERA=PATH, with the camera's name.")
        place = Path(path)
        names.append(name)
        if place.is_dir() or "*" in place.name:
            files = images_in(place)
            if not files:
                raise FileError("no images here", file=place, remedy="Name a photograph, a folder of them, or a video.")
            photographs.append(tuple(files))
        elif place.suffix.lower() in _PHOTOGRAPHS:
            photographs.append((place,))
        else:
            videos.append(place)
    if len(names) < 2 or (photographs and videos) or len({len(files) for files in photographs}) > 1:
        counts = ", ".join(str(len(files)) for files in photographs)
        problem = f"{len(names)} views: {len(videos)} videos, photographs: {counts or 'none'}"
        raise ObservationError(problem, remedy="Give two views or more, all videos or all with as many photographs.")
    if photographs:
        size = read_picture(photographs[0][0]).shape[1::-1]
    else:
        with Video(videos[0]) as video:
            size = video.size
    metres = float(unit) if _is_number(unit) else unit
    rig = read_calibration(calibration, unit=metres, image_size=size)
    return rig.select(tuple(names)), Views(tuple(names), tuple(photographs), tuple(videos))


def read_seeds(path: Path, views: int) -> list[Seeds]:
    """Seeds from the first camera to each other one, of a CSV file: a row has u and v in every view."""
    remedy = "Give u and v [px] of each point in every view: u1,v1,u2,v2."
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            rows = [(reader.line_num, row) for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"cannot be read: {error}", file=path, remedy="Write numbers, separated by commas.") from None
    if rows and not _is_number(rows[0][1][0]):
        rows = rows[1:]
    for line, row in rows:
        bad = next((cell for cell in row if cell.strip() and not _is_number(cell)), None)
        if bad is not None or len(row) != 2 * views:
            problem = f"{len(row)} columns for {views} views" if bad is None else f"'{shortened(bad, 60)}' is no number"
            raise FileError(problem, file=path, place=f"line {line}", remedy=remedy)
    table = np.array([[float(cell) if cell.strip() else np.nan for cell in row] for _, row in rows])
    if not len(table):
        raise FileError("no points in it", file=path, remedy=remedy)
    return [Seeds.of(table[:, :2], table[:, 2 * k : 2 * k + 2]) for k in range(1, views)]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def with_field(rig: Rig, field: str | None) -> Rig:
    """Cameras of a field of interlaced images."""
    return rig if field is None else Rig(tuple(field_camera(camera, field) for camera in rig))  # type: ignore[arg-type]


def spline_of(image: NDArray, field: str | None, smooth: float) -> SplineImage:
    """An image, or a field of it, smoothed by [px]."""
    return SplineImage.of(image if field is None else field_of(image, field), smooth=smooth)  # type: ignore[arg-type]


def mask_of(path: Path | None, field: str | None) -> NDArray | None:
    """Where points are wanted (H, W)."""
    if path is None:
        return None
    mask = read_picture(path).max(axis=2) > 0
    return mask if field is None else field_of(mask, field)  # type: ignore[arg-type]


def measure_photographs(rig: Rig, views: Views, wanted: Wanted, progress: Progress) -> list[str]:
    """Measure all states and write them; what to say about them."""
    rig = with_field(rig, wanted.field)
    count = len(views.photographs[0])
    if wanted.still is not None and wanted.still >= count:
        raise ObservationError(f"state {wanted.still} of {count}", remedy="The first is 0; --still names another one.")
    states = _States(views.photographs, wanted.field, wanted.smooth)
    first = states[0]
    grid = Grid.of(first[0].size, wanted.step, mask=mask_of(wanted.mask, wanted.field))
    seeds = None if wanted.seeds is None else read_seeds(wanted.seeds, len(rig))
    window = wanted.side(first[0], first[1], grid)
    surfaces = measure_states(
        rig, states, grid, seeds=seeds, window=window, incremental=wanted.incremental, progress=progress,
        least=LEAST_CORRELATION if wanted.least is None else wanted.least,
    )  # fmt: skip
    return _write_all(surfaces, views.photographs[0], wanted, int(np.max(window)))


def measure_one_camera(photographs: Sequence[Path], millimetres: float, wanted: Wanted) -> list[str]:
    """Measure a flat surface in photographs of one camera and write it; what to say about it.

    Raises
    ------
    ObservationError
        Fewer than two photographs, views with names of cameras, or --seeds.
    """
    named = [str(p) for p in photographs if p.suffix.lower() not in _PHOTOGRAPHS or ("=" in p.name and not p.exists())]
    if named or wanted.seeds is not None or len(photographs) < 2:
        problem = f"--flat with {', '.join(named) or ('--seeds' if wanted.seeds else 'one photograph')}"
        raise ObservationError(problem, remedy="Name photographs of one camera, before and after, and nothing else.")
    states = [spline_of(read_picture(path), wanted.field, wanted.smooth) for path in photographs]
    grid = Grid.of(states[0].size, wanted.step, mask=mask_of(wanted.mask, wanted.field))
    window = wanted.side(states[0], states[1], grid)
    surfaces = measure_flat(
        states, grid, millimetres / 1e3, window=window, incremental=wanted.incremental,
        least=LEAST_CORRELATION if wanted.least is None else wanted.least,
    )  # fmt: skip
    return _write_all(surfaces, photographs, wanted, int(np.max(window)))


def _write_all(surfaces: Sequence[Surface], photographs: Sequence[Path], wanted: Wanted, window: int) -> list[str]:
    """Write all states; lines about them."""
    told = []
    for k, surface in enumerate(surfaces):
        reference = surfaces[max(k - 1, 0) if wanted.incremental else 0] if k else None
        told += _write(surface, reference, _grey(photographs[k], wanted.field), wanted, k, window)
    return told


class _States(Sequence[list[SplineImage]]):
    """Images of all cameras in each state, read when they are asked for: the first and the latest are kept."""

    def __init__(self, photographs: tuple[tuple[Path, ...], ...], field: str | None, smooth: float) -> None:
        self._files, self._field, self._smooth = photographs, field, smooth
        self._kept = dict[int, list[SplineImage]]()

    def __len__(self) -> int:
        return len(self._files[0])

    def __getitem__(self, k: Any) -> Any:
        if k not in self._kept:
            self._kept = {j: images for j, images in self._kept.items() if j == 0}
            self._kept[k] = [spline_of(read_picture(files[k]), self._field, self._smooth) for files in self._files]
        return self._kept[k]


def _grey(path: Path, field: str | None) -> NDArray:
    """Grey values (H, W) of a photograph, or of a field of it."""
    image = cv2.cvtColor(read_picture(path), cv2.COLOR_RGB2GRAY)
    return image if field is None else field_of(image, field)  # type: ignore[arg-type]


def _write(
    surface: Surface, reference: Surface | None, grey: NDArray, wanted: Wanted, k: int, window: int
) -> list[str]:
    """Write one state; lines about it."""
    out, told = wanted.out, [_about(surface, k)]
    strain = None
    if reference is not None:
        T, residual = rigid_motion(reference.x_world, surface.x_world)
        rms = 1e3 * float(np.sqrt(np.nanmean(residual**2)))
        middle = np.nanmean(reference.x_world, axis=0)
        moved = 1e3 * float(np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle))
        turned = np.rad2deg(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        told.append(
            f"   moved by {moved:.3f} mm, turned by {turned:.3f} degrees; the rest {rms:.4f} mm RMS a coordinate"
        )
        if wanted.gauge is not None:
            strain = surface_strain(reference, surface, wanted.gauge / 1e3, window)
            levels = {name: 1e6 * value for name, value in strain.rms().items()}
            kind = "noise floor" if k == wanted.still else "strain"
            told.append(
                f"   {kind} over {1e3 * strain.gauge:.2f} mm, RMS: xx {levels['xx']:.0f}e-6, yy {levels['yy']:.0f}e-6, "
                f"xy {levels['xy']:.0f}e-6"
            )
    columns = point_columns(surface, reference, strain)
    write_points_csv(surface, out / f"points_{k:03d}.csv", columns)
    write_surface_vtk(surface, out / f"surface_{k:03d}.vtk", columns)
    std = 1e3 * np.linalg.norm(surface.std, axis=1)
    write_field_picture(surface, grey, std, out / f"std_{k:03d}.png", title="std deviation", unit="mm")
    if reference is not None:
        file = out / f"displacement_{k:03d}.png"
        length = 1e3 * np.linalg.norm(surface.x_world - reference.x_world, axis=1)
        write_field_picture(surface, grey, length, file, title="displacement", unit="mm")
    if strain is not None:
        for name in ("xx", "yy", "xy"):
            file = out / f"strain_{name}_{k:03d}.png"
            title = f"strain {name}, {1e3 * strain.gauge:.1f} mm"
            write_field_picture(surface, grey, 1e6 * getattr(strain, name), file, title=title, unit="1e-6")
    return told


def _about(surface: Surface, k: int) -> str:
    inside, seen = surface.grid.inside.sum(), surface.measured
    if not seen.any():
        return f"state {k}: none of {inside} points found"
    std = 1e3 * float(np.median(np.linalg.norm(surface.std[seen], axis=1)))
    return (
        f"state {k}: {seen.sum()} of {inside} points, {len(surface.triangles)} triangles; "
        f"standard deviation {std:.4f} mm, "
        f"correlation {np.median(surface.correlation[seen]):.3f}, parallax {np.median(surface.parallax[seen]):.2f} px "
        "(medians)"
    )


def measure_videos(rig: Rig, views: Views, wanted: Wanted, progress: Progress) -> list[str]:
    """Track the surface through videos and write its paths; what to say about them.

    Raises
    ------
    ObservationError
        Options that are for photographs, or videos of other rates.
    """
    photographs = {"--gauge": wanted.gauge, "--still": wanted.still, "--incremental": wanted.incremental or None}
    given = [name for name, value in photographs.items() if value is not None]
    if given:
        problem = f"{', '.join(given)} with videos"
        raise ObservationError(problem, remedy="These are for photographs: states of one surface.")
    rig = with_field(rig, wanted.field)
    with ExitStack() as opened:
        videos = [opened.enter_context(Video(path)) for path in views.videos]
        check_rates({name: video.rate for name, video in zip(views.names, videos)})
        count = min(len(video) for video in videos)
        settings = SurfaceTracking(
            window=wanted.side_of_all(), step=wanted.step,
            least=LEAST_CORRELATION if wanted.least is None else wanted.least,
        )  # fmt: skip
        seeds = None if wanted.seeds is None else read_seeds(wanted.seeds, len(rig))
        tracker = SurfaceTracker(rig, videos[0].rate, settings, mask_of(wanted.mask, wanted.field), seeds)
        told = []
        for k in range(count):
            images = [spline_of(video.read(k), wanted.field, wanted.smooth) for video in videos]
            try:
                points = tracker.update(images)
            except TrackingError as error:
                told.append(f"stopped: {error}")
                break
            if k in (0, count // 2, count - 1):
                write_point_picture(points.uv[:, 0], images[0].grey, wanted.out / f"points_{k:06d}.png")
            progress("frames", k + 1, count)
    paths = tracker.trajectories()
    speed = float(np.nanpercentile(np.linalg.norm(paths.velocity, axis=2), 99)) if len(paths.times) > 1 else 0.0
    kept = paths.kept(uniform(paths, radius=_surroundings(paths))) if len(paths.times) > 2 else paths
    write_paths_csv(kept, wanted.out / "trajectories.csv")
    live, before = kept.live.sum(axis=1), int(paths.live.any(axis=0).sum())
    lengths = kept.live.sum(axis=0)
    lengths = lengths[lengths > 0]
    about = f"{len(paths.times)} frames: {len(lengths)} of {before} paths kept, {live.min()} to {live.max()} a frame"
    told.insert(0, f"{about}, {np.median(lengths):.0f} frames a path (median), speed {speed:.3f} m/s (99 %)")
    return told


def _surroundings(paths: Trajectories) -> float:
    """[m] about a point within which the surface moves alike: five times the distance of neighbours."""
    x = paths.x_world[0][paths.live[0]]
    gaps = np.linalg.norm(x[:, None] - x[None, :200], axis=2)
    gaps[gaps == 0] = np.inf
    return 5.0 * float(np.median(gaps.min(axis=0)))
