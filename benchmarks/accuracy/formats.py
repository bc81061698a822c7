"""Formats, read back by programs that others wrote: the largest distance of a joint centre from where it was.

A figure squats and waves; of TRC the points are landmarks. Of rosbags, which reads numbers alone, the positions are
recomputed here as the format defines them. Blender and OpenSim run in environments of their own and are left out of the
quick form. Readers that `tests/exporters` hold to the same bound are not repeated here.
"""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.accuracy.surfaces.retarget import validated
from benchmarks.figures import LEFT_OUT, figure, peers
from benchmarks.peers.environments import run_peer
from kinefit import exporters
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError
from kinefit.exporters.skeletons.common import bone_names
from kinefit.geometry import se3
from kinefit.simulation import squat_and_wave

GOAL = "<= 1e-05"
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
        _programs(motion, folder)


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


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """(F, 3, 3) of unit quaternions w, x, y, z."""
    w, v = quaternions[:, :1], quaternions[:, 1:]
    sines = np.linalg.norm(v, axis=1, keepdims=True)
    angles = 2.0 * np.arctan2(sines, w)
    return se3.exp_so3(np.divide(v, sines, out=np.zeros_like(v), where=sines > 0) * angles)


Write = Callable[[Motion, Path], object]
READERS: dict[str, tuple[Write, Callable[[Path], Places], str]] = {
    "usd_pxr": (lambda m, f: exporters.write_usd(m, f / "motion.usdc"), _usd, "y"),
    "c3d_ezc3d": (lambda m, f: exporters.write_c3d(m, f / "motion.c3d", up="y"), _c3d, "y"),
    "mcap_rosbags": (lambda m, f: exporters.write_mcap(m, f / "motion.mcap"), _mcap, "z"),
}
"""{format and reader: (writer, reader, vertical axis of what it gives)}"""
