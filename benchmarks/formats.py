"""Every format, read back by a program that others wrote: the largest distance of a joint centre from where it was.

A figure squats and waves; of TRC the points are landmarks. Readers that only read numbers (h5py, rosbags, the parser
of XML) have the positions recomputed here as the format defines them. Blender and OpenSim run in environments of their
own and are left out of the quick form.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.bags import Bag
from benchmarks.figures import LEFT_OUT, figure, peers
from benchmarks.peers.environments import run_peer
from benchmarks.retarget import validated
from kinefit import exporters
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError
from kinefit.exporters.skeletons.common import bone_names
from kinefit.geometry import se3
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.depth.recordings import read_depth
from kinefit.readers.videos.video import Video
from kinefit.simulation import squat_and_wave

GOAL = "<= 1e-05"
_FRAMES = 60  # of the motion
_FBX_READER = Path(__file__).parents[1] / "tests" / "exporters" / "skeletons" / "read_fbx.py"
Places = dict[str, np.ndarray]


def run() -> None:
    """Print a figure for each format and reader."""
    motion = squat_and_wave()
    with tempfile.TemporaryDirectory() as work, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of readers about themselves
        folder = Path(work)
        for name, (write, read, up) in READERS.items():
            try:
                write(motion, folder)
                told = (difference(motion, read(folder), up), "")
            except (ImportError, ExportError) as error:
                told = (None, str(error))
            figure(f"formats_{name}", told[0], "m", GOAL, told[1])
        _recorded(folder)
        _programs(motion, folder)


def _recorded(folder: Path) -> None:
    """A recording of ROS 2 that rosbags wrote, read by kinefit: depth, colours, and where cameras stand."""
    names = "formats_mcap_read_depth", "formats_mcap_read_colours", "formats_mcap_read_cameras"
    random, size = np.random.default_rng(0), (64, 48)
    counts = random.integers(500, 4000, (5, 48, 64)).astype(np.uint16)
    metres = (0.001 * counts).astype(np.float32)
    colours = random.integers(0, 256, (5, 48, 64, 3)).astype(np.uint8)
    K, T = np.array([[60.0, 0, 31.5], [0, 61.0, 23.5], [0, 0, 1]]), np.eye(4)
    T[:3, :3], T[:3, 3] = se3.exp_so3(np.array([0.3, -1.2, 0.7])), (1.0, -2.0, 1.5)
    try:
        bag = Bag().images("/a/depth/image", "16UC1", counts).images("/b/depth/image", "16UC1 png", counts)
        bag.images("/c/depth/image", "32FC1", metres).images("/a/color/image", "rgb8", colours)
        places = [("map", "rig", T)]
        for topic in ("a/depth", "b/depth", "c/depth", "a/color"):
            bag.info(f"/{topic}/camera_info", K, size, frame=topic)
            places.append(("rig", topic, T))
        file = bag.static(*places).write(folder / "bag")
    except ImportError as error:
        for name in names:
            figure(name, None, "", "> 0", str(error))
        return
    videos = [read_depth(file / topic / "depth" / "image") for topic in "abc"]
    off = [np.abs(video.frame(i).depth - metres[i]).max() for video in videos for i in range(5)]
    figure(names[0], float(max(off)), "m", "<= 1e-6")
    with Video(file / "a" / "color" / "image") as video:
        wrong = sum(int((video.read(i) != colours[i]).any(axis=-1).sum()) for i in range(5))
    figure(names[1], wrong, "pixels", "== 0")
    apart = [np.abs(camera.T_world_camera - T @ T).max() for camera in read_calibration(file)]
    figure(names[2], float(max(apart)), "m", GOAL)


def difference(motion: Motion, found: Places, up: str) -> float:
    """[m] largest distance of a joint centre, where it was found under any of the names of its segment."""
    truth, worst = motion.turned(up).joint_centres, 0.0
    for s, segment in enumerate(motion.body.tree.segments):
        aliases = [bone_names(motion.body, convention, "")[s] for convention in ("bvh", "hanim", "opensim")]
        places = next(found[name] for name in (motion.body.joints[s], segment, *aliases) if name in found)
        worst = max(worst, float(np.linalg.norm(places - truth[:, s], axis=1).max()))
    return worst


def _programs(motion: Motion, folder: Path) -> None:
    """Blender, OpenSim and Khronos' validator."""
    exporters.write_bvh(motion, folder / "m.bvh", unit="m")
    exporters.write_glb(motion, folder / "motion.glb")
    exporters.write_osim(motion.body, folder / "body.osim")
    exporters.write_mot(motion, folder / "motion.mot")
    exporters.write_trc(motion, folder / "motion.trc")
    given = {"rate": round(motion.rate), "frames": len(motion), "files": {"bvh": "m.bvh", "glb": "motion.glb"}}
    (folder / "formats.json").write_text(json.dumps(given), encoding="utf-8")
    for peer, files in (("blender_formats", ("bvh", "glb")), ("opensim_formats", ("mot", "trc"))):
        told = run_peer(peer, folder) if peers() else {"reason": LEFT_OUT}
        for name in files:
            program, value = peer.partition("_")[0], None
            if "reason" not in told:
                with np.load(folder / f"{program}-{name}.npz") as read:
                    found = dict(read)
                value = _landmarks(motion, found) if name == "trc" else difference(motion, found, _UPS[name])
            figure(f"formats_{name}_{program}", value, "m", GOAL, told.get("reason", ""))


    figure("formats_glb_khronos", *_errors(folder / "motion.glb"))


