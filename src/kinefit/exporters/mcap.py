"""MCAP with messages of ROS 2: joint states and transforms over time, for robots, Foxglove and `ros2 bag`."""

from __future__ import annotations

from os import PathLike

from kinefit._files import writing
from kinefit.errors import ExportError, extra
from kinefit.exporters.skeletons.common import bone_names, turned
from kinefit.exporters.skeletons.rest import rest_pose
from kinefit.motion import Motion

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
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim" or "bvh"
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
