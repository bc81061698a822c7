"""Read 2D keypoints of detectors: OpenPose json folders, MediaPipe and FreeMoCap arrays, caliscope tables."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import npy_header, read_bytes, read_npy, read_table
from kinefit._mapped import kept
from kinefit.errors import FileError, ObservationError, choices, names_file
from kinefit.observations import Keypoints
from kinefit.observations.arrays import sealed
from kinefit.observations.clocks import frames_by_name
from kinefit.readers.depth.images import natural
from kinefit.readers.landmarks import keypoint_sets
from kinefit.readers.landmarks.keypoint_sets import FACE_POINTS, FACE_SET, HAND_POINTS, KEYPOINT_SETS, MEDIAPIPE_SETS
from kinefit.readers.plugins import KEYPOINTS, FileFormat

if TYPE_CHECKING:
    from kinefit.geometry.camera import ImageFrame

_Decoded = TypeVar("_Decoded")
_FREEMOCAP = (33, 3), (75, 3), (553, 3)  # last dimensions of its arrays: points, and x, y, z
_MISSING_HAND = [0.0] * (3 * HAND_POINTS)
FRAME_NUMBER = re.compile(r"(\d+)(?:_keypoints)?\.json$", re.IGNORECASE)
"""At the end of the name of a file of one frame."""


class OpenPosePerson(msgspec.Struct):
    """One person of a frame: x, y [px], confidence of each point; hands if the detector ran on them."""

    pose_keypoints_2d: list[float]
    hand_left_keypoints_2d: list[float] = []
    hand_right_keypoints_2d: list[float] = []

    def with_hands(self) -> list[float]:
        """Numbers (x, y [px], confidence) of the body, the left and the right hand; zeros without a hand."""
        left, right = (hand or _MISSING_HAND for hand in (self.hand_left_keypoints_2d, self.hand_right_keypoints_2d))
        return [*self.pose_keypoints_2d, *left, *right]


class OpenPoseFrame(msgspec.Struct):
    """All people of a frame; an empty object is no person (Pose2Sim's `pose-associated`)."""

    people: list[msgspec.Raw]

    def persons(self) -> list[OpenPosePerson]:
        """Those who are there; raises msgspec.DecodeError."""
        return [_PERSON.decode(one) for one in self.people if bytes(one)[1:-1].strip()]


_PERSON, _FRAME = msgspec.json.Decoder(OpenPosePerson), msgspec.json.Decoder(OpenPoseFrame)
_OLD_KEY = re.compile(rb'"(pose|hand_left|hand_right)_keypoints"')


def with_new_keys(raw: bytes) -> bytes:
    """JSON with today's keys in place of those of old versions of OpenPose, and of AlphaPose's form "cmu"."""
    raw = raw.replace(b'"bodies"', b'"people"').replace(b'"joints"', b'"pose_keypoints_2d"')
    return _OLD_KEY.sub(rb'"\1_keypoints_2d"', raw)


def decode_openpose(raw: bytes) -> list[OpenPosePerson]:
    """All people of one frame; raises msgspec.DecodeError."""
    return _FRAME.decode(with_new_keys(raw)).persons()


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
    paths, start = keypoint_sets.cut_frames(_numbered_files(folder), frames, folder)
    people = [decoded(path, decode_openpose, "openpose") for path in paths]
    places = [(path, "") for path in paths]
    record = people_record(people, places, folder, camera, rate, keypoint_set, start)
    return _calibrated(record, time_offset, image_frame)


def people_record(
    people: Sequence[Sequence[OpenPosePerson]], places: Sequence[tuple[Path, str]], source: Path, camera: str,
    rate: float, keypoint_set: str | None, start: int = 0,
) -> Keypoints:  # fmt: skip
    """The record of all people of every frame; `places` of the frames are their files and places there, for messages.

    `start` is the number of the first frame; others as in `read_openpose`, whose errors it raises.
    """
    if not any(people) and (source.is_dir() or len(people) != 1):
        raise _nobody(len(people), camera)
    first = next((len(persons[0].pose_keypoints_2d) // 3 for persons in people if persons), 0)
    named = keypoint_set or keypoint_sets.SET_OF_COUNT.get(first, "BODY_25B")
    numbers = [_numbers(persons, *place, named) for persons, place in zip(people, places, strict=True)]
    data = keypoint_sets.stacked(numbers, len(keypoint_sets.keypoint_names(named)))
    record = keypoint_sets.keypoint_record(data, camera, named, rate, source, start=start)
    return keypoint_sets.in_right_order(record, stated=keypoint_set is not None)


def _calibrated(record: Keypoints, time_offset: float, image_frame: ImageFrame | None) -> Keypoints:
    """The record on the clock of all cameras, `time_offset` [s] later, and in the pixels of the calibration's image."""
    points = record.points if image_frame is None else sealed(kept(image_frame.to_calibration(record.points)))
    return replace(record, points=points, time_offset=record.time_offset + time_offset)


def _nobody(frames: int, camera: str) -> ObservationError:
    problem = f"no person is detected in any of the {frames} frames of camera {camera}"
    remedy = "Check that the detector ran on this camera's video, or remove this camera."
    return ObservationError(problem, remedy=remedy)


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
    data, start = keypoint_sets.cut_frames(data, frames, path)
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
        data = keypoint_sets.face_mesh(data)
    if not data[..., 2].any():
        raise _nobody(len(data), camera)
    record = keypoint_sets.keypoint_record(data[:, None], camera, keypoint_set, rate, path, start=start)
    return _calibrated(record, time_offset, image_frame)


_CALISCOPE_HANDS = (100, 200)  # first indices of the right and of the left hand
_PORTS = 100  # cameras, beyond which a table is damaged


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
    frame, port, point = (
        keypoint_sets.frame_numbers(table[:, k], columns[k], from_first=columns[k] == "sync_index") for k in (0, 1, 3)
    )
    keypoint_set = MEDIAPIPE_SETS[int(point.max() >= pose)]
    for k, begin in enumerate(_CALISCOPE_HANDS):  # the left hand comes first in the set
        point[(point >= begin) & (point < begin + HAND_POINTS)] += pose + (1 - k) * HAND_POINTS - begin
    if len(np.unique(port)) > _PORTS:
        problem = f"{len(np.unique(port))} ports"
        raise ObservationError(problem, remedy="A port is a camera: export the table again.")
    if rate is None:
        first = port == port[0]
        _, at = np.unique(frame[first], return_index=True)
        rate = float(1 / np.median(np.diff(table[first, 2][at]))) if len(at) > 1 else 1.0
    keypoints = {}
    for p in np.unique(port):
        data = np.zeros((frame.max() + 1, 1, len(KEYPOINT_SETS[keypoint_set]), 3))
        rows = port == p
        data[frame[rows], 0, point[rows]] = np.column_stack([table[rows, 4:6], np.ones(rows.sum())])
        keypoints[f"cam_{p}"] = keypoint_sets.keypoint_record(data, f"cam_{p}", keypoint_set, rate, path)
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
    format : "openpose", "alphapose" (and COCO's results), "mmpose", "mediapipe", "freemocap", "caliscope", \
            "deeplabcut", "sleap", "sports2d" or a plug-in's, optional
        Default: the one that recognises the folder or file. Of caliscope and FreeMoCap the camera of the last number
        in the camera's name.
    camera, rate, time_offset, image_frame
        As in `read_openpose` and `read_mediapipe`; caliscope's tables state their rate.
    **options
        keypoint_set : of all but caliscope. Default: by the number of points or by their names; for DeepLabCut, SLEAP
        and Sports2D any set of the body, whose points then have the names in the file.
        names : {name in the file: point of the set}, "" to leave a point out: of DeepLabCut, SLEAP and Sports2D.
        frames : of `read_openpose` and `read_mediapipe`.

    Raises
    ------
    ObservationError, FileError
        An unknown format, a file of another or of none; names of no point; and what those raise.
    PluginError
        A plug-in fails.
    """
    path = Path(path)
    format = format or KEYPOINTS.name_of(path)
    reader = KEYPOINTS.get(format or "mediapipe", ObservationError)
    if reader.plugin is None and path.is_file():
        refuse_another(path, format)
    record: Keypoints = reader.call(
        "read", path, camera=camera, rate=rate, **options, what=f"Keypoints of the camera '{camera}' at {rate} Hz",
        valid=lambda one: isinstance(one, Keypoints) and one.camera == camera and rate in (None, one.rate),
    )  # fmt: skip
    return _calibrated(record, time_offset, image_frame)


def _is_caliscope(path: Path) -> bool:
    return path.suffix.lower() == ".csv" and b"sync_index" in read_bytes(path, 4096)


def _is_array(path: Path, dimensions: int, *last: tuple[int, int]) -> bool:
    """Whether a file is an array of numbers with as many dimensions, of which the last two are one of these."""
    header = npy_header(path) if path.suffix.lower() == ".npy" else None
    shape = header[0] if header is not None and header[1].kind in "fiu" else ()
    return len(shape) == dimensions and shape[-2:] in last


def _of_number(cameras: Mapping[str, _Decoded], camera: str) -> _Decoded:
    """What a file has of the camera that the last number in a name counts."""
    numbers = re.findall(r"\d+", camera)
    name = f"cam_{int(numbers[-1][-18:])}" if numbers else ""
    if name not in cameras:
        raise ObservationError(choices("camera in this file named", camera, cameras))
    return cameras[name]


@names_file
def _caliscope_camera(path: Path, *, camera: str, rate: float | None) -> Keypoints:
    return replace(_of_number(read_caliscope_csv(path, rate=rate), camera), camera=camera)


@names_file
def _freemocap_camera(path: Path, *, camera: str, rate: float | None, keypoint_set: str | None = None) -> Keypoints:
    """Pose with the right, then the left hand, and the face mesh: (C, F, K, 3) x, y [px], and a depth, not used.

    NaN where undetected. Without a rate, which the file does not state, at 1 Hz.
    """
    data, face = read_npy(path, remedy="Process the videos again."), keypoint_set == FACE_SET
    pose, left, end = (len(KEYPOINT_SETS["MEDIAPIPE_33"]) + k * HAND_POINTS for k in range(3))
    if not _is_array(path, 4, *_FREEMOCAP) or (face and data.shape[2] <= end):
        remedy = "Give FreeMoCap's array of 2D landmarks, (cameras, frames, 33, 75 or 553, 3); with the face 553."
        raise ObservationError(f"landmarks have shape {data.shape}", remedy=remedy)
    uv = _of_number({f"cam_{k}": of for k, of in enumerate(data[..., :2])}, camera)
    uv = uv[:, end:] if face else np.concatenate([uv[:, :pose], uv[:, left:end], uv[:, pose:left]], axis=1)
    seen = np.isfinite(uv).all(axis=-1, keepdims=True)
    whole = np.where(seen, np.concatenate([uv, seen], axis=-1), 0.0)[:, None]
    name = FACE_SET if face else MEDIAPIPE_SETS[int(data.shape[2] > pose)]
    return keypoint_sets.keypoint_record(whole, camera, name, rate or 1.0, path)


_OTHER_FILES = {  # what such a file has near its start, after spaces: what it is
    rb"\{(?=.*\"(?:annotations|categories|file_name)\")": "COCO's annotations of many images",
    rb"\x89HDF\r\n": "HDF5, of which DeepLabCut's and SLEAP's is read with the package h5py (kinefit[hdf5])",
}
_READ = (
    "Give OpenPose's folder of one json file a frame, or a file of AlphaPose, MMPose, MediaPipe, FreeMoCap (2D), "
    "Caliscope, DeepLabCut, SLEAP or Sports2D; others by a package (page own-sensor)."
)


def other_keypoints(path: Path) -> str:
    """What a file of keypoints that are not read is; "" for any other file."""
    start = read_bytes(path, 4096).lstrip()
    return next((what for pattern, what in _OTHER_FILES.items() if re.match(pattern, start, re.DOTALL)), "")


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
        if not FRAME_NUMBER.search(path.name):
            refuse_another(path, "openpose")
            raise ObservationError("no frame number in this name", file=path, remedy="Expected NAME_0012.json.")
    numbered = frames_by_name([path.name.lower().replace("_keypoints", "") for path in files], "frames")
    numbered.refuse_gaps("frames")
    if numbered.step > 1 or numbered.times is not None:
        problem = f"its files are not numbered by one: {files[0].name} and {files[1].name}"
        remedy = "Run the detector on every frame, or number the files by one and give the rate of these frames."
        raise ObservationError(problem, remedy=remedy)
    return files


def decoded(path: Path, decode: Callable[[bytes], _Decoded], format: str) -> _Decoded:
    """What a json file of a format holds; ObservationError if it is of another one, or broken."""
    raw = read_bytes(path)
    try:
        return decode(raw)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        refuse_another(path, format)
        infinite = re.search(rb"[\[,:]\s*-?(NaN|Inf)", raw, re.IGNORECASE)
        problem = "NaN or infinity among the keypoints" if infinite else f"broken json ({error})"
        raise ObservationError(problem, file=path, remedy="Run the detector again on this frame.") from error


def refuse_another(path: Path, format: str | None) -> None:
    """Raise ObservationError for a file that is recognised as of another format, or as nothing that is read."""
    found = KEYPOINTS.name_of(path, [])
    if found not in (None, format):
        problem = f"{KEYPOINTS.get(str(found)).summary}, not {format}"
        raise ObservationError(problem, file=path, remedy=f'Write format = "{found}" in place of "{format}".')
    strange = format is None and path.suffix.lower() != ".npy"
    other = "" if found else other_keypoints(path) or "a file of another kind" * strange
    if other:
        raise ObservationError(f"{other}: no keypoints of a known form", file=path, remedy=_READ)


def _numbers(people: Sequence[OpenPosePerson], path: Path, place: str, keypoint_set: str) -> NDArray:
    """(P, K, 3) x, y [px], confidence of all people of one frame."""
    count = len(keypoint_sets.keypoint_names(keypoint_set))
    values = [p.with_hands() if keypoint_set == keypoint_sets.OPENPOSE_HANDS else p.pose_keypoints_2d for p in people]
    for i, numbers in enumerate(values):
        if len(numbers) != 3 * count:
            fitting = [name for name in KEYPOINT_SETS if 3 * len(KEYPOINT_SETS[name]) == len(numbers)]
            remedy = (
                f"This number fits: {', '.join(fitting)}; name it by set = ... of [[keypoints]]." if fitting
                else f"No set has so many; there are: {', '.join(KEYPOINT_SETS)}. Run the detector with one of these."
            )  # fmt: skip
            problem = f"{len(numbers)} numbers where {keypoint_set} has {count} x 3"
            raise ObservationError(problem, file=path, place=f"{place}person {i}", remedy=remedy)
    data = np.array(values, dtype=float).reshape(len(people), count, 3)
    if not np.isfinite(data).all():
        raise ObservationError("numbers too large", file=path, remedy="Run the detector again on this frame.")
    return data


OPENPOSE = FileFormat("OpenPose (Cao et al. 2021, IEEE TPAMI 43:172)", (), read_openpose, Path.is_dir)
MEDIAPIPE = FileFormat(
    "MediaPipe Pose (Bazarevsky et al. 2020, BlazePose)", (".npy",), read_mediapipe,
    lambda path: _is_array(path, 3, (33, 3), (75, 3)),
)
FREEMOCAP = FileFormat(
    "the landmarks in all images of FreeMoCap", (".npy",), _freemocap_camera,
    lambda path: _is_array(path, 4, *_FREEMOCAP), has_all_cameras=True,
)
CALISCOPE = FileFormat(
    "the landmarks that Caliscope recorded", (".csv",), _caliscope_camera, _is_caliscope, has_all_cameras=True
)
