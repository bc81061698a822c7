"""The tables of a take file as records: every key, default and bound stands here and nowhere else.

What an entry alone can have wrong is refused where it is made: numbers by the bounds of their types, whose descriptions
say what to write; keys that need each other by `__post_init__`.
"""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from kinefit._files import LENGTHS, worth
from kinefit.errors import choices, located
from kinefit.geometry import se3
from kinefit.observations import KEYPOINT_SIGMA
from kinefit.readers.landmarks.keypoint_sets import FACE_SET, KEYPOINT_SETS, MEDIAPIPE_SETS
from kinefit.readers.plugins import KEYPOINTS
from kinefit.readers.take.kinds import KINDS, TakeEntry, refuse

_Read = TypeVar("_Read")
Pixels = Annotated[float, Meta(gt=0, lt=1e4, description="Give a positive number of pixels.")]
Rate = Annotated[float, Meta(gt=0, lt=1e6, description="Give frames per second, a positive number, or remove it.")]
Metres = Annotated[float, Meta(gt=0, lt=1, description="Give metres, above 0 and below 1.")]
Seconds = Annotated[float, Meta(gt=-1e6, lt=1e6, description="Give seconds.")]
_Scale = Annotated[float, Meta(gt=0, lt=1e6, description="Give a positive number: unit in metres a count, times in s.")]
_Number = Annotated[float, Meta(ge=-1e6, le=1e6, description="Give metres, directions and degrees.")]
_Side = Annotated[int, Meta(ge=1, lt=100_000, description="Give [width, height] in pixels.")]
_Shift = Annotated[float, Meta(gt=-1e4, lt=1e4, description="Give metres.")]
_Turn = Annotated[float, Meta(ge=-360, le=360, description="Give degrees, at most 360.")]
_Focal = Annotated[float, Meta(gt=0, description="Give [fx, fy, cx, cy] in pixels.")]
_Length = Annotated[float, Meta(gt=0, description="Give [left, top, width, height] in pixels of the video.")]
_Reach = Annotated[float, Meta(ge=0, description="Give [near, far] in metres.")]
_Place = Annotated[float, Meta(ge=0, lt=1, description="Give metres below 1: one farther off needs calibration.")]
_Angle = Annotated[float, Meta(ge=0, lt=30, description="Give degrees below 30: one farther off needs calibration.")]
_View = Annotated[float, Meta(ge=5, le=150, description="Give degrees from 5 to 150.")]
_Mass = Annotated[float, Meta(gt=2, lt=700, description="Give the mass in kilograms, or remove it.")]
_Stature = Annotated[float, Meta(gt=0.3, lt=3, description="Give the stature in metres, or remove it.")]
_Disparity = Annotated[float, Meta(gt=0, lt=100, description="Give a positive number of pixels.")]
_BandSigma = Annotated[float, Meta(gt=0, lt=1, description="Give the standard deviation of a band in metres: 0.005.")]
_Step = Annotated[int, Meta(gt=-(10**9), lt=10**9, description="Give [first, one after the last].")]
_Counted = Annotated[
    int, Meta(ge=0, lt=10**9, description="Give [first, one after the last], counted from 0, for every range.")
]


SKIN_SETS = ("HANDS", "WRISTS")
"""Which points of the body the skin's patches are: middles of the hands, or wrists of a body without fingers."""

NO_FILES = ("detect", "skin")
"""Formats of `[[keypoints]]` that are computed from videos, besides those of files."""

COUNTED = ("openpose", "alphapose", "mmpose")
"""Formats of `[[keypoints]]` whose set the number of points tells, or the user."""

NAMED = ("deeplabcut", "sleap", "sports2d")
"""Those whose points have names, of a known set or of a set of the body's own."""

RENAMED: dict[str, dict[str, str]] = {
    table: {"accuracy": "sigma"} for table in ("keypoints", "silhouette", "markers", "depth", "stereo")
}
"""{table: {old key: new key}}: old keys are read with a warning in this version, and are unknown in the next."""


