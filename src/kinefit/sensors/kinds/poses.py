"""`[[pose]]`: joints in space, or a whole motion, that another program estimated: a second opinion.

`[[tracker]]`: trackers fixed on the body, such as magnetic ones: poses of segments, or places of points.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, field
from numpy.typing import ArrayLike, NDArray

from kinefit._files import LENGTHS, rate_of, read_npz, read_table, read_text, repeated, worth
from kinefit.bodies import Body
from kinefit.bodies.marker_sets.sets import read_sides
from kinefit.bodies.motion import UP_AXES
from kinefit.bodies.toml.joint_names import LIMBS, SIDES, conventions, find, plain
from kinefit.errors import FileError, KinefitError, ObservationError, check_choice, choices
from kinefit.geometry import se3
from kinefit.observations import BodyTrackerFrame, SensorRecording
from kinefit.readers.markers import read_markers
from kinefit.readers.motion import FORMAT, read_motion
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.readers.take.cameras import TakeCameras, stated_rate
from kinefit.readers.take.entries import Metres, PlacedEntry, Rate
from kinefit.readers.take.kinds import Proposal, SensorKind, refuse
from kinefit.sensors.points.body_trackers import BodyTrackerSensor
from kinefit.sensors.points.poses import HIPS, Place, PoseErrors, PoseSensor

_POSITION_COLUMNS = ("time_s", "x", "y", "z")
_QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
_TABLE_REMEDY = "Give a table with the columns time_s, tracker, x, y, z [s, m] and, for orientations, qw, qx, qy, qz."
_MAX_NORM_ERROR = 0.5  # of a unit quaternion; rounding changes it by much less


class TrackerEntry(PlacedEntry, frozen=True, kw_only=True):
    """`[[tracker]]`."""

    points: dict[str, str]  # of each tracker of the file: landmark of the body, or segment, whose origin it then is
    mounts: dict[str, tuple[float, float, float]] = field(default_factory=dict)  # [deg] rotation vector, from a
    # tracker's axes to its segment's
    rotation_sigma: float = 2.0  # [deg] standard deviation of an orientation
    mount_sigma: float = 0.0  # [deg] standard deviation of the mounts, which are then estimated; default: exact


@dataclass(frozen=True, eq=False)
class BodyTrackerRecording(SensorRecording):
    """Trackers on the body over time.

    Parameters
    ----------
    sensor, rate, times : see `SensorRecording`
    names : (K,) of the trackers
    x_world : (F, K, 3) [m]; NaN if missing
    Rs_world_tracker : (F, K, 3, 3); NaN if missing
    source : file, for messages
    """

    names: tuple[str, ...]
    x_world: NDArray
    Rs_world_tracker: NDArray
    source: str = ""

    def frame(self, i: int) -> BodyTrackerFrame:
        """Frame number `i`; a negative number counts from the end."""
        i, time = self._at(i)
        return BodyTrackerFrame(self.sensor, time, self.names, self.x_world[i], self.Rs_world_tracker[i])


def read_body_trackers(
    path: Path, names: Iterable[str], sensor: str = "trackers", *, time_offset: float = 0.0,
    T_world_file: ArrayLike | None = None,
) -> BodyTrackerRecording:  # fmt: skip
    """Read named trackers of a table with the columns time_s, tracker, x, y, z [s, m], and optional qw, qx, qy, qz.

    Parameters
    ----------
    names : of the trackers to read; other rows are skipped
    time_offset : float [s] added to the times
    T_world_file : (4, 4) [m] from the frame of the table to the world; default: they are the same

    Raises
    ------
    FileError
        No such table, other columns, an invalid number or quaternion, a tracker twice at one time.
    ObservationError
        A name that the table lacks; a single time, which gives no rate.
    """
    names, T = tuple(names), np.eye(4) if T_world_file is None else np.asarray(T_world_file, float)
    labels, values = read_table(path, _POSITION_COLUMNS, _TABLE_REMEDY, text="tracker", optional=_QUATERNION_COLUMNS)
    for name in names:
        if name not in labels:
            remedy = "Correct the name in `points` of this [[tracker]]."
            raise ObservationError(choices("tracker", name, list(dict.fromkeys(labels))), file=path, remedy=remedy)
    turned = np.isfinite(values[:, 4:]).all(axis=1)
    norm = np.linalg.norm(values[:, 4:], axis=1)
    odd = ~np.isnan(values[:, 4:]).all(axis=1) & ~(turned & (np.abs(norm - 1.0) < _MAX_NORM_ERROR))
    for bad, problem in (
        (~np.isfinite(values[:, :4]).all(axis=1), "a number that is not finite"),
        (odd, "qw, qx, qy, qz are not a unit quaternion"),
    ):
        if bad.any():
            place = f"line {int(np.argmax(bad)) + 2}"
            raise FileError(problem, file=path, place=place, remedy="Remove the row, or leave its quaternion empty.")
    keys = [(t, name) for t, name in zip(values[:, 0].tolist(), labels)]
    if twice := repeated(f"{name} at {t:g} s" for t, name in keys):
        raise FileError(f"{twice[0]} has two rows", file=path, remedy="Keep one.")
    times, frame = np.unique(values[:, 0], return_inverse=True)
    x, R = np.full((len(times), len(names), 3), np.nan), np.full((len(times), len(names), 3, 3), np.nan)
    for k, name in enumerate(names):
        own = np.array([label == name for label in labels])
        x[frame[own], k] = se3.apply(T, values[own, 1:4])
        R[frame[own & turned], k] = T[:3, :3] @ se3.rotation_from_quaternion(values[own & turned, 4:])
    rate = rate_of(times, path, _TABLE_REMEDY)
    return BodyTrackerRecording(sensor, rate, times + time_offset, names, x, R, source=str(path))


def _read_trackers(entry: TrackerEntry, name: str, _: Any) -> BodyTrackerRecording:
    T = entry.T_world_file
    return read_body_trackers(entry.file, entry.points, name, time_offset=entry.time_offset, T_world_file=T)


def _tracker_sensor(entry: TrackerEntry, recording: BodyTrackerRecording, body: Body) -> BodyTrackerSensor:
    turn, mounts = np.radians(entry.rotation_sigma), {name: np.radians(m) for name, m in entry.mounts.items()}
    sensor = BodyTrackerSensor(
        recording.sensor, entry.points, sigma=entry.sigma, rotation_sigma=float(turn), mounts=mounts,
        mount_sigma=float(np.radians(entry.mount_sigma)),
    )  # fmt: skip
    sensor.places(body, recording.names)
    return sensor


TRACKERS = SensorKind(
    table="tracker", summary="trackers fixed on the body: poses of segments, or places of points", label="trackers",
    entry=TrackerEntry, read=_read_trackers, sensor=_tracker_sensor, finds_pose=True, replaces_keypoints=True,
)  # fmt: skip


_SMPL = tuple(
    "Pelvis L_Hip R_Hip Spine1 L_Knee R_Knee Spine2 L_Ankle R_Ankle Spine3 L_Foot R_Foot Neck L_Collar R_Collar Head "
    "L_Shoulder R_Shoulder L_Elbow R_Elbow L_Wrist R_Wrist L_Hand R_Hand".split()
)
_SMPL_COUNTS = {24: 24, 45: 24, 22: 22, 52: 22, 55: 22, 127: 22, 144: 22}
"""Number of joints of SMPL, SMPL-H and SMPL-X -> of these the body's, which all of them give first, in one order."""

