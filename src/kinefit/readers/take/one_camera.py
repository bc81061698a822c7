"""Cameras of a take without calibration: level, at the world's origin, of the usual field of view."""

from __future__ import annotations

import numpy as np

from kinefit.errors import TakeError
from kinefit.geometry.camera import Camera
from kinefit.motion import UP_AXES
from kinefit.readers.take.entries import CameraEntry
from kinefit.readers.take.file import Take

USUAL = 64.0
"""[deg] across the longer side of the image where nothing is told: videos of telephones have some 60 to 70."""


def is_alone(take: Take) -> bool:
    """Whether a take has one camera, and no calibration; `check_take` lets no sensor of another world beside it."""
    return take.calibration is None and len(take.cameras) == 1


def is_uncalibrated(take: Take) -> bool:
    """Whether a take has several cameras and nothing that tells where they stand but the people in view."""
    return take.calibration is None and len(take.cameras) > 1


def assumed_camera(entry: CameraEntry, size: tuple[int, int] | None, take: Take) -> Camera:
    """The camera as the take tells it, or as cameras usually are.

    It looks level, along the axis before the vertical one: y where z is up, x where y is.

    Raises
    ------
    TakeError
        Nothing tells the size of its image.
    """
    if size is None:
        raise TakeError(
            "nothing tells the size of the image", file=take.path, place=f"camera {entry.name}",
            remedy="Give the camera its video, or size = [width, height].",
        )  # fmt: skip
    width, height = size
    focal = 0.5 * max(size) / np.tan(np.radians(entry.field_of_view or USUAL) / 2.0)
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    up = np.array(UP_AXES[take.up], float)
    ahead = np.roll(np.abs(up), -1)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(ahead, up), -up, ahead])
    return Camera(entry.name, size, matrix, T_camera_world=T)


def what_is_assumed(take: Take) -> list[str]:
    """What the report of a take with one camera and no calibration has to say; nothing of any other."""
    if not is_alone(take):
        return []
    entry = take.cameras[0]
    told = f"a field of view of {entry.field_of_view or USUAL:g}°" + ("" if entry.field_of_view else ", the usual one")
    out = [
        f"camera {entry.name} is alone and not calibrated: it is taken to look level, with {told}; where it is a tenth "
        "wider, the person is a tenth nearer. Error bars do not hold this."
    ]
    if take.height is None:
        out.append("no height is stated: lengths and distances are as unsure as the person's size, about a tenth")
    return out
