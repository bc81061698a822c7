"""Silhouette recordings: the masks of one camera, read on demand."""

from __future__ import annotations

from dataclasses import dataclass

from kinefit.observations.depth import _ImageRecording
from kinefit.observations.frames import SilhouetteFrame


@dataclass(frozen=True, eq=False)
class SilhouetteVideo(_ImageRecording):
    """Silhouettes of one camera.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    size : (width, height) [px] of the calibration's image
    image : callable
        Frame number -> (H, W) uint8 in the calibration's image frame, 255 for pixels of the body.
    source : str
        File or folder, for messages.

    Raises
    ------
    ObservationError
        Times that do not increase.
    """

    def frame(self, i: int) -> SilhouetteFrame:
        """Frame number `i`, read now; a negative number counts from the end."""
        return SilhouetteFrame(self.sensor, *self._image(i))
