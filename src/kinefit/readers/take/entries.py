"""The tables of a take file as typed records; every default stands here and nowhere else."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.observations import KEYPOINT_SIGMA


class _Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the take file; paths are absolute once it is read."""


SKIN_SETS = ("HANDS", "WRISTS")
"""Which points of the body the skin's patches are: middles of the hands, or wrists of a body without fingers."""

RENAMED: dict[str, dict[str, str]] = {
    table: {"accuracy": "sigma"} for table in ("keypoints", "silhouette", "markers", "depth", "stereo")
}
"""{table: {old key: new key}}: old keys are read with a warning in this version, and are unknown in the next."""


class StartEntry(_Entry, frozen=True, kw_only=True):
    """`[start]`: where the body is at one step, for sensors that alone cannot find it."""

    at: tuple[float, float, float] | None = None  # [m] of the root's origin in the world; of clicks alone: none
    forward: tuple[float, float, float] | None = None  # direction in the world in which the root's x looks
    upward: tuple[float, float, float] | None = None  # and its y; default: the take's `up`
    angles: dict[str, float] = {}  # [deg] or, of joints that slide, [m]; others are the body's usual ones
    step: int | None = None  # of the common time; default: the first
    low_pass: bool = True  # whether silhouettes are also fitted with low-pass approximations of the surface first
    clicks: Path | None = None  # joints clicked at any steps, which are measurements of their steps
    click_sigma: float = 3.0  # [px] standard deviation of a click along each axis, in the calibration's image

    @property
    def is_clicks_alone(self) -> bool:
        """Whether it states clicks, and no pose."""
        return self.clicks is not None and self == StartEntry(clicks=self.clicks, click_sigma=self.click_sigma)


class SessionEntry(_Entry, frozen=True, kw_only=True):
    """`[session]`: subject and movement of the recording, for the report; nothing is computed from it."""

    subject: str = ""  # a code rather than a name
    date: datetime.date | None = None  # of the recording, 2026-03-02
    movement: str = ""
    side: Literal["left", "right", "both", ""] = ""  # that is affected, or that the movement is about
    visit: str = ""
    operator: str = ""
    notes: str = ""
    norms: Path | None = None  # table of normative values over the cycle: coordinate, percent, mean, sd

    @property
    def stated(self) -> dict[str, str]:
        """What was stated, as texts."""
        return {k: str(v) for k in self.__struct_fields__ if (v := getattr(self, k)) and k != "norms"}


class CalibrationEntry(_Entry, frozen=True, kw_only=True):
    """`[calibration]`: where the cameras stood."""

    file: Path
    unit: str | float = "auto"  # of its translations, where the format does not state it; or [m] of one
    position_sigma: float | None = None  # [m] of each camera's position; with rotation_sigma, or neither
    rotation_sigma: float | None = None  # [deg] of each camera's direction; both 0 for an exact calibration


class CameraEntry(_Entry, frozen=True, kw_only=True):
    """`[[camera]]`: one camera of the calibration, with its video or the size of its image."""

    name: str
    video: Path | None = None
    topic: str | None = None  # of a video that is an MCAP recording of ROS 2: "/front/color/image_raw"
    stream: str | None = None  # of `kinefit live`: a webcam's number, an address, or a folder that fills up
    size: tuple[int, int] | None = None  # [px] (width, height) of the image; default: the video's
    image: Literal["as calibrated", "scaled", "letterboxed"] = "as calibrated"  # what became of the image
    rotation: Literal[0, 90, 180, 270] = 0  # [deg] the image is the calibration's, turned clockwise
    time_offset: float = 0.0  # [s] added to frame / rate
    field_of_view: float | None = None  # [deg] across the longer side, of a camera of a take without calibration


