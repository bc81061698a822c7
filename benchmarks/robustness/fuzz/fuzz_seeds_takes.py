"""Seeds of readers that came later: tables of surfaces, bars and norms, bodies with closures, metaballs and skins, and
takes with every kind of sensor."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.robustness.fuzz.fuzz_seeds import Seed, body_of, calibration_of, depth_counts, finite
from benchmarks.scenes.bags import Bag

_CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
_FACES = "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
_SKIN = """[body]
name = "limb"
[[segment]]
name = "upper"
joint = { name = "ground", type = "free" }
[[segment]]
name = "lower"
parent = "upper"
joint = { name = "bend", type = "revolute", at = [0, 0.5, 0], axes = ["z"], range = [[-1, 1]] }
[skin]
mesh = "skin.obj"
weights = "skin.csv"
unit = "m"
"""
_TAKE = """[take]
name = "all"
rate = 30.0
up = "z"
person = "nearest 0 0 1"
body = "humanoid"
frames = [0, 3]
[session]
subject = "P07"
date = 2026-03-02
side = "left"
norms = "norms.csv"
[start]
at = [0.0, 0.0, 0.95]
forward = [1.0, 0.0, 0.0]
upward = [0.0, 0.0, 1.0]
angles = { arm_add_r = -40, knee_angle_l = 10 }
step = 1
[calibration]
file = "calibration.toml"
unit = "m"
position_sigma = 0.002
rotation_sigma = 0.1
[[camera]]
name = "cam01"
video = "cam01"
[[camera]]
name = "cam02"
video = "cam02"
time_offset = 0.0
rotation = 0
[[keypoints]]
camera = "cam01"
file = "cam01.npy"
format = "mediapipe"
frames = [0, 2]
[[keypoints]]
camera = "cam02"
format = "skin"
face = [20, 10, 16, 16]
set = "HANDS"
[[region]]
camera = "cam01"
sigma = 2.0
[[silhouette]]
camera = "cam01"
format = "threshold"
low = [0, 20, 20]
high = [255, 255, 255]
channels = "hsv"
smooth = 1.5
[[silhouette]]
camera = "cam02"
format = "background"
file = "plate.png"
[[lines]]
camera = "cam01"
file = "lines.csv"
landmarks = { hips = ["r_asis", "l_asis"], back = ["c7"] }
sigma = 2.0
[[stereo]]
left = "cam01"
right = "cam02"
range = [0.5, 6.0]
[[surface_points]]
file = "surface.csv"
time_offset = 0.0
sigma = 0.01
[[tracker]]
file = "trackers.csv"
points = { back = "thorax", wrist = "r_wrist" }
mounts = { wrist = [0, 0, 90] }
rotation_sigma = 2.0
[[markers]]
file = "a.trc"
shift = [0.0, 0.1, 0.0]
turn = [0, 0, 10]
"""
_DEPTH = """[take]
rate = 30.0
up = "-y"
size = false
body = "arm"
[[depth]]
name = "front"
file = "depth/d*.png"
unit = "mm"
range = [0.5, 5.0]
intrinsics = [60.0, 60.0, 32.0, 24.0]
distortion = [0.1, 0.01, 0, 0]
rate = 30.0
sigma = 0.01
background = "plate.png"
on_body = false
"""


def _surface_table(path: Path) -> None:
    rows = [f"{i / 30:.4f},{k},{0.1 * k},{0.2},{1 + 0.01 * i},0.001,0.001,0.002" for i in range(3) for k in range(4)]
    path.write_text("time_s,point,x,y,z,std_x,std_y,std_z\n" + "\n".join(rows) + "\n")


def _surface_points(folder: Path) -> Seed:
    from kinefit.readers.take.file import read_take
    from kinefit.readers.take.load import load_observations

    _surface_table(folder / "surface.csv")
    text = '[take]\nrate = 30.0\n[[surface_points]]\nfile = "surface.csv"\ntime_offset = 0.0\nsigma = 0.01\n'
    (folder / "take.toml").write_text(text)

    def read() -> object:
        seen = load_observations(read_take(folder / "take.toml"))
        return [video.frame(i) for video in seen.of_kind("surface_points") for i in range(min(len(video), 3))]

    return Seed((folder / "surface.csv",), read)


def _tracker_table(path: Path) -> None:
    rows = [f"{i / 30:.4f},{n},0.1,0.2,{1 + 0.01 * i},1,0,0,0" for i in range(3) for n in ("back", "wrist")]
    path.write_text("time_s,tracker,x,y,z,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")


def _trackers(folder: Path) -> Seed:
    from kinefit.sensors.kinds.poses import read_body_trackers

    _tracker_table(folder / "trackers.csv")

    def read() -> object:
        video = read_body_trackers(folder / "trackers.csv", ("back", "wrist"))
        return [video.frame(i) for i in range(min(len(video), 3))]

    return Seed((folder / "trackers.csv",), read)


def _bar(folder: Path) -> Seed:
    from kinefit.rigs.bar.targets import read_centroids

    rows = [f"{c},{i},{10 + i}.5,{5 + 8 * k}.25" for c in ("a", "b") for i in range(4) for k in (0, 1)]
    (folder / "bar.csv").write_text("camera,frame,u,v\n" + "\n".join(rows) + "\n")
    return Seed((folder / "bar.csv",), lambda: read_centroids(folder / "bar.csv", (64, 48)))


def _norms(folder: Path) -> Seed:
    from kinefit.exporters.report.cycles import read_norms

    _norms_table(folder / "norms.csv")
    return Seed((folder / "norms.csv",), lambda: read_norms(folder / "norms.csv"))


def _norms_table(path: Path) -> None:
    rows = [f"{name},{p},{p / 2},{4.5}" for name in ("knee_angle", "hip_flexion_l") for p in range(0, 101, 25)]
    path.write_text("coordinate,percent,mean,sd\n" + "\n".join(rows) + "\n")


def _seeds(folder: Path) -> Seed:
    from kinefit.cli.surfaces._measure import read_seeds

    rows = [f"{10 + i}.5,{20 - i}.25,{12 + i}.5,{20 - i}.75" for i in range(6)]
    (folder / "seeds.csv").write_text("u1,v1,u2,v2\n" + "\n".join(rows) + "\n")
    return Seed((folder / "seeds.csv",), lambda: read_seeds(folder / "seeds.csv", 2))


def _skin(folder: Path) -> Seed:
    from kinefit.bodies import load_body

    (folder / "body.toml").write_text(_SKIN)
    (folder / "skin.obj").write_text("".join("v {} {} {}\n".format(*c) for c in _CORNERS) + _FACES)
    weights = [(i + 1, "lower" if c[1] else "upper", 0.75 if i == 2 else 1) for i, c in enumerate(_CORNERS)]
    rows = [f"{v},{s},{w}" for v, s, w in [*weights, (3, "upper", 0.25)]]
    (folder / "skin.csv").write_text("vertex,segment,weight\n" + "\n".join(rows) + "\n")
    return Seed(tuple(folder / f"{name}" for name in ("skin.csv", "body.toml", "skin.obj")),
                lambda: finite(load_body(folder / "body.toml")))  # fmt: skip


def _sensors(folder: Path) -> Seed:
    from kinefit.exporters import write_markers
    from kinefit.geometry.camera import Rig
    from kinefit.observations import Markers
    from kinefit.readers.calibration.read import read_calibration, write_calibration
    from kinefit.readers.take.file import read_take
    from kinefit.readers.take.load import load_observations
    from kinefit.readers.take.videos import load_stereo

    calibration_of(folder)
    first = read_calibration(folder / "calibration.toml")["cam01"]
    beside = first.T_camera_world.copy()
    beside[0, 3] -= 0.2
    pair = Rig((first, replace(first, name="cam02", T_camera_world=beside)))
    write_calibration(pair, folder / "calibration.toml")
    picture = np.full((48, 64, 3), 90, np.uint8)
    cv2.ellipse(picture, (28, 20), (10, 12), 0, 0, 360, (120, 150, 220), -1)
    for camera in ("cam01", "cam02"):
        (folder / camera).mkdir()
        for i in range(3):
            cv2.imwrite(str(folder / camera / f"{i}.png"), np.roll(picture, i, 1))
    cv2.imwrite(str(folder / "plate.png"), np.full((48, 64, 3), 90, np.uint8))
    np.save(folder / "cam01.npy", np.full((3, 33, 3), 0.9))
    _tracker_table(folder / "trackers.csv")
    _surface_table(folder / "surface.csv")
    _norms_table(folder / "norms.csv")
    (folder / "lines.csv").write_text("frame,line,u1,v1,u2,v2\n0,hips,1,2,30,4\n1,back,1,2,30,4\n")
    write_markers(Markers(("a", "b", "c"), 30.0, np.ones((3, 3, 3)), up="z"), folder / "a.trc")
    (folder / "take.toml").write_text(_TAKE)

    def read() -> object:
        take = read_take(folder / "take.toml")
        seen = load_observations(take)
        return [video.frame(0) for video in (*seen.recordings, *load_stereo(take, seen))]

    return Seed((folder / "take.toml",), read)


def _depth_take(folder: Path) -> Seed:
    from kinefit.readers.take.file import read_take
    from kinefit.readers.take.load import load_observations

    (folder / "depth").mkdir()
    for i, counts in enumerate(depth_counts()):
        cv2.imwrite(str(folder / "depth" / f"d{i}.png"), counts)
    shutil.copyfile(folder / "depth" / "d0.png", folder / "plate.png")
    (folder / "take.toml").write_text(_DEPTH)

    def read() -> object:
        return [video.frame(0) for video in load_observations(read_take(folder / "take.toml")).recordings]

    return Seed((folder / "take.toml",), read)


def _recording(read: str) -> Callable[[Path], Seed]:
    """A recording of ROS 2 with depth, raw and compressed, colour, lenses and places; what of it is read."""

    def make(folder: Path) -> Seed:
        size, K = (64, 48), np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
        counts, place = depth_counts(), np.eye(4)
        bag = Bag().images("/a/depth/image_raw", "16UC1", counts).images("/b/depth/image", "16UC1 png", counts)
        bag.images("/a/color/image_raw", "rgb8", [np.full((48, 64, 3), 40 * i, np.uint8) for i in range(3)])
        for name in ("a/depth", "b/depth", "a/color"):
            bag.info(f"/{name}/camera_info", K, size, frame=name)
        bag.static(*[("map", name, place) for name in ("a/depth", "b/depth", "a/color")])
        file = bag.write(folder / "bag")

        def depth() -> object:
            from kinefit.readers.depth.recordings import read_depth

            videos = [read_depth(file / topic) for topic in ("a/depth/image_raw", "b/depth/image")]
            return [video.frame(i) for video in videos for i in range(min(len(video), 3))]

        def video() -> object:
            from kinefit.readers.videos.video import Video

            with Video(file / "a/color/image_raw") as found:
                return [found.read(i) for i in range(min(len(found), 3))]

        def rig() -> object:
            from kinefit.readers.calibration.read import read_calibration

            return finite(read_calibration(file))

        def init() -> object:
            from kinefit.readers.guess.folder import guess_take

            return guess_take(file.parent)

        return Seed((file,), {"depth": depth, "video": video, "rig": rig, "init": init}[read])

    return make


LATER: dict[str, Callable[[Path], Seed]] = {
    "surface points": _surface_points, "trackers": _trackers, "bar": _bar, "norms": _norms, "surface seeds": _seeds,
    "metaballs toml": body_of("arm_metaballs"), "closures toml": body_of("cyclist"),
    "couplings toml": body_of("humanoid"), "lifter toml": body_of("weight_lifter"), "body skin": _skin,
    "take of all sensors": _sensors, "take of depth": _depth_take,
    **{f"mcap {read}": _recording(read) for read in ("depth", "video", "rig", "init")},
}  # fmt: skip
"""{reader: maker of its seed}."""
