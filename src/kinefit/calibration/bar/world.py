"""World frame of a calibration with a bar: the first camera's, or the floor on which the bar lay."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Rig
from kinefit.geometry.se3 import transform

_MIN_FLOOR_ASPECT = 0.1  # width over length of the points on the floor: narrower ones determine no plane


def on_floor(rig: Rig, x_world: NDArray, frames: NDArray, floor: Sequence[int]) -> tuple[Rig, NDArray, str]:
    """The rig in the requested world, T_new_world (4, 4), and a description of that world.

    Parameters
    ----------
    x_world : (F, 2, 3) [m] ends of the bar; frames (F,) their numbers.
    floor : frames in which the bar lies on the floor; empty: the world stays.

    Raises
    ------
    CalibrationError
        A frame without the bar, or points on one line.
    """
    first = rig.names[0]
    if not floor:
        return rig, np.eye(4), (
            f"The world is the frame of {first} (x right, y down, z forward in its image): its -y points up if {first} "
            "was level. Lay the bar on the floor in two directions and name the frames to have z up."
        )  # fmt: skip
    absent = [frame for frame in floor if frame not in frames]
    if absent:
        nearest = int(frames[np.argmin(np.abs(frames - absent[0]))])
        raise CalibrationError(
            f"two cameras do not see the bar in frame {absent[0]}, in which it should lie on the floor", place="floor",
            remedy=f"The nearest frame with the bar is {nearest}; the last is {int(frames[-1])}.",
        )  # fmt: skip
    points = x_world[np.searchsorted(frames, np.array(floor))].reshape(-1, 3)
    middle = points.mean(axis=0)
    size, axes = np.linalg.svd(points - middle)[1:]
    if len(floor) < 2 or size[1] < _MIN_FLOOR_ASPECT * size[0]:
        raise CalibrationError(
            "the bar on the floor lies along one line, which does not determine the vertical", place="floor",
            remedy="Lay it there in two directions, and give a frame of each.",
        )  # fmt: skip
    above = np.mean([camera.centre_world for camera in rig], axis=0) - middle
    up = axes[2] * np.sign(axes[2] @ above)
    along = points[1] - points[0]
    along -= (along @ up) * up
    along /= np.linalg.norm(along)
    R = np.stack([along, np.cross(up, along), up])
    T = transform(R, -R @ points[0])
    height = 1e3 * float(np.sqrt(np.mean(((points - middle) @ up) ** 2)))
    listed = ", ".join(map(str, floor))
    return rig.moved(T), T, (
        f"Origin in a target of the bar on the floor (frame {floor[0]}), x along the bar, z up; the targets of frames "
        f'{listed} lie in a plane to {height:.1f} mm RMS. Write up = "z" in the take.'
    )
