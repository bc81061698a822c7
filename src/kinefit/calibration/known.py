"""Known intrinsics as input of a calibration."""

from __future__ import annotations

import numpy as np

from kinefit.errors import CalibrationError, choices
from kinefit.geometry.camera import Camera, Rig


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
