"""What the commands of each page take for granted: files, made anew for every page, and which commands are not run.

A page's function is a generator: it makes what its next block needs, and is asked on before each further block.
"""

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
from tests.conftest import ROOT
from tests.docs import drawn
from tests.docs.blocks import blocks
from tests.docs.world import world
from tests.exporters.report.test_cycles import walk as walking

from kinefit import Markers, learn_model
from kinefit.bodies.marker_sets import placement
from kinefit.exporters import write_markers, write_motion
from kinefit.geometry.camera import Rig
from kinefit.markers.model.model import save_model
from kinefit.readers.calibration.read import write_calibration
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave

NOT_RUN = {
    ("app", "pip install"): "changes the environment",
    ("app", "kinefit app"): "serves pages until Ctrl-C; tests/app/test_pages.py goes this way in a browser",
    ("README", "python3 -m venv"): "makes an environment and installs into it; tests/test_wheel.py and .ci/run do that",
    ("batch", "dask scheduler"): "cluster of several machines; tests/batch/test_cluster.py starts one on this machine",
    ("batch", "dask worker"): "the same",
    ("batch", "kinefit batch 'sessions/**/take.toml' --cluster"): "the same",
    ("detect", "pip install"): "changes the environment",
    ("detect", "kinefit detect"): "needs videos of a real person; tests/cli/test_detect.py runs it on a recording",
    ("init", "kinefit init my_recording --click"): "waits for a person who clicks; tests/cli/test_init.py clicks",
    ("live", "kinefit live studio.toml"): "needs two cameras; tests/live has some that pretend",
    ("index", "kinefit demo"): "fetches a recording; tests/cli/tracking/test_demo.py runs it with that",
    ("install", ""): "makes an environment and installs into it, as README's commands do",
    (
        "several-telephones",
        "",
    ): "needs videos of a person; tests/calibration/people goes this way with a recording",
    ("one-camera", ""): "needs a video of a real person; tests/cli/test_init.py goes this way with a recording",
    ("silhouettes", "kinefit track"): "shows one camera of four; tests/tracking/test_kinds.py has such takes",
    ("regions", "kinefit track"): "needs video and mesh of one object; tests/tracking/test_kinds.py has such takes",
    ("surfaces", "kinefit surface calib.toml a=a.mp4"): "minutes; tests/cli/surfaces/test_surface.py follows videos",
    ("surfaces", "kinefit surface calib.toml left=left.mp4"): "the same",
    ("surfaces", "kinefit surface side.mp4"): "needs a video; tests/cli/surfaces/test_surface.py follows a drawn one",
    ("surfaces", "kinefit surface calib.toml 201"): "the same, with states",
    ("surfaces", "kinefit track"): "tests/tracking/test_surface_takes.py tracks such takes",
    ("sensors", "kinefit track"): "a minute; the robot's tutorial does it with ten images",
    ("simulate", "kinefit track"): "the same",
    ("which-setup", "kinefit track"): "the same",
    ("view", "kinefit replay my_take-kinefit"): "needs a video; tests/simulation/test_replay.py draws beside one",
    ("printed-voodoo", "kinefit evaluate"): "minutes to an hour; tests/evaluation/test_experiment.py runs a part",
}
"""{(page, how a line begins): why it is not run}; of `install`, `one-camera` and `several-telephones` nothing is."""

ADDED = {"view": ["--html", "scene.html"], "live": ["--port", "0"]}
"""{command: what is added, so that it ends by itself and takes no fixed port}."""

SLOW = {"batch", "calibration", "comparison", "first-recording", "depth", "sensors", "simulate",
        "surfaces", "which-setup"}  # fmt: skip
"""Pages whose commands take more than a few seconds."""


def batch(folder):
    for name in ("monday", "tuesday"):
        drawn.write_take(folder / "sessions" / name)
    yield


def blender(folder):
    shutil.copytree(ROOT / "blender", folder / "blender")
    write_motion(world().motion, folder / "motion.npz")
    yield


def calibration(folder):
    drawn.board_videos(folder / "videos")
    yield
    (folder / "calibration.toml").unlink()
    drawn.bar_videos(folder / "videos", floor=(12, 80))
    yield
    (folder / "calibration.toml").unlink()
    drawn.write_take(folder)
    yield


def take(folder):
    drawn.write_take(folder)
    yield


def nothing(folder):
    yield


def comparison(folder, recordings):
    project = folder / "pose2sim_project"
    motion, rig = drawn.write_recording(project / "videos", calibration=False)
    for leftover in (project / "videos").glob("*.npy"):
        leftover.unlink()
    (project / "calibration").mkdir()
    write_calibration(rig, project / "calibration" / "Calib.toml")
    for k in simulate_keypoints(motion, rig, "BODY_25B"):
        drawn.write_openpose(project / "pose" / f"{k.camera}_json", k)
    w = world()
    write_markers(w.markers(20), folder / "static.c3d")
    write_markers(w.markers(40), folder / "trial.c3d")
    yield from walk(folder, recordings, 10)


