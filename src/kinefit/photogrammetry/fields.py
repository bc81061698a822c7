"""Fields of interlaced video (the odd or even lines, taken at one instant) and cameras for them."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera

Field = Literal["odd", "even"]


def field_of(image: NDArray, field: Field) -> NDArray:
    """Lines of one field of an image (H, W, ...), about half as many; "odd" are the first, third, ... line."""
    return np.ascontiguousarray(image[_first(field) :: 2])


def field_camera(camera: Camera, field: Field) -> Camera:
    """Camera of a field: the same rays with half the pixels in the vertical direction.

    Raises
    ------
    CalibrationError
        The image has a single line.
    """
    width, height = camera.size
    if height < 2:
        raise CalibrationError("an image of one line", place=f"camera {camera.name}", remedy="Give two lines or more.")
    matrix, start = camera.matrix.copy(), _first(field)
    matrix[1, 1] *= 0.5
    matrix[1, 2] = 0.5 * (matrix[1, 2] - start)
    return replace(camera, size=(width, (height - start + 1) // 2), matrix=matrix)


def _first(field: Field) -> int:
    return 0 if field == "odd" else 1