_ARRAYS = ("joints", "positions", "keypoints_3d", "joints3d", "j3d")
"""Names of an array of joints in .json and .npz."""

_MIN_JOINTS = 6  # of the body that are needed: hips, knees and two more
_MAX_SPREAD_M = 3.0  # of one person's joints about their middle, the median: beyond, the unit is another
_REMEDY = (
    "Give OpenCap's .json; .json or .npz with joints (frames, joints, 3), names and rate, or with the joints of SMPL; "
    ".trc, .c3d or .bvh; or a motion.npz of kinefit."
)
_LIMBS = dict(
    zip(LIMBS, ("{s}_hip", "{s}_knee", "{s}_ankle", "toes_{s}", "{s}_shoulder", "{s}_elbow", "{s}_wrist"), strict=True)
)
"""Segment of a limb -> place of the body at which it begins, {s} for the side."""

_JOINTS = {
    "hip": "{s}_hip", "knee": "{s}_knee", "ankle": "{s}_ankle", "foot": "toes_{s}", "shoulder": "{s}_shoulder",
    "elbow": "{s}_elbow", "wrist": "{s}_wrist", "bigtoe": "{s}_digit_1", "smalltoe": "{s}_digit_5",
    "heel": "{s}_heel", "ear": "{s}_tragion",
}  # fmt: skip
"""Joints as networks name them, without their side ("LHip", "left_hip", "L_Hip") -> place on the body."""

