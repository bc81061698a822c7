"""Recordings of silhouettes: the masks of one camera, read when they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.observations.depth import _Recording, checked_times
from kinefit.observations.frames import SilhouetteFrame


@dataclass(frozen=True, eq=False)
class SilhouetteVideo(_Recording):
    """Silhouettes of one camera.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    size : (width, height) [px] of the calibration's image.
    image : callable
        Frame number -> (H, W) uint8 in that image's frame, 255 where the body is.
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

    def frame(self, i: int) -> SilhouetteFrame:
        """Frame number `i`, negative ones from the end; read now."""
        i = range(len(self))[i]
        mask = np.asarray(self.image(i))
        if mask.shape != self.size[::-1]:
            raise ObservationError(
                f"the mask has {mask.shape[::-1]} px, its camera {self.size}", file=self.source or None,
                place=f"frame {i} of {self.sensor}", remedy="All masks of one camera are of its image's size.",
            )  # fmt: skip
        return SilhouetteFrame(self.sensor, float(self.times[i]), mask)
