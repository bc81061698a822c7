"""A seated person with both hands before four cameras (caliscope's recordings), each camera held out of the whole fit.

Landmarks of MediaPipe Holistic as caliscope wrote them ("real"), and those of kinefit's own detector in the videos of
another recording, as a take with the body "humanoid_hands" has them looked for ("video"). There is no truth of
fingers. What is measured: how far, in the camera that the fit did not have, points of hands lie from where it puts
them. Beside it the same of points that the other cameras triangulate, each by itself, over the same frames and points.
Holistic often puts both hands onto one; frames of the camera in which its two hands are nearer to each other than 0.4
of a hand's size do not judge. One camera of the videos is 0.65 of a frame out of step, at 6 a second (`kinefit check`).
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, data, figure
from benchmarks.scenes.held_out import left_over
from benchmarks.scenes.takes import seen_of
from kinefit import Keypoints, Recording, Rig, load_body, track
from kinefit.errors import AssetError, ObservationError
from kinefit.geometry.lines import triangulate_robust
from kinefit.observations import MEDIAPIPE_33, MEDIAPIPE_75
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.landmarks.keypoints import read_caliscope_csv

_NAME, _VIDEOS = "mv4_landmarks_caliscope", "mv4_upperbody_caliscope"
_GESTURES = 60  # first images of the videos; then a board is held before the hands
_INLIER = 15.0  # [px] beyond which a view is no part of a triangulated point
_APART = 0.4  # of a hand's size, by which two hands are two
_FIRST = len(MEDIAPIPE_33)
_LEFT, _RIGHT = slice(_FIRST, _FIRST + 21), slice(_FIRST + 21, _FIRST + 42)


def triangulated(rig: Rig, records: list[Keypoints]) -> NDArray:
    """(F, K, 3) [m] each point by itself, NaN where no two views agree."""
    uv = np.stack([record.points[:, 0] for record in records], axis=2)
    x = triangulate_robust(rig, uv.reshape(-1, *uv.shape[2:]), max_residual_px=_INLIER)[0]
    return x.reshape(*uv.shape[:2], 3)


def two_hands(points: NDArray) -> NDArray:
    """(F,) bool: frames of one camera (F, 75, 2) whose two hands are not one and the same."""
    left, right = points[:, _LEFT], points[:, _RIGHT]
    size = np.linalg.norm(np.ptp(left, axis=1), axis=-1)
    return np.median(np.linalg.norm(left - right, axis=-1), axis=1) > _APART * size


def run() -> None:
    """Print every figure."""
    folder, videos, missing = data(_NAME), data(_VIDEOS), "no recording"
    rig, seen = Rig(()), dict[str, Keypoints]()
    if folder is not None:
        rig = read_calibration(folder / "config.toml")
        table = read_caliscope_csv(folder / "HOLISTIC" / "xy_HOLISTIC.csv")
        seen = {name: one.rows(slice(40, amount(220, 60)), 0.0) for name, one in table.items()}
    _figures("real", rig, seen, "x", missing)
    rig, seen = Rig(()), {}
    if videos is not None:
        try:
            rig, seen = _detected(videos)
        except (AssetError, ObservationError) as error:
            missing = error.problem
    _figures("video", rig, seen, "z", missing)


def _detected(videos: Path) -> tuple[Rig, dict[str, Keypoints]]:
    """The cameras of the recording of videos, and the built-in detector's points, hands with them."""
    text = f'[take]\nrate = 6.0\nup = "z"\nbody = "humanoid_hands"\nframes = [0, {amount(_GESTURES, 12)}]\n'
    text += f'[calibration]\nfile = "{videos / "config.toml"}"\n'
    for k in range(4):
        text += f'[[camera]]\nname = "cam_{k}"\nvideo = "{videos / f"port_{k}.mp4"}"\n'
    found = seen_of(text, detect=True)
    assert found.rig is not None
    return found.rig, {k.camera: k for k in found.keypoints}


def _figures(kind: str, rig: Rig, seen: dict[str, Keypoints], up: str, missing: str) -> None:
    errors: list[tuple[NDArray, NDArray]] = []
    for name in amount(rig.names, rig.names[:1]):
        errors.append(_held_out(rig, seen, name, up))
        px = [float(np.median(e)) if len(e) else float("nan") for e in errors[-1]]
        print(f"# {name} held out: {px[0]:.1f} px, triangulated {px[1]:.1f} px, {len(errors[-1][0])} points")
    fit, alone = (np.concatenate(e) for e in zip(*errors)) if errors else (np.full(1, np.nan), np.full(1, np.nan))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no recording
        of_fit, of_points = float(np.nanmedian(fit)), float(np.nanmedian(alone))
    figure(f"hands_{kind}_held_out", of_fit, "px", "<= 3", missing)
    figure(f"hands_{kind}_held_out_vs_triangulated", of_fit / of_points, "x", "<= 1", missing)


def _held_out(rig: Rig, seen: dict[str, Keypoints], name: str, up: str) -> tuple[NDArray, NDArray]:
    """(N,) [px] of all points of hands that both have: measured minus the fit's, and minus the triangulated."""
    others = rig.select(tuple(n for n in rig.names if n != name))
    records = [seen[n] for n in others.names]
    motion = track(Recording.of_keypoints(others, records, up=up), load_body("humanoid_hands"))
    x = triangulated(others, records)
    uv = rig[name].project(x.reshape(-1, 3)).reshape(*x.shape[:2], 2)
    measured = seen[name].points[:, 0]
    alone = np.linalg.norm(measured - uv, axis=-1)
    columns = [MEDIAPIPE_75.index(n) for n in motion.body.keypoints("MEDIAPIPE_75").names]
    fit = np.full(alone.shape, np.nan)
    fit[:, columns] = np.linalg.norm(left_over(motion, rig, seen[name]), axis=-1)
    judges = np.isfinite(fit) & np.isfinite(alone) & two_hands(measured)[:, None]
    judges[:, :_FIRST] = False
    return fit[judges], alone[judges]
