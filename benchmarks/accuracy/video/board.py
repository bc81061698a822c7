"""Calibration from boards: OpenCV's stereo pair and caliscope's webcams, against the calibrations they came with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figures import NotMeasured, amount, data, each, figure, recording
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import read_calibration
from kinefit.rigs.board.calibrate import BoardCalibration, calibrate_board
from kinefit.rigs.board.detection import Board
from kinefit.rigs.board.sources import camera_sources, find_boards

_WEBCAMS = {"mv4_upperbody_caliscope": "", "mv4_landmarks_caliscope": "calibration/extrinsic"}


def run() -> None:
    """Print the figures."""
    each(_stereo)
    results = {name: _webcams(name, inner) for name, inner in list(_WEBCAMS.items())[amount(0, 1) :]}
    measured = [result for result in results.values() if result is not None]
    if not measured:
        raise NotMeasured("the recordings are absent")
    figure("board_mv4_rms", max(found.rms_px for found, _ in measured), "px", "<= 1")
    figure("board_mv4_view_rms", max(found.own_rms_px for found, _ in measured), "px", "<= 0.5")
    figure("board_mv4_distances", max(_distances(*result) for result in measured), "%", "<= 2")


def _stereo() -> None:
    folder = recording("stereo_opencv_chessboard")
    reference = read_calibration(folder, image_size=(640, 480), unit=0.025)
    board, seen = find_boards(camera_sources([folder]), Board.parse("checkerboard:9x6:0.025"))
    found = calibrate_board(seen, board)
    focal = max(abs(100 * (a.matrix[0, 0] / b.matrix[0, 0] - 1)) for a, b in zip(found.rig, reference))
    figure("board_stereo_focal", focal, "%", "<= 1")
    figure("board_stereo_baseline", _distances(found, reference), "%", "<= 1")
    figure("board_stereo_rms", found.rms_px, "px", "<= 0.5")


def _webcams(name: str, inner: str) -> tuple[BoardCalibration, Rig] | None:
    """Exteriors found with the interiors that came with the recording (made from other videos), and the reference."""
    folder = data(name)
    if folder is None:
        return None
    reference = read_calibration(folder / "config.toml")
    reference = Rig(tuple(replace(camera, name=camera.name.replace("cam", "port")) for camera in reference))
    board, seen = find_boards(camera_sources([Path(folder) / inner]), Board.parse("charuco:4x5:0.054:0.0405:4X4_50"))
    kept = calibrate_board(seen, board, interiors=reference)
    print(f"  {name}, interiors kept: rms {kept.rms_px:.2f} px, each view for itself {kept.own_rms_px:.2f} px,")
    print(
        f"    between views the board is off by {1e3 * kept.jitter[0]:.1f} mm, {np.degrees(kept.jitter[1]):.2f} deg;"
        f" distances within {_distances(kept, reference):.2f} %"
    )
    return kept, reference


def _distances(found: BoardCalibration, reference: Rig) -> float:
    """Largest difference [%] of the distances between cameras."""
    out = 0.0
    for (a, b), metres in found.rig.distances.items():
        true = float(np.linalg.norm(reference[a].centre_world - reference[b].centre_world))
        out = max(out, abs(100 * (metres / true - 1)))
    return out
