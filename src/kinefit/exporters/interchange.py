"""Motions for other programs, by their packages: NWB for neuroscience, MCAP for ROS 2, RRD for the Rerun viewer."""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Iterator, Mapping
from os import PathLike
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import writing
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError, extra
from kinefit.exporters.skeletons.common import bone_names, convention, plain_names, rest_pose, turned

CONFIDENCE_RADIUS_M = 0.02
"""[m] within which `confidence` has the true joint centre."""


@checked
def write_nwb(motion: Motion, path: str | PathLike[str], *, up: str | None = None, names: str = "kinefit") -> None:
    """Write joint centres as NWB: a PoseEstimation of ndx-pose in the processing module "behavior".

    Every joint has a PoseEstimationSeries in metres, whose confidence is the probability that the true centre lies
    within 2 cm, by the error bars (`joint_std`, taken as equal in all directions); 0 where nothing observed it.
    The module holds TimeSeries of all joint coordinates (`angles`, radians, metres where they slide) and of the
    standard deviations (`joint_std`, `angles_std`), too. The acquisition holds what force plates measured, at their own
    rates: `plate_1_force` [N], `plate_1_moment` [N m] about the middle of its corners and `plate_1_centre_of_pressure`
    [m], NaN below 20 N. The session starts on the date that the take states, else on 1970-01-01, and the file says so.

    Parameters
    ----------
    motion : Motion
    path : path
    up : str, optional
        Vertical axis of the file's world. Default: the motion's own.
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh", "vrm", "unity" or "unreal"
        Names of the joints; ":" becomes "_": mixamorig_Hips.

    Raises
    ------
    ExportError
        The extra "nwb" is not installed, no frame, unknown axis or names, or the file cannot be written.
    """
    needed = "NWB needs the packages pynwb and ndx-pose"
    with extra("nwb", needed, ExportError, file=path), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import ndx_pose
        import pynwb
    if not len(motion):
        raise ExportError("a motion without frames has nothing to write", file=path, remedy="Track the take first.")
    bones = list(motion.body.joints) if convention(names) == "kinefit" else bone_names(motion.body, names, path)
    world = turned(motion, up or motion.up, path)
    with writing(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of packages about each other
        file = _file(pynwb, world)
        behavior = file.create_processing_module("behavior", "motion of a body, fitted by kinefit")
        for thing in _pose(ndx_pose, pynwb, world, plain_names(bone.replace(":", "_") for bone in bones)):
            behavior.add(thing)
        for series in _plates(pynwb, world):
            file.add_acquisition(series)
        with pynwb.NWBHDF5IO(str(temporary), "w") as out:
            out.write(file)


def confidence(std: NDArray) -> NDArray:
    """(...) probability that a point with standard deviations (..., 3) [m] lies within `CONFIDENCE_RADIUS_M`.

    Of a normal distribution equal in all directions, with the mean variance (Maxwell's distribution).
    """
    from scipy.special import gammainc

    sigma = np.nan_to_num(np.sqrt(np.mean(np.square(std), axis=-1)), nan=np.inf, posinf=np.inf)
    with np.errstate(divide="ignore"):
        return np.asarray(gammainc(1.5, 0.5 * np.square(CONFIDENCE_RADIUS_M / sigma)))


def _file(pynwb: Any, motion: Motion) -> Any:
    stated = motion.provenance.get("session")
    session = stated if isinstance(stated, Mapping) else {}
    start, said = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC), " The date of the recording is not known."
    try:
        start = datetime.datetime.fromisoformat(str(session["date"])).replace(tzinfo=datetime.UTC)
        said = ""
    except (KeyError, ValueError):
        pass
    file = pynwb.NWBFile(
        session_description=f"{motion.name}: motion of a body, {motion.up} up.{said}", session_start_time=start,
        identifier=str(uuid5(NAMESPACE_URL, f"kinefit:{motion.name}:{len(motion)}:{motion.rate}:{start}")),
    )  # fmt: skip
    if session.get("subject"):
        file.subject = pynwb.file.Subject(subject_id=str(session["subject"]), species="Homo sapiens")
    return file


