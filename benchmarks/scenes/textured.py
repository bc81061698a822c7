"""Render grey images of a moving body with a fine texture fixed to its surface, for photogrammetry."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.rendering import scaled
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.simulation.rendering.scenes import SimulatedScene

_LATTICE_CELLS = 64  # of the texture, after which it repeats
_SAMPLES = 2  # rays along each side of a pixel
_MEAN_GREY = 120.0
_GREY_STD = 45.0
_BACKGROUND_GREY = 50.0


@checked
def textured_picture(
    scene: SimulatedScene, frame: int, camera: Camera, *, grain: float = 0.003, noise: float = 2.0, seed: int = 0
) -> NDArray:
    """Grey image (H, W), 8 bit, of one frame of a scene; the texture is a smooth function of the place on the body.

    Parameters
    ----------
    grain : float [m]
        Distance of the lattice points between which the texture is interpolated.
    noise : float
        Standard deviation of a grey value.
    seed : int
        Of the noise, together with the frame and the camera's name.

    Raises
    ------
    ObservationError
        `grain` is not between 0 and 1 m; `noise` is negative or not finite.
    """
    if not (0 < grain < 1 and 0 <= noise < np.inf):
        problem = f"grain is {grain} m, noise is {noise}"
        raise ObservationError(problem, remedy="Give a grain between 0 and 1 m, and noise of 0 or more.")
    view = scene.view(frame, scaled(camera, _SAMPLES))
    visible, segment = view.raster.seen, view.raster.segment
    fine = np.full(visible.shape, _BACKGROUND_GREY, np.float32)
    x = view.x_rest[visible] / grain + 17.0 * segment[visible][:, None]  # another texture for every segment
    fine[visible] = _MEAN_GREY + _GREY_STD * _lattice(x)
    image = cv2.resize(fine, camera.size, interpolation=cv2.INTER_AREA)
    random = np.random.default_rng([seed, frame, *camera.name.encode()])
    return np.clip(np.rint(image + noise * random.standard_normal(image.shape)), 0, 255).astype(np.uint8)


def write_video(path: Path, images: Iterable[NDArray], rate: float, codec: str = "MJPG") -> None:
    """Write grey images (H, W), or BGR images (H, W, 3), as a video; "FFV1" is without loss."""
    video = None
    for image in images:
        video = video or cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), rate, image.shape[1::-1])
        video.write(image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    if video is not None:
        video.release()


@cache
def _table() -> NDArray:
    """(n, n, n) lattice values with mean 0 and standard deviation 1."""
    return np.random.default_rng(31).standard_normal((_LATTICE_CELLS,) * 3).astype(np.float32)


def _lattice(x: NDArray) -> NDArray:
    """(N,) smooth random function at places (N, 3) in cells: trilinear with smooth steps."""
    low = np.floor(x).astype(np.int64)
    t = x - low
    t = t * t * (3.0 - 2.0 * t)
    out, table = np.zeros(len(x)), _table()
    for corner in np.ndindex(2, 2, 2):
        i, j, k = ((low[:, a] + corner[a]) % _LATTICE_CELLS for a in range(3))
        out += table[i, j, k] * np.prod(np.where(corner, t, 1.0 - t), axis=1)
    return out
