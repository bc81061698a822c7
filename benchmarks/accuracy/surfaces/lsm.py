"""Least-squares matching of drawn texture, whose motion is exact, beside OpenCV in one run.

Texture is a sum of cosines with a Gaussian spectrum, drawn analytically in both images: tiles of 40 px, each moved by
its own random shift (within half a pixel) and affine map (up to 5 %), with 2 % noise and whole grey values. All three
are given the tile's centre and no deformation. OpenCV's PyrLK has a window of 13 px, no pyramid; ECC an affine map over
13x13 px, no Gauss filter, each until nothing moves by 0.001. Grain (standard deviation of the drawn blobs) 1.2 px,
seeds not used in development; the bias curve has no noise, one shift for all, and whole grey values not rounded.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.timing import fastest
from kinefit.images.photogrammetry.least_squares_matching import Matches, match
from kinefit.images.photogrammetry.spline_image import SplineImage

TILE, GRAIN, CONTRAST, NOISE, SEED = 40, 1.2, 40.0, 0.02 * 255, 20261


class Texture:
    """A smooth random function of the plane."""

    def __init__(self, seed: int, grain: float = GRAIN, waves: int = 300) -> None:
        rng = np.random.default_rng(seed)
        self.frequency = rng.normal(size=(waves, 2)) / (grain * np.sqrt(2))
        self.phase = rng.uniform(0, 2 * np.pi, waves)
        self.scale = CONTRAST * np.sqrt(2 / waves)

    def __call__(self, x: NDArray) -> NDArray:
        """Grey values (N,) at places (N, 2)."""
        return 128 + self.scale * np.cos(x @ self.frequency.T + self.phase).sum(axis=1)


def drawn(
    tiles: int, seed: int, *, shift: float | None = None, stretch: float = 0.05, noise: float = NOISE,
    grain: float = GRAIN,
) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:  # fmt: skip
    """Two images of tiles x tiles; the tiles' centres (N, 2), where they went (N, 2), and their maps (N, 2, 2)."""
    rng = np.random.default_rng(seed)
    texture, size = Texture(seed + 1, grain), tiles * TILE
    first, second = np.empty((size, size)), np.empty((size, size))
    v, u = np.mgrid[:TILE, :TILE]
    inner = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    centres, goals, maps = [], [], []
    for row in range(tiles):
        for column in range(tiles):
            corner = np.array([column, row], float) * TILE
            centre = corner + TILE // 2
            move = rng.uniform(-0.5, 0.5, 2) if shift is None else np.full(2, shift)
            A = np.eye(2) + rng.uniform(-stretch, stretch, (2, 2))
            block = slice(row * TILE, (row + 1) * TILE), slice(column * TILE, (column + 1) * TILE)
            far = centre * 7.0  # tiles show unlike parts of the texture
            first[block] = texture(inner + corner - centre + far).reshape(TILE, TILE)
            back = (inner + corner - centre - move) @ np.linalg.inv(A).T
            second[block] = texture(back + far).reshape(TILE, TILE)
            centres.append(centre)
            goals.append(centre + move)
            maps.append(A)
    pair = [image + noise * rng.normal(size=image.shape) for image in (first, second)]
    if noise:
        pair = [np.clip(np.rint(image), 0, 255) for image in pair]
    return pair[0], pair[1], np.array(centres), np.array(goals), np.array(maps)


def run() -> None:
    """Print every figure."""
    _precision()
    _bias()


def _precision() -> None:
    first, second, at, goal, _ = drawn(amount(30, 6), SEED)
    bytes1, bytes2 = first.astype(np.uint8), second.astype(np.uint8)

    def ours() -> Matches:
        return match(SplineImage.of(first), SplineImage.of(second), at)

    ours()
    times = amount(3, 1)
    matches, spent = fastest(ours, times)
    error = (matches.uv - goal)[matches.found]
    rms = float(np.sqrt(np.mean(error**2)))
    inside = 100 * float(np.mean(np.abs(error) <= 1.96 * matches.std[matches.found]))
    lk = _lucas_kanade(bytes1, bytes2, at)
    ecc, ecc_spent = fastest(lambda: _ecc(first, second, at), times)
    lk_rms, ecc_rms = _rms(lk - goal), _rms(ecc - goal)
    count = len(at)
    print(f"# {count} tiles; RMS [px]: kinefit {rms:.4f}, PyrLK {lk_rms:.4f}, ECC {ecc_rms:.4f}")
    figure("lsm_precision", rms, "px", "<= 0.03")
    figure("lsm_found", 100 * matches.found.mean(), "%", ">= 99")
    figure("lsm_against_pyrlk", rms / lk_rms, "x its error", "<= 1")
    figure("lsm_against_ecc", rms / ecc_rms, "x its error", "<= 1.02")
    figure("lsm_times_faster_than_ecc", ecc_spent / spent, "x", ">= 1")
    figure("lsm_points_a_second", count / spent, "points/s", ">= 10000")
    figure("lsm_intervals_low", inside, "% in 95 % intervals", ">= 93")
    figure("lsm_intervals_high", inside, "% in 95 % intervals", "<= 97")


def _bias() -> None:
    """Mean error over the sub-pixel shift."""
    told, shifts = [], (0.0, 0.125, 0.25, 0.375, 0.5)
    for shift in shifts:
        first, second, at, goal, _ = drawn(amount(12, 2), 77, shift=shift, stretch=0.0, noise=0.0, grain=1.0)
        found = match(SplineImage.of(first), SplineImage.of(second), at)
        told.append(float(np.nanmean(found.uv - goal)))
    print("# bias, grain 1 px: " + ", ".join(f"{s:g} px {b:+.5f}" for s, b in zip(shifts, told)))
    figure("lsm_bias_grain_1", np.abs(told).max(), "px", "<= 0.002")


def _rms(error: NDArray) -> float:
    """Of those within a pixel."""
    good = np.abs(np.nan_to_num(error, nan=9.0)).max(axis=1) < 1.0
    return float(np.sqrt(np.mean(error[good] ** 2)))


def _lucas_kanade(first: NDArray, second: NDArray, at: NDArray) -> NDArray:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 0.001)
    start = at.astype(np.float32).reshape(-1, 1, 2)
    told = cv2.calcOpticalFlowPyrLK(first, second, start, None, winSize=(13, 13), maxLevel=0, criteria=criteria)
    uv, status = told[:2]
    return np.where(status == 1, uv[:, 0], np.nan)


def _ecc(first: NDArray, second: NDArray, at: NDArray) -> NDArray:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-6)
    one, two, out = first.astype(np.float32), second.astype(np.float32), np.full(at.shape, np.nan)
    half, room = 6, TILE // 2
    for k, (u, v) in enumerate(at.astype(int)):
        template = one[v - half : v + half + 1, u - half : u + half + 1]
        around = two[v - room : v + room, u - room : u + room]
        warp = np.float32([[1, 0, room - half], [0, 1, room - half]])
        try:
            _, warp = cv2.findTransformECC(template, around, warp, cv2.MOTION_AFFINE, criteria, None, 1)
        except cv2.error:
            continue
        out[k] = warp[:, :2] @ (half, half) + warp[:, 2] + (u - room, v - room)
    return out