class StartEntry(TakeEntry, frozen=True, kw_only=True):
    """`[start]`: where the body is at one step, for sensors that alone cannot find it."""

    at: tuple[_Number, _Number, _Number] | None = None  # [m] of the root's origin in the world; of clicks alone: none
    forward: tuple[_Number, _Number, _Number] | None = None  # direction in the world in which the root's x looks
    upward: tuple[_Number, _Number, _Number] | None = None  # and its y; default: the take's `up`
    angles: dict[str, _Number] = msgspec.field(default_factory=dict)  # [deg] or, of joints that slide, [m]; others are
    # those of the default pose
    step: int | None = None  # of the common time; default: the first
    low_pass: bool = True  # whether silhouettes are also fitted with low-pass approximations of the surface first
    clicks: Path | None = None  # joints clicked at any steps, which are measurements of their steps
    click_sigma: Pixels = 3.0  # [px] standard deviation of a click along each axis, in the calibration's image

    @property
    def is_clicks_alone(self) -> bool:
        """Whether it states clicks, and no pose."""
        return self.clicks is not None and self == StartEntry(clicks=self.clicks, click_sigma=self.click_sigma)


class SessionEntry(TakeEntry, frozen=True, kw_only=True):
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


class CalibrationEntry(TakeEntry, frozen=True, kw_only=True):
    """`[calibration]`: where the cameras stood."""

    file: Path
    unit: str | float = "auto"  # of its translations, where the format does not state it; or [m] of one
    position_sigma: _Place | None = None  # [m] of each camera's position; with rotation_sigma, or neither
    rotation_sigma: _Angle | None = None  # [deg] of each camera's direction; both 0 for an exact calibration

    def __post_init__(self) -> None:
        both = self.position_sigma, self.rotation_sigma
        problem = "position_sigma {}, rotation_sigma {}".format(*both)
        remedy = "Give metres and degrees above 0, or 0 and 0 for an exact calibration, or neither."
        refuse(both not in ((None, None), (0, 0)) and not all(both), problem, remedy)


class CameraEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[camera]]`: one camera of the calibration, with its video or the size of its image."""

    name: str
    video: Path | None = None
    topic: str | None = None  # of a video that is an MCAP recording of ROS 2: "/front/color/image_raw"
    stream: str | None = None  # of `kinefit live`: a webcam's number, an address, or a folder that fills up
    size: tuple[_Side, _Side] | None = None  # [px] (width, height) of the image; default: the video's
    image: Literal["as calibrated", "scaled", "letterboxed"] = "as calibrated"  # what became of the image
    rotation: Literal[0, 90, 180, 270] = 0  # [deg] the image is the calibration's, turned clockwise
    time_offset: Seconds = 0.0  # [s] added to frame / rate
    field_of_view: _View | None = None  # [deg] across the longer side, of a camera of a take without calibration

    def __post_init__(self) -> None:
        refuse(self.stream is not None and self.video is not None, "a stream and a video", "Remove one of the two.")


class KeypointsEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[keypoints]]`: what a detector saw in one camera."""

    camera: str
    file: Path | None = None  # or folder; default, of "detect" only: what `kinefit detect` leaves next to the take
    stream: Path | None = None  # of `kinefit live`, in place of a file: a folder that OpenPose's JSON files come into
    format: str = "openpose"  # of `KEYPOINTS`, or "detect" or "skin"
    set: str | None = None  # default: by the number or the names of the points, MEDIAPIPE_33, HANDS of skin
    names: dict[str, str] | None = None  # {name in the file: point of the set, "" for none}
    frame: Literal["calibration", "video"] | None = None  # image frame of the coordinates; needed where the two differ
    rate: Rate | None = None  # [Hz]; default: the camera's video, or the take
    sigma: Pixels = KEYPOINT_SIGMA  # [px] standard deviation, in the calibration's image
    frames: tuple[_Step, _Step] | None = None  # steps (start, stop) at which they count; default: all
    excluded: tuple[tuple[_Counted, _Counted], ...] = ()  # ranges (start, stop) of steps at which they do not count
    swapped: tuple[tuple[_Counted, _Counted], ...] = ()  # ranges (start, stop) of steps at which left is right
    face: tuple[float, float, _Length, _Length] | None = None  # [px] of "skin": left, top, width, height in the video

    def __post_init__(self) -> None:
        files, own = KEYPOINTS.names(), (*KEYPOINTS.built_in, *NO_FILES)
        self._uses(self.format, {
            "file": (*files, "detect"), "frame": files, "rate": files, "face": ("skin",), "stream": ("openpose",),
            "excluded": (*files, "detect"), "swapped": (*files, "detect"), "set": own, "names": NAMED,
        })  # fmt: skip
        of_all, of_face = dict.fromkeys(COUNTED, tuple(KEYPOINT_SETS)), (*MEDIAPIPE_SETS, FACE_SET)
        sets = {**of_all, "skin": SKIN_SETS, "detect": of_face, "freemocap": of_face}
        known = sets.get(self.format, MEDIAPIPE_SETS)
        kind = "keypoint set" if self.format in COUNTED else f"keypoint set of {self.format}"
        odd = self.set is not None and self.set not in known and self.format not in NAMED
        refuse(odd, choices(kind, str(self.set), known), f'Use set = "{known[0]}", or remove it.')
        none = self.file is None and self.stream is None and self.format not in NO_FILES
        refuse(none, f"no file of {self.format} keypoints", 'Write file = "...", or format = "detect".')
        self._ordered("frames", "excluded", "swapped")
        if self.stream is not None:
            refuse(self.file is not None, "a stream and a file", "Remove one of the two.")
            for key in ("excluded", "swapped"):
                refuse(getattr(self, key), f"'{key}' has no use with a stream", "Leave it out.")


class PlateEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[plate]]`: force plates in a file of their own; those of a C3D that `[[markers]]` names come with it."""

    file: Path  # .c3d, or .mot of OpenSim
    time_offset: Seconds = 0.0  # [s]
    shift: tuple[_Shift, _Shift, _Shift] = (0.0, 0.0, 0.0)  # [m] of the file's origin, in the world
    turn: tuple[_Turn, _Turn, _Turn] = (0.0, 0.0, 0.0)  # [deg] rotation vector, from the file's axes to the world's

    @property
    def T_world_file(self) -> NDArray:
        """(4, 4) [m] from the frame of the file to the world."""
        return se3.transform(se3.exp_so3(np.radians(self.turn)), np.array(self.shift))


