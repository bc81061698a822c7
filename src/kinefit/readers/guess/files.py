"""Find the calibrations, videos, keypoints and markers in a folder, by trying to read them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._files import npy_header, read_table
from kinefit._pictures import read_picture
from kinefit.errors import CalibrationError, FileError, KinefitError, PluginError
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import MAX_CALIBRATION_BYTES, PAIRS, SUFFIXES, read_calibration
from kinefit.readers.depth.images import PICTURES, natural, npy_source, picture_source
from kinefit.readers.depth.streams import has_depth_track
from kinefit.readers.guess.names import camera_of
from kinefit.readers.landmarks.keypoints import FRAME_NUMBER, decode_openpose, other_keypoints, read_keypoints
from kinefit.readers.plugins import CALIBRATIONS, KEYPOINTS, MARKERS
from kinefit.readers.ros.recordings import inside
from kinefit.readers.videos.video import ENDINGS, ImageFolder, Video

VIDEOS = {".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".mts", ".m2ts", ".ts", ".wmv", ".mxf"}
OF_CALIBRATION = re.compile(
    r"(?<![a-z])(?:(?:intrinsic|extrinsic|charuco|checker|chess|calib)\w*|board|wand|int|ext)(?![a-z])", re.IGNORECASE
)
"""Words in the path of a recording for calibration."""
STATIC = re.compile(r"(?<![a-z])(?:static|neutral|[ta][-_ ]?pose)", re.IGNORECASE)
"""Words in the path of a static trial."""

DRAWN_ON = re.compile(r"(?<![a-z])(?:pose|overlay|labell?ed|annotated|results?|debug)(?![a-z])", re.IGNORECASE)
"""Words in the path of a video with a detector's overlay."""

_RESULT_ENDINGS = ("-kinefit", "-detect")  # of the folders that kinefit writes
_MAX_DEPTH = 6  # folders below the given one
_MIN_SEQUENCE = 12  # numbered json files in one folder are a detector's frames, fewer may be cameras
_MAYBE_KEYPOINTS = (".json", ".csv", ".h5")
_CALISCOPE_COLUMNS = ("sync_index", "port", "point_id", "img_loc_x", "img_loc_y")
_CALIBRATION_NAME = re.compile(r"calib|intrin|extrin|cam", re.IGNORECASE)  # else a broken file may be anything
_UNITS = ("mm", "cm", "inch", "dm")
_LAST_NUMBER = re.compile(r"\d+(?=\D*$)")
_MASK_TOLERANCE = 10  # grey levels of a compressed mask's pixels from black or white
_WITH_DEPTH = (".mkv", ".avi", ".mov")  # of videos that may have a track of depth
_MIN_DEPTH_SIDE = 40  # [px]
_MIN_DEPTH_VALUES = 15  # different ones in an image: a mask of 16 bits has few
_MIN_GREY_SHARE = 0.1  # of the other pixels in a photograph


@dataclass(frozen=True, eq=False)
class CalibrationFile:
    """A calibration of several cameras, and the unit of length with which it was read.

    `sized`: cameras whose image size is their video's, as the file states none.
    """

    path: Path
    rig: Rig
    unit: str = "auto"
    sized: tuple[str, ...] = ()

    @property
    def spread(self) -> float:
        """[m] median distance of its cameras from their centroid."""
        return _spread(self.rig)

    @property
    def is_refined(self) -> bool:
        """Whether its name contains "refined" or a similar word."""
        return any(word in self.path.name.lower() for word in ("refined", "adjusted", "optimi"))

    @property
    def is_qualisys(self) -> bool:
        """Whether it is a Qualisys file, whose world is z up."""
        return self.path.is_file() and "<calibration" in self.path.read_text("utf-8", errors="replace")[:1000]


@dataclass(frozen=True)
class KeypointFile:
    """Keypoints of one camera (of all cameras in caliscope's table), with the number of frames and of points."""

    path: Path
    format: str
    frames: int
    points: int