def _errors(path: Path) -> tuple[float | None, str, str, str]:
    """What `figure` tells of the validator's errors."""
    errors, why = validated([path])
    return errors, "errors", "== 0", why


_UPS = {"bvh": "z", "glb": "z", "mot": "y"}


def _landmarks(motion: Motion, found: Places) -> float:
    truth = motion.turned("y").positions()
    places = np.stack([found[name] for name in motion.body.landmarks.names], axis=1)
    return float(np.linalg.norm(places - truth, axis=2).max())


def _bvh(folder: Path) -> Places:
    import bvhio

    root = bvhio.readAsHierarchy(str(folder / "m.bvh"))
    joints = [joint for joint, _, _ in root.layout()]
    out: dict[str, list] = {joint.Name: [] for joint in joints}
    first, last = root.getKeyframeRange()
    for frame in range(first, last + 1):
        root.loadPose(frame)
        for joint in joints:
            out[joint.Name].append(list(joint.PositionWorld))
    return {name: np.array(places) for name, places in out.items()}


def _glb(folder: Path) -> Places:
    from pygltflib import GLTF2

    gltf = GLTF2().load(str(folder / "motion.glb"))
    blob = gltf.binary_blob()

    def array(number: int) -> np.ndarray:
        accessor = gltf.accessors[number]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        start = gltf.bufferViews[accessor.bufferView].byteOffset
        return np.frombuffer(blob, "<f4", accessor.count * width, start).reshape(-1, width).astype(float)

    animation, out = gltf.animations[0], {}
    moved = {(c.target.node, c.target.path): array(animation.samplers[c.sampler].output) for c in animation.channels}

    def walk(node: int, above: np.ndarray) -> None:
        turn = moved.get((node, "rotation"))
        R = np.eye(3) if turn is None else _rotations(turn[:, [3, 0, 1, 2]])
        place = moved.get((node, "translation"), np.array(gltf.nodes[node].translation or [0.0, 0.0, 0.0]))
        T = above @ se3.transform(R, place)
        out[gltf.nodes[node].name] = np.broadcast_to(T, (len(array(animation.samplers[0].input)), 4, 4))[..., :3, 3]
        for child in gltf.nodes[node].children or ():
            walk(child, T)

    for root in gltf.scenes[0].nodes:
        walk(root, np.eye(4))
    return out


def _fbx(folder: Path) -> Places:
    """By ufbx, in a process of its own, as the tests read it."""
    import ufbx  # noqa: F401, so that its absence is an ImportError here

    def read(times: list[float]) -> dict:
        command = [sys.executable, str(_FBX_READER), str(folder / "motion.fbx"), json.dumps(times)]
        return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])

    _, start, stop = read([0.0])["clips"][0]
    found = read([float(t) for t in np.linspace(start, stop, _FRAMES)])
    local = np.array(found["local"])
    T = np.tile(np.eye(4), (*local.shape[:2], 1, 1))
    T[..., :3, 3], T[..., :3, :3] = local[..., :3], Rotation.from_quat(local[..., 3:7]).as_matrix()
    for node, parent in enumerate(found["parents"]):  # parents come first
        T[:, node] = T[:, parent] @ T[:, node] if parent >= 0 else T[:, node]
    return dict(zip(found["nodes"], np.moveaxis(T[..., :3, 3], 1, 0)))


def _usd(folder: Path) -> Places:
    from pxr import Usd, UsdSkel

    stage = Usd.Stage.Open(str(folder / "motion.usdc"))
    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetDefaultPrim())
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Figure/Skeleton")))
    codes = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1)
    at = [[list(T.ExtractTranslation()) for T in query.ComputeJointSkelTransforms(code)] for code in codes]
    return dict(zip((path.rpartition("/")[2] for path in query.GetJointOrder()), np.moveaxis(np.array(at), 1, 0)))


def _c3d(folder: Path) -> Places:
    import ezc3d

    read = ezc3d.c3d(str(folder / "motion.c3d"))
    labels = read["parameters"]["POINT"]["LABELS"]["value"]
    return dict(zip(labels, 0.001 * np.moveaxis(read["data"]["points"][:3], (0, 2), (2, 1))))


def _c3d_second(folder: Path) -> Places:
    import c3d

    with open(folder / "motion.c3d", "rb") as file:
        reader = c3d.Reader(file)
        points = np.array([found for _, found, _ in reader.read_frames()])
    return {name.strip(): 0.001 * points[:, k, :3] for k, name in enumerate(reader.point_labels)}


