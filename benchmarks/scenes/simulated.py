"""What simulated takes have in common: points that stand elsewhere, cameras off their calibration, what is not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit import Keypoints, Motion
from kinefit.bodies import Body
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.solving.bundle.shape import mirror_points

CALIBRATION = (np.radians(0.1), 0.003)  # [rad, m] one standard deviation about and along each axis


def with_points_off(body: Body, keypoint_set: str, off: NDArray) -> Body:
    """A body whose points of a set stand off their places by (K, 3) [m]; of a pair both by that of one, mirrored."""
    points = body.keypoints(keypoint_set)
    lead, sign = mirror_points(points, body.tree.segments)
    shift = off[lead]
    shift[:, 2] *= sign
    return body.with_keypoints(keypoint_set, points.points + shift)


def somebody(truth: Motion, keypoint_set: str, random: np.random.Generator, std: float | NDArray = 0.008) -> Motion:
    """The motion of somebody whose lengths differ by 5 %, and whose detector's points stand `std` [m] elsewhere."""
    body = truth.body.scaled(random.normal(1.0, 0.05, len(truth.body.scale_groups)))
    off = std * random.normal(size=(len(body.keypoints(keypoint_set)), 3))
    return replace(truth, body=with_points_off(body, keypoint_set, off))


def camera_error(random: np.random.Generator, times: float = 1.0) -> NDArray:
    """(4, 4) a small error of a camera's pose, so many times as large as calibrations usually have."""
    turn, shift = times * np.array(CALIBRATION)
    return se3.transform(se3.exp_so3(random.normal(0.0, turn, 3)), random.normal(0.0, shift, 3))


def calibrated(rig: Rig, random: np.random.Generator, times: float = 1.0) -> Rig:
    """The cameras as a calibration has them that is off so many times as calibrations usually are."""
    return Rig(tuple(c.with_pose(camera_error(random, times) @ c.T_camera_world) for c in rig))


def turned(rig: Rig, name: str, turn: NDArray) -> Rig:
    """The rig with a camera turned about itself, by a rotation vector (3,) [rad] in its own frame."""
    T = se3.transform(se3.exp_so3(turn), np.zeros(3))
    return Rig(tuple(c.with_pose(T @ c.T_camera_world) if c.name == name else c for c in rig))


def to_and_fro(count: int, frames: int) -> NDArray:
    """(F,) which of so many frames is shown in each, forwards and backwards until there are enough."""
    return np.resize(np.concatenate([np.arange(count), np.arange(count - 2, 0, -1)]), frames)


def rows_of(record: Keypoints) -> NDArray:
    """(F, K, 3) x, y [px] and confidence of the first person, 0 where a point is not seen: MediaPipe's array."""
    return np.nan_to_num(np.concatenate([record.points[:, 0], record.confidence[:, 0, :, None]], axis=-1))


def without(record: Keypoints, frames: slice | NDArray, columns: slice | Sequence[int] = slice(None)) -> Keypoints:
    """A record in which some points, or all, are not seen in some frames: a slice of them, or (F,) bool."""
    points, confidence = np.array(record.points), np.array(record.confidence)
    rows, which = np.arange(len(points))[frames][:, None], np.arange(points.shape[2])[columns]
    points[rows, :, which], confidence[rows, :, which] = np.nan, 0.0
    return replace(record, points=points, confidence=confidence)


def write_cameras(folder: Path, told: Rig, points: Sequence[NDArray], rate: float, tag: str = "") -> str:
    """Write a calibration and MediaPipe's array of each camera; the text of a take of them, world y up."""
    write_calibration(told, folder / f"{tag}calibration.toml")
    text = f'[take]\nrate = {rate}\nup = "y"\n[calibration]\nfile = "{folder}/{tag}calibration.toml"\n'
    for name, own in zip(told.names, points, strict=True):
        np.save(folder / f"{tag}{name}.npy", own)
        text += f'[[camera]]\nname = "{name}"\n[[keypoints]]\ncamera = "{name}"\nformat = "mediapipe"\n'
        text += f'file = "{folder}/{tag}{name}.npy"\nrate = {rate}\n'
    return text
