"""Recordings of colour images: the video of one camera, read when its frames are asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.observations.depth import _Recording, checked_times
from kinefit.observations.frames import ColourFrame


@dataclass(frozen=True, eq=False)
class ColourVideo(_Recording):
    """Colour images of one camera.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    size : (width, height) [px] of the calibration's image.
    image : callable
        Frame number -> (H, W, 3) uint8 RGB in that image's frame.
    source : str
        File or folder, for messages.

    Raises
    ------
    ObservationError
        Times that do not increase.
    """

    size: tuple[int, int]
    image: Callable[[int], NDArray]
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times(self.times, self.sensor, self.source))

    def frame(self, i: int) -> ColourFrame:
        """Frame number `i`, negative ones from the end; read now."""
        i = range(len(self))[i]
        return ColourFrame(self.sensor, float(self.times[i]), np.asarray(self.image(i)))
