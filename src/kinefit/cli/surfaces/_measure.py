"""What `kinefit surface` reads, measures and writes."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular
from kinefit._pictures import read_picture
from kinefit.bodies.motion import Motion
from kinefit.errors import CalibrationError, FileError, ObservationError, TrackingError, shortened
from kinefit.exporters import surface_files
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.photogrammetry.bright_points import BrightPointTracker
from kinefit.images.photogrammetry.intersection import flat_camera
from kinefit.images.photogrammetry.least_squares_matching import MIN_CORRELATION, Grid, Seeds, windows_by_texture
from kinefit.images.photogrammetry.spline_image import SplineImage, grey
from kinefit.images.photogrammetry.surface import (
    MeasuredSurface,
    measure_flat,
    measure_states,
    rigid_motion,
    surface_strain,
)
from kinefit.images.photogrammetry.surface_tracking import SurfaceTracker, SurfaceTracking
from kinefit.images.photogrammetry.trajectories import Trajectories, filtered
from kinefit.observations.clocks import is_even
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.depth.images import natural
from kinefit.readers.motion import read_motion
from kinefit.readers.videos.video import Video, images_in

PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


@dataclass(frozen=True)
class StateImages:
    """Photographs of each camera, one a state; or a video of each."""

    names: tuple[str, ...]
    photographs: tuple[tuple[Path, ...], ...]
    videos: tuple[Path, ...]


def read_views(calibration: Path, unit: str, views: Sequence[str], fewest: int = 2) -> tuple[Rig, StateImages]:
    """Cameras that are named, and their files; a calibration that states no image size has that of the first view.

    Raises
    ------
    ObservationError
        Fewer than `fewest` views, one without a name, photographs mixed with videos, or other numbers of photographs.
    FileError
        A file or folder that is not there or holds no image.
    """
    names, photographs, videos = [], [], []
    for view in views:
        name, sign, path = view.partition("=")
        if not sign or not path:
            raise ObservationError(f"view '{view}' is not CAMERA=PATH", remedy="Write it as left=left.png.")
        place = Path(path)
        names.append(name)
        if place.is_dir() or "*" in place.name:
            files = images_in(place, PHOTOGRAPHS)
            if not files:
                raise FileError("no images here", file=place, remedy="Give a photograph, a folder of them, a video.")
            photographs.append(tuple(files))
        elif place.suffix.lower() in PHOTOGRAPHS:
            photographs.append((place,))
        else:
            videos.append(place)
    if len(names) < fewest or (photographs and videos) or len({len(files) for files in photographs}) > 1:
        counts = ", ".join(str(len(files)) for files in photographs)
        if not names:
            remedy = "Give the calibration first, or --flat with the millimetres of a pixel for one video."
            raise ObservationError("no views", remedy=remedy)
        problem = f"these {len(names)} views do not go together: {len(videos)} videos, photographs: {counts or 'none'}"
        raise ObservationError(problem, remedy="Give at least two views: all videos, or all with as many photographs.")
    if photographs:
        size = read_photograph(photographs[0][0]).shape[1::-1]
    else:
        with Video(videos[0]) as video:
            size = video.size
    metres = float(unit) if _is_number(unit) else unit
    rig = read_calibration(calibration, unit=metres, image_size=size)
    return rig.select(tuple(names)), StateImages(tuple(names), tuple(photographs), tuple(videos))


def read_photograph(path: Path) -> NDArray:
    """An image (H, W) or (H, W, 3) RGB in 0..255: uint8, or float32 of a file with more bits, its brightest pixel 255.

    Raises
    ------
    FileError
        As `read_picture`; values that are not finite, or no light at all in more than eight bits.
    """
    if path.suffix.lower() in (".tif", ".tiff"):  # float is read in no other way
        picture = read_picture(path, cv2.IMREAD_UNCHANGED)
        picture = picture if picture.ndim == 2 else picture[..., 2::-1]
    else:
        picture = read_picture(path, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH)
    if picture.dtype == np.uint8:
        return picture
    brightest = float(picture.max())
    if not 0.0 < brightest < np.inf or picture.min() < 0.0:
        problem = f"grey values range from {picture.min():g} to {brightest:g}"
        raise FileError(problem, file=path, remedy="Give photographs with finite values, 0 for black and not all 0.")
    return np.asarray(picture * np.float32(255.0 / brightest))


def read_seeds(path: Path, views: int) -> list[Seeds]:
    """Seeds from the first camera to each other one, of a CSV file: a row has u and v in every view.

    Raises FileError for a file without points, or with other columns.
    """
    remedy = "Give u and v [px] of each point in every view, as in u1,v1,u2,v2."
    try:
        with regular(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            rows = [(reader.line_num, row) for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"cannot be read: {error}", file=path, remedy="Write numbers separated by commas.") from None
    if rows and not _is_number(rows[0][1][0]):
        rows = rows[1:]
    for line, row in rows:
        bad = next((cell for cell in row if cell.strip() and not _is_number(cell)), None)
        if bad is not None or len(row) != 2 * views:
            problem = f"{len(row)} columns, not {2 * views}" if bad is None else f"'{shortened(bad, 60)}' is no number"
            raise FileError(problem, file=path, place=f"line {line}", remedy=remedy)
    table = np.array([[float(cell) if cell.strip() else np.nan for cell in row] for _, row in rows])
    if not len(table):
        raise FileError("the file has no points", file=path, remedy=remedy)
    return [Seeds.of(table[:, :2], table[:, 2 * k : 2 * k + 2]) for k in range(1, views)]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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
    motion: Path | None = None
    bounds: tuple[float, float] | None = None
    neighbours: bool = False
    bright: int | None = None
    reach: int | None = None

    def tracker(self, rig: Rig, rate: float, motion: Motion | None) -> SurfaceTracker:
        """Tracker of videos: of bright points, or of texture."""
        least = MIN_CORRELATION if self.least is None else self.least
        reach = SurfaceTracking.reach if self.reach is None else self.reach
        settings = SurfaceTracking(window=self.side_of_all(), step=self.step, reach=reach, least=least)
        mask = mask_of(self.mask, self.field)
        if self.bright is not None:
            return BrightPointTracker(rig, rate, settings, mask, diameter=self.bright)
        seeds = None if self.seeds is None else read_seeds(self.seeds, len(rig))
        return SurfaceTracker(rig, rate, settings, mask, seeds, motion)

    def side_of_all(self) -> int:
        """Side of the windows [px], of all; ObservationError for one that is no odd number."""
        if not self.window.isdigit():
            problem = f"--window '{self.window}' is not a number"
            raise ObservationError(problem, remedy="Give an odd number of pixels, or 'texture' with photographs.")
        return int(self.window)

    def side(self, first: SplineImage, second: SplineImage, grid: Grid) -> int | NDArray:
        """Side of the windows [px], of all or of each place."""
        if self.window == "texture":
            return windows_by_texture(first, second, np.nan_to_num(grid.points))
        return self.side_of_all()


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


def measure_photographs(rig: Rig, views: StateImages, wanted: Wanted, progress: Progress) -> list[str]:
    """Measure all states and write them; returns lines about them. Raises ObservationError for a state out of range."""
    rig = with_field(rig, wanted.field)
    count = len(views.photographs[0])
    if wanted.still is not None and wanted.still >= count:
        problem = f"--still {wanted.still} does not exist; there are {count} states"
        raise ObservationError(problem, remedy=f"Give a state from 1 to {count - 1}; state 0 is the reference.")
    states = _States(views.photographs, wanted.field, wanted.smooth)
    first = states[0]
    grid = Grid.of(first[0].size, wanted.step, mask=mask_of(wanted.mask, wanted.field))
    seeds = None if wanted.seeds is None else read_seeds(wanted.seeds, len(rig))
    window = wanted.side(first[0], first[1], grid)
    surfaces = measure_states(
        rig, states, grid, seeds=seeds, window=window, incremental=wanted.incremental, progress=progress,
        least=MIN_CORRELATION if wanted.least is None else wanted.least,
    )  # fmt: skip
    return _write_all(surfaces, views.photographs[0], wanted, int(np.max(window)))


def measure_one_camera(photographs: Sequence[Path], millimetres: float, wanted: Wanted) -> list[str]:
    """Measure a flat surface in photographs of one camera and write it; what to say about it.

    Raises
    ------
    ObservationError
        Fewer than two photographs, views with names of cameras, or --seeds.
    """
    named = [str(p) for p in photographs if p.suffix.lower() not in PHOTOGRAPHS or ("=" in p.name and not p.exists())]
    if named or wanted.seeds is not None or len(photographs) < 2:
        given = ", ".join(named) or ("--seeds" if wanted.seeds else "one photograph")
        problem = f"--flat does not work with {given}"
        raise ObservationError(problem, remedy="Give only photographs of one camera, before and after.")
    as_given, photographs = photographs, in_number_order(photographs)
    states = [spline_of(read_photograph(path), wanted.field, wanted.smooth) for path in photographs]
    grid = Grid.of(states[0].size, wanted.step, mask=mask_of(wanted.mask, wanted.field))
    window = wanted.side(states[0], states[1], grid)
    surfaces = measure_flat(
        states, grid, millimetres / 1e3, window=window, incremental=wanted.incremental,
        least=MIN_CORRELATION if wanted.least is None else wanted.least,
    )  # fmt: skip
    reordered = ["photographs in the order of their numbers, not of the shell's pattern"] * (as_given != photographs)
    return reordered + _write_all(surfaces, photographs, wanted, int(np.max(window)))


def in_number_order(photographs: Sequence[Path]) -> Sequence[Path]:
    """Photographs as given; in the order of their numbers where a shell's pattern puts load_10 before load_2."""
    alike = len({re.sub(r"\d+", "#", str(path)) for path in photographs}) == 1
    by_shell = list(photographs) == sorted(photographs, key=str)
    return sorted(photographs, key=lambda path: natural(str(path))) if alike and by_shell else photographs


