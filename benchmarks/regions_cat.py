"""A hand-held toy before real clutter (`region_cat`), followed by its mesh and the colours about its contour.

Started once from the true first pose, with no resets. One recording cannot be both for settings and for figures, so
settings were chosen on the rendered objects of `regions_scene.TUNED` and looked at here.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import data, figure
from benchmarks.regions_scene import away, rigid, state_of
from kinefit.bodies import Body
from kinefit.bodies.surfaces.obj import read_obj
from kinefit.frame.results import FrameResult
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import ColourFrame
from kinefit.tracking.takes.take import track_take
from kinefit.tracking.tracker import Tracker

RATE = 30.0  # [Hz] that the images are taken to have; the recording does not state it
RIGHT = 50.0, 5.0  # [mm], [deg], the field's rule
GOALS = {1: ">= 30", 2: ">= 15", 3: ">= 9", 4: ">= 5"}
BY_COMMAND = "cat, by the command: images right"
SRT3D = {1: "29 of 30", 2: "1 of 15", 3: "0 of 10", 4: "0 of 7"}


def images(folder: Path) -> list[NDArray]:
    """All images (H, W, 3) uint8 RGB."""
    return [cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in sorted((folder / "img").glob("*.png"))]


def truth(folder: Path, count: int) -> NDArray:
    """(F, 4, 4) [m] true poses, camera from object."""
    rows = np.loadtxt(folder / "img" / "pose.txt")[:count]
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3], out[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), 1e-3 * rows[:, 9:]
    return out


def camera(folder: Path) -> Camera:
    """The camera, which is the world."""
    return Camera("cam", (640, 512), np.loadtxt(folder / "K.txt").reshape(3, 3))


def follow(
    body: Body, rig: Rig, seen: list[NDArray], true: NDArray, every: int
) -> tuple[NDArray, NDArray, list[FrameResult], float]:
    """Errors (F, 2) [mm], [deg] and CPU times (F,) [ms] of every so many images, the results, and [s] to be ready."""
    began = time.process_time()
    tracker = Tracker(body, rig, rate=RATE / every, up="y")
    tracker.start_at(state_of(true[0]))
    results = [tracker.update([ColourFrame("cam", 0.0, seen[0])])]
    ready = time.process_time() - began
    off, spent = [], []
    for i in range(every, len(seen), every):
        began = time.process_time()
        results.append(tracker.update([ColourFrame("cam", i / RATE, seen[i])]))
        spent.append(1e3 * (time.process_time() - began))
        off.append(away(results[-1].state.T_world_root, true[i]))
    return np.array(off), np.array(spent), results, ready


def run() -> None:
    """Print how many images are right, how far the poses are off, and the time of one."""
    folder = data("region_cat")
    names = {every: f"cat, every {every}. image: right" if every > 1 else "cat, every image: right" for every in GOALS}
    if folder is None:
        for every, goal in GOALS.items():
            figure(names[every], None, "images", goal, "no recording region_cat")
        figure(BY_COMMAND, None, "images", ">= 29", "no recording region_cat")
        return
    seen = images(folder)
    true = truth(folder, len(seen))
    began = time.process_time()
    vertices, faces = read_obj(folder / "Cat.obj")
    body, rig = rigid("cat", 1e-3 * vertices, faces), Rig((camera(folder),))
    loaded = time.process_time() - began
    follow(body, rig, seen, true, 2)  # compiled kernels are loaded from their cache
    print("# started once from the true first pose, no resets; the truth is good to about 5.5 mm and 2.4 degrees")
    for every, goal in GOALS.items():
        off, spent, results, ready = follow(body, rig, seen, true, every)
        right = (off < RIGHT).all(axis=1)
        lost = np.array([r.lost[0] or r.hidden[0] for r in results[1:]])
        figure(names[every], float(right.sum()), "images", goal)
        print(f"  of {len(right)}; SRT3D {SRT3D[every]}; said to be lost {lost.sum()}; within 10 degrees and 5 cm "
              f"{(off < (50.0, 10.0)).all(axis=1).sum()}; largest error {off[:, 0].max():.0f} mm, "
              f"{off[:, 1].max():.1f} deg; median CPU time {np.median(spent):.1f} ms")  # fmt: skip
        if every == 1:
            print("  errors [deg]: " + " ".join(f"{e:.1f}" for e in off[:, 1]))
            figure("cat, every image: median place", float(np.median(off[:, 0])), "mm", "<= 4.6")
            figure("cat, every image: median turn", float(np.median(off[:, 1])), "deg", "<= 2.1")
            again = np.min([follow(body, rig, seen, true, 1)[1] for _ in range(5)], axis=0)
            name = "cat, every image: CPU time a frame, median of each frame's best of 5"
            figure(name, float(np.median(again)), "ms", "<= 2")
            figure("cat: ready after, mesh and first image", loaded + ready, "s", "<= 3")
    _through_the_door(folder, true)


def _through_the_door(folder: Path, true: NDArray) -> None:
    """The same recording as `kinefit track` follows it: from a take file whose `[start]` is the true pose, smoothed."""
    with tempfile.TemporaryDirectory() as work:
        path = take_of(folder, Path(work), true[0])
        motion = track_take(path)[0]
    off = np.array([away(motion.Ts_world_root[i], true[i]) for i in range(1, len(motion))])
    right = (off < RIGHT).all(axis=1)
    figure(BY_COMMAND, float(right.sum()), "images", ">= 29")
    print(f"  of {len(right)}; median {np.median(off[:, 0]):.1f} mm, {np.median(off[:, 1]):.1f} deg; "
          f"lowest quality {motion.quality.min():.2f}")  # fmt: skip


def take_of(folder: Path, work: Path, first: NDArray) -> Path:
    """A take file of the recording, its first pose stated."""
    K = np.loadtxt(folder / "K.txt").reshape(3, 3)
    (work / "cat.toml").write_text(
        f'[body]\nname = "cat"\n[[segment]]\nname = "cat"\njoint = {{ name = "free", type = "free" }}\n'
        f'surface = {{ mesh = "{folder}/Cat.obj", unit = "mm" }}\n'
    )
    (work / "calibration.toml").write_text(
        f'[cam]\nname = "cam"\nsize = [640.0, 512.0]\nmatrix = {K.tolist()}\ndistortions = [0.0, 0.0, 0.0, 0.0]\n'
        "rotation = [0.0, 0.0, 0.0]\ntranslation = [0.0, 0.0, 0.0]\nfisheye = false\n"
    )
    (work / "take.toml").write_text(
        f'[take]\nrate = {RATE}\nup = "-y"\nbody = "cat.toml"\nsize = false\n[start]\nat = {first[:3, 3].tolist()}\n'
        f"forward = {first[:3, 0].tolist()}\nupward = {first[:3, 1].tolist()}\n"
        f'[calibration]\nfile = "calibration.toml"\n[[camera]]\nname = "cam"\nvideo = "{folder}/img/*.png"\n'
        '[[region]]\ncamera = "cam"\n'
    )
    return work / "take.toml"