_OPENSIM: dict[str, Place] = {"pelvis": ("r_asis", "l_asis")}
_OPENSIM |= {
    f"{name}_{side}": _LIMBS[limb].format(s=side) for side in SIDES
    for name, limb in zip(("femur", "tibia", "talus", "toes", "humerus", "ulna", "hand"), LIMBS, strict=True)
}  # fmt: skip
"""Bodies of OpenSim's models -> where their frames begin on the body: the pelvis amid the front of the iliac spines."""


class PoseEntry(PlacedEntry, frozen=True, kw_only=True):
    """`[[pose]]`."""

    joints: dict[str, str | tuple[str, ...]] = field(default_factory=dict)  # of each joint of the file: landmark or
    # segment of the body, or landmarks, in whose middle it is; default: by their names
    camera: str | None = None  # in whose axes the joints are: x right, y down, z away; default: in a world
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None  # vertical axis of the file; default: its format's
    unit: str | None = None  # of lengths; default: what the file states, else m
    rate: Rate | None = None  # [Hz]; default: what the file states
    sides: Literal["labelled", "exchanged", "mirrored-x", "mirrored-y", "mirrored-z"] | None = None  # None: checked
    person: Annotated[int, Meta(ge=1, description="Give a number from 1.")] | None = None  # of a file of several
    sigma: Metres = PoseErrors.sigma  # [m] standard deviation of a joint against the hips, across the camera's ray
    root_sigma: Metres = PoseErrors.root  # [m] of the hips, where the file is in the take's world
    offset_sigma: Annotated[float, Meta(ge=0, lt=1, description="Give metres.")] = PoseErrors.offset  # [m] of constant
    # offsets of its joints from the body's, which are estimated; 0: there are none

    def __post_init__(self) -> None:
        odd = self.unit is not None and worth(self.unit, LENGTHS) is None
        refuse(odd, choices("unit", str(self.unit), LENGTHS), "Use one of these.")
        placed = self.camera is not None and (any(self.shift) or any(self.turn) or self.up is not None)
        refuse(placed, "a camera, and a place in the world", "Remove shift, turn and up, or the camera.")


@dataclass(frozen=True, eq=False)
class PoseRecording(BodyTrackerRecording):
    """Joints that another program estimated, over time: a `BodyTrackerRecording` without orientations.

    Parameters
    ----------
    points : {joint: place on the body} by its format; None: by their names
    another : vertical axis of the take, where the joints are in another world; "camera" in a camera's axes; else None
    """

    points: Mapping[str, Place] | None = None
    another: str | None = None


@dataclass(frozen=True, eq=False)
class _PoseFile:
    """Names (K,), times (F,) [s] or None, joints (F, K, 3) in the file's unit, vertical axis, places by its format."""

    names: tuple[str, ...]
    times: NDArray | None
    x: NDArray
    up: str | None = None
    points: Mapping[str, Place] | None = None


