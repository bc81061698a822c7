"""Calibrate the intrinsics of one camera from views of a board (Z. Zhang, PAMI 2000; by OpenCV)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError, choices
from kinefit.geometry.camera import Camera, Rig
from kinefit.rigs.board.detection import Board, BoardView, CameraViews

MIN_VIEWS = 4  # three determine focal length and centre; one more allows a check
_MAX_VIEWS = 60  # more add time, hardly accuracy
_MIN_K3_VIEWS = 20  # to estimate the third radial coefficient
_MIN_K3_REACH = 0.7  # of the way to the image's corner, covered by board corners: with less k3 is extrapolated
_MAX_FOCAL_STD = 0.03  # of the focal length: with more it is a guess
_MIN_TILT = np.radians(10.0)  # between two views: with less, distance and focal length are not separable
_COVERAGE_CELLS = 8  # along each side of the image
_MAX_ERROR_RATIO = 3.0  # of a view's error to the median view's


@dataclass(frozen=True, eq=False)
class Interiors:
    """Intrinsics of a camera, with their uncertainty.

    Parameters
    ----------
    camera : Camera, at the origin.
    rms_px : float, of the views used.
    focal_std : float [px] standard deviation of the focal length, as OpenCV estimates it.
    coverage : float, share 0..1 of an 8 x 8 grid over the image with a corner.
    tilt : float [rad] largest angle between two views of the board.
    frames : tuple of int, of the views used.
    """

    camera: Camera
    rms_px: float
    focal_std: float
    coverage: float
    tilt: float
    frames: tuple[int, ...]


def calibrate_interiors(name: str, seen: CameraViews, board: Board) -> Interiors:
    """Calibrate one camera; outlier views are discarded, k3 and the centre stay fixed unless the views determine them.

    Raises
    ------
    CalibrationError
        Too few views, or too little tilt to determine the focal length.
    """
    place = f"camera {name}"
    views = _spread([view for view in seen.views if len(view.ids) >= 8 or len(board.corners) < 8], seen.size)
    if len(views) < MIN_VIEWS:
        raise CalibrationError(
            f"only {len(views)} images show enough of the board",
            place=place,
            remedy=f"Record {MIN_VIEWS} or better 20 views, turned by 20 to 45 degrees, over the whole image.",
        )
    flags = _flags(views, seen.size)
    while True:
        rms, K, k, rotations, stds, errors = _calibrate(views, seen.size, board, flags)
        keep = errors <= max(_MAX_ERROR_RATIO * float(np.median(errors)), 0.3)
        if keep.all() or keep.sum() < max(MIN_VIEWS, len(views) // 2):
            break
        views = [view for view, good in zip(views, keep) if good]
    std, tilt = float(stds[0]), _tilt(rotations)
    if tilt < _MIN_TILT or not std < _MAX_FOCAL_STD * K[0, 0]:
        error = f"{100 * std / K[0, 0]:.0f} %" if np.isfinite(std) else "any amount"
        raise CalibrationError(
            f"the focal length is not determined: {K[0, 0]:.0f} px may be off by {error}; the board turned by "
            f"{np.degrees(tilt):.0f} degrees in {len(views)} views",
            place=place,
            remedy="Record views in which the board is turned by 20 to 45 degrees, to all sides, near and far.",
        )
    used = 5 if not flags & cv2.CALIB_FIX_K3 else 4
    camera = Camera(name, seen.size, K, k[:used], "radtan")
    return Interiors(camera, rms, std, coverage(seen.uv, seen.size), tilt, tuple(view.frame for view in views))


def coverage(uv: NDArray, size: tuple[int, int]) -> float:
    """Share 0..1 of the cells of a grid (8, 8) over an image with a pixel of uv (N, 2)."""
    cells = np.clip((uv + 0.5) / size * _COVERAGE_CELLS, 0, _COVERAGE_CELLS - 1).astype(int)
    return len(np.unique(cells, axis=0)) / _COVERAGE_CELLS**2


def _flags(views: list[BoardView], size: tuple[int, int]) -> int:
    uv, half = np.concatenate([view.uv for view in views]), np.array(size) / 2
    reach = np.quantile(np.linalg.norm(uv - half, axis=1), 0.98) / np.linalg.norm(half)
    return 0 if len(views) >= _MIN_K3_VIEWS and reach > _MIN_K3_REACH else cv2.CALIB_FIX_K3


def _calibrate(views: list[BoardView], size: tuple[int, int], board: Board, flags: int) -> tuple:
    """OpenCV's calibration; with the principal point fixed at the image's centre if it is not determined."""
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
    """Largest angle [rad] between the board's normals of two views."""
    normals = np.array([R[:, 2] for R in rotations])
    return float(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))


def _spread(views: list[BoardView], size: tuple[int, int]) -> list[BoardView]:
    """Views that differ most in position, size and shape of the board: farthest-point sampling (T. Gonzalez, 1985)."""
    if len(views) <= _MAX_VIEWS:
        return views
    features = np.array([_shape(view, size) for view in views])
    chosen = [int(np.argmax(np.linalg.norm(features - features.mean(axis=0), axis=1)))]
    distance = np.full(len(views), np.inf)
    while len(chosen) < _MAX_VIEWS:
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return [views[i] for i in sorted(chosen)]


def _shape(view: BoardView, size: tuple[int, int]) -> NDArray:
    centre, spread = view.uv.mean(axis=0) / size, np.cov(view.uv.T)
    root = np.sqrt(np.linalg.det(spread) + 1e-9)
    return np.array([*centre, np.log(root) / 4, spread[0, 0] / root / 4, spread[0, 1] / root / 2])


def known_camera(interiors: Rig, name: str, size: tuple[int, int]) -> Camera:
    """The camera of known intrinsics, at the world's origin.

    Parameters
    ----------
    size : (width, height) [px] of its new images

    Raises
    ------
    CalibrationError
        No camera of this name, or one with another image size.
    """
    if name not in interiors:
        problem = choices("intrinsics of camera", name, interiors.names)
        raise CalibrationError(problem, remedy="Name the videos like the cameras.")
    camera = interiors[name].with_pose(np.eye(4))
    if camera.size != size:
        raise CalibrationError(
            f"its image has {size[0]}x{size[1]} px, its intrinsics are of {camera.size[0]}x{camera.size[1]}",
            place=f"camera {name}", remedy="Calibrate the intrinsics again, or record at the calibrated size.",
        )  # fmt: skip
    return camera
