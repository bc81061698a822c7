"""Simulate a calibration bar with two targets: places of its ends, and detections in cameras; a board as bars."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import exp_so3, log_so3, transform
from kinefit.rigs.bar.targets import BarViews
from kinefit.simulation.figures import look_at


@checked
def bar_rig(count: int = 3, size: tuple[int, int] = (1920, 1080), *, seed: int | None = None) -> Rig:
    """Rig of cameras 3.8 m around the middle of a room, z up, each with another lens.

    With a `seed` places and lenses vary at random.
    """
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(-1.0, 1.0, (count, 12)) * (seed is not None)
    cameras = []
    for i, d in enumerate(drawn):
        azimuth = np.radians(20.0 + max(70.0, 300.0 / count) * i + 10.0 * d[0])
        distance = 3.8 + 0.4 * d[1]
        centre = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), 1.2 + 0.4 * (i % 4) + 0.3 * d[2]])
        level = look_at(centre, np.array([0.1 * d[3], 0.1 * d[4], 1.0]), np.array([0.0, 0.0, 1.0]))
        R = exp_so3(np.array([0.0, 0.0, 0.1 * d[5]])) @ level[:3, :3]
        f = (0.6 + 0.1 * (i % 3) + 0.08 * d[6]) * size[0]
        u, v = size[0] / 2 - 9.0 * (i % 3) + 10.0 * d[7], size[1] / 2 + 6.0 * (i % 3) + 10.0 * d[8]
        K = np.array([[f, 0.0, u], [0.0, (1.001 + 1e-3 * d[9]) * f, v], [0.0, 0.0, 1.0]])
        lens = np.array([-0.15 + 0.1 * d[10], 0.04 + 0.03 * d[11], 5e-4, -3e-4, 0.0])
        cameras.append(Camera(f"cam{i}", size, K, lens, "radtan", transform(R, -R @ centre)))
    return Rig(tuple(cameras))


@checked
def wave_bar(
    length: float, count: int, *, low: ArrayLike = (-1.0, -1.0, 0.3), high: ArrayLike = (1.0, 1.0, 2.0), seed: int = 0
) -> NDArray:
    """Ends (N, 2, 3) [m] of a bar at `count` random places in a box, in random directions.

    Parameters
    ----------
    length : [m] of the bar
    low, high : (3,) [m] corners of the box

    Raises
    ------
    ObservationError
        `length` or `count` is not positive.
    """
    if not (length > 0 and count > 0):
        raise ObservationError(f"length is {length} m, count is {count}", remedy="Give positive numbers.")
    rng = np.random.default_rng(seed)
    middle = rng.uniform(np.asarray(low, float), np.asarray(high, float), (count, 3))
    direction = rng.normal(size=(count, 3))
    half = 0.5 * length * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return np.stack([middle - half, middle + half], axis=1)


@checked
def see_bar(rig: Rig, ends: NDArray, *, noise: float = 0.1, seed: int = 0) -> dict[str, BarViews]:
    """Detections of a bar's ends (N, 2, 3) [m] in the cameras of a rig, in random order, with noise [px]."""
    rng, views = np.random.default_rng([seed, 1]), {}
    for camera in rig:
        uv = camera.project(ends) + rng.normal(0.0, noise, (*ends.shape[:2], 2))
        swapped = rng.random(len(ends)) < 0.5
        uv[swapped] = uv[swapped, ::-1]
        inside = (np.isfinite(uv) & (uv > 2.0) & (uv < np.array(camera.size) - 3.0)).all(axis=(1, 2))
        views[camera.name] = BarViews(camera.size, {int(f): uv[f] for f in np.flatnonzero(inside)}, len(ends))
    return views


@checked
def draw_bar(
    camera: Camera, ends: ArrayLike, *, radius: float = 0.02, lamps: ArrayLike = (), noise: float = 3.0, seed: int = 0
) -> NDArray:
    """Grey image (H, W) uint8 of a bar with bright balls at its ends (2, 3) [m].

    Each pixel is the mean of 4 x 4 rays, on a dark background with noise.

    Parameters
    ----------
    radius : [m] of the balls
    lamps : (K, 3) [m] other lights, as bright as the balls
    noise : standard deviation of a grey value
    """
    rng, (width, height) = np.random.default_rng(seed), camera.size
    image = np.full((height, width), 18.0)
    grid = (np.arange(4) + 0.5) / 4 - 0.5
    for x in [*np.asarray(ends, float), *np.asarray(lamps, float).reshape(-1, 3)]:
        uv = camera.project(x)
        distance = float(np.linalg.norm(x - camera.centre_world))
        if not np.isfinite(uv).all():
            continue
        reach = int(np.ceil(2 * camera.matrix[0, 0] * radius / distance)) + 3
        u, v = np.rint(uv).astype(int)
        us = np.arange(max(u - reach, 0), min(u + reach + 1, width))
        vs = np.arange(max(v - reach, 0), min(v + reach + 1, height))
        if not (len(us) and len(vs)):
            continue
        fine = np.stack(np.meshgrid((us[:, None] + grid).ravel(), (vs[:, None] + grid).ravel()), axis=-1)
        from_ray = np.linalg.norm(np.cross(camera.ray(fine), x - camera.centre_world), axis=-1)
        share = (from_ray < radius).reshape(len(vs), 4, len(us), 4).mean(axis=(1, 3))
        patch = image[vs[0] : vs[-1] + 1, us[0] : us[-1] + 1]
        np.maximum(patch, 18.0 + 220.0 * share, out=patch)
    return np.clip(np.rint(image + rng.normal(0.0, noise, image.shape)), 0, 255).astype(np.uint8)


CORNERS = (0, 9), (1, 10), (2, 11)
"""Pairs of corners 16.2 cm apart of the board in `mv4_landmarks_caliscope`: three bars at a time."""
CORNERS_LENGTH = 0.162


def write_corners(
    recording: Path, table: Path, *, pairs: Sequence[tuple[int, int]] = CORNERS, late: int = 0
) -> None:
    """Write pairs of corners of a moved board, as four webcams saw them, as centroids of a bar in random order.

    The fourth webcam's images get the number of those `late` times before.
    """
    rng, seen = np.random.default_rng(0), dict[tuple[int, int, int], str]()
    with (recording / "calibration/extrinsic/xy.csv").open() as file:
        for row in csv.DictReader(file):
            at = int(row["sync_index"]), int(row["port"]), int(row["point_id"])
            seen[at] = f"{row['img_loc_x']},{row['img_loc_y']}"
    lines = ["camera,frame,u,v"]
    for time, port in sorted({at[:2] for at in seen}):
        for k, ends in enumerate(pairs):
            if all((time, port, end) in seen for end in ends):
                bar = f"cam_{port},{len(pairs) * (time - late * (port == 3)) + k}"
                lines += [f"{bar},{seen[time, port, ends[end]]}" for end in rng.permutation(2)]
    table.write_text("\n".join(lines))


def pose_differences(found: Rig, known: Rig) -> tuple[float, float]:
    """Largest relative difference of a distance between two cameras, and of their rotation [deg]."""
    lengths, angles = list[float](), list[float]()
    for a, b in combinations(known.names, 2):
        one, other = (rig[b].T_camera_world @ np.linalg.inv(rig[a].T_camera_world) for rig in (found, known))
        lengths.append(abs(float(np.linalg.norm(one[:3, 3]) / np.linalg.norm(other[:3, 3])) - 1.0))
        angles.append(float(np.degrees(np.linalg.norm(log_so3(one[:3, :3] @ other[:3, :3].T)))))
    return max(lengths), max(angles)
