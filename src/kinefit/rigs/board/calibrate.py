"""Calibrate cameras with a board: intrinsics from its views, extrinsics from frames that two cameras share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import inverse
from kinefit.rigs.board.bundle import BoardBundle, adjust_boards
from kinefit.rigs.board.detection import Board, CameraViews
from kinefit.rigs.board.extrinsics import Interiors, Placed, calibrate_interiors, coverage, known_camera, place_cameras

_ADVISED_VIEWS = 15  # of one camera; with fewer the distortion is poorly determined
_ADVISED_SHARED = 8  # frames of a pair
_ADVISED_COVERAGE = 0.5  # of the image
_MAX_FOCAL_STD = 0.005  # of the focal length, without advice


@dataclass(frozen=True, eq=False)
class BoardCameraReport:
    """Quality of one camera's calibration.

    Parameters
    ----------
    rms_px : float [px]
        Distance of the corners from their projections, with the board at its pose in the frame.
    own_rms_px : float [px]
        The same with the board at its pose in this view: the error of lens and detector.
    views, used : int
        Images with the board, and those of them used for the intrinsics.
    coverage : float
        Share 0..1 of the image (cells of an 8 x 8 grid) with corners.
    focal_std_px, position_std : float [px], [m]
        Standard deviations; 0 if given or defining the world, infinite if unobserved.
    """

    rms_px: float
    own_rms_px: float
    views: int
    used: int
    coverage: float
    focal_std_px: float
    position_std: float


@dataclass(frozen=True, eq=False)
class BoardCalibration:
    """Result of a calibration with a board.

    Parameters
    ----------
    rig : Rig
    board : Board
    cameras : {camera: BoardCameraReport}
    rms_px, own_rms_px : float [px], as in `BoardCameraReport`, over all cameras.
    shared : {(camera, camera): int}
        Frames in which both see the board and agree; empty for intrinsics alone.
    jitter : (float [m], float [rad])
        Standard deviation of a view's board about its pose in the frame, from unsynchronised cameras or a bent board.
    world : str
        Description of the origin and the vertical axis.
    advice : tuple of str
        What else to record.
    """

    rig: Rig
    board: Board
    cameras: dict[str, BoardCameraReport]
    rms_px: float
    own_rms_px: float
    shared: dict[tuple[str, str], int]
    jitter: tuple[float, float]
    world: str
    advice: tuple[str, ...]


@checked
def calibrate_board(
    seen: Mapping[str, CameraViews],
    board: Board,
    *,
    interiors: Rig | None = None,
    floor: int | None = None,
    exteriors: bool = True,
) -> BoardCalibration:
    """Calibrate cameras with a board; its squares give the scale.

    Parameters
    ----------
    seen : {camera: CameraViews} of `find_boards`; views of one frame number are of one time.
    board : Board
    interiors : Rig, optional
        Known intrinsics, kept (their poses are not used); default: intrinsics are calibrated too.
    floor : int, optional
        Frame in which the board lies on the floor, face up: origin in its first inner corner, x along its rows, z up.
        Default: the world is the first camera's frame.
    exteriors : bool
        False: intrinsics alone; the cameras need no common views, and are placed at the origin.

    Raises
    ------
    CalibrationError
        Too few views, an undetermined focal length, cameras without a shared view, a floor that is not visible.
    """
    if not seen:
        raise CalibrationError("no camera", remedy="Give the views of at least one camera.")
    if interiors is None:
        single = {name: calibrate_interiors(name, views, board) for name, views in seen.items()}
        cameras = {name: of_camera.camera for name, of_camera in single.items()}
    else:
        single, cameras = {}, {name: known_camera(interiors, name, views.size) for name, views in seen.items()}
    if not exteriors:
        return _interiors_only(board, seen, cameras, single)
    placed = place_cameras(cameras, seen, board)
    bundle = adjust_boards(placed.rig, placed.Ts_world_board, placed.corners, interiors=interiors is None)
    rig, world = _in_world(bundle, placed, floor, board)
    reports = {
        camera.name: _report(c, seen[camera.name], single.get(camera.name), placed, bundle)
        for c, camera in enumerate(rig)
    }
    return BoardCalibration(
        rig, board, reports, _rms(bundle.residuals), _rms(bundle.within), placed.agreeing, bundle.jitter, world,
        tuple(_advice(rig, reports, placed.agreeing, len(seen))),
    )


def _interiors_only(
    board: Board, seen: Mapping[str, CameraViews], cameras: dict[str, Camera], single: dict[str, Interiors]
) -> BoardCalibration:
    if not single:
        raise CalibrationError("intrinsics are given, but extrinsics are not wanted", remedy="Remove one of the two.")
    reports = {
        name: BoardCameraReport(
            own.rms_px, own.rms_px, len(seen[name].views), len(own.frames), own.coverage, own.focal_std, np.inf
        )
        for name, own in single.items()
    }
    rms = float(np.sqrt(np.mean([own.rms_px**2 for own in single.values()])))
    rig = Rig(tuple(cameras.values()))
    advice = tuple(_advice(rig, reports, {}, 1))
    return BoardCalibration(rig, board, reports, rms, rms, {}, (0.0, 0.0), "Intrinsics alone: no poses.", advice)


def _in_world(bundle: BoardBundle, placed: Placed, floor: int | None, board: Board) -> tuple[Rig, str]:
    first = bundle.rig.names[0]
    if floor is None:
        return bundle.rig, (
            f"The world is the frame of {first} (x right, y down, z forward in its image): its -y points up if "
            f"{first} was level. Give the frame in which the board lies on the floor to have z up."
        )
    if floor not in placed.frames:
        nearest = min(placed.frames, key=lambda frame: abs(frame - floor))
        raise CalibrationError(
            f"no camera sees the board in frame {floor}, in which it should lie on the floor",
            place="floor",
            remedy=f"The nearest frame with a board is {nearest}; the last is {placed.frames[-1]}.",
        )
    rig = bundle.rig.moved(inverse(bundle.Ts_world_board[placed.frames.index(floor)]))
    below = [camera.name for camera in rig if camera.centre_world[2] < 0]
    if below:
        raise CalibrationError(
            f"in frame {floor} the board's face points away from {', '.join(below)}, as if below the floor",
            place="floor",
            remedy="Give a frame in which the board lies flat on the floor, face up.",
        )
    return rig, (
        f"Origin in the first inner corner of the board on the floor (frame {floor}), x along its rows, z up. Write "
        'up = "z" in the take.'
    )


def _rms(residuals: NDArray) -> float:
    return float(np.sqrt(np.nanmean(np.sum(residuals**2, axis=1))))


def _report(
    c: int, seen: CameraViews, single: Interiors | None, placed: Placed, bundle: BoardBundle
) -> BoardCameraReport:
    own = placed.corners.camera == c
    used = len(np.unique(placed.corners.frame[own]))
    return BoardCameraReport(
        _rms(bundle.residuals[own]), _rms(bundle.within[own]), len(seen.views),
        len(single.frames) if single else used, coverage(seen.uv, seen.size), float(bundle.focal_std[c]),
        float(bundle.position_std[c]),
    )


def _advice(
    rig: Rig, reports: Mapping[str, BoardCameraReport], shared: Mapping[tuple[str, str], int], count: int
) -> list[str]:
    out = []
    for camera in rig:
        report = reports[camera.name]
        if report.views < _ADVISED_VIEWS:
            out.append(f"{camera.name}: {report.views} views; record {_ADVISED_VIEWS} or more, turned to all sides.")
        if report.focal_std_px and report.coverage < _ADVISED_COVERAGE:
            out.append(
                f"{camera.name}: the board covered {100 * report.coverage:.0f} % of the image; bring it near, and "
                "into the corners: the distortion there is a guess."
            )
        if report.focal_std_px > _MAX_FOCAL_STD * camera.matrix[0, 0]:
            part = 100 * report.focal_std_px / camera.matrix[0, 0]
            out.append(f"{camera.name}: focal length known to {part:.1f} % only; turn the board by 20 to 45 degrees.")
    for camera in rig if count > 1 else ():
        best = max((n for pair, n in shared.items() if camera.name in pair), default=0)
        if best < _ADVISED_SHARED:
            out.append(f"{camera.name}: shares {best} frames with another camera; record {_ADVISED_SHARED} or more.")
    return out
