"""Read depth recordings of all common formats: `DepthVideo`, or `CloudVideo` for unorganised points."""

from __future__ import annotations

import builtins
import re
from collections.abc import Callable
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked, renamed
from kinefit._files import read_text
from kinefit.errors import FileError, ObservationError, names_file
from kinefit.observations.clocks import counted_times, frames_by_name
from kinefit.observations.videos import CloudVideo, DepthVideo
from kinefit.readers.depth import clouds, images
from kinefit.readers.depth.streams import bag_source, track_source
from kinefit.readers.ros.images import mcap_source
from kinefit.readers.ros.recordings import inside

FORMATS = (
    "a folder of 16-bit PNG or TIFF, of .npy, of raw 16-bit files or of organised PCD clouds; .npz; Azure Kinect .mkv; "
    "RealSense .bag; .mcap of ROS 2"
)
_MIN_MEDIAN_DEPTH = 0.1  # [m] no sensor measures nearer
_MAX_MEDIAN_DEPTH = 30.0  # [m] no sensor shows a person farther away
_PERSON_DISTANCES = (0.4, 6.0)  # [m] typical range in front of a depth sensor
_COUNT_UNITS = (1.0, 0.001, 0.01, 0.000125, 0.0001, 0.0002, 0.00025)  # [m] of sensors and data sets
_DEFAULT_RATE = 30.0  # [Hz] of nearly every depth camera
_TUM_LISTS = ("depth.txt", "associations.txt", "associate.txt", "assoc.txt")
_MIN_SHARE_OF_EIGHT = 0.6  # of the different counts: by chance an eighth
_MIN_DIFFERENT_COUNTS = 15  # of an image, so that their multiples are no chance
_MAX_ROUGHNESS = 0.1  # of a depth: median difference of neighbouring pixels; of depth cameras below 0.02
_MAX_MULTIPLE_ERROR = 0.1  # of the stated rate to that of the times in names: a whole number


@renamed(usual_rate="default_rate")
@checked
@names_file
def read_depth(
    path: str | PathLike[str],
    *,
    sensor: str | None = None,
    unit: float | None = None,
    rate: float | None = None,
    default_rate: float | None = _DEFAULT_RATE,
    size: tuple[int, int] | None = None,
    range: tuple[float, float] = (0.0, np.inf),
    time_unit: float | None = None,
    time_offset: float = 0.0,
) -> DepthVideo:
    """Read depth images; each frame is loaded on demand.

    Parameters
    ----------
    path : file, folder or pattern (frames/depth_*.png)
        16-bit PNG or TIFF (float TIFF: metres), raw little-endian 16-bit files (or float16, float32 in metres), .npy of
        one image a file, .npz (`depth` (F, H, W), optional
        `times` [s], `unit` [m], `rate` [Hz]), organised PCD, Azure Kinect .mkv, RealSense .bag, .mcap of ROS 2, with
        the topic as a part of the path if several have depth (session.mcap/front/depth/image_raw). Files are taken
        in the order of the numbers in their names.
    sensor : str, optional
        Name of the sensor's camera; default: the name of the file or folder.
    unit : float [m], optional
        Of one count; default: as the file states, else 0.001 for whole numbers and 1 for float.
    rate : float [Hz], optional
        Default: as the file states or its times give.
    default_rate : float [Hz] or None
        For files without rate and times; None raises.
    size : (width, height) [px], of raw files.
    range : (near, far) [m]
        Measurements outside of it are discarded.
    time_unit : float [s], optional
        Unit of the last number in every file's name, if that is a time. Default: seconds since 1970, dates and decimal
        seconds in the names are times; other numbers count frames at `rate`, also where they step by more than one.
    time_offset : float [s]
        Time of the first frame in the take.

    Raises
    ------
    FileError
        Missing, damaged, of another format, or its library is not installed.
    ObservationError
        A wrong unit, no depth at all or none in `range`, times that do not increase, or a size that does not fit.
    """
    path = Path(path)
    name = sensor or path.stem
    source = _source(path, name, size, unit)
    times, rate, said = _times(source, rate, default_rate, time_unit, time_offset, "depth images")
    notes = [*source.notes, *said]
    if unit is None and source.unit == 0.001 and not source.stated:
        likely, why = _unit_of_counts(path, source)
        source, notes = replace(source, unit=likely), [*notes, *([why] if why else [])]
    factor = _factor(unit if unit is not None else source.unit)
    video = DepthVideo(
        name, rate, times, source.size, _scaled(source.image, factor), float(range[0]), float(range[1]),
        source.camera, source=str(path),
    )  # fmt: skip
    roughness = _check_content(video, factor)
    if roughness > _MAX_ROUGHNESS:
        differ = f"neighbouring pixels of {path.name} differ by {100 * roughness:.0f} %"
        notes.append(f"{differ}: infrared images, photographs in 16 bits and depth that is mostly noise look so")
    return replace(video, notes=tuple(notes))


