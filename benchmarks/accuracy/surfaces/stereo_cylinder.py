"""The speckled cylinder of MultiDIC before two cameras 31 degrees apart, in three positions.

Cameras: intrinsics and lens distortion from MultiDIC's corners of its checkerboards (25 and 20 photographs), poses from
the squares of its calibration cylinder (radius 57 mm, found in the photographs here), then both adjusted together so
that the rays of a thousand matches of position 1 meet. No truth of the speckled cylinder was measured independently:
56.87 mm is what other software found. A grid of step 8 px over the speckle, from SIFT seeds. Positions 1 to 3 are
matched with the first camera's first photograph. Settings were chosen on position 1.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure, recording
from benchmarks.timing import fastest
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import log_so3
from kinefit.images.photogrammetry.least_squares_matching import Grid, grow
from kinefit.images.photogrammetry.seeding.unaided import sift_seeds
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface import (
    MeasuredSurface,
    displacement_std,
    measure,
    measure_states,
    rigid_motion,
    surface_strain,
)

CAMERAS, SIZE = ("201", "202"), (2464, 3280)
SPECKLE = slice(430, 2180), slice(720, 1620)  # of the first photograph
WINDOW, STEP = 31, 8
GAUGE = amount(0.005, 0.01)  # [m] of strain: five windows
SQUARE = 0.01  # [m]


def run() -> None:
    """Print every figure."""
    folder = recording("stereo_dic_cylinder")
    objects = [calibration_object(folder, name) for name in CAMERAS]
    rig = Rig(tuple(calibrated(folder, name, *seen) for name, seen in zip(CAMERAS, objects)))
    states = [
        [SplineImage.of(_photograph(folder / "speckledObjectImages" / name / f"{name}_{k}.jpg")) for name in CAMERAS]
        for k in amount((1, 2, 3), (1, 2))
    ]
    first = states[0][0]
    mask = np.zeros(SIZE[::-1], bool)
    mask[SPECKLE] = True
    grid = Grid.of(SIZE, amount(STEP, 24), mask=mask, margin=30)
    whole = Grid.of(SIZE, STEP, mask=mask, margin=30)  # also in the quick form: the cameras are adjusted to all points
    start = measure(rig, states[0], whole, window=WINDOW)
    rig = adjusted(rig, objects, start.uv[start.measured])
    surfaces = measure_states(rig, states, grid, window=WINDOW)
    for k, surface in enumerate(surfaces, 1):
        radius, residual = cylinder(surface.x_world[surface.measured])
        mad = 1e3 * float(np.median(np.abs(residual)))
        parallax = np.nanmedian(surface.parallax)
        print(f"# position {k}: {surface.measured.sum()} points, radius {1e3 * radius:.3f} mm, MAD {mad:.4f} mm, "
              f"parallax {parallax:.2f} px, stated std {1e3 * _length(surface):.4f} mm")  # fmt: skip
        figure(f"cylinder_points_{k}", surface.measured.sum(), "points", ">= 10000")
        figure(f"cylinder_radius_error_{k}", abs(1e3 * radius - 56.87), "mm", "<= 0.05")
        figure(f"cylinder_mad_{k}", mad, "mm", "<= 0.03")
    shares = []
    for k, surface in enumerate(surfaces[1:], 2):
        T, residual = rigid_motion(surfaces[0].x_world, surface.x_world)
        lengths = 1e3 * np.linalg.norm(residual, axis=1)
        angle = np.rad2deg(np.arccos((np.trace(T[:3, :3]) - 1) / 2))
        rms = 1e3 * np.sqrt(np.nanmean(residual**2))
        print(f"# 1 to {k}: turned by {angle:.3f} degrees; a coordinate {rms:.4f} mm")
        shares += inside(surfaces[0], surface, residual)
        figure(f"cylinder_rigid_motion_{k}", float(np.sqrt(np.nanmean(lengths**2))), "mm RMS in space", "<= 0.02")
    figure("cylinder_inside_least", min(shares), "% within 1.96 std, worst of displacements and strains", ">= 90")
    figure("cylinder_inside_most", max(shares), "% within 1.96 std, the widest", "<= 98")
    seeds = sift_seeds(first, states[0][1], (rig.cameras[0], rig.cameras[1]))
    matches, spent = fastest(lambda: grow(first, states[0][1], grid, seeds), amount(3, 1))
    print(f"# 13x13: {matches.found.sum()} points, {matches.iterations[matches.found].mean():.1f} iterations")
    figure("cylinder_points_a_second", matches.found.sum() / spent, "found points/s a core, 13x13", ">= 10000")


def inside(reference: MeasuredSurface, state: MeasuredSurface, residual: NDArray) -> list[float]:
    """[%] within 1.96 standard deviations after a rigid motion: displacements x, y, z, strains xx, yy, xy.

    Of displacements what neighbours 32 px apart, whose windows share no pixels, differ from each other (second
    differences): the calibration's errors, which change slowly over the surface, are in no deviation.
    """
    std = displacement_std(reference, state, WINDOW)
    apart = max(1, round(4 * STEP / reference.grid.step))
    columns = reference.grid.columns
    value, variance = (a.reshape(-1, columns, 3)[::apart, ::apart] for a in (residual, std**2))
    second = value[1:-1] - 0.5 * (value[:-2] + value[2:])
    spread = np.sqrt(variance[1:-1] + 0.25 * (variance[:-2] + variance[2:]))
    z = (second / spread).reshape(-1, 3)
    strained = surface_strain(reference, state, GAUGE, WINDOW)
    all_z = [*z.T, *(getattr(strained, n) / getattr(strained, f"std_{n}") for n in ("xx", "yy", "xy"))]
    out = [100 * float(np.mean(np.abs(one[np.isfinite(one)]) <= 1.96)) for one in all_z]
    print("#   within 1.96 std: " + ", ".join(f"{n} {s:.1f} %" for n, s in zip(("x", "y", "z", "xx", "yy", "xy"), out)))
    return out


def _photograph(file: Path) -> NDArray:
    return cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)


def _length(surface: MeasuredSurface) -> float:
    return float(np.median(np.linalg.norm(surface.std[surface.measured], axis=1)))


def calibration_object(folder: Path, name: str) -> tuple[NDArray, NDArray]:
    """Squares of the calibration cylinder (N, 3) [m], and their centres in the photograph (N, 2) [px]."""
    from scipy.io import loadmat

    objects = folder / "calibrationObjectImages"
    told = loadmat(objects / f"DLTstruct_cam_{name}.mat", simplify_cells=True)["DLTstructCam"]
    truth = loadmat(objects / "calibrationObjectCoordinates.mat", simplify_cells=True)["P3d"]
    x = 1e-3 * np.concatenate([truth[:, column - 1] for column in told["columns"]])
    return x, centres(cv2.imread(str(objects / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE), told["imageCentroids"] - 1)


def calibrated(folder: Path, name: str, x: NDArray, uv: NDArray) -> Camera:
    """A camera from MultiDIC's boards, whose pixels from 1 are made to count from 0, and the calibration cylinder."""
    from scipy.io import loadmat

    boards = loadmat(folder / "BAcheckerboardImages" / f"cameraCBparameters_cam_{name}.mat", simplify_cells=True)
    corners = boards["cameraCBparameters"]["imagePoints"] - 1
    board = np.array([[SQUARE * j, SQUARE * i, 0] for i in range(19) for j in range(14)], np.float32)
    seen = [np.ascontiguousarray(corners[:, :, k], np.float32) for k in range(corners.shape[2])]
    start = np.array([[2600.0, 0, SIZE[0] / 2], [0, 2600, SIZE[1] / 2], [0, 0, 1]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    rms, K, k, _, _ = cv2.calibrateCamera([board] * len(seen), seen, SIZE, start, np.zeros(5), flags=flags)
    _, r, t = cv2.solvePnP(x, uv, K, k)
    camera = _camera(name, np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], k.ravel()[:4], r.ravel(), t.ravel()]))
    off = camera.project(x) - uv
    print(f"# camera {name}: boards {rms:.2f} px, calibration cylinder {np.sqrt(np.mean(off**2)):.2f} px a coordinate")
    return camera