def _write_all(
    surfaces: Sequence[MeasuredSurface], photographs: Sequence[Path], wanted: Wanted, window: int
) -> list[str]:
    """Write all states; lines about them."""
    lines = []
    for k, surface in enumerate(surfaces):
        reference = surfaces[max(k - 1, 0) if wanted.incremental else 0] if k else None
        state = _write(surface, reference, _grey(photographs[k], wanted.field), wanted, k, window)
        lines += [f"{state[0]} ({photographs[k].name})", *state[1:]]
    return lines


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
            self._kept[k] = [spline_of(read_photograph(files[k]), self._field, self._smooth) for files in self._files]
        return self._kept[k]


def _grey(path: Path, field: str | None) -> NDArray:
    """Grey values (H, W) of a photograph, or of a field of it."""
    image = np.rint(grey(read_photograph(path))).astype(np.uint8)
    return image if field is None else field_of(image, field)  # type: ignore[arg-type]


def _write(
    surface: MeasuredSurface, reference: MeasuredSurface | None, grey: NDArray, wanted: Wanted, k: int, window: int
) -> list[str]:
    """Write one state; lines about it."""
    out, lines = wanted.out, [_about(surface, k)]
    strain = None
    if reference is not None:
        T, residual = rigid_motion(reference.x_world, surface.x_world)
        rms = 1e3 * float(np.sqrt(np.nanmean(residual**2)))
        middle = np.nanmean(reference.x_world, axis=0)
        moved = 1e3 * float(np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle))
        turned = np.rad2deg(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        lines.append(
            f"   moved by {moved:.3f} mm, turned by {turned:.3f} degrees; residual {rms:.4f} mm RMS per coordinate"
        )
        if wanted.gauge is not None:
            strain = surface_strain(reference, surface, wanted.gauge / 1e3, window)
            levels = {name: 1e6 * value for name, value in strain.rms().items()}
            kind = "noise floor" if k == wanted.still else "strain"
            lines.append(
                f"   {kind} over {1e3 * strain.gauge:.2f} mm, RMS: xx {levels['xx']:.0f}e-6, yy {levels['yy']:.0f}e-6, "
                f"xy {levels['xy']:.0f}e-6"
            )
    columns = surface_files.point_columns(surface, reference, strain, window)
    surface_files.write_points_csv(surface, out / f"points_{k:03d}.csv", columns)
    surface_files.write_surface_vtk(surface, out / f"surface_{k:03d}.vtk", columns)
    std = 1e3 * np.linalg.norm(surface.std, axis=1)
    surface_files.write_field_picture(surface, grey, std, out / f"std_{k:03d}.png", title="std deviation", unit="mm")
    if reference is not None:
        file = out / f"displacement_{k:03d}.png"
        length = 1e3 * np.linalg.norm(surface.x_world - reference.x_world, axis=1)
        surface_files.write_field_picture(surface, grey, length, file, title="displacement", unit="mm")
    if strain is not None:
        for name in ("xx", "yy", "xy"):
            file = out / f"strain_{name}_{k:03d}.png"
            title = f"strain {name}, {1e3 * strain.gauge:.1f} mm"
            values = 1e6 * getattr(strain, name)
            surface_files.write_field_picture(surface, grey, values, file, title=title, unit="1e-6")
    return lines


def _about(surface: MeasuredSurface, k: int) -> str:
    inside, seen = surface.grid.inside.sum(), surface.measured
    if not seen.any():
        return f"state {k}: none of {inside} points matched"
    std = 1e3 * float(np.median(np.linalg.norm(surface.std[seen], axis=1)))
    return (
        f"state {k}: {seen.sum()} of {inside} points, {len(surface.triangles)} triangles; "
        f"standard deviation {std:.4f} mm, "
        f"correlation {np.median(surface.correlation[seen]):.3f}, parallax {np.median(surface.parallax[seen]):.2f} px "
        "(medians)"
    )


def measure_videos(rig: Rig, views: StateImages, wanted: Wanted, progress: Progress) -> list[str]:
    """Track the surface through videos and write its paths; what to say about them.

    Raises
    ------
    ObservationError
        Options that are for photographs, or videos of other rates.
    """
    photographs = {"--gauge": wanted.gauge, "--still": wanted.still, "--incremental": wanted.incremental or None}
    given = [name for name, value in photographs.items() if value is not None]
    if given:
        problem = f"{', '.join(given)} cannot be used with videos"
        raise ObservationError(problem, remedy="Leave them out, or give photographs: states of one surface.")
    rig = with_field(rig, wanted.field)
    motion = None if wanted.motion is None else read_motion(wanted.motion)
    with ExitStack() as opened:
        videos = [opened.enter_context(Video(path)) for path in views.videos]
        if not all(is_even(video.times, videos[0].rate) for video in videos):
            rates = [video.unevenness or f"{video.rate:.6g} Hz" for video in videos]
            listed = ", ".join(f"{name} {rate}" for name, rate in zip(views.names, rates))
            remedy = "Record with synchronised cameras at one constant rate."
            raise ObservationError(f"the videos' frame rates differ or vary: {listed}", remedy=remedy)
        if motion is not None:
            _check_motion(motion, wanted.motion, videos[0].rate)
        count = min(len(video) for video in videos)
        tracker = wanted.tracker(rig, videos[0].rate, motion)
        lines, middle = list[str](), list[SplineImage]()
        for k in range(count):
            images = [spline_of(video.read(k), wanted.field, wanted.smooth) for video in videos]
            try:
                points = tracker.update(images)
            except TrackingError as error:
                lines.append(f"stopped: {error}")
                break
            if k in (0, count // 2, count - 1):
                surface_files.write_point_picture(points.uv[:, 0], images[0].grey, wanted.out / f"points_{k:06d}.png")
            middle = images if k == min(count // 2, max(count - 2, 0)) else middle
            progress("frames", k + 1, count)
    paths = tracker.trajectories()
    speed = float(np.nanpercentile(np.linalg.norm(paths.velocity, axis=2), 99)) if len(paths.times) > 1 else 0.0
    kept, cut = paths, dict[str, int]()
    if len(paths.times) > 2:
        kept, cut = filtered(
            paths, radius=_surroundings(paths), bounds=wanted.bounds, neighbours=wanted.neighbours,
            uniformity=wanted.bright is None,
        )  # fmt: skip
    surface_files.write_paths_csv(kept, wanted.out / "trajectories.csv")
    if kept.live.any():
        for view, (name, image) in enumerate(zip(views.names, middle)):
            surface_files.write_paths_picture(kept, view, image.grey, wanted.out / f"paths_{name}.png")
        at = min(count // 2, count - 2)
        if 0 < at < len(kept.times) - 1:
            surface_files.write_velocity_picture(kept, at, middle[0].grey, wanted.out / "velocity.png")
    if motion is not None:
        surface_files.write_returns_csv(tracker.returns(), motion.rate, wanted.out / "returns.csv")
    live, before = kept.live.sum(axis=1), int(paths.live.any(axis=0).sum())
    lengths = kept.live.sum(axis=0)
    lengths = lengths[lengths > 0] if lengths.any() else np.zeros(1, int)
    count = int(kept.live.any(axis=0).sum())
    about = f"{len(paths.times)} frames: {count} of {before} paths kept, {live.min()} to {live.max()} per frame"
    lines.insert(0, f"{about}, {np.median(lengths):.0f} frames per path (median), speed {speed:.3f} m/s (99 %)")
    if cut:
        lines.insert(1, "points rejected by filters: " + ", ".join(f"{name} {count}" for name, count in cut.items()))
    return lines


def flat_video(path: Path, millimetres: float) -> tuple[Rig, StateImages]:
    """A camera that faces a flat surface, and its video; raises FileError for one that cannot be read."""
    with Video(path) as video:
        camera = flat_camera(video.size, millimetres / 1e3)
    return Rig((camera,)), StateImages((camera.name,), (), (path,))


def _check_motion(motion: Motion, path: Path | None, rate: float) -> None:
    """Refuse a motion of another rate than the videos', or one that does not begin with them."""
    if abs(motion.rate - rate) > 1e-3 * rate or abs(float(motion.times[0])) > 0.5 / rate:
        problem = f"motion of {motion.rate:g} Hz from {motion.times[0]:.3f} s on does not fit videos of {rate:g} Hz"
        remedy = "Give a motion with the videos' rate that starts at 0 s: set rate and frames in its take."
        raise FileError(problem, file=path, place="times", remedy=remedy)


def _surroundings(paths: Trajectories) -> float:
    """[m] about a point within which the surface moves alike: five times the distance of neighbours."""
    x = paths.x_world[0][paths.live[0]]
    gaps = np.linalg.norm(x[:, None] - x[None, :200], axis=2)
    gaps[gaps == 0] = np.inf
    return 5.0 * float(np.median(gaps.min(axis=0)))


Field = Literal["odd", "even"]


def field_of(image: NDArray, field: Field) -> NDArray:
    """Lines of one field of an image (H, W, ...), about half as many; "odd" are the first, third, ... line."""
    return np.ascontiguousarray(image[_first(field) :: 2])


def field_camera(camera: Camera, field: Field) -> Camera:
    """Camera of a field: the same rays with half the pixels in the vertical direction.

    Raises
    ------
    CalibrationError
        The image has a single line.
    """
    width, height = camera.size
    if height < 2:
        raise CalibrationError("an image of one line", place=f"camera {camera.name}", remedy="Give two lines or more.")
    matrix, start = camera.matrix.copy(), _first(field)
    matrix[1, 1] *= 0.5
    matrix[1, 2] = 0.5 * (matrix[1, 2] - start)
    return replace(camera, size=(width, (height - start + 1) // 2), matrix=matrix)


def _first(field: Field) -> int:
    return 0 if field == "odd" else 1