class KeypointsEntry(_Entry, frozen=True, kw_only=True):
    """`[[keypoints]]`: what a detector saw in one camera."""

    camera: str
    file: Path | None = None  # or folder; default, of "detect" only: what `kinefit detect` leaves beside the take
    stream: Path | None = None  # of `kinefit live`, in place of a file: a folder that OpenPose's JSON files come into
    format: Literal["openpose", "mediapipe", "caliscope", "detect", "skin"] = "openpose"
    set: str | None = None  # default: BODY_25B of openpose, MEDIAPIPE_33 of mediapipe, HANDS of skin
    frame: Literal["calibration", "video"] | None = None  # image frame of the coordinates; needed where the two differ
    rate: float | None = None  # [Hz]; default: the camera's video, or the take
    sigma: float = KEYPOINT_SIGMA  # [px] standard deviation, in the calibration's image
    frames: tuple[int, int] | None = None  # steps (start, stop) at which they count; default: all
    excluded: tuple[tuple[int, int], ...] = ()  # ranges (start, stop) of steps at which they do not count
    swapped: tuple[tuple[int, int], ...] = ()  # ranges (start, stop) of steps at which left is right
    face: tuple[float, float, float, float] | None = None  # [px] of "skin": left, top, width, height in the video


class SilhouetteEntry(_Entry, frozen=True, kw_only=True):
    """`[[silhouette]]`: which pixels of one camera show the person."""

    camera: str
    file: Path | None = None  # of "masks": folder or pattern; of "background": image of the empty scene
    format: Literal["masks", "background", "threshold", "detect"] = "masks"
    frame: Literal["calibration", "video"] | None = None  # image frame of the masks; needed where the two differ
    rate: float | None = None  # [Hz] of the masks; default: the camera's video, or the take
    sigma: float = 4.0  # [px] standard deviation of an outline, in the calibration's image
    low: tuple[int, int, int] | None = None  # of "threshold": least value of each channel that is the body's
    high: tuple[int, int, int] | None = None  # and the largest
    channels: Literal["rgb", "hsv", "lab", "ycrcb"] | None = None  # of low and high, 8 bits each; default: rgb
    smooth: float | None = None  # [px] of the Gaussian before the Laplace operator; default: 1


class RegionEntry(_Entry, frozen=True, kw_only=True):
    """`[[region]]`: a camera in whose video the body is followed by the colours inside and outside of its contour."""

    camera: str
    sigma: float | None = None  # [px] standard deviation of the contour, shape included; default: as the body is made


class LinesEntry(_Entry, frozen=True, kw_only=True):
    """`[[lines]]`: image lines in one camera on which points or edges of the body lie."""

    camera: str
    file: Path  # table of frame, line, u1, v1, u2, v2 [px]
    landmarks: dict[str, tuple[str, ...]]  # of each line: two ends of an edge of the body, or one point
    frame: Literal["calibration", "video"] | None = None  # image frame of the lines; needed where the two differ
    rate: float | None = None  # [Hz]; default: the camera's video, or the take
    sigma: float = 2.0  # [px] standard deviation, in the calibration's image


class SurfacePointsEntry(_Entry, frozen=True, kw_only=True):
    """`[[surface_points]]`: a surface that was tracked, such as by `kinefit surface`."""

    file: Path  # table of time_s, point, x, y, z, std_x, std_y, std_z [s, m]
    time_offset: float = 0.0  # [s]
    sigma: float = 0.01  # [m] standard deviation by which the surface slides on the bone, and the body's shape is off


class _PlacedEntry(_Entry, frozen=True, kw_only=True):
    """A file of places in a world of its own."""

    file: Path
    time_offset: float = 0.0  # [s]
    sigma: float = 0.005  # [m] standard deviation
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m] of the file's origin, in the world
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [deg] rotation vector, from the file's axes to the world's

    @property
    def T_world_file(self) -> NDArray:
        """(4, 4) [m] from the frame of the file to the world."""
        return se3.transform(se3.exp_so3(np.radians(self.turn)), np.array(self.shift))