class PlacedEntry(PlateEntry, frozen=True, kw_only=True):
    """A file of places in a world of its own."""

    sigma: Metres = 0.005  # [m] standard deviation


class MarkersEntry(PlacedEntry, frozen=True, kw_only=True):
    """`[[markers]]`: a marker recording."""

    unit: str | None = None  # where the file does not state it
    set: str | None = None  # the body's marker set that its labels belong to; default: the one that fits
    sides: Literal["labelled", "exchanged", "mirrored-x", "mirrored-y", "mirrored-z"] | None = None  # None: checked
    model: Path | None = None  # of the subject, for markers without names; default: they have names
    static: Path | None = None  # labelled static trial of the same subject, for lengths and marker offsets

    def __post_init__(self) -> None:
        odd = self.unit is not None and worth(self.unit, LENGTHS) is None
        refuse(odd, choices("unit", str(self.unit), LENGTHS), "Use one of these.")


class DepthEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[depth]]`: a depth sensor."""

    name: str
    camera: str | None = None  # its camera in the calibration; default: of its own name
    file: Path | None = None  # or folder, or pattern (frames/depth_*.png)
    stream: Path | None = None  # of `kinefit live`, in place of a file: a folder that depth images come into
    topic: str | None = None  # of a file that is an MCAP recording of ROS 2: "/front/depth/image_raw"
    unit: _Scale | None = None  # [m] of one count; default: what the file states, else millimetres
    size: tuple[_Side, _Side] | None = None  # [px] (width, height), of raw files
    range: tuple[_Reach, _Reach] | None = None  # [m] (near, far): what is measured outside of it is dropped
    intrinsics: tuple[_Focal, _Focal, float, float] | None = None  # [px] fx, fy, cx, cy, in a take without calibration
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6]] besides the intrinsics
    rate: Rate | None = None  # [Hz]; default: what the file states, the take's, the videos'
    time_unit: _Scale | None = None  # [s] of the last number in every file's name, where that is the time
    time_offset: Seconds = 0.0  # [s] time of the first frame
    sigma: Metres = 0.01  # [m] standard deviation of a depth
    background: Path | None = None  # the same sensor before the empty scene
    on_body: bool = False  # everything but the body was taken out already
    segment: str | None = None  # of clouds of points: the one segment of the body that they are on

    def __post_init__(self) -> None:
        problem = "neither a file nor a stream" if self.file is None else "a stream and a file"
        remedy = 'Write file = "...", or, for `kinefit live`, stream = "FOLDER".'
        refuse((self.stream is None) == (self.file is None), problem, remedy)
        if self.stream is not None:
            for key in ("time_unit", "segment"):
                refuse(getattr(self, key) is not None, f"'{key}' has no use with a stream", "Remove it.")
            unsized = self.intrinsics is not None and self.size is None
            remedy = "Write size = [width, height] of its images."
            refuse(unsized, "a stream with intrinsics, and no size", remedy)
        bare = self.distortion and self.intrinsics is None
        refuse(bare, "distortion without intrinsics", "Write intrinsics = [fx, fy, cx, cy] too.")
        self._ordered("range")


class StereoEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[stereo]]`: two cameras of the take whose videos give depth."""

    left: str
    right: str
    range: tuple[_Scale, _Scale] = (0.5, 6.0)  # [m] along the left camera's axis
    sigma: _Disparity = 0.5  # [px] standard deviation of a disparity

    def __post_init__(self) -> None:
        self._ordered("range")
        refuse(self.left == self.right, "left and right are one camera", "Name two cameras.")

    @property
    def name(self) -> str:
        """Name of the depth sensor that the two are."""
        return f"{self.left}-{self.right}"


@dataclass(frozen=True, kw_only=True)
class TakeHead:
    """`[take]`: what holds for the whole take.

    Parameters
    ----------
    name : str
        Default: the take file's own name.
    rate : float [Hz] or None
        None: the videos' or markers'.
    up : "x", "y", "z", "-x", "-y" or "-z"
        Vertical axis of the calibration's (or markers') world.
    body : str
        Name in the catalogue, or absolute path of a body file.
    bands : {joint: float [m]} or None
        Joints by elastic bands in place of hard ones, see `correspondences.closures.with_bands`; "all": all others.
    height : float [m] or None
        Stature of the person, as a first guess.
    mass : float [kg] or None
        Of the person: scales the masses of segments; None: about that of people of the stature.
    person : int, str or None
        The target person if several are in view, see `PersonChoice`; None: the one with most visible points.
    subject : Path or None
        Take of the same person (a T-pose trial) that bone lengths come from; None: from this take itself.
    start : Path or None
        Motion file (`motion.npz`) that gives body and pose of the first step; None: they are sought.
    size : bool or None
        Whether the body is fitted to the person's size and shape; None: unless `start` tells it.
    frames : (start, stop) or None
        Steps of the common time, t = step / rate.
    hide_faces : bool
        Whether images and videos that are made from the take's show no faces.
    """

    name: str = ""
    rate: Rate | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    body: str = "humanoid"
    bands: dict[str, _BandSigma] | None = None
    height: _Stature | None = None
    mass: _Mass | None = None
    person: int | str | None = None
    subject: Path | None = None
    start: Path | None = None
    size: bool | None = None
    frames: tuple[_Step, _Step] | None = None
    hide_faces: bool = False


_OLD_ATTRIBUTES = {
    "silhouettes": "silhouette", "regions": "region", "lines": "lines", "surface_points": "surface_points",
}  # fmt: skip
"""{attribute of a `Take` and its `Observations` in 0.2: its table}"""


def old_attribute(name: str, successor: str) -> str:
    """The table that an attribute of 0.2 is of, with a warning; AttributeError if it was none."""
    if name not in _OLD_ATTRIBUTES:
        raise AttributeError(name)
    warnings.warn(f"'{name}' is {successor} by the name of its table now", FutureWarning, stacklevel=3)
    return _OLD_ATTRIBUTES[name]


@dataclass(frozen=True, kw_only=True)
class Take(TakeHead):
    """A take file, checked: all names in it agree and all files it names exist.

    Parameters
    ----------
    path : Path
        Of the take file.
    session : SessionEntry, subject and movement of the recording
    placed : StartEntry or None, `[start]`
    calibration : CalibrationEntry or None
    cameras, keypoints, markers, depth, stereo, skin : tuples
        Of entries; `skin` are the [[keypoints]] of format "skin", `keypoints` all others.
    plates : tuple of PlateEntry
    sensors : {table: entries} of all other kinds, see `SensorKind`
    digest : str
        SHA-256 of the file's tables as they are written, without comments and spacing; "" for a take of no file.
    """

    path: Path
    digest: str = ""
    session: SessionEntry = field(default_factory=SessionEntry)
    placed: StartEntry | None = None
    calibration: CalibrationEntry | None = None
    cameras: tuple[CameraEntry, ...] = ()
    keypoints: tuple[KeypointsEntry, ...] = ()
    markers: tuple[MarkersEntry, ...] = ()
    depth: tuple[DepthEntry, ...] = ()
    stereo: tuple[StereoEntry, ...] = ()
    skin: tuple[KeypointsEntry, ...] = ()
    plates: tuple[PlateEntry, ...] = ()
    sensors: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Keypoints by colour apart from others."""
        if skin := tuple(entry for entry in self.keypoints if entry.format == "skin"):
            object.__setattr__(self, "skin", (*self.skin, *skin))
            object.__setattr__(self, "keypoints", tuple(entry for entry in self.keypoints if entry.format != "skin"))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            return self.sensors.get(old_attribute(name, "Take.sensors"), ())

    @property
    def pose(self) -> StartEntry | None:
        """Where the body is at one step."""
        return None if self.placed is None or self.placed.is_clicks_alone else self.placed

    @property
    def clicks(self) -> Path | None:
        """Joints that were clicked in images, see `read_clicks`."""
        return None if self.placed is None else self.placed.clicks

    @property
    def click_sigma(self) -> float:
        """Standard deviation [px] of a click along each axis."""
        return (self.placed or StartEntry()).click_sigma

    @property
    def other_sensors(self) -> tuple[object, ...]:
        """Entries of all sensors but cameras and the keypoints of a detector."""
        others = (*SINGLE_TABLES, "camera", "keypoints", "plate")
        return (*(entry for table, _, entry in self.entries if table not in others), *self.skin)

    @property
    def entries(self) -> Iterator[tuple[str, str, Any]]:
        """Every entry of every table: table, the entry's name in messages, entry."""
        for table in TABLES:
            found = self if table == "take" else getattr(self, ATTRIBUTES.get(table, table))
            of_table = found if isinstance(found, tuple) else () if found is None else (found,)
            for entry in (*of_table, *(self.skin if table == "keypoints" else ())):
                yield table, title_of(table, entry), entry
        for table, entries in self.sensors.items():
            for entry in entries:
                yield table, title_of(table, entry), entry