def first_recording(folder):
    drawn.write_recording(folder / "my_recording")
    yield


def init(folder):
    motion, rig = drawn.write_recording(folder / "my_recording")
    points = {}
    for camera in rig.names[:2]:
        x = motion.positions()[0]
        names = ("r_elbow", "r_wrist", "l_elbow", "l_wrist", "r_ankle", "l_ankle", "r_knee", "l_knee")
        uv = rig[camera].project(x[[motion.body.landmarks.names.index(name) for name in names]])
        points[camera] = dict(zip(names, uv.tolist()))
    (folder / "clicks.json").write_text(json.dumps({"step": 0, "points": points}))
    yield
    (folder / "my_recording" / "take.toml").unlink()
    yield


def depth_fusion(folder):
    """Files of the names that the page's own take has."""
    (folder / "take.toml").write_text(blocks("depth", "toml")[0].text)
    w = world()
    colour = replace(w.colour, name="colour")
    motion = cut(w.motion, 0, 6)
    write_calibration(Rig((w.depth_camera, colour)), folder / "calibration.toml")
    (folder / "kinect").mkdir()
    for i in range(len(motion)):
        counts = np.rint(1000 * w.depth.frame(i).depth).astype(np.uint16)
        cv2.imwrite(str(folder / "kinect" / f"{i:03d}.png"), counts)
    k = simulate_keypoints(motion, Rig((colour,)), "MEDIAPIPE_33")[0]
    seen = np.concatenate([k.points[:, 0], k.confidence[:, 0, :, None]], axis=-1)
    np.save(folder / "mediapipe_colour.npy", np.nan_to_num(seen).astype(np.float32))
    names = ("r_wrist", "l_wrist", "r_ankle", "l_ankle")
    x = motion.positions()[:, [motion.body.landmarks.names.index(name) for name in names]]
    write_markers(Markers(names, motion.rate, x, up=motion.up), folder / "few.trc")
    yield


def walk(folder, recordings, frames=30):
    """The first frames of a recorded walk."""
    lines = (recordings / "cmu_12_01_walk.bvh").read_text().splitlines()
    begin = next(i for i, line in enumerate(lines) if line.startswith("Frames:"))
    lines[begin] = f"Frames: {frames}"
    (folder / "walk.bvh").write_text("\n".join(lines[: begin + 2 + frames]) + "\n")
    yield


def simulate(folder, recordings):
    return walk(folder, recordings, 4)


def which_setup(folder):
    write_motion(cut(squat_and_wave(), 0, 4), folder / "motion.npz")
    yield


def gait(folder):
    for name in ("walk1", "walk2"):
        write_motion(walking(), folder / "monday" / name / "motion.npz")
    write_motion(squat_and_wave(), folder / "squats" / "motion.npz")
    (reference,) = (block.text for block in blocks("gait", "text") if block.text.startswith("coordinate,"))
    (folder / "adults.csv").write_text(reference)
    yield


def motion(folder):
    write_motion(world().motion, folder / "motion.npz")
    yield


def surfaces(folder):
    before, after = drawn.speckles((240, 320))
    cv2.imwrite(str(folder / "before.png"), before.astype(np.uint8))
    cv2.imwrite(str(folder / "after.png"), after.astype(np.uint8))
    rig, left, right = drawn.stereo_pair()
    write_calibration(rig, folder / "calib.toml")
    cv2.imwrite(str(folder / "left.png"), left)
    cv2.imwrite(str(folder / "right.png"), right)
    yield


def sapm(folder):
    motion = cut(squat_and_wave(), 0, 6)
    points = placement(motion.body, "CMU_41").points
    take = Markers(points.names, motion.rate, motion.positions(points), up="z")
    write_markers(take, folder / "points.c3d")
    save_model(learn_model(take, name="anna"), folder / "anna.json")
    yield


PREPARED = {
    "README": nothing, "app": nothing, "batch": batch, "blender": blender, "calibration": calibration, "check": take,
    "closed-chains": nothing, "comparison": comparison, "detect": nothing, "first-recording": first_recording,
    "gait": gait,
    "index": nothing, "init": init, "install": nothing, "live": take, "one-camera": nothing,
    "depth": depth_fusion, "silhouettes": nothing,
    "printed-sapm": sapm, "regions": nothing, "sensors": walk, "simulate": simulate, "surfaces": surfaces,
    "several-telephones": nothing, "view": motion, "printed-voodoo": nothing, "which-setup": which_setup,
}  # fmt: skip
"""{page: its function}."""


RECORDED = dict.fromkeys(("comparison", "sensors", "simulate"), "motion_cmu_bvh")
"""{page: the folder of real recordings that its function is given}."""


def reason(page, line):
    """Why a line is not run; None where it is."""
    line = re.sub(r"\s+", " ", line.strip())
    return next((why for (of, begin), why in NOT_RUN.items() if of == page and line.startswith(begin)), None)
