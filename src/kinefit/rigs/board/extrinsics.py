"""Relative poses of cameras, from frames in which two of them see one board.

Calibrate the intrinsics of one camera from views of a board (Z. Zhang, PAMI 2000; by OpenCV).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations, product

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError, choices
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import aligned, inverse, transform
from kinefit.rigs.board.bundle import Corners
from kinefit.rigs.board.detection import Board, BoardView, CameraViews

_MAX_AMBIGUITY_RATIO = 3.0  # of the errors of a flat board's two poses; with more the second is discarded
_MAX_PROPOSALS = 25  # frames that propose a relative pose; all shared frames vote
_MAX_ERROR = 0.01  # of the image diagonal, between a camera's view and the board's pose from another view
_MIN_VOTES = 3  # fewer frames may agree by chance


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of the board from one view: candidates (K, 4, 4) T_camera_board, best first, and rays (n, 2)."""

    view: BoardView
    Ts_camera_board: NDArray
    xy: NDArray  # (n, 2) normalised image coordinates


@dataclass(frozen=True, eq=False)
class Placed:
    """Rig in the frame of its first camera, poses of the board in it, the corners, and the votes of each pair."""

    rig: Rig
    Ts_world_board: NDArray
    frames: tuple[int, ...]
    corners: Corners
    agreeing: dict[tuple[str, str], int]


def place_cameras(cameras: Mapping[str, Camera], seen: Mapping[str, CameraViews], board: Board) -> Placed:
    """Chain the cameras by the pairs with most votes, and estimate the board's pose in every frame.

    Raises
    ------
    CalibrationError
        Cameras that share no view, or whose shared views contradict each other.
    """
    poses = {
        name: {frame: _poses(cameras[name], view, board) for frame, view in views.frames.items()}
        for name, views in seen.items()
    }
    links: dict[tuple[str, str], NDArray] = {}
    votes: dict[tuple[str, str], int] = {}
    shared: dict[tuple[str, str], int] = {}
    for a, b in combinations(cameras, 2):
        common = sorted(poses[a].keys() & poses[b].keys())
        shared[a, b] = len(common)
        if common:
            T_b_a, agree = _vote(cameras[b], [(poses[a][f], poses[b][f]) for f in common], board)
            # One shared frame gives a pose without any check of it.
            if agree >= min(_MIN_VOTES, len(common)) and agree >= 0.3 * len(common):
                links[a, b], votes[a, b] = T_b_a, agree
    Ts_camera_world = _chain(list(cameras), links, votes, shared)
    rig = Rig(tuple(camera.with_pose(Ts_camera_world[name]) for name, camera in cameras.items()))
    return _place_boards(rig, poses, board, votes)


def _poses(camera: Camera, view: BoardView, board: Board) -> Poses:
    """Both poses of a flat board that one view allows (T. Collins and A. Bartoli, IJCV 2014)."""
    rays = camera.with_pose(np.eye(4)).ray(view.uv)
    ok = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.05)
    view = BoardView(view.frame, view.ids[ok], view.uv[ok], view.mirrored)
    xy = rays[ok, :2] / rays[ok, 2:]
    candidates: list[tuple[float, NDArray]] = []
    if len(xy) >= 4:
        x = board.corners[view.ids]
        try:
            found = cv2.solvePnPGeneric(x, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        except cv2.error:  # the remaining corners lie on one line
            found = (0, (), (), ())
        for r, t, error in zip(found[1], found[2], np.ravel(found[3])):
            T = transform(cv2.Rodrigues(r)[0], np.ravel(t))
            if np.isfinite(T).all() and (T[:3] @ np.c_[x, np.ones(len(x))].T)[2].min() > 0:
                candidates.append((float(error), T))
    candidates.sort(key=lambda pair: pair[0])
    floor = 0.3 / camera.matrix[0, 0]  # both fit within the noise of a corner
    kept = [T for error, T in candidates if error <= _MAX_AMBIGUITY_RATIO * max(candidates[0][0], floor)]
    return Poses(view, np.array(kept).reshape(-1, 4, 4), xy)


def _view_error(T_camera_board: NDArray, poses: Poses, board: Board) -> float:
    """Median distance of a view's corners from their projections at a pose of the board, in normalised coordinates."""
    return min(_symmetry_errors(T_camera_board, poses, board))


def _symmetry_errors(T_camera_board: NDArray, poses: Poses, board: Board) -> Iterator[float]:
    """The same of each symmetry of the board; infinite with corners behind the camera."""
    for order in board.symmetries:
        x = board.corners[order[poses.view.ids]] @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
        error = np.median(np.linalg.norm(x[:, :2] / x[:, 2:] - poses.xy, axis=1))
        yield float(error) if x[:, 2].min() > 0 else np.inf


def _vote(camera: Camera, pairs: list[tuple[Poses, Poses]], board: Board) -> tuple[NDArray, int]:
    """T_b_a with the lowest robust cost over shared frames (MLESAC), and the number of frames that agree."""
    limit = _MAX_ERROR * float(np.hypot(*camera.size)) / camera.matrix[0, 0]
    chosen = [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MAX_PROPOSALS)).astype(int))]
    best, best_T, best_agree = np.inf, np.eye(4), 0
    turns = [aligned(board.corners, board.corners[order]) for order in board.symmetries]  # T_board_board
    for a, b in chosen:
        for T_a, T_b, turn in product(a.Ts_camera_board, b.Ts_camera_board, turns):
            T_b_a = T_b @ turn @ inverse(T_a)
            cost, agree = 0.0, 0
            for in_a, in_b in pairs:
                error = min([_view_error(T_b_a @ T, in_b, board) for T in in_a.Ts_camera_board] or [np.inf])
                cost, agree = cost + min(error, limit), agree + (error < limit)
                if cost >= best:
                    break
            else:
                best, best_T, best_agree = cost, T_b_a, agree
    return best_T, best_agree