def list_files(folder: Path) -> list[Path]:
    """Files below a folder, in natural order, except hidden ones and results of kinefit."""
    found: list[Path] = []
    for parent, folders, names in os.walk(folder, followlinks=True):
        depth = len(Path(parent).relative_to(folder).parts)
        searched = folders if depth < _MAX_DEPTH else []
        folders[:] = [name for name in searched if not name.startswith(".") and not name.endswith(_RESULT_ENDINGS)]
        shown = [name for name in names if not name.startswith(".") or name.endswith(".icloud")]
        found += [path for name in shown if (path := Path(parent) / name).is_file()]
    return sorted(found, key=lambda path: natural(str(path)))


def find_recordings(files: list[Path]) -> list[Path]:
    """MCAP recordings of ROS 2 among files, the largest first.

    Raises
    ------
    FileError
        Recordings in SQLite alone, or one that is split into several files.
    """
    found = [path for path in files if path.suffix.lower() in (".mcap", ".db3")]
    whole = [path for path in found if path.suffix.lower() == ".mcap"]
    for path in whole or found:
        inside(path.parent if (path.parent / "metadata.yaml").is_file() else path)
    return sorted(whole, key=lambda path: -path.stat().st_size)


def find_calibrations(
    files: list[Path], videos: Sequence[Path] = (), folder: Path | None = None
) -> tuple[list[CalibrationFile], list[Path], list[KinefitError]]:
    """All calibrations of two or more cameras among files, by trying to read them.

    Parameters
    ----------
    videos : that give the image size of cameras without one, matched by their names below `folder`.

    Returns
    -------
    calibrations; files of a single camera; errors of files that are calibrations but cannot be used, and of plug-ins.
    """
    found: list[CalibrationFile] = []
    singles: list[Path] = []
    faults: list[KinefitError] = []
    sizes = partial(_video_size, sorted(videos, key=lambda path: bool(OF_CALIBRATION.search(path.name))), folder)
    detectors = {folder for folder, group in _by_folder(files) if sum(map(_numbered, group)) > _MIN_SEQUENCE}
    for path in files:
        known = path.name.lower().endswith(SUFFIXES) or _is_xml_text(path) or CALIBRATIONS.name_of(path, faults)
        if not known or (path.parent in detectors and _numbered(path)):
            continue
        if path.stat().st_size > MAX_CALIBRATION_BYTES:
            continue
        read = _try(path, faults, sizes)
        if read and len(read.rig) > 1:
            found.append(read)
        elif read:
            singles.append(path)
    for place in _folders(files, singles):
        read = _try(place, faults, sizes)
        if read and len(read.rig) > 1:
            found.append(read)
            faults = [fault for fault in faults if Path(str(fault.file)).parent != place]
    return found, singles, faults


def _numbered(path: Path) -> bool:
    return bool(FRAME_NUMBER.search(path.name))


def _by_folder(files: list[Path]) -> list[tuple[Path, list[Path]]]:
    ordered = sorted(files, key=lambda path: str(path.parent))
    return [(folder, list(group)) for folder, group in groupby(ordered, key=lambda path: path.parent)]


def _folders(files: list[Path], singles: list[Path]) -> list[Path]:
    """Folders that form one calibration: COLMAP, intrinsics and extrinsics, one file or folder for each camera."""
    out = []
    for folder, group in _by_folder(files):
        names = {path.name for path in group}
        stems = {path.stem.lower() for path in group}
        if {"cameras.txt", "images.txt"} <= names or any(set(pair) <= stems for pair in PAIRS):
            out.append(folder)
    per_folder = _by_folder(singles)
    out += [folder for folder, group in per_folder if len(group) > 1]
    alone = sorted(folder.parent for folder, group in per_folder if len(group) == 1)
    out += [parent for parent, group in groupby(alone) if len(list(group)) > 1]
    return list(dict.fromkeys(out))


def _is_xml_text(path: Path) -> bool:
    """Whether a text file has the tags of Qualisys and Theia3D."""
    if path.suffix.lower() != ".txt" or not path.is_file():
        return False
    with path.open("rb") as file:
        return b"<calibration" in file.read(1000)


def _video_size(videos: Sequence[Path], folder: Path | None, camera: str) -> tuple[int, int] | None:
    """(width, height) [px] of the first video with a camera's name or number; None if there is none."""
    for path in videos:
        if folder is not None and camera_of(path, folder, [camera]):
            try:
                with Video(path, rate=1.0) as video:
                    return video.size
            except KinefitError:
                continue
    return None