class MarkersEntry(_PlacedEntry, frozen=True, kw_only=True):
    """`[[markers]]`: a marker recording."""

    unit: str | None = None  # where the file does not state it
    set: str | None = None  # the body's marker set that its labels belong to; default: the one that fits
    sides: Literal["labelled", "exchanged", "mirrored-x", "mirrored-y", "mirrored-z"] | None = None  # None: checked
    model: Path | None = None  # of the subject, for markers without names; default: they have names


class TrackerEntry(_PlacedEntry, frozen=True, kw_only=True):
    """`[[tracker]]`: trackers fixed on the body, such as magnetic ones: poses of segments, or places of points."""

    points: dict[str, str]  # of each tracker of the file: landmark of the body, or segment, whose origin it then is
    mounts: dict[str, tuple[float, float, float]] = {}  # [deg] rotation vector, from a tracker's axes to its segment's
    rotation_sigma: float = 2.0  # [deg] standard deviation of an orientation
    mount_sigma: float = 0.0  # [deg] standard deviation of the mounts, which are then estimated; default: exact


class DepthEntry(_Entry, frozen=True, kw_only=True):
    """`[[depth]]`: a depth sensor."""

    name: str
    camera: str | None = None  # its camera in the calibration; default: of its own name
    file: Path | None = None  # or folder, or pattern (frames/depth_*.png)
    stream: Path | None = None  # of `kinefit live`, in place of a file: a folder that depth images come into
    topic: str | None = None  # of a file that is an MCAP recording of ROS 2: "/front/depth/image_raw"
    unit: float | None = None  # [m] of one count; default: what the file states, else millimetres
    size: tuple[int, int] | None = None  # [px] (width, height), of raw files
    range: tuple[float, float] | None = None  # [m] (near, far): what is measured outside of it is dropped
    intrinsics: tuple[float, float, float, float] | None = None  # [px] fx, fy, cx, cy, in a take without calibration
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6]] beside the intrinsics
    rate: float | None = None  # [Hz]; default: what the file states, the take's, the videos'
    time_unit: float | None = None  # [s] of the last number in every file's name, where that is the time
    time_offset: float = 0.0  # [s] time of the first frame
    sigma: float = 0.01  # [m] standard deviation of a depth
    background: Path | None = None  # the same sensor before the empty scene
    on_body: bool = False  # everything but the body was taken out already
    segment: str | None = None  # of clouds of points: the one segment of the body that they are on


class StereoEntry(_Entry, frozen=True, kw_only=True):
    """`[[stereo]]`: two cameras of the take whose videos give depth."""

    left: str
    right: str
    range: tuple[float, float] = (0.5, 6.0)  # [m] along the left camera's axis
    sigma: float = 0.5  # [px] standard deviation of a disparity

    @property
    def name(self) -> str:
        """Name of the depth sensor that the two are."""
        return f"{self.left}-{self.right}"


class _Head(_Entry, frozen=True, kw_only=True):
    name: str | None = None
    rate: float | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    body: str = "humanoid"
    height: float | None = None
    person: int | str | None = None
    subject: Path | None = None
    start: Path | None = None
    size: bool | None = None
    frames: tuple[int, int] | None = None
    hide_faces: bool = False  # in all images and videos that show what the cameras saw


TABLES: dict[str, type[msgspec.Struct]] = {
    "take": _Head, "session": SessionEntry, "start": StartEntry, "calibration": CalibrationEntry, "camera": CameraEntry,
    "keypoints": KeypointsEntry, "markers": MarkersEntry, "depth": DepthEntry, "stereo": StereoEntry,
    "silhouette": SilhouetteEntry, "region": RegionEntry, "lines": LinesEntry,
    "surface_points": SurfacePointsEntry, "tracker": TrackerEntry,
}  # fmt: skip
"""Every table of a take file, and its keys as the fields of a record."""


def sensor_name(kind: str, entries: Sequence[object], k: int) -> str:
    """Name of the sensor of the k-th entry of a kind in a take."""
    return kind if len(entries) == 1 else f"{kind} {k + 1}"