def _chain(
    names: list[str],
    links: Mapping[tuple[str, str], NDArray],
    votes: Mapping[tuple[str, str], int],
    shared: Mapping[tuple[str, str], int],
) -> dict[str, NDArray]:
    """T_camera_world of every camera, in the frame of the first: the spanning tree of most votes (Prim)."""
    placed = {names[0]: np.eye(4)}
    while len(placed) < len(names):
        across = [(n, pair) for pair, n in votes.items() if (pair[0] in placed) != (pair[1] in placed)]
        if not across:
            _raise_unconnected(names, set(placed), shared)
        _, (a, b) = max(across)
        if a in placed:
            placed[b] = links[a, b] @ placed[a]
        else:
            placed[a] = inverse(links[a, b]) @ placed[b]
    return placed


def _raise_unconnected(names: list[str], placed: set[str], shared: Mapping[tuple[str, str], int]) -> None:
    rest = [name for name in names if name not in placed]
    group = ", ".join(name for name in names if name in placed)
    common = {pair: n for pair, n in shared.items() if (pair[0] in placed) != (pair[1] in placed) and n}
    if common:
        (a, b), n = max(common.items(), key=lambda item: item[1])
        raise CalibrationError(
            f"{a} and {b} see the board in {n} common frames, but these contradict each other about the poses",
            place=f"cameras {group} against {', '.join(rest)}",
            remedy="Give synchronised videos that are not mirrored.",
        )
    raise CalibrationError(
        f"no frame in which one of {group} and one of {', '.join(rest)} see the board",
        place=f"cameras {', '.join(rest)}",
        remedy="Record the board where two of them see it at the same time; 10 frames or more, in different places.",
    )


def _place_boards(
    rig: Rig, poses: Mapping[str, Mapping[int, Poses]], board: Board, votes: dict[tuple[str, str], int]
) -> Placed:
    """The pose of the board with the lowest cost in every frame, with all views' corners in a common order."""
    frames = sorted({frame for of_camera in poses.values() for frame in of_camera})
    Ts: list[NDArray] = []
    kept, columns = [], []
    for frame in frames:
        here = [(c, poses[camera.name][frame]) for c, camera in enumerate(rig) if frame in poses[camera.name]]
        limits = [_MAX_ERROR * float(np.hypot(*camera.size)) / camera.matrix[0, 0] for camera in rig]
        best, best_T = np.inf, None
        for c, of_view in here:
            for T_camera_board in of_view.Ts_camera_board:
                T = rig.cameras[c].T_world_camera @ T_camera_board
                cost = sum(min(_view_error(rig.cameras[d].T_camera_world @ T, p, board), limits[d]) for d, p in here)
                if cost < best:
                    best, best_T = cost, T
        if best_T is None:
            continue
        for c, of_view in here:
            T = rig.cameras[c].T_camera_world @ best_T
            if _view_error(T, of_view, board) < limits[c]:
                columns.append((c, len(Ts), *_named(T, of_view, board)))
        Ts.append(best_T)
        kept.append(frame)
    if len({c for c, *_ in columns}) < len(rig):
        without = [camera.name for c, camera in enumerate(rig) if c not in {c for c, *_ in columns}]
        raise CalibrationError(
            "no view of the board fits its intrinsics",
            place=f"camera {', '.join(without)}",
            remedy="Check the given intrinsics and the board's size, or calibrate the intrinsics too.",
        )
    camera = np.concatenate([np.full(len(uv), c) for c, _, _, uv in columns])
    index = np.concatenate([np.full(len(uv), f) for _, f, _, uv in columns])
    corners = Corners(
        camera, index, np.concatenate([x for *_, x, _ in columns]), np.concatenate([uv for *_, uv in columns])
    )
    return Placed(rig, np.array(Ts), tuple(kept), corners, votes)


def _named(T_camera_board: NDArray, poses: Poses, board: Board) -> tuple[NDArray, NDArray]:
    """Corners of a view in the board's frame, in the order of the pose, and their pixels."""
    nearest = int(np.argmin([*_symmetry_errors(T_camera_board, poses, board)]))
    return board.corners[board.symmetries[nearest][poses.view.ids]], poses.view.uv


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