def _try(
    path: Path, faults: list[KinefitError], video_size: Callable[[str], tuple[int, int] | None]
) -> CalibrationFile | None:
    """Read a calibration; if it cannot be metres, in the unit with the most plausible camera distances."""
    sized: dict[str, tuple[int, int] | None] = {}

    def size_of(camera: str) -> tuple[int, int] | None:
        return sized.setdefault(camera, video_size(camera))

    try:
        return CalibrationFile(path, read_calibration(path, image_size=size_of), sized=tuple(sized))
    except CalibrationError as error:
        if "cannot be metres" not in error.problem:
            if "no camera in it" not in error.problem and (error.place or _CALIBRATION_NAME.search(path.name)):
                faults.append(error)
            return None
    except (KinefitError, RecursionError) as error:
        faults += [error] if isinstance(error, PluginError) else []
        return None
    rigs = {unit: read_calibration(path, unit=unit, image_size=size_of) for unit in _UNITS}
    unit = min(rigs, key=lambda u: abs(np.log(_spread(rigs[u]) / 3.0)))  # 3 m from the scene is typical
    return CalibrationFile(path, rigs[unit], unit, tuple(sized))


def _spread(rig: Rig) -> float:
    """[m] median distance of the cameras from their centroid."""
    centres = np.array([camera.centre_world for camera in rig])
    return float(np.median(np.linalg.norm(centres - centres.mean(0), axis=1))) or 1e-9


def find_videos(files: list[Path], folder: Path) -> list[Path]:
    """Video files, and numbered photographs as a folder, or as patterns if it has several series."""
    films = [film for parent, group in _by_folder(files) for film in _films(group, parent, alone=parent != folder)]
    return [path for path in files if path.suffix.lower() in VIDEOS] + films


def _films(group: list[Path], folder: Path, *, alone: bool) -> list[Path]:
    """Image series in a folder: many photographs whose names differ by the last number."""
    named: dict[str, list[Path]] = {}
    for path in group:
        if path.suffix.lower() in ENDINGS:
            named.setdefault(_LAST_NUMBER.sub("*", path.name), []).append(path)
    films = [pattern for pattern, images in named.items() if len(images) >= _MIN_SEQUENCE and _is_film(images[0])]
    if alone and films and len(named) == 1:
        return [folder]
    return [folder / pattern for pattern in films if _is_whole(folder / pattern)]


def _is_whole(pattern: Path) -> bool:
    """Whether the images of a pattern form a video without a gap."""
    try:
        ImageFolder(pattern, 1.0)
    except KinefitError:
        return False
    return True


def _is_film(image: Path) -> bool:
    """Whether an image is a photograph."""
    try:
        pixels = read_picture(image, cv2.IMREAD_UNCHANGED)
    except FileError:
        return False
    return pixels.dtype == np.uint8 and (pixels.ndim == 3 or _is_photograph(pixels))


def _is_photograph(grey: NDArray) -> bool:
    """Whether a grey image is no mask, whose pixels are nearly black or white."""
    return float(np.mean((grey > _MASK_TOLERANCE) & (grey < 255 - _MASK_TOLERANCE))) > _MIN_GREY_SHARE