@renamed(usual_rate="default_rate")
@checked
@names_file
def read_clouds(
    path: str | PathLike[str],
    *,
    sensor: str | None = None,
    unit: float = 1.0,
    rate: float | None = None,
    default_rate: float | None = _DEFAULT_RATE,
    range: tuple[float, float] = (0.0, np.inf),
    time_unit: float | None = None,
    time_offset: float = 0.0,
    T_world_sensor: ArrayLike | None = None,
    viewpoint: bool = True,
) -> CloudVideo:
    """Read point clouds, PCD or PLY, organised or not: one file, a folder or a pattern.

    Parameters
    ----------
    path, sensor, rate, default_rate, time_unit, time_offset : as in `read_depth`
    unit : float [m] of the files' coordinates
    range : (near, far) [m] distance from the sensor
    T_world_sensor : (4, 4) [m], optional
        Pose of the sensor; default: as the first file states (VIEWPOINT of a PCD), else the origin.
    viewpoint : bool
        Whether the sensor saw the points from the origin of its frame; False for clouds of several sensors.

    Raises
    ------
    FileError, ObservationError
        As `read_depth`.
    """
    path, unit = Path(path), _factor(unit)
    files = _of_ending(images.listed(path), clouds.ENDINGS)
    if not files:
        raise _nothing(f"clouds ({', '.join(clouds.ENDINGS)})")
    name = sensor or path.stem
    names = tuple(file.name for file in files)
    source = images.DepthSource(len(files), lambda i: np.zeros((1, 1)), (1, 1), unit, names=names)
    times, rate, said = _times(source, rate, default_rate, time_unit, time_offset, "clouds")
    first = clouds.read_cloud(files[0])
    T = np.array(first.T_file_sensor if T_world_sensor is None else T_world_sensor, float)
    if T_world_sensor is None:
        T[:3, 3] *= unit
    video = CloudVideo(
        name, rate, times, lambda i: clouds.in_sensor(clouds.read_cloud(files[i])) * unit, T, viewpoint,
        float(range[0]), float(range[1]), source=str(path), notes=said,
    )  # fmt: skip
    points = clouds.in_sensor(first)
    away = np.linalg.norm(points[np.isfinite(points).all(axis=1)], axis=1) * unit
    _check_values(away[away > 0.0], unit, video.near, video.far, least=0.001)
    return video


def is_unordered(path: Path) -> bool:
    """Whether a path holds unorganised point clouds."""
    files = _of_ending(images.listed(path), clouds.ENDINGS)
    return bool(files) and clouds.read_cloud(files[0]).shape is None


def _source(path: Path, name: str, size: tuple[int, int] | None, unit: float | None) -> images.DepthSource:
    if (found := inside(path)) is not None:
        return mcap_source(found[0], name, found[1])
    files = images.listed(path)
    if not files:
        if path.is_dir():
            raise _nothing("files")
        raise FileError("no such file or folder", remedy=f"Check the path; kinefit reads {FORMATS}.")
    if len(files) == 1:
        ending = files[0].suffix.lower()
        if ending == ".npz":
            return images.array_source(files[0])
        if ending in (".mkv", ".avi", ".mov", ".mp4"):
            return track_source(files[0], name)
        if ending == ".bag":
            return bag_source(files[0], name)
    if pictures := _of_ending(files, images.PICTURES):
        return images.picture_source(pictures)
    if pieces := _of_ending(files, clouds.ENDINGS):
        return _organised(pieces, name)
    if size is None and (colour := _of_ending(files, (".jpg", ".jpeg", ".bmp", ".gif"))):
        problem = f"{colour[0].suffix} files hold colour, not depth"
        raise FileError(problem, remedy=f"kinefit reads {FORMATS}.")
    if arrays := _of_ending(files, (".npy",)):
        return images.npy_source(arrays)
    return images.raw_source(files, size, unit)


