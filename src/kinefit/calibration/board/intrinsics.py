"""Focal length, centre and distortion of one camera from views of a board (Z. Zhang, PAMI 2000; by OpenCV)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.calibration.board.detection import Board, BoardView, CameraViews
from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera

FEWEST_VIEWS = 4  # three determine focal length and centre; one more to have something to check
_MOST_VIEWS = 60  # more add time, hardly accuracy
_MANY_VIEWS = 20  # from which the third radial coefficient is tried
_REACH = 0.7  # of the way to the picture's corner that board corners reach, below which k3 would bend free space
_UNSURE = 0.03  # of the focal length, one standard deviation: no calibration but a guess
_FRONTAL = np.radians(10.0)  # turned by less than this, distance and focal length are one
_CELLS = 8  # cells along each side of the picture, for the share of it that was covered
_OUTLIER = 3.0  # times the median view's error


@dataclass(frozen=True, eq=False)
class Interiors:
    """Interior of a camera and how well its views tell it.

    Parameters
    ----------
    camera : Camera, at the origin.
    rms_px : float, of the views used.
    focal_std : float [px] standard deviation of the focal length, as OpenCV estimates it.
    coverage : float, share of an 8 x 8 grid over the picture in which a corner was seen.
    tilt : float [rad] angle between the two views that are turned most against each other.
    frames : tuple of int, of the views used.
    """

    camera: Camera
    rms_px: float
    focal_std: float
    coverage: float
    tilt: float
    frames: tuple[int, ...]


def calibrate_interiors(name: str, seen: CameraViews, board: Board) -> Interiors:
    """Calibrate one camera; views that fit badly are dropped, k3 and the centre stay fixed unless the views tell them.

    Raises
    ------
    CalibrationError
        Too few views; or none turned enough, so that the focal length is not determined.
    """
    place = f"camera {name}"
    views = _spread([view for view in seen.views if len(view.ids) >= 8 or len(board.corners) < 8], seen.size)
    if len(views) < FEWEST_VIEWS:
        raise CalibrationError(
            f"the board is seen in {len(views)} images that show enough of it",
            place=place,
            remedy=f"Record {FEWEST_VIEWS} or better 20 views, turned by 20 to 45 degrees, over the whole image.",
        )
    flags = _flags(views, seen.size)
    while True:
        rms, K, k, rotations, stds, errors = _calibrate(views, seen.size, board, flags)
        keep = errors <= max(_OUTLIER * float(np.median(errors)), 0.3)
        if keep.all() or keep.sum() < max(FEWEST_VIEWS, len(views) // 2):
            break
        views = [view for view, good in zip(views, keep) if good]
    std, tilt = float(stds[0]), _tilt(rotations)
    if tilt < _FRONTAL or not std < _UNSURE * K[0, 0]:
        told = f"{100 * std / K[0, 0]:.0f} %" if np.isfinite(std) else "any amount"
        raise CalibrationError(
            f"the focal length is not determined: {K[0, 0]:.0f} px may be off by {told}; the board turned by "
            f"{np.degrees(tilt):.0f} degrees in {len(views)} views",
            place=place,
            remedy="Record views in which the board is turned by 20 to 45 degrees, to all sides, near and far.",
        )
    used = 5 if not flags & cv2.CALIB_FIX_K3 else 4
    camera = Camera(name, seen.size, K, k[:used], "radtan")
    return Interiors(camera, rms, std, coverage(seen), tilt, tuple(view.frame for view in views))


def coverage(seen: CameraViews) -> float:
    """Share of an 8 x 8 grid over the picture in which a corner was seen."""
    if not seen.views:
        return 0.0
    uv = np.concatenate([view.uv for view in seen.views])
    cells = np.clip((uv + 0.5) / seen.size * _CELLS, 0, _CELLS - 1).astype(int)
    return len(np.unique(cells, axis=0)) / _CELLS**2


def _flags(views: list[BoardView], size: tuple[int, int]) -> int:
    uv, half = np.concatenate([view.uv for view in views]), np.array(size) / 2
    reach = np.quantile(np.linalg.norm(uv - half, axis=1), 0.98) / np.linalg.norm(half)
    return 0 if len(views) >= _MANY_VIEWS and reach > _REACH else cv2.CALIB_FIX_K3


def _calibrate(views: list[BoardView], size: tuple[int, int], board: Board, flags: int) -> tuple:
    """OpenCV's calibration; with the centre fixed to the picture's where it would wander without sense."""
    x = [board.corners[view.ids].astype(np.float32) for view in views]
    uv = [view.uv.reshape(-1, 1, 2).astype(np.float32) for view in views]
    for extra in (0, cv2.CALIB_FIX_PRINCIPAL_POINT):
        try:
            rms, K, k, r, _, stds, _, errors = cv2.calibrateCameraExtended(
                x, uv, size, np.eye(3), np.zeros(5), flags=flags | extra
            )
        except cv2.error:
            rms, K, k, r, stds, errors = np.inf, np.diag([1.0, 1, 1]), np.zeros(5), [np.zeros(3)], [np.inf] * 4, [0.0]
        off = np.abs(K[:2, 2] - (np.array(size) - 1) / 2) / np.array(size)
        if off.max() < 0.15 and np.ravel(stds)[2:4].max() < 0.02 * max(size):
            break
    return float(rms), K, np.ravel(k), [cv2.Rodrigues(v)[0] for v in r], np.ravel(stds), np.ravel(errors)


def _tilt(rotations: list[NDArray]) -> float:
    """Largest angle between the normals of two views."""
    normals = np.array([R[:, 2] for R in rotations])
    return float(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))


def _spread(views: list[BoardView], size: tuple[int, int]) -> list[BoardView]:
    """Views that differ most in place, size and shape of the board: farthest first (T. Gonzalez, 1985)."""
    if len(views) <= _MOST_VIEWS:
        return views
    features = np.array([_shape(view, size) for view in views])
    chosen = [int(np.argmax(np.linalg.norm(features - features.mean(axis=0), axis=1)))]
    distance = np.full(len(views), np.inf)
    while len(chosen) < _MOST_VIEWS:
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return [views[i] for i in sorted(chosen)]


def _shape(view: BoardView, size: tuple[int, int]) -> NDArray:
    centre, spread = view.uv.mean(axis=0) / size, np.cov(view.uv.T)
    root = np.sqrt(np.linalg.det(spread) + 1e-9)
    return np.array([*centre, np.log(root) / 4, spread[0, 0] / root / 4, spread[0, 1] / root / 2])
