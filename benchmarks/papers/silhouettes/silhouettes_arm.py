# ruff: noqa: E501
"""A real bare arm and hand over a desk in two views, tracked by the outlines that its colour gives.

The pose of one frame is found from two points that were read by hand in both pictures, all ways that the arm may be
turned about its axis tried; the rest is silhouettes alone, forwards and backwards.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure, recording
from benchmarks.scenes.silhouettes_scene import shape_from_silhouettes
from kinefit.bodies import Body, BodyState, load_body
from kinefit.bodies.rendering import render_body, scaled
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.fitting.initialization.candidates import Level, coarse_to_fine
from kinefit.fitting.subject.parameters import SegmentScales
from kinefit.fitting.subject.surfaces import CylinderShape
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.silhouette import choose_person, colour_mask
from kinefit.observations import SilhouetteFrame
from kinefit.readers.videos.video import Video
from kinefit.sensors.settings import TrackSettings

UNIT = 0.042  # [m] of the calibration: index finger to wrist is 4.2 of them
FIRST, LAST = amount((40, 378), (150, 180))
START, RATE, TURN = 160, 30.0, amount(30, 90)  # frame; [Hz]; [deg] between the turns that are tried
SEEN = {"wrist": ((434, 160), (281, 369)), "tip": ((519, 375), (458, 406)), "arm": ((336, 28), (20, 382))}
SKIN = (40, 138, 85), (235, 185, 123)  # YCrCb
SETTINGS = TrackSettings(search=False, outline=360, far=0.08, near=0.015, patch=0.02, reach=0.08, iterations=10)
SIGMA = 4.0  # [px]
BODY = """
[body]
name = "forearm and hand"
[[segment]]
name = "forearm"
joint = { name = "free", type = "free" }
scale = "forearm"
surface = { end = [0.0, 0.24, 0.0], radii = [[0.021, 0.029], [0.042, 0.045]] }
[[segment]]
name = "upperarm"
parent = "forearm"
joint = { name = "elbow", type = "universal", at = [0.0, 0.24, 0.0], axes = ["z", "x"], coordinates = ["elbow_flex", "elbow_dev"], range = [[-140, 140], [-140, 140]], usual = [0, 0], spread = [60, 60] }
scale = "forearm"
surface = { end = [0.0, 0.1, 0.0], radii = [0.045, 0.045] }
[[segment]]
name = "palm"
parent = "forearm"
joint = { name = "wrist", type = "universal", at = [0.0, 0.0, 0.0], axes = ["z", "x"], coordinates = ["wrist_flex", "wrist_dev"], range = [[-80, 85], [-40, 45]], spread = [40, 20] }
scale = "hand"
surface = { end = [0.0, -0.085, 0.0], radii = [[0.019, 0.03], [0.014, 0.042]] }
[[segment]]
name = "fingers"
parent = "palm"
joint = { name = "knuckles", type = "revolute", at = [0.0, -0.085, -0.012], axes = ["z"], coordinates = ["finger_flex"], range = [[-25, 110]], usual = [40], spread = [40] }
scale = "hand"
surface = { end = [0.0, -0.065, 0.0], radii = [[0.012, 0.03], [0.01, 0.024]] }
[[segment]]
name = "index"
parent = "palm"
joint = { name = "index", type = "universal", at = [0.0, -0.085, 0.028], axes = ["z", "x"], coordinates = ["index_flex", "index_dev"], range = [[-25, 100], [-20, 20]], usual = [20, 0], spread = [40, 10] }
scale = "hand"
surface = { end = [0.0, -0.085, 0.0], radii = [0.010, 0.008] }
[[segment]]
name = "thumb"
parent = "palm"
joint = { name = "thumb", type = "universal", at = [0.0, -0.025, 0.025], axes = ["z", "x"], coordinates = ["thumb_flex", "thumb_dev"], range = [[-40, 90], [-90, 10]], usual = [20, -35], spread = [30, 25] }
scale = "hand"
surface = { end = [0.0, -0.085, 0.0], radii = [0.014, 0.009] }
"""


def camera(folder: Path, c: int) -> Camera:
    """A camera of the recording; its translations are in the calibration's unit."""
    numbers = [line.split() for line in (folder / f"c{c}.dat").read_text().splitlines()]
    placed = [line.split() for line in (folder / f"rot_trans_c{c}.dat").read_text().splitlines()]
    u, _, v = np.linalg.svd(np.array(placed[1:4], float))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = u @ v, UNIT * np.array(placed[5:8], float).ravel()
    return Camera(f"cam{c}", (720, 720), np.array(numbers[1:4], float), np.array(numbers[5], float), T_camera_world=T)


def met(rig: Rig, pixels: tuple) -> NDArray:
    """(3,) [m] the point nearest to the rays of two pixels."""
    rays = [c.ray(np.array(uv, float)) for c, uv in zip(rig, pixels)]
    across = [np.eye(3) - np.outer(r, r) for r in rays]
    return np.linalg.solve(sum(across), sum(a @ c.centre_world for a, c in zip(across, rig)))