def _pose(ndx_pose: Any, pynwb: Any, motion: Motion, bones: list[str]) -> list[Any]:
    """Skeleton and pose estimation, and further time series."""
    tree, sure = motion.body.tree, confidence(motion.joint_std)
    centres = motion.joint_centres
    skeleton = ndx_pose.Skeleton(
        name="skeleton", nodes=bones,
        edges=np.array([(p, s) for s, p in enumerate(tree.parents) if p >= 0], dtype="uint8"),
    )  # fmt: skip
    series: list[Any] = []
    for s, name in enumerate(bones):
        series.append(ndx_pose.PoseEstimationSeries(
            name=name, description=f"joint centre, segment {tree.segments[s]}", data=centres[:, s], unit="meters",
            reference_frame=f"right-handed world, {motion.up} up, of the calibration", confidence=sure[:, s],
            confidence_definition=f"probability that the true centre is within {CONFIDENCE_RADIUS_M:g} m, by its sigma",
            timestamps=series[0] if series else np.array(motion.times),
        ))  # fmt: skip
    pose = ndx_pose.PoseEstimation(
        name="PoseEstimation", pose_estimation_series=series, skeleton=skeleton, source_software="kinefit",
        description="joint centres of the fitted body",
    )  # fmt: skip
    coordinates = ", ".join(tree.coordinates)
    beside = (
        ("joint_std", motion.joint_std, "meters", f"standard deviations along x, y, z; joints: {', '.join(bones)}"),
        ("angles", motion.angles, "radians", f"joint coordinates (metres where they slide): {coordinates}"),
        ("angles_std", motion.dof_std[:, 6:], "radians",
         f"their standard deviations; inf: not observed; {coordinates}"),
    )  # fmt: skip
    times = {"timestamps": series[0]}
    return [
        ndx_pose.Skeletons(skeletons=[skeleton]), pose,
        *(pynwb.TimeSeries(name=n, data=np.array(d), unit=u, description=t, **times) for n, d, u, t in beside),
    ]  # fmt: skip


def _plates(pynwb: Any, motion: Motion) -> Iterator[Any]:
    """Time series of each plate's force, moment and centre of pressure."""
    for plate, name in zip(motion.plates, plain_names(plate.name for plate in motion.plates)):
        times = {"rate": plate.rate, "starting_time": plate.first_time}
        about = f"{plate.name}, corners [m] {plate.corners.round(4).tolist()}, along x, y, z of a world, {motion.up} up"
        for what, unit, values, text in (
            ("force", "newtons", plate.force, "on the person"),
            ("moment", "newton meters", plate.moment, "on the person, about the middle of the corners"),
            ("centre_of_pressure", "meters", plate.centre_of_pressure(), "NaN below 20 N"),
        ):
            said = f"{text}; {about}"
            yield pynwb.TimeSeries(f"{name}_{what}", np.array(values), unit, description=said, **times)


WORLD = "world"
"""Frame that the root's transforms are given in."""

_TIME = "int32 sec\nuint32 nanosec\n"
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
_LINE = f"{'=' * 80}\nMSG: "
_STATE = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    f"{_LINE}std_msgs/Header\n{_HEADER}{_LINE}builtin_interfaces/Time\n{_TIME}"
)
_MOVE = (
    "geometry_msgs/TransformStamped[] transforms\n"
    f"{_LINE}geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform\n"
    f"{_LINE}geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    f"{_LINE}geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{_LINE}geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
    f"{_LINE}std_msgs/Header\n{_HEADER}{_LINE}builtin_interfaces/Time\n{_TIME}"
)