def _camera(name: str, p: NDArray) -> Camera:
    """From 14 numbers: focal lengths, principal point, four of the lens, turn, place."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(p[8:11])[0], p[11:]
    return Camera(name, SIZE, np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]]), p[4:8], "radtan", T)


def _numbers(camera: Camera) -> NDArray:
    K, T = camera.matrix, camera.T_camera_world
    inner = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    return np.concatenate([inner, camera.distortion, log_so3(T[:3, :3]), T[:3, 3]])


def adjusted(rig: Rig, objects: list[tuple[NDArray, NDArray]], uv: NDArray) -> Rig:
    """Both cameras by least squares: squares to 0.3 px, rays of matches (N, 2, 2) [px] that meet to 0.1 px.

    The boards count as priors: 8 px for focal lengths and principal point, 0.01 and 0.03, 0.002 and 0.002 for the lens.
    """
    from scipy.optimize import least_squares

    start = np.concatenate([_numbers(camera) for camera in rig])
    scale = np.tile([5, 5, 5, 5, 0.01, 0.02, 1e-3, 1e-3, *[0.01] * 6], 2)
    prior = np.array([8, 8, 8, 8, 0.01, 0.03, 0.002, 0.002])
    ties = uv[:: max(1, len(uv) // 1000)]

    def residuals(q: NDArray) -> NDArray:
        p = start + scale * q
        cameras = [_camera(c.name, p[14 * i : 14 * i + 14]) for i, c in enumerate(rig)]
        squares = [(camera.project(x) - at).ravel() / 0.3 for camera, (x, at) in zip(cameras, objects)]
        boards = [(p - start)[14 * i : 14 * i + 8] / prior for i in range(2)]
        one, two = (camera.ray(ties[:, i]) for i, camera in enumerate(cameras))
        across = np.cross(one, two)
        baseline = cameras[1].centre_world - cameras[0].centre_world
        distance = np.linalg.norm(baseline + cameras[0].centre_world)  # of the cylinder, which stands at the origin
        gap = (across @ baseline) / np.linalg.norm(across, axis=1) * rig.cameras[0].matrix[0, 0] / distance
        return np.concatenate([*squares, *boards, gap / 0.1])

    found = start + scale * least_squares(residuals, np.zeros(28)).x
    return Rig(tuple(_camera(c.name, found[14 * i : 14 * i + 14]) for i, c in enumerate(rig)))


def centres(image: NDArray, near: NDArray) -> NDArray:
    """Centres (N, 2) [px] of dark squares near places, weighted by how dark."""
    out, room = [], 30
    y, x = np.mgrid[: 2 * room + 1, : 2 * room + 1]
    for u, v in np.rint(near).astype(int):
        block = image[v - room : v + room + 1, u - room : u + room + 1].astype(float)
        low, high = np.percentile(block, (3, 90))
        _, labels, _, middles = cv2.connectedComponentsWithStats((block < (low + high) / 2).astype(np.uint8))
        label = 1 + np.argmin(np.linalg.norm(middles[1:] - room, axis=1))
        area = cv2.dilate((labels == label).astype(np.uint8), np.ones((5, 5))) > 0
        weight = np.clip((high - block) / (high - low), 0, 1) * area
        out.append([(weight * x).sum() / weight.sum() + u - room, (weight * y).sum() / weight.sum() + v - room])
    return np.array(out)


def cylinder(x: NDArray) -> tuple[float, NDArray]:
    """Radius [m] of the cylinder about points (N, 3), its axis near z, and the residuals (N,) of all of them.

    Points further than five robust deviations off take no part in the fit.
    """
    p, middle, good = np.array([0.0, 0, 0, 0, 0.057]), x[:, 2].mean(), np.ones(len(x), bool)
    for step in range(30):
        axis = np.array([p[0], p[1], 1.0])
        axis /= np.linalg.norm(axis)
        gap = x - (p[2], p[3], middle)
        along = gap @ axis
        across = gap - np.outer(along, axis)
        distance = np.linalg.norm(across, axis=1)
        residual, e = distance - p[4], across / distance[:, None]
        if step > 3:
            good = np.abs(residual) < 5 * 1.4826 * np.median(np.abs(residual))
        J = np.column_stack([-e[:, 0] * along, -e[:, 1] * along, -e[:, 0], -e[:, 1], -np.ones(len(x))])
        p = p - np.linalg.lstsq(J[good], residual[good], rcond=None)[0]
    return float(p[4]), residual