def find_depth(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Depth among files: folders or patterns of images and videos with a depth track; images that are alone."""
    found = [path for path in files if path.suffix.lower() in _WITH_DEPTH and has_depth_track(path)]
    single = list[Path]()
    for folder, group in _by_folder(list(files)):
        series: dict[str, list[Path]] = {}
        for path in (path for path in group if path.suffix.lower() in (*PICTURES, ".npy")):
            series.setdefault(re.sub(r"\d+", "*", path.name), []).append(path)
        for pattern, images in series.items():
            count = _depth_images(images[0]) * len(images)
            if count > 1:
                found.append(folder if len(series) == 1 < len(images) else folder / re.sub(r"\*.*\*", "*", pattern))
            elif count:
                single += images
    return found, single


def _depth_images(file: Path) -> int:
    """Number of depth images in a file: of one channel of 16 bits or float, and many values, as a mask has not."""
    try:
        source = npy_source([file]) if file.suffix.lower() == ".npy" else picture_source([file])
        is_depth = min(source.size) >= _MIN_DEPTH_SIDE and len(np.unique(source.image(0))) > _MIN_DEPTH_VALUES
        return source.count * is_depth
    except KinefitError:
        return 0


_STAND_INS = {
    (".zip", ".7z", ".rar", ".tar", ".tgz", ".tar.gz"): "an archive: unpack it, and run kinefit init again",
    (".icloud",): "a placeholder of iCloud, the file itself is not here: download it (open it in Finder)",
    (".crdownload", ".part", ".download"): "a download that is not finished: download it again",
    (".360", ".insv"): "a 360° video of two fisheye images: export a flat view of it with the maker's program",
}


def stand_in(path: Path) -> str:
    """What a file is that stands in place of a recording, and what to do; "" for others."""
    return next((text for endings, text in _STAND_INS.items() if path.name.lower().endswith(endings)), "")


def find_markers(files: list[Path], faults: list[KinefitError]) -> list[Path]:
    """Files of markers; errors of plug-ins are added to `faults`."""
    return [path for path in files if MARKERS.name_of(path, faults) and not KEYPOINTS.name_of(path, faults)]


def find_keypoints(files: list[Path], faults: list[KinefitError]) -> tuple[list[KeypointFile], list[str]]:
    """Keypoints of all formats of a take file; remarks on similar files of unknown formats.

    Errors of plug-ins are added to `faults`.
    """
    found: list[KeypointFile] = []
    remarks: list[str] = []
    for folder, group in _by_folder(files):
        numbered = [path for path in group if _numbered(path)]
        points = _openpose_points(numbered)
        if points is not None:
            found.append(KeypointFile(folder, "openpose", len(numbered), points))
    for path in files:
        suffix = path.suffix.lower()
        shape = _array_shape(path) if suffix == ".npy" else None
        format = KEYPOINTS.name_of(path, faults)
        if shape is not None and format in ("mediapipe", "freemocap"):
            found.append(KeypointFile(path, format, *shape[-3:-1]))
        elif format == "caliscope":
            found += [KeypointFile(path, format, frames, 33)] if (frames := _caliscope_frames(path)) else []
        elif format == "deeplabcut" and path.with_suffix(".csv") in files and suffix == ".h5":
            continue  # both are of one result
        elif format:
            try:
                record = read_keypoints(path, format=format, camera=path.stem, rate=1.0)
                found.append(KeypointFile(path, format, len(record), len(record.names)))
            except KinefitError as error:
                faults.append(error)
        elif shape is not None and len(shape) >= 3 and shape[-1] in (2, 3):
            known = "landmarks in images are read as (frames, 33, 3), or (frames, 75, 3) with hands"
            remarks.append(f"{path.name}: an array of shape {shape}; {known}")
        elif suffix in _MAYBE_KEYPOINTS and (other := other_keypoints(path)):
            remarks.append(f"{path.name}: {other}; not used")
    return found, remarks


def _openpose_points(numbered: list[Path]) -> int | None:
    """Number of points of a person in numbered json files; 0 without people, None if not OpenPose's."""
    is_openpose = False
    for path in numbered:
        try:
            people = decode_openpose(path.read_bytes())
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, OSError):
            if not is_openpose:
                return None
            continue
        is_openpose = True
        if people:
            person = people[0]
            hands = person.hand_left_keypoints_2d or person.hand_right_keypoints_2d
            return len(person.with_hands() if hands else person.pose_keypoints_2d) // 3
    return 0 if is_openpose else None


def _array_shape(path: Path) -> tuple[int, ...] | None:
    header = npy_header(path)
    return header[0] if header and header[1].kind in "fiu" else None


def _caliscope_frames(path: Path) -> int:
    """Number of frames of a caliscope table with points of a body, not of a board; 0 for any other table."""
    try:
        table = read_table(path, _CALISCOPE_COLUMNS, "", optional=("obj_loc_x",))[1]
    except KinefitError:
        return 0
    body = table[np.isnan(table[:, -1]), 0]
    return int(np.ptp(body)) + 1 if len(body) else 0