@checked
def write_mcap(motion: Motion, path: str | PathLike[str], *, up: str = "z", names: str = "kinefit") -> None:
    """Write a motion as MCAP with messages of ROS 2, in metres and radians.

    - `/tf` (tf2_msgs/TFMessage): every segment in its parent, the root in "world"; origins are joint centres.
    - `/joint_states` (sensor_msgs/JointState): all coordinates under the body's names.
    - `/joint_std` (sensor_msgs/JointState): their standard deviations, as positions; inf where nothing observed one.

    Stamps are the motion's times, from 0 on; ROS has no negative time.

    Parameters
    ----------
    motion : Motion
    path : path
    up : str
        Vertical axis of the world; of ROS it is z.
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh", "vrm", "unity" or "unreal"
        Names of the frames in `/tf`; with "kinefit" those of the segments.

    Raises
    ------
    ExportError
        The extra "ros" is not installed, no frame, a time before 0, unknown axis or names, or the file cannot be
        written.
    """
    with extra("ros", "MCAP needs the package mcap-ros2-support", ExportError, file=path):
        from mcap_ros2.writer import Writer
    if not len(motion) or motion.times[0] < 0:
        problem = "a motion without frames" if not len(motion) else "a motion that begins before 0 s"
        raise ExportError(f"{problem} has no ROS time stamps", file=path, remedy="Cut it to frames from time 0 on.")
    bones, world = bone_names(motion.body, names, path), turned(motion, up, path)
    with writing(path) as temporary, temporary.open("wb") as file, Writer(file) as out:
        state = out.register_msgdef("sensor_msgs/msg/JointState", _STATE)
        move = out.register_msgdef("tf2_msgs/msg/TFMessage", _MOVE)
        rest = rest_pose(world.body, "body", "kinefit", path)
        above = [bones[p] if p >= 0 else WORLD for p in world.body.tree.parents]
        turns, places = (values.tolist() for values in rest.local_moves(world, up))
        for f, seconds in enumerate(world.times):
            time = round(float(seconds) * 1e9)
            stamp = {"sec": time // 10**9, "nanosec": time % 10**9}
            log = {"log_time": time, "publish_time": time}
            transforms = [
                {"header": {"stamp": stamp, "frame_id": frame}, "child_frame_id": bone,
                 "transform": {"translation": dict(zip("xyz", place)), "rotation": dict(zip("wxyz", turn))}}
                for frame, bone, place, turn in zip(above, bones, places[f], turns[f])
            ]  # fmt: skip
            header = {"stamp": stamp, "frame_id": ""}
            out.write_message("/tf", move, {"transforms": transforms}, **log)
            for topic, values in (("/joint_states", world.angles[f]), ("/joint_std", world.dof_std[f, 6:])):
                message = {"header": header, "name": list(world.body.tree.coordinates), "position": values.tolist(),
                           "velocity": [], "effort": []}  # fmt: skip
                out.write_message(topic, state, message, **log)


@checked
def write_rrd(motion: Motion, path: str | PathLike[str], *, up: str | None = None, names: str = "kinefit") -> None:
    """Write a motion as a recording of Rerun, in metres and degrees, over the timelines `time` and `frame`.

    - `world/joints`: joint centres, labelled by segment; `world/bones`: lines from each to the one above it.
    - `world/uncertainty`: ellipsoids of two standard deviations about joint centres; none where they are infinite.
    - `angles/NAME` and `std/NAME`: coordinates and their standard deviations (metres where they slide).
    - `quality`: that of each frame.

    Parameters
    ----------
    motion : Motion
    path : path
    up : str, optional
        Vertical axis of the file's world, which it states. Default: the motion's own.
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh", "vrm", "unity" or "unreal"
        Labels of the joints.

    Raises
    ------
    ExportError
        The extra "rerun" is not installed, no frame, unknown axis or names, or the file cannot be written.
    """
    with extra("rerun", "RRD needs the package rerun-sdk", ExportError, file=path):
        import rerun as rr
    if not len(motion):
        raise ExportError("a motion without frames has nothing to show", file=path, remedy="Track the take first.")
    world, labels = turned(motion, up or motion.up, path), bone_names(motion.body, names, path)
    with writing(path) as temporary:
        recording = rr.RecordingStream("kinefit")
        try:
            recording.save(str(temporary))
            _log(rr, recording, world, labels)
            recording.flush()
        except RuntimeError as error:
            raise ExportError(f"Rerun cannot write it ({error})", file=path, remedy="Check the disk.") from error
        finally:
            recording.disconnect()


def _log(rr: Any, recording: Any, motion: Motion, labels: list[str]) -> None:
    tree, centres, std = motion.body.tree, motion.joint_centres, motion.joint_std
    count, joints = centres.shape[:2]
    index = [rr.TimeColumn("time", duration=motion.times), rr.TimeColumn("frame", sequence=np.arange(count))]

    def columns(entity: str, values: Any) -> None:
        recording.send_columns(entity, indexes=index, columns=values)

    axis = f"RIGHT_HAND_{motion.up[-1].upper()}_{'DOWN' if motion.up.startswith('-') else 'UP'}"
    recording.log("world", getattr(rr.ViewCoordinates, axis), static=True)
    recording.log("world/joints", rr.Points3D.from_fields(labels=labels, show_labels=False), static=True)
    each = [joints] * count
    columns("world/joints", rr.Points3D.columns(positions=centres.reshape(-1, 3)).partition(lengths=each))
    below = np.flatnonzero(tree.parents >= 0)
    strips = np.stack([centres[:, tree.parents[below]], centres[:, below]], axis=2).reshape(-1, 2, 3)
    columns("world/bones", rr.LineStrips3D.columns(strips=list(strips)).partition(lengths=[len(below)] * count))
    known = np.isfinite(std).all(axis=2)
    ellipsoids = rr.Ellipsoids3D.columns(centers=centres[known], half_sizes=2.0 * std[known])
    columns("world/uncertainty", ellipsoids.partition(lengths=known.sum(axis=1)))
    factors = np.where(tree.prismatic, 1.0, np.degrees(1.0))
    for d, name in enumerate(tree.coordinates):
        columns(f"angles/{name}", rr.Scalars.columns(scalars=factors[d] * motion.angles[:, d]))
        columns(f"std/{name}", rr.Scalars.columns(scalars=factors[d] * motion.dof_std[:, 6 + d]))
    columns("quality", rr.Scalars.columns(scalars=motion.quality))
