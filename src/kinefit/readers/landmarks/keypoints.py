"""Read 2D keypoints of detectors: OpenPose json folders, MediaPipe arrays, caliscope tables."""

from __future__ import annotations

import re
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import read_bytes, read_npy, read_table
from kinefit._mapped import kept
from kinefit.errors import FileError, ObservationError, choices, names_file
from kinefit.observations import Keypoints
from kinefit.observations.arrays import sealed
from kinefit.observations.clocks import frames_by_name
from kinefit.readers.depth.images import natural
from kinefit.readers.landmarks import keypoint_sets
from kinefit.readers.landmarks.keypoint_sets import (
    FACE_POINTS,
    HAND_POINTS,
    KEYPOINT_SETS,
    MEDIAPIPE_SETS,
    OPENPOSE_HANDS,
    cut_frames,
    face_mesh,
    in_right_order,
    keypoint_names,
    keypoint_record,
)
from kinefit.readers.plugins import KEYPOINTS, FileFormat

if TYPE_CHECKING:
    from kinefit.geometry.camera import ImageFrame

_MISSING_HAND = [0.0] * (3 * HAND_POINTS)
_FRAME_NUMBER = re.compile(r"(\d+)(?:_keypoints)?\.json$", re.IGNORECASE)


class OpenPosePerson(msgspec.Struct):
    """One person of a frame: x, y [px], confidence of each point; hands if the detector ran on them."""

    pose_keypoints_2d: list[float]
    hand_left_keypoints_2d: list[float] = []
    hand_right_keypoints_2d: list[float] = []

    def with_hands(self) -> list[float]:
        """Numbers (x, y [px], confidence) of the body, the left and the right hand; zeros without a hand."""
        left, right = (hand or _MISSING_HAND for hand in (self.hand_left_keypoints_2d, self.hand_right_keypoints_2d))
        return [*self.pose_keypoints_2d, *left, *right]


class _OpenPoseFrame(msgspec.Struct):
    people: list[OpenPosePerson]


decode_openpose = msgspec.json.Decoder(_OpenPoseFrame).decode