class Pictures:
    """Both videos, as silhouettes of what has the colour of skin."""

    def __init__(self, folder: Path, rig: Rig) -> None:
        self.rig, self.videos = rig, [Video(folder / f"cam{c}_test.mp4") for c in (0, 1)]

    def __call__(self, i: int) -> list[SilhouetteFrame]:
        out = []
        for camera, video in zip(self.rig, self.videos):
            smooth = cv2.GaussianBlur(video.read(i), (0, 0), 1.5)
            mask = colour_mask(cv2.cvtColor(smooth, cv2.COLOR_RGB2YCrCb), *SKIN)
            out.append(SilhouetteFrame(camera.name, i / RATE, choose_person(mask)))
        return out


def first_pose(body: Body, rig: Rig, seen: list[SilhouetteFrame]) -> tuple[BodyState, float]:
    """Of all turns about the forearm's axis the one whose fit overlaps the silhouettes most."""
    wrist, arm = met(rig, SEEN["wrist"]), met(rig, SEEN["arm"])
    y = (arm - wrist) / np.linalg.norm(arm - wrist)
    x = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
    x /= np.linalg.norm(x)
    z = np.cross(x, y)
    levels = (Level(180, 0.12, 0.04, 1.3), Level(360, 0.06, 0.015, 1.0))
    found = []
    for turn in np.radians(np.arange(0, 360, TURN)):
        T = np.eye(4)
        T[:3, 0], T[:3, 1] = np.cos(turn) * x + np.sin(turn) * z, y
        T[:3, 2] = np.cross(T[:3, 0], y)
        T[:3, 3] = wrist
        accuracy = {f"silhouette {c.name}": SIGMA for c in rig}
        start = body.default_state(T)
        found.append(coarse_to_fine(body, rig, seen, start, sigma=accuracy, levels=levels, settings=SETTINGS))
    best = max(found, key=lambda f: f.overlap)
    return best.result.state, best.overlap


def tracked(body: Body, rig: Rig, pictures: Pictures, start: BodyState) -> dict[int, BodyState]:
    """States of all frames, forwards and backwards from the start."""
    out = {}
    for steps in (range(START, LAST), range(START - 1, FIRST - 1, -1)):
        accuracy = {f"silhouette {c.name}": SIGMA for c in rig}
        follow = Tracker(body, rig, rate=RATE, sigma=accuracy, settings=SETTINGS, up="y")
        follow.start_at(start)
        for k, i in enumerate(steps):
            result = follow.update([replace(frame, time=k / RATE) for frame in pictures(i)])  # also backwards
            assert result is not None
            out[i] = result.state
    return out


def overlap(body: Body, state: BodyState, rig: Rig, seen: list[SilhouetteFrame]) -> NDArray:
    """(2,) intersection over union in both cameras; of what is nearer than the elbow, as sleeves hide the rest."""
    out, mesh = [], body_mesh(body)
    for camera, frame in zip(rig, seen):
        small = scaled(camera, 0.5)
        drawn = render_body(body, state, small, mesh=mesh)
        beyond = drawn.segment == body.tree.segment("upperarm")
        mask = (cv2.resize(frame.mask, small.size, interpolation=cv2.INTER_AREA) > 127) & ~beyond
        mine = drawn.seen & ~beyond
        out.append((mine & mask).sum() / max((mine | mask).sum(), 1))
    return np.array(out)


def run() -> None:
    """Print how well the arm is followed."""
    folder = recording("stereo_arm_handpose3d")
    name = f"arm and hand: frames of {LAST - FIRST} with an overlap of 0.7 or more in both views"
    with tempfile.TemporaryDirectory() as work:
        (Path(work) / "arm.toml").write_text(BODY)
        body = load_body(str(Path(work) / "arm.toml"))
    rig = Rig((camera(folder, 0), camera(folder, 1)))
    pictures = Pictures(folder, rig)
    start, agreed = first_pose(body, rig, pictures(START))
    print(f"# first pose: overlap {agreed:.3f}")
    rough = tracked(body, rig, pictures, start)
    chosen = range(FIRST + amount(20, 5), LAST, amount(40, 10))
    seen = [pictures(i) for i in chosen]
    fit = shape_from_silhouettes(
        body, rig, seen, [rough[i] for i in chosen], [SegmentScales(body), CylinderShape(body)], sigma=SIGMA,
        settings=SETTINGS,
    )  # fmt: skip
    states = tracked(fit.body, rig, pictures, rough[START])
    told = np.array([overlap(fit.body, states[i], rig, pictures(i)) for i in sorted(states)])
    figure("arm and hand: mean overlap with the silhouettes", told.mean(), "IoU", ">= 0.8")
    figure(name, float((told.min(axis=1) >= 0.7).sum()), "frames", ">= 300")
