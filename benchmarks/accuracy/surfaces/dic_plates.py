"""A rigid plate and a plate with a hole, drawn by pyvale's renderer from its own simulations, beside pyvale.

Grey values have no noise but rounding to 8 bits, so what scatters is the interpolation of the texture. Cameras are
those that drew the pictures. Both programs match the same grid of step 10 px from one seed and are compared where both
found a point, 60 px from the edges and a window from the hole; the truth is the simulation's, between its nodes by
triangles. Error: RMS of all components; noise: standard deviation of each component over the plate less the truth. Time
is the processor's, one thread, from pixels to points, least of three. Both smooth the pictures by 1 px first, pyvale's
default: the texture is sharper than the pixels. No setting is chosen here.
"""

from __future__ import annotations

import json
import tempfile
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator

from benchmarks.figures import LEFT_OUT, NotMeasured, amount, each, figure, peers, quick
from benchmarks.peers.environments import run_peer
from benchmarks.timing import fastest
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.photogrammetry.least_squares_matching import Grid, Seeds, grow
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface import measure_states

CASES = {"rigid_1px": 5, "platehole": 10}  # frame: half a pixel along both axes; one pixel at the loaded edge
WINDOWS, STEP, MARGIN, SEED, SMOOTH = (21, 31), 10, 60, [200, 200], 1.0
SIZE, FOCAL, DISTANCE, ANGLE = (1040, 1540), 50.0 / 3.45e-3, 1.449275362, np.radians(20.0)  # px, px, m


def run() -> None:
    """Print every figure."""
    wanted = {
        "cases": CASES, "windows": WINDOWS, "step": STEP, "margin": MARGIN, "seed": SEED, "repeats": amount(3, 1),
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        where = Path(name)
        (where / "plates.json").write_text(json.dumps(wanted))
        told = run_peer("pyvale_plates", where) if peers() else {"reason": LEFT_OUT if quick() else "--no-peers"}
        for case in CASES:
            for window in WINDOWS:
                for kind in ("mono", "stereo"):
                    each(partial(_compare, where / case, case, window, kind, told))


def _compare(place: Path, case: str, window: int, kind: str, told: dict) -> None:
    """Figures of one window, of one camera or two."""
    label, key = f"{case}_{kind}_{window}", f"{case} {kind} {window}"
    if key not in told:
        raise NotMeasured(str(told.get("reason", "not run")))
    images = [[cv2.imread(str(next(place.glob(f"*_cam{c}_frame0{k}.tiff"))), 0) for c in (0, 1)] for k in (0, 1)]
    measure = _mono if kind == "mono" else _stereo
    measure(images, window)  # compiles
    (points, shift), spent = fastest(partial(measure, images, window), amount(3, 1))
    with np.load(place / f"{kind}_{window}.npz") as file:
        theirs = _table(file["points"], file["shift"])
    ours = _table(points, shift)
    with np.load(place / "truth.npz") as file:
        nodes, moved = file["nodes"], file["moved"]
    both = np.array(sorted(set(ours) & set(theirs)))
    truth = LinearNDInterpolator(nodes, moved / 0.1 if kind == "mono" else moved)(both)[:, : 2 if kind == "mono" else 3]
    away = np.linalg.norm(both - nodes.mean(axis=0), axis=1) - np.linalg.norm(nodes - nodes.mean(axis=0), axis=1).min()
    whole = np.isfinite(truth).all(axis=1) & ((away > window) if case == "platehole" else True)
    both, truth = both[whole], truth[whole]
    off = [np.array([table[tuple(at)] for at in both]) - truth for table in (ours, theirs)]
    unit = "px" if kind == "mono" else "mm"
    error = [float(np.sqrt(np.mean(d**2))) for d in off]
    noise = [float(np.sqrt(np.mean(d.var(axis=0)))) for d in off]
    rate, theirs_rate = len(ours) / spent, told[key]["points"] / told[key]["seconds"]
    print(f"# {label}, kinefit / pyvale: {len(both)} points of {len(ours)} / {len(theirs)}; "
          f"{rate:.0f} / {theirs_rate:.0f} points/s; "
          f"error {error[0]:.6f} / {error[1]:.6f}, noise {noise[0]:.6f} / {noise[1]:.6f} {unit}")  # fmt: skip
    figure(f"plate_{label}_error_against_pyvale", error[0] / error[1], "x", "<= 1.02")
    figure(f"plate_{label}_noise_against_pyvale", noise[0] / noise[1], "x", "<= 1.02")
    figure(f"plate_{label}_times_faster_than_pyvale", rate / theirs_rate, "x", ">= 5")


def _grid(window: int) -> Grid:
    return Grid.of(SIZE, STEP, margin=MARGIN + window // 2)


def _mono(images: list, window: int) -> tuple[NDArray, NDArray]:
    """Points (N, 2) and how they move (N, 2) [px] in the first camera."""
    first, second = (SplineImage.of(pair[0], smooth=SMOOTH) for pair in images)
    grid = _grid(window)
    return grid.points, grow(first, second, grid, Seeds.of([SEED], [SEED]), window=window).uv - grid.points


def _stereo(images: list, window: int) -> tuple[NDArray, NDArray]:
    """Points (N, 2) [px] and how they move (N, 3) [mm] along the first camera's axes."""
    grid = _grid(window)
    states = [[SplineImage.of(image, smooth=SMOOTH) for image in pair] for pair in images]
    before, after = measure_states(rig(), states, grid, window=window)
    return grid.points, 1e3 * (after.x_world - before.x_world)


def rig() -> Rig:
    """The two cameras that drew the pictures; the world is the first one's."""
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    R = se3.exp_so3(np.array([0.0, ANGLE, 0.0]))
    middle = np.array([0.0, 0.0, DISTANCE])
    second = se3.transform(R, middle - R @ middle)
    return Rig((Camera("0", SIZE, K, T_camera_world=np.eye(4)), Camera("1", SIZE, K, T_camera_world=second)))


def _table(points: NDArray, shift: NDArray) -> dict[tuple[int, int], NDArray]:
    good = np.isfinite(shift).all(axis=1)
    return {(round(u), round(v)): s for (u, v), s in zip(points[good], shift[good])}