@checked
@names_file
def read_openpose(
    folder: str | PathLike[str], *, camera: str, rate: float, keypoint_set: str | None = None,
    frames: tuple[int, int] | None = None, time_offset: float = 0.0, image_frame: ImageFrame | None = None,
) -> Keypoints:  # fmt: skip
    """Read a folder with one json file per frame, in the format of OpenPose.

    Parameters
    ----------
    folder : path
        Files are read in the order of the frame number at the end of their name; the first one is frame 0. Or one file
        of one frame, which may have no people.
    camera : str
    rate : float [Hz]
    keypoint_set : str, optional
        One of `KEYPOINT_SETS`; the files do not state it. Default: the one of as many points; of BODY_25 and BODY_25B
        the one in which the bones are shorter.
    frames : (start, stop), optional
        Only these; their times are kept.
    time_offset : float [s]
    image_frame : ImageFrame, optional
        Image frame of the coordinates, if it is not the calibration's.

    Returns
    -------
    Keypoints
        All people of every frame, in the files' order; (0, 0) with confidence 0 becomes NaN.

    Raises
    ------
    ObservationError
        A missing or repeated frame number, broken json, NaN, a wrong number of keypoints, points that are clearly in
        the order of another set, no people.
    FileError
        No such folder, or no json in it.
    """
    folder = Path(folder)
    paths, start = cut_frames(_numbered_files(folder), frames, folder)
    read = [_read_people(path) for path in paths]
    first = next((len(people[0].pose_keypoints_2d) // 3 for people in read if people), 0)
    named = keypoint_set or keypoint_sets.SET_OF_COUNT.get(first, "BODY_25B")
    names = keypoint_names(named)
    people = [_numbers(persons, path, named) for persons, path in zip(read, paths, strict=True)]
    if folder.is_dir() and not any(map(len, people)):
        raise ObservationError(
            f"no person is detected in any of the {len(paths)} frames of camera {camera}",
            remedy="Check that the detector ran on this camera's video, or remove this camera.",
        )
    data = np.zeros((len(people), max(map(len, people)), len(names), 3))
    for row, persons in zip(data, people, strict=True):
        row[: len(persons)] = persons
    record = keypoint_record(data, camera, named, rate, time_offset, start, folder, image_frame)
    return in_right_order(record, stated=keypoint_set is not None)


@checked
@names_file
def read_mediapipe(
    path: str | PathLike[str], *, camera: str, rate: float, frames: tuple[int, int] | None = None,
    time_offset: float = 0.0, image_frame: ImageFrame | None = None,
) -> Keypoints:  # fmt: skip
    """Read MediaPipe landmarks from an array file (.npy): of the pose alone, of both hands too, or of the face mesh.

    Parameters
    ----------
    path : path
        (F, 33, 3), or (F, 75, 3) with the left and the right hand after the pose: x, y [px] in the video's image
        frame, visibility; all NaN or all zero in frames without a person, or without a hand. (F, 478, 3), or
        (F, 468, 3) without irises, is a face mesh: x, y [px], and a depth, which is ignored.
    camera, rate, frames, time_offset
        As in `read_openpose`.
    image_frame : ImageFrame, optional
        The video's image frame, from which the points are converted to the calibration's.

    Raises
    ------
    ObservationError
        Another shape, single NaNs, no person; a face mesh in shares of the image size.
    FileError
        Missing or not an array file.
    """
    path = Path(path)
    data = read_npy(path, remedy="Write it by numpy.save.")
    sets = {(len(KEYPOINT_SETS[name]), 3): name for name in MEDIAPIPE_SETS}
    sets |= dict.fromkeys(((n, 3) for n in FACE_POINTS), "MEDIAPIPE_478")
    if data.dtype.kind not in "fiu" or data.shape[1:] not in sets:
        remedy = "Give x, y [px], visibility: (frames, 33, 3), with hands (frames, 75, 3), of a face (frames, 478, 3)."
        raise ObservationError(f"landmarks have shape {data.shape}", remedy=remedy)
    data, start = cut_frames(data, frames, path)
    data, keypoint_set = np.array(data, dtype=float), sets[data.shape[1:]]
    names = KEYPOINT_SETS[keypoint_set]
    pose = len(KEYPOINT_SETS["MEDIAPIPE_33"])
    for part in np.split(data, range(pose, len(names), HAND_POINTS) if len(names) < min(FACE_POINTS) else (), axis=1):
        part[np.isnan(part).all(axis=(1, 2))] = 0
    if not np.isfinite(data).all():
        frame, point, _ = np.argwhere(~np.isfinite(data))[0]
        remedy = "A frame without a person must be all NaN (or zero)."
        raise ObservationError(f"NaN or infinity at {names[point]}", place=f"frame {start + frame}", remedy=remedy)
    if keypoint_set == "MEDIAPIPE_478":
        data = face_mesh(data)
    if not data[..., 2].any():
        raise ObservationError(
            f"no person is detected in any of the {len(data)} frames of camera {camera}",
            remedy="Check that the detector ran on this camera's video, or remove this camera.",
        )
    return keypoint_record(data[:, None], camera, keypoint_set, rate, time_offset, start, path, image_frame)


_CALISCOPE_HANDS = (100, 200)  # first indices of the right and of the left hand
_GAPS, _PORTS = 20, 100  # indices for each that is there, and cameras, beyond which a table is damaged


@checked
@names_file
def read_caliscope_csv(path: str | PathLike[str], *, rate: float | None = None) -> dict[str, Keypoints]:
    """Read MediaPipe's landmarks of all cameras from a table of caliscope (pyxy3d): xy_*.csv.

    The pose alone is `MEDIAPIPE_33`; with hands, whose indices begin at 100 (right) and 200 (left), `MEDIAPIPE_75`.
    Points of the face, from 500 on, are skipped.

    Parameters
    ----------
    path : path
        Columns sync_index, port, frame_time, point_id, img_loc_x, img_loc_y [px].
    rate : float [Hz], optional
        Default: the median of the table's own times.

    Returns
    -------
    {"cam_0": Keypoints, ...}
        One entry per port; frames are sync indices from the smallest on; confidence is 1 where detected.

    Raises
    ------
    FileError, ObservationError
        Missing file; missing columns, cells that are no numbers, no body landmark.
    """
    path, pose = Path(path), len(KEYPOINT_SETS["MEDIAPIPE_33"])
    columns = ("sync_index", "port", "frame_time", "point_id", "img_loc_x", "img_loc_y")
    table = read_table(path, columns, f"Export it again, with {', '.join(columns)}.")[1]
    right, left = (np.isin(table[:, 3], begin + np.arange(HAND_POINTS)) for begin in _CALISCOPE_HANDS)
    table = table[((table[:, 3] < pose) | right | left) & np.isfinite(table).all(axis=1)]
    if not len(table):
        raise ObservationError("no landmark of the body in this table", remedy="Track the whole pose.")
    numbers = table[:, (0, 1, 3)]
    if (wrong := (numbers < 0) | (numbers > 2**31) | (numbers % 1 != 0)).any():
        row, k = np.argwhere(wrong)[0]
        problem = f"{('sync_index', 'port', 'point_id')[k]} = {numbers[row, k]:g}"
        raise ObservationError(problem, remedy="They are whole numbers from 0 on: export the table again.")
    frame, port, point = numbers.astype(int).T
    keypoint_set = MEDIAPIPE_SETS[int(point.max() >= pose)]
    for k, begin in enumerate(_CALISCOPE_HANDS):  # the left hand comes first in the set
        point[(point >= begin) & (point < begin + HAND_POINTS)] += pose + (1 - k) * HAND_POINTS - begin
    frame = frame - frame.min()
    if frame.max() > _GAPS * len(np.unique(frame)) + 1000 or len(np.unique(port)) > _PORTS:
        problem = f"{len(np.unique(frame))} frames of {len(np.unique(port))} ports in {frame.max() + 1} of sync_index"
        raise ObservationError(problem, remedy="Indices follow each other: export the table again.")
    if rate is None:
        first = port == port[0]
        _, at = np.unique(frame[first], return_index=True)
        rate = float(1 / np.median(np.diff(table[first, 2][at]))) if len(at) > 1 else 1.0
    keypoints = {}
    for p in np.unique(port):
        data = np.zeros((frame.max() + 1, 1, len(KEYPOINT_SETS[keypoint_set]), 3))
        rows = port == p
        data[frame[rows], 0, point[rows]] = np.column_stack([table[rows, 4:6], np.ones(rows.sum())])
        keypoints[f"cam_{p}"] = keypoint_record(data, f"cam_{p}", keypoint_set, rate, 0.0, 0, path, None)
    return keypoints


@checked
@names_file
def read_keypoints(
    path: str | PathLike[str], *, format: str | None = None, camera: str, rate: float | None = None,
    time_offset: float = 0.0, image_frame: ImageFrame | None = None, **options: Any,
) -> Keypoints:  # fmt: skip
    """Read one camera's keypoints of any format.

    Parameters
    ----------
    path : path
    format : "openpose", "mediapipe", "caliscope" or a plug-in's, optional
        Default: a folder is OpenPose's, a .npy file MediaPipe's, another file of the plug-in that recognises it. Of
        caliscope the port of the camera's last number.
    camera, rate, time_offset, image_frame
        As in `read_openpose` and `read_mediapipe`; caliscope's tables state their rate.
    **options
        More of `read_openpose` or `read_mediapipe`.

    Raises
    ------
    ObservationError, FileError
        An unknown format; and what those raise.
    PluginError
        A plug-in fails.
    """
    path = Path(path)
    format = format or KEYPOINTS.name_of(path) or "mediapipe"
    reader = KEYPOINTS.get(format, ObservationError)
    if reader.plugin is None and path.is_file():
        keypoint_sets.refuse_other_keypoints(path)
    record: Keypoints = reader.call(
        "read", path, camera=camera, rate=rate, **options, what=f"Keypoints of the camera '{camera}' at {rate} Hz",
        valid=lambda one: isinstance(one, Keypoints) and one.camera == camera and rate in (None, one.rate),
    )  # fmt: skip
    points = record.points if image_frame is None else sealed(kept(image_frame.to_calibration(record.points)))
    return replace(record, points=points, time_offset=record.time_offset + time_offset)


def _is_caliscope(path: Path) -> bool:
    return path.suffix.lower() == ".csv" and b"sync_index" in read_bytes(path, 4096)


@names_file
def _caliscope_camera(path: Path, *, camera: str, rate: float | None) -> Keypoints:
    ports, numbers = read_caliscope_csv(path, rate=rate), re.findall(r"\d+", camera)
    port = ports.get(f"cam_{int(numbers[-1][-18:])}" if numbers else "")
    if port is None:
        raise ObservationError(choices("camera in this table named", camera, ports))
    return replace(port, camera=camera)


def _numbered_files(folder: Path) -> list[Path]:
    """Json files of a folder in the order of their frame numbers; raises for a gap."""
    if folder.suffix.lower() == ".json" and folder.is_file():
        return [folder]
    if not folder.is_dir():
        remedy = 'Name the folder, not one of its files; .npy files are of format = "mediapipe", .csv of "caliscope".'
        raise FileError("no such folder of json files", remedy=remedy)
    files = sorted((p for p in folder.iterdir() if p.suffix.lower() == ".json"), key=lambda path: natural(path.name))
    if not files:
        remedy = "Name the folder that the detector wrote for this camera."
        raise FileError("there are no json files in this folder", remedy=remedy)
    for path in files:
        if not _FRAME_NUMBER.search(path.name):
            keypoint_sets.refuse_other_keypoints(path)
            raise ObservationError("no frame number in this name", file=path, remedy="Expected NAME_0012.json.")
    numbered = frames_by_name([path.name.lower().replace("_keypoints", "") for path in files], "frames")
    numbered.refuse_gaps("frames")
    if numbered.step > 1 or numbered.times is not None:
        problem = f"its files are not numbered by one: {files[0].name} and {files[1].name}"
        remedy = "Run the detector on every frame, or number the files by one and give the rate of these frames."
        raise ObservationError(problem, remedy=remedy)
    return files


def _read_people(path: Path) -> list[OpenPosePerson]:
    """All people of one frame."""
    raw = read_bytes(path)
    try:
        return decode_openpose(raw).people
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        keypoint_sets.refuse_other_keypoints(path)
        infinite = re.search(rb"[\[,:]\s*-?(NaN|Inf)", raw, re.IGNORECASE)
        problem = "NaN or infinity among the keypoints" if infinite else f"broken json ({error})"
        raise ObservationError(problem, file=path, remedy="Run the detector again on this frame.") from error


def _numbers(people: list[OpenPosePerson], path: Path, keypoint_set: str) -> NDArray:
    """(P, K, 3) x, y [px], confidence of all people of one frame."""
    count = len(keypoint_names(keypoint_set))
    values = [p.with_hands() if keypoint_set == OPENPOSE_HANDS else p.pose_keypoints_2d for p in people]
    for i, numbers in enumerate(values):
        if len(numbers) != 3 * count:
            fitting = [name for name in KEYPOINT_SETS if 3 * len(KEYPOINT_SETS[name]) == len(numbers)]
            remedy = (
                f"This number fits: {', '.join(fitting)}; name it by set = ... of [[keypoints]]." if fitting
                else f"No set has so many; there are: {', '.join(KEYPOINT_SETS)}. Run the detector with one of these."
            )  # fmt: skip
            problem = f"{len(numbers)} numbers where {keypoint_set} has {count} x 3"
            raise ObservationError(problem, file=path, place=f"person {i}", remedy=remedy)
    data = np.array(values, dtype=float).reshape(len(people), count, 3)
    if not np.isfinite(data).all():
        raise ObservationError("numbers too large", file=path, remedy="Run the detector again on this frame.")
    return data


OPENPOSE = FileFormat("OpenPose (Cao et al. 2021, IEEE TPAMI 43:172)", (), read_openpose, Path.is_dir)
MEDIAPIPE = FileFormat("MediaPipe Pose (Bazarevsky et al. 2020, BlazePose)", (".npy",), read_mediapipe)
CALISCOPE = FileFormat(
    "the landmarks that Caliscope recorded", (".csv",), _caliscope_camera, _is_caliscope, has_all_cameras=True
)