def _nwb(folder: Path) -> Places:
    import h5py

    with h5py.File(folder / "motion.nwb") as file:
        pose = file["processing/behavior/PoseEstimation"]
        series = {name: group for name, group in pose.items() if isinstance(group, h5py.Group)}
        return {name: group["data"][:] for name, group in series.items() if "data" in group}


def _mcap(folder: Path) -> Places:
    from rosbags.highlevel import AnyReader

    frames = []
    with AnyReader([folder / "motion.mcap"]) as reader:
        for connection, _, raw in reader.messages():
            if connection.topic == "/tf":
                frames.append(reader.deserialize(raw, connection.msgtype).transforms)
    placed = {"world": np.tile(np.eye(4), (len(frames), 1, 1))}
    for moves in zip(*frames):
        turns = np.array([[getattr(m.transform.rotation, axis) for axis in "wxyz"] for m in moves])
        places = np.array([[getattr(m.transform.translation, axis) for axis in "xyz"] for m in moves])
        above = placed[moves[0].header.frame_id]
        placed[moves[0].child_frame_id] = above @ se3.transform(_rotations(turns), places)
    return {name: T[:, :3, 3] for name, T in placed.items()}


def _x3d(folder: Path) -> Places:
    root = ET.parse(folder / "motion.x3d").getroot()
    named = {node.get("DEF"): node for node in root.iter() if node.get("DEF")}
    routes = [r for r in root.iter("ROUTE") if r.get("fromField") == "value_changed"]
    feeds = {(r.get("toNode"), r.get("toField")): named[r.get("fromNode")] for r in routes}
    out = {}

    def values(node: tuple[str, str], width: int) -> np.ndarray:
        return np.array(feeds[node].get("keyValue").split(), float).reshape(-1, width)

    def walk(node: ET.Element, above: np.ndarray) -> None:
        name, centre = node.get("DEF"), np.array(node.get("center").split(), float)
        turns = values((name, "set_rotation"), 4)
        R = se3.exp_so3(turns[:, :3] * turns[:, 3:])
        moves = (name, "set_translation")
        move = values(moves, 3) if moves in feeds else np.zeros(3)
        T = above @ se3.transform(R, move + centre - R @ centre)
        out[node.get("name")] = (T @ [*centre, 1.0])[:, :3]
        for child in node.findall("HAnimJoint"):
            walk(child, T)

    for joint in root.iter("HAnimJoint"):
        if joint.get("containerField") == "skeleton":
            walk(joint, np.eye(4))
    return out


def _rrd(folder: Path) -> Places:
    from rerun.server import Server

    local = {"host": "127.0.0.1", "addr": "127.0.0.1"}
    with Server(**local, datasets={"motion": [str(folder / "motion.rrd")]}) as server:
        client = server.client()  # which must live as long as what it gives
        view = client.get_dataset("motion").filter_contents(["/**"])
        frames = view.reader(index="time")
        table = frames.to_arrow_table()
    positions, labels = (
        next(table.column(name).to_pylist() for name in table.schema.names if name.endswith(f"joints:Points3D:{what}"))
        for what in ("positions", "labels")
    )
    return dict(zip(next(filter(None, labels)), np.moveaxis(np.array(positions), 1, 0)))


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """(F, 3, 3) of unit quaternions w, x, y, z."""
    w, v = quaternions[:, :1], quaternions[:, 1:]
    sines = np.linalg.norm(v, axis=1, keepdims=True)
    angles = 2.0 * np.arctan2(sines, w)
    return se3.exp_so3(np.divide(v, sines, out=np.zeros_like(v), where=sines > 0) * angles)


Write = Callable[[Motion, Path], object]
READERS: dict[str, tuple[Write, Callable[[Path], Places], str]] = {
    "bvh_bvhio": (lambda m, f: exporters.write_bvh(m, f / "m.bvh", unit="m"), _bvh, "y"),
    "glb_pygltflib": (lambda m, f: exporters.write_glb(m, f / "motion.glb"), _glb, "y"),
    "fbx_ufbx": (lambda m, f: exporters.write_fbx(m, f / "motion.fbx", unit="m", up="y"), _fbx, "y"),
    "usd_pxr": (lambda m, f: exporters.write_usd(m, f / "motion.usdc"), _usd, "y"),
    "c3d_ezc3d": (lambda m, f: exporters.write_c3d(m, f / "motion.c3d", up="y"), _c3d, "y"),
    "c3d_c3d": (lambda m, f: exporters.write_c3d(m, f / "motion.c3d", up="y"), _c3d_second, "y"),
    "nwb_h5py": (lambda m, f: exporters.write_nwb(m, f / "motion.nwb", up="y"), _nwb, "y"),
    "mcap_rosbags": (lambda m, f: exporters.write_mcap(m, f / "motion.mcap"), _mcap, "z"),
    "rrd_rerun": (lambda m, f: exporters.write_rrd(m, f / "motion.rrd", up="y"), _rrd, "y"),
    "x3d_xml": (lambda m, f: exporters.write_x3d(m, f / "motion.x3d"), _x3d, "y"),
}
"""{format and reader: (writer, reader, vertical axis of what it gives)}"""
