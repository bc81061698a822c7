"""Colour recordings: the video of one camera, read on demand."""

from __future__ import annotations

from dataclasses import dataclass

from kinefit.observations.depth import _ImageRecording
from kinefit.observations.frames import ColourFrame


@dataclass(frozen=True, eq=False)
class ColourVideo(_ImageRecording):
    """Colour images of one camera.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    size : (width, height) [px] of the calibration's image
    image : callable
        Frame number -> (H, W, 3) uint8 RGB in the calibration's image frame.
    source : str
        File or folder, for messages.

    Raises
    ------
    ObservationError
        Times that do not increase.
    """

    def frame(self, i: int) -> ColourFrame:
        """Frame number `i`, read now; a negative number counts from the end."""
        return ColourFrame(self.sensor, *self._image(i))