def _unit_of_counts(path: Path, source: images.DepthSource) -> tuple[float, str]:
    """Unit [m] of 16-bit counts that no file states, and what is worth saying of it; millimetres without evidence.

    Lists of a TUM RGB-D folder next to the images state their convention. First Kinects keep three bits of each count
    for the number of a person: most counts are multiples of eight.
    """
    counts = [np.asarray(source.image(k)) for k in sorted({0, source.count // 2, source.count - 1})]
    values = np.unique(np.concatenate([image[(image > 0) & np.isfinite(image)] for image in counts]))
    if not len(values) or (values % 1 != 0).any():
        return 0.001, ""
    if any(_is_tum_list(folder / name) for folder in (path.parent, path) for name in _TUM_LISTS):
        return 0.0002, "the folder has a list of TUM RGB-D: unit = 0.0002 is taken; millimetres would be 0.001"
    median = float(np.median(np.concatenate([image[image > 0] for image in counts])))
    if 0.001 * median <= _PERSON_DISTANCES[1]:
        return 0.001, ""
    of_eight = float(np.mean(values % 8 == 0)) if len(values) > _MIN_DIFFERENT_COUNTS else 0.0
    if of_eight > _MIN_SHARE_OF_EIGHT and _PERSON_DISTANCES[0] < 0.000125 * median < _PERSON_DISTANCES[1]:
        said = f"{100 * of_eight:.0f} % of its counts are multiples of 8, as of first Kinects with a person's number in"
        return 0.000125, f"{said} three bits: unit = 0.000125 is taken; depth in steps of 8 mm would be 0.001"
    likely = [u for u in _COUNT_UNITS if u < 0.001 and _PERSON_DISTANCES[0] < median * u < _PERSON_DISTANCES[1]]
    said = f"no file states the unit: as millimetres its median is {0.001 * median:.3g} m, farther than depth cameras"
    return 0.001, f"{said} see. A hall looks so; else write unit = {' or '.join(f'{u:g}' for u in likely) or '...'}"


def _is_tum_list(file: Path) -> bool:
    """Whether a file lists depth images with their times, as TUM RGB-D folders do."""
    rows = read_text(file, "it", remedy="", errors="replace")[:4000] if file.is_file() else ""
    return re.search(r"\d+\.\d+[ \t]+\S*depth\S*\.png", rows) is not None


def _of_ending(files: list[Path], endings: tuple[str, ...]) -> list[Path]:
    """The files with these endings; raises ObservationError for two different endings."""
    found = [file for file in files if file.suffix.lower() in endings]
    kinds = sorted({file.suffix.lower() for file in found})
    if len(kinds) > 1:
        raise ObservationError(
            f"files of several kinds: {', '.join(kinds)}", file=found[0].parent, remedy=f"Name one kind: *{kinds[0]}."
        )
    return found


def _nothing(what: str) -> FileError:
    return FileError(f"it holds no {what}", remedy=f"kinefit reads {FORMATS}.")


def _organised(files: list[Path], name: str) -> images.DepthSource:
    first = clouds.read_cloud(files[0])
    if first.shape is None:
        remedy = "Read it with kinefit.readers.read_clouds; a take does so by itself."
        raise ObservationError("a cloud without the rows of an image", file=files[0], remedy=remedy)
    return images.DepthSource(
        len(files), lambda i: _depth(files[i]), first.shape[::-1], 1.0,
        camera=clouds.camera_of(first, name), names=tuple(f.name for f in files),
    )  # fmt: skip


def _depth(file: Path) -> NDArray:
    cloud = clouds.read_cloud(file)
    if cloud.shape is None:
        raise ObservationError("a cloud without the rows of an image", file=file, remedy="Remove this file.")
    return clouds.depth_of(cloud)


def _times(
    source: images.DepthSource, rate: float | None, default_rate: float | None, time_unit: float | None,
    time_offset: float, what: str,
) -> tuple[NDArray, float, tuple[str, ...]]:  # fmt: skip
    """Times (F,) [s], rate [Hz], what is worth saying of them; the caller's values come before the file's."""
    times, said = source.times, ""
    if time_unit is not None:
        times = counted_times(source.names, time_unit)
    if not (np.isfinite(time_offset) and (time_unit is None or (np.isfinite(time_unit) and time_unit > 0))):
        raise ObservationError(f"time unit {time_unit} s, offset {time_offset} s", remedy="Give seconds.")
    if rate is not None and not 0 < rate < 1e6:
        raise ObservationError(f"rate {rate:g} Hz", remedy="Give frames per second.")
    numbered = frames_by_name(source.names, what) if times is None and len(source.names) > 1 else None
    if numbered is not None and (numbered.times is not None or rate or default_rate):
        times, said = numbered.on_clock(rate or default_rate or _DEFAULT_RATE, what)
        times = times if said else None
    if times is None:
        rate = rate or source.rate or (default_rate if source.count > 1 else _DEFAULT_RATE)
        if rate is None:
            raise ObservationError("its rate is not stated", remedy="Give rate = ... in frames per second.")
        return np.arange(source.count) / rate + time_offset, rate, ()
    steps = np.diff(times)
    measured = 1.0 / float(np.median(steps[steps > 0])) if (steps > 0).any() else None
    if said and measured and rate and abs(rate / measured - round(rate / measured)) < _MAX_MULTIPLE_ERROR:
        rate = measured  # frames were left out, by their names
    if rate is not None and measured is not None and not 0.9 < rate / measured < 1.1:
        problem = f"the times of its frames give {measured:.4g} Hz, not {rate:g} Hz"
        raise ObservationError(problem, remedy="Remove the rate, or correct the unit of the times.")
    if source.rate and measured and abs(source.rate / measured - 1.0) < 0.1:
        measured = source.rate  # times are rounded to milliseconds
    rate = rate or measured or source.rate or default_rate or _DEFAULT_RATE
    return times + time_offset, rate, (said,) if said else ()


def _factor(unit: float) -> float:
    if not (np.isfinite(unit) and unit > 0):
        raise ObservationError(f"a unit of {unit} m", remedy="Give metres a count: 0.001 for millimetres.")
    return float(unit)


def _scaled(image: Callable[[int], NDArray], factor: float) -> Callable[[int], NDArray]:
    return lambda i: image(i) * np.float32(factor)


def _check_content(video: DepthVideo, factor: float) -> float:
    """Check some frames for depth, a plausible unit and a range that contains it; raises ObservationError.

    Returns the median difference of neighbouring pixels, as a share of the depth.
    """
    rough: list[NDArray] = []
    seen: list[NDArray] = []
    first = dict.fromkeys(round(k) for k in np.linspace(0, len(video) - 1, 5))
    for i in (*first, *(k for k in builtins.range(len(video)) if k not in first)):
        if len(seen) >= len(first) and any(map(len, seen)):
            break  # read the others only while all are empty
        image = np.asarray(video.image(i))
        if image.shape == video.size[::-1]:
            pairs = image[:, :-1], image[:, 1:]
            known = np.isfinite(image[:, :-1] + image[:, 1:]) & (np.minimum(*pairs) > 0)
            rough.append(np.abs(pairs[1] - pairs[0])[known] / pairs[0][known])
            image = image[::4, ::4] if image.size > 40_000 else image
            seen.append(image[(image > 0) & np.isfinite(image)])
        else:
            video.frame(i)  # raises for the wrong size
    _check_values(np.concatenate(seen), factor, video.near, video.far)
    differences = np.concatenate(rough)
    return float(np.median(differences)) if len(differences) else 0.0


def _check_values(depth: NDArray, factor: float, near: float, far: float, least: float = _MIN_MEDIAN_DEPTH) -> None:
    if not len(depth):
        remedy = "Check that the sensor was not covered and that these are not infrared images."
        raise ObservationError("no frame has a depth value", remedy=remedy)
    median = float(np.median(depth))
    if not least < median < _MAX_MEDIAN_DEPTH:
        likely = [unit for unit in _COUNT_UNITS if _PERSON_DISTANCES[0] < median / factor * unit < _PERSON_DISTANCES[1]]
        entry = "unit = " + " or ".join(f"{unit:g}" for unit in likely) if likely else "the sensor's own unit = ..."
        what = " (probably millimetres)" if factor == 1.0 and median > 100 else ""
        problem = f"the median depth is {median:.4g} m{what}: the unit of {factor:g} m a count is wrong"
        raise ObservationError(problem, remedy=f"Write {entry} (metres a count).")
    if not ((depth >= near) & (depth <= far)).any():
        low, high = np.percentile(depth, (1, 99))
        problem = f"nothing lies within the range of {near:g} to {far:g} m: depths go from {low:.3g} to {high:.3g} m"
        raise ObservationError(problem, remedy="Correct the range, or the unit.")