TABLES: dict[str, type[Any]] = {
    "take": TakeHead, "session": SessionEntry, "start": StartEntry, "calibration": CalibrationEntry,
    "camera": CameraEntry, "keypoints": KeypointsEntry, "markers": MarkersEntry, "depth": DepthEntry,
    "stereo": StereoEntry, "plate": PlateEntry,
}  # fmt: skip
"""Tables of a take file but those of each `SensorKind`, and their keys as the fields of a record."""
ATTRIBUTES = {"start": "placed", "camera": "cameras", "plate": "plates"}
"""{table: attribute of a `Take`} where they differ; the keys of [take] are attributes themselves."""
SINGLE_TABLES = ("take", "session", "start", "calibration")


def entry_class(table: str) -> type[Any]:
    """The record of a table's entries."""
    return TABLES.get(table) or KINDS.get(table).entry


def keys_of(table: str) -> tuple[str, ...]:
    """All keys of a table."""
    record = entry_class(table)
    return tuple(getattr(record, "__struct_fields__", None) or record.__dataclass_fields__)


def title_of(table: str, entry: Any) -> str:
    """Name of an entry in messages."""
    if table in SINGLE_TABLES:
        return f"[{table}]"
    if table not in ("camera", "depth", "stereo"):
        if hasattr(entry, "camera"):
            return f"{table} of camera {entry.camera}"
        file = getattr(entry, "file", None)
        return f"{table} {file.name}" if isinstance(file, Path) else table
    return f"{table} {entry.name}"


def read_each(take: Take, entries: Iterable[Any], read: Callable[[Any], _Read]) -> tuple[_Read, ...]:
    """What is read of each of some entries of a take; errors get the entry's name."""
    out, names = [], {id(entry): name for _, name, entry in take.entries}
    for entry in entries:
        with located(take.path, names[id(entry)]):
            out.append(read(entry))
    return tuple(out)


def sensor_name(kind: str, entries: Sequence[object], k: int) -> str:
    """Name of the sensor of the k-th entry of a kind in a take."""
    return kind if len(entries) == 1 else f"{kind} {k + 1}"