def read_poses(path: Path, *, person: int | None = None) -> _PoseFile:
    """Read joints in space that another program estimated; the content decides on the format.

    Parameters
    ----------
    person : from 1, of a file of several

    Raises
    ------
    FileError
        No such file, another format, or arrays that do not fit together.
    ObservationError
        Several people, none of them chosen; what the readers of the formats raise.
    """
    suffix = path.suffix.lower()
    if suffix in (".trc", ".c3d"):
        markers = read_markers(path)
        return _PoseFile(markers.names, markers.times - markers.times[0], markers.positions, markers.up)
    if suffix == ".bvh":
        motion = read_bvh(path)
        return _PoseFile(motion.names, np.arange(len(motion)) / motion.rate, motion.positions, motion.up)
    if suffix not in (".json", ".npz"):
        raise FileError("no format of poses that is read", file=path, remedy=_REMEDY)
    try:
        arrays = _arrays(path)
        if isinstance(bodies := arrays.get("bodies"), dict):
            x = np.stack([np.array(one["translation"], float) for one in bodies.values()], axis=1)
            return _fitting(path, _PoseFile(tuple(bodies), np.array(arrays["time"], float), x, "y", _OPENSIM))
        if str(arrays.get("format", "")) == FORMAT:
            own = read_motion(path)
            return _PoseFile(tuple(own.body.tree.segments), own.times, np.array(own.joint_centres), own.up)
        key = next((key for key in _ARRAYS if key in arrays), None)
        if key is None:
            raise FileError(f"no joints among {', '.join(arrays) or 'nothing'}", file=path, remedy=_REMEDY)
        x = np.array(arrays[key], float)
        if x.ndim == 4 and x.shape[1] > 1 and not 1 <= (person or 0) <= x.shape[1]:
            remedy = f"Write person = 1, or another number to {x.shape[1]}, into [[pose]]."
            raise ObservationError(f"{x.shape[1]} people, and none of them chosen", file=path, remedy=remedy)
        x = x[:, (person or 1) - 1] if x.ndim == 4 else x
        names = arrays.get("names", arrays.get("joint_names"))
        if names is None and x.ndim == 3:
            if x.shape[1] not in _SMPL_COUNTS:
                raise FileError(f"{x.shape[1]} joints without names", file=path, remedy=_REMEDY)
            names = _SMPL[: _SMPL_COUNTS[x.shape[1]]]
            x = x[:, : len(names)]
        times, rate = (arrays.get(a, arrays.get(b)) for a, b in (("times", "time"), ("rate", "fps")))
        if times is None and rate is not None:
            times = np.arange(len(x)) / float(rate)
        return _fitting(
            path,
            _PoseFile(
                tuple(map(str, () if names is None else names)), None if times is None else np.array(times, float), x
            ),
        )
    except (ValueError, TypeError, KeyError, AttributeError, ZeroDivisionError) as error:
        raise FileError(f"cannot read the poses ({error})", file=path, remedy=_REMEDY) from error


def _arrays(path: Path) -> Mapping[str, Any]:
    """What a .json or .npz file has by its keys."""
    if path.suffix.lower() == ".npz":
        return read_npz(path, remedy=_REMEDY)
    try:
        content = json.loads(read_text(path, "the poses", remedy=_REMEDY))
    except RecursionError as error:
        raise FileError("nested too deeply", file=path, remedy=_REMEDY) from error
    if not isinstance(content, dict):
        raise FileError(f"a {type(content).__name__} without keys", file=path, remedy=_REMEDY)
    return content


def _fitting(path: Path, found: _PoseFile) -> _PoseFile:
    """A file whose arrays fit together; FileError for others."""
    names, times, x = found.names, found.times, found.x
    if x.ndim != 3 or x.shape[1:] != (len(names), 3) or not len(x):
        raise FileError(f"joints of shape {x.shape} and {len(names)} names", file=path, remedy=_REMEDY)
    if times is not None and not (
        times.shape == x.shape[:1] and np.isfinite(times).all() and (np.diff(times) > 0).all()
    ):
        problem = f"{times.size} times, not increasing or not one for each of {len(x)} frames"
        raise FileError(problem, file=path, remedy="Correct its times, or give a rate in their place.")
    if twice := repeated(names):
        raise FileError(f"two joints are named '{twice[0]}'", file=path, remedy="Rename one.")
    return found


def places_of(names: Sequence[str], body: Body) -> dict[str, Place]:
    """{joint: place on the body} of the joints of a file, by the table of names that most of them fit.

    Tables are the body's own names, those that networks use ("LHip", "left_hip", "L_Hip", "Neck"), and joints of limbs
    in skeletons (`bodies.toml.joint_names`).
    """
    words = {"neck": "neck", "nose": "nose_tip"}
    for side, spelled in SIDES.items():
        for kind, place in _JOINTS.items():
            words |= {
                plain(w): place.format(s=side) for one in (side, spelled["side"]) for w in (one + kind, kind + one)
            }
    known = {*body.landmarks.names, *body.tree.segments}
    tables: list[dict[str, Place]] = [{n: n for n in names}, {n: words[plain(n)] for n in names if plain(n) in words}]
    limbs = {f"{limb}_{side}": place.format(s=side) for limb, place in _LIMBS.items() for side in SIDES}
    for family in conventions():
        at = {limbs[segment]: find(names, name) for segment, name in family.joints.items() if segment in limbs}
        tables.append({names[i]: place for place, i in at.items() if i is not None})
    return max(({n: p for n, p in table.items() if p in known} for table in tables), key=len)


