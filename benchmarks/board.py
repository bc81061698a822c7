"""Calibration from boards: OpenCV's stereo pair and caliscope's webcams, against the calibrations they came with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figures import amount, data, figure
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import read_calibration
from kinefit.rigs.board.calibrate import BoardCalibration, calibrate_board
from kinefit.rigs.board.detection import Board
from kinefit.rigs.board.sources import camera_sources, find_boards

_WEBCAMS = {"mv4_upperbody_caliscope": "", "mv4_landmarks_caliscope": "calibration/extrinsic"}


def run() -> None:
    """Print the figures."""
    _stereo()
    results = {name: _webcams(name, inner) for name, inner in list(_WEBCAMS.items())[amount(0, 1) :]}
    measured = [result for result in results.values() if result is not None]
    if not measured:
        for name, unit, goal in (("rms", "px", "<= 1"), ("view_rms", "px", "<= 0.5"), ("distances", "%", "<= 2")):
            figure(f"board_mv4_{name}", None, unit, goal, "the recordings are absent")
        return
    figure("board_mv4_rms", max(found.rms_px for found, _ in measured), "px", "<= 1")
    figure("board_mv4_view_rms", max(found.own_rms_px for found, _ in measured), "px", "<= 0.5")
    figure("board_mv4_distances", max(_distances(*result) for result in measured), "%", "<= 2")


def _stereo() -> None:
    folder = data("stereo_opencv_chessboard")
    if folder is None:
        for name, unit, goal in (("focal", "%", "<= 1"), ("baseline", "%", "<= 1"), ("rms", "px", "<= 0.5")):
            figure(f"board_stereo_{name}", None, unit, goal, "the recording is absent")
        return
    reference = read_calibration(folder, image_size=(640, 480), unit=0.025)
    board, seen = find_boards(camera_sources([folder]), Board.parse("checkerboard:9x6:0.025"))
    found = calibrate_board(seen, board)
    for axis, name in enumerate("xy"):
        mean, true = (np.mean([camera.matrix[axis, axis] for camera in rig]) for rig in (found.rig, reference))
        print(f"  stereo: focal length along {name} {mean:.1f} px, OpenCV's sample {true:.1f} px")
    focal = max(abs(100 * (a.matrix[0, 0] / b.matrix[0, 0] - 1)) for a, b in zip(found.rig, reference))
    figure("board_stereo_focal", focal, "%", "<= 1")
    figure("board_stereo_baseline", _distances(found, reference), "%", "<= 1")
    figure("board_stereo_rms", found.rms_px, "px", "<= 0.5")
    for name, rig in (("found", found.rig), ("OpenCV's sample", reference)):
        print(f"  stereo: rms distance from epipolar lines {_epipolar(rig, seen):.3f} px ({name})")


def _epipolar(rig: Rig, seen: dict) -> float:
    """RMS distance [px] of the corners from the epipolar lines of their partners, without lens distortion."""
    left, right = rig
    pairs = [(a, seen[right.name].frames[f]) for f, a in seen[left.name].frames.items() if f in seen[right.name].frames]
    T = right.T_camera_world @ left.T_world_camera
    tx, ty, tz = T[:3, 3]
    E = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ T[:3, :3]
    rays = [
        camera.with_pose(np.eye(4)).ray(np.concatenate([pair[i].uv for pair in pairs]))
        for i, camera in enumerate((left, right))
    ]
    x, y = (ray / ray[:, 2:] for ray in rays)
    line = x @ E.T
    return float(
        right.matrix[0, 0] * np.sqrt(np.mean((np.sum(y * line, axis=1) / np.linalg.norm(line[:, :2], axis=1)) ** 2))
    )


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
    own = calibrate_board(seen, board)
    focal = max(abs(100 * (a.matrix[0, 0] / b.matrix[0, 0] - 1)) for a, b in zip(own.rig, reference))
    print(
        f"  {name}, interiors found too: rms {own.rms_px:.2f} px, focal lengths within {focal:.1f} %, "
        f"distances within {_distances(own, reference):.1f} %"
    )
    return kept, reference


def _distances(found: BoardCalibration, reference: Rig) -> float:
    """Largest difference [%] of the distances between cameras."""
    out = 0.0
    for (a, b), metres in found.rig.distances.items():
        true = float(np.linalg.norm(reference[a].centre_world - reference[b].centre_world))
        out = max(out, abs(100 * (metres / true - 1)))
    return out


if __name__ == "__main__":
    run()
