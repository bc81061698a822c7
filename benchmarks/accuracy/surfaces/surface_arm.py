"""Surfaces tracked through videos: a drawn textured limb with truth, and the real bare arm.

The limb is a cylinder of 45 mm radius that turns by 2 degrees a frame about its axis while it swings, before three
cameras of 400x300 px a metre away, drawn from formulas with noise of 2 grey values: points vanish on one side and
appear on the other. A path is false where a point leaves the place of the surface at which it began by more than 2 mm.
Filters: 3 m/s, 100 m/s², and the default bound on uniformity within 20 mm. The seed was not used in development.

The real arm (`stereo_arm_handpose3d`): two webcams turned by 74 degrees against each other.
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.surfaces.lsm import Texture
from benchmarks.figures import amount, figure, recording
from benchmarks.papers.silhouettes.silhouettes_arm import SKIN, camera
from kinefit.errors import KinefitError
from kinefit.exporters.surface_files import write_field_picture
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.photogrammetry.least_squares_matching import Grid
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface import measure, measure_states, surface_strain
from kinefit.images.photogrammetry.surface_tracking import SurfaceTracker, SurfaceTracking
from kinefit.images.photogrammetry.trajectories import Trajectories, uniform, within_bounds
from kinefit.readers.videos.video import Video
from kinefit.simulation.figures import look_at

RADIUS, SIZE, SEED = 0.045, (400, 300), 4242
FALSE = 0.002  # [m]


def run() -> None:
    """Print every figure."""
    _limb()
    _arm()


def _rig() -> Rig:
    cameras = []
    for name, x in (("middle", 0.0), ("left", -0.18), ("right", 0.18)):
        T = look_at(np.array([x, 0.02, -1.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
        K = [[1100.0, 0, SIZE[0] / 2], [0, 1100.0, SIZE[1] / 2], [0, 0, 1]]
        cameras.append(Camera(name, SIZE, K, (-0.05, 0.01, 0, 0), "radtan", T))
    return Rig(tuple(cameras))


def pose(frame: int) -> NDArray:
    """T_world_limb (4, 4): y is the axis."""
    swing = se3.exp_so3(np.array([0.0, 0.0, 0.25 * np.sin(0.06 * frame)]))
    turn = se3.exp_so3(np.array([0.0, np.deg2rad(2.0) * frame, 0.0]))
    return se3.transform(swing @ turn, np.array([0.02 * np.sin(0.05 * frame), 0.0, 0.02 * np.sin(0.08 * frame)]))


def drawn(view: Camera, rays: NDArray, texture: Texture, frame: int, rng: np.random.Generator) -> SplineImage:
    """What a camera sees of the limb."""
    back = se3.inverse(pose(frame))
    d, o = rays @ back[:3, :3].T, se3.apply(back, view.centre_world)
    a, b = d[:, 0] ** 2 + d[:, 2] ** 2, d[:, 0] * o[0] + d[:, 2] * o[2]
    under = b**2 - a * (o[0] ** 2 + o[2] ** 2 - RADIUS**2)
    hit = np.flatnonzero(under > 0)
    x = o + d[hit] * ((-b[hit] - np.sqrt(under[hit])) / a[hit])[:, None]
    grey = np.full(len(rays), 60.0)
    grey[hit] = texture(np.column_stack([RADIUS * np.arctan2(x[:, 0], x[:, 2]), x[:, 1]]) / 0.001)
    return SplineImage.of(grey.reshape(SIZE[::-1]) + 2.0 * rng.normal(size=SIZE[::-1]))


def _limb() -> None:
    rig, rng, texture = _rig(), np.random.default_rng(SEED), Texture(SEED, grain=1.4, waves=100)
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    rays = [camera.ray(np.stack([u, v], axis=-1).reshape(-1, 2)) for camera in rig]
    tracker, live = SurfaceTracker(rig, 30.0, SurfaceTracking(step=6)), []
    for frame in range(amount(100, 4)):
        images = [drawn(view, d, texture, frame, rng) for view, d in zip(rig, rays)]
        live.append(len(tracker.update(images)))
    paths = tracker.trajectories()
    good = uniform(paths, radius=0.02) & within_bounds(paths, speed=3.0, acceleration=100.0)
    filtered = paths.kept(good)
    bad = 100 * float((np.nanmax(_drift(filtered), axis=0) > FALSE).mean())
    figure("surface_limb_live_points", _fewest(filtered), "points in every frame", ">= 500")
    figure("surface_limb_false_paths", bad, "%", "<= 1")
    figure("surface_limb_regenerated", len(paths.x_world[0]) - live[0], "points", ">= 1")
    if os.environ.get("KINEFIT_PICTURES"):
        _draw(rig, rays, texture, Path(os.environ["KINEFIT_PICTURES"]) / "surface_limb.png")


def _draw(rig: Rig, rays: list[NDArray], texture: Texture, path: Path) -> None:
    """The limb at frames 0 and 2, turned by 4 degrees: standard deviation, displacement and strain."""
    rng, grid = np.random.default_rng(SEED), Grid.of(SIZE, 3)
    states = [[drawn(view, d, texture, frame, rng) for view, d in zip(rig, rays)] for frame in (0, 2)]
    first, second = measure_states(rig, states, grid, window=21)
    moved, told = second.x_world - first.x_world, surface_strain(first, second, 0.02, 21)
    fields = (
        ("std deviation", "mm", 1e3 * np.linalg.norm(first.std, axis=1)),
        ("displacement", "mm", 1e3 * np.linalg.norm(moved, axis=1)), ("strain xx, 20 mm", "1e-6", 1e6 * told.xx),
    )  # fmt: skip
    parts, one = [], path.with_name("field.png")
    for title, unit, values in fields:
        write_field_picture(first, states[0][0].grey, values, one, title=title, unit=unit)
        parts.append(cv2.imread(str(one)))
    one.unlink()
    cv2.imwrite(str(path), np.hstack(parts))


def _fewest(paths: Trajectories) -> int:
    """Live points in the poorest frame; paths of the last frames are still too short for the filters."""
    return int(paths.live[: max(1, len(paths.times) - 2)].sum(axis=1).min())


def _drift(paths: Trajectories) -> NDArray:
    """(F, P) [m] from where on the limb each path began, of paths that there are."""
    local = np.stack([se3.apply(se3.inverse(pose(k)), x) for k, x in enumerate(paths.x_world)])
    local = local[:, np.isfinite(local).any(axis=(0, 2))]
    first = np.argmax(np.isfinite(local[..., 0]), axis=0)
    begun = local[first, np.arange(local.shape[1])]
    return np.linalg.norm(local - begun, axis=2)


def _arm() -> None:
    folder = recording("stereo_arm_handpose3d")
    rig, most = Rig((camera(folder, 0), camera(folder, 1))), 0
    for frame in amount((5, 60, 110, 160, 200, 250, 300), (160,)):
        told = [_seen(folder / f"cam{k}_test.mp4", frame) for k in range(2)]
        images, skin = [SplineImage.of(picture) for picture in told], _skin(told[0])
        try:
            surface = measure(rig, images, Grid.of(rig.cameras[0].size, 6), window=31, least=0.7)
        except KinefitError as error:
            print(f"# arm, frame {frame}: {error}")
            continue
        at = surface.uv[surface.measured, 0].astype(int)
        count = int(skin[at[:, 1], at[:, 0]].sum())
        print(f"# arm, frame {frame}: {surface.measured.sum()} points, {count} of them on skin")
        most = max(most, count)
    figure("surface_arm_live_points", most, "points on skin in the best frame", ">= 500")


def _seen(path: Path, frame: int) -> NDArray:
    with Video(path) as video:
        return video.read(frame)


def _skin(picture: NDArray) -> NDArray:
    return cv2.inRange(cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb), SKIN[0], SKIN[1]) > 0