def _read_poses(entry: PoseEntry, name: str, cameras: TakeCameras) -> PoseRecording:
    found, take = read_poses(entry.file, person=entry.person), cameras.take
    for joint in entry.joints:
        check_choice("joint", joint, found.names, ObservationError, file=entry.file, remedy="Correct joints.")
    names, x = read_sides(found.names, found.x, entry.sides or "labelled")
    x = x * (1.0 if entry.unit is None else worth(entry.unit, LENGTHS))
    spread = float(np.nanmedian(np.linalg.norm(x - np.nanmedian(x, axis=1, keepdims=True), axis=2)))
    if not 0.0 < spread < _MAX_SPREAD_M:
        problem = f"joints {spread:.3g} m from their middle"
        raise ObservationError(problem, file=entry.file, remedy='State the unit of the file: unit = "mm".')
    up = entry.up or found.up or take.up
    T = entry.T_world_file @ se3.transform(
        se3.shortest_turn(np.array(UP_AXES[up]), np.array(UP_AXES[take.up])), np.zeros(3)
    )
    others = take.cameras or take.markers or take.depth or take.stereo
    another: str | None = take.up if others and not (any(entry.shift) or any(entry.turn)) else None
    if entry.camera is not None:
        T, another = np.eye(4), "camera"
    times, rate = found.times, entry.rate
    if times is None or rate is not None:
        times = np.arange(len(x)) / stated_rate(rate or cameras.fastest, entry.file)
    return PoseRecording(
        name, rate or rate_of(times, entry.file, _REMEDY), times + entry.time_offset, names, se3.apply(T, x),
        np.full((*x.shape, 3), np.nan), str(entry.file), entry.joints or found.points, another,
    )  # fmt: skip


def _pose_sensor(entry: PoseEntry, recording: PoseRecording, body: Body) -> PoseSensor:
    known = {*body.landmarks.names, *body.tree.segments}
    points = entry.joints or {
        n: p for n, p in (recording.points or places_of(recording.names, body)).items()
        if n in recording.names and known.issuperset((p,) if isinstance(p, str) else p)
    }  # fmt: skip
    if len(points) < _MIN_JOINTS or sum(place in HIPS for place in points.values()) != 2:
        problem = f"joints {', '.join(recording.names)}: {len(points)} are known places of the body"
        remedy = 'Write joints = { NAME = "thigh_l", NAME = "thigh_r", ... }, of both hips and four more.'
        raise ObservationError(problem, file=entry.file, remedy=remedy)
    at = {name: recording.names.index(name) for name in points}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of pairs that are never there together: NaN
        apart = [(a, b, recording.x_world[:, at[a]] - recording.x_world[:, at[b]]) for a, b in permutations(points, 2)]
        lengths = {(a, b): float(np.nanmedian(np.linalg.norm(d, axis=1))) for a, b, d in apart}
    errors = PoseErrors(sigma=entry.sigma, root=entry.root_sigma, offset=entry.offset_sigma)
    sensor = PoseSensor(recording.sensor, points, lengths, errors, camera=entry.camera, up=recording.another)
    sensor.places(body, tuple(points))  # raises where the body has none of a name
    return sensor


def _propose(files: Sequence[Path]) -> Iterator[Proposal]:
    """Files with joints of a body that state what they are: OpenCap's, and arrays of joints."""
    for file in files:
        if file.suffix.lower() in (".json", ".npz"):
            try:
                found = read_poses(file, person=1)
            except KinefitError:
                continue
            reason = f"{len(found.names)} joints that another program estimated in {len(found.x)} frames"
            yield Proposal({"file": file}, reason)


POSES = SensorKind(
    table="pose", summary="joints in space that another program estimated: a second opinion", label="poses",
    entry=PoseEntry, read=_read_poses, sensor=_pose_sensor, propose=_propose, finds_pose=True,
)  # fmt: skip
