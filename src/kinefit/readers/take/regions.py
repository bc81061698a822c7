"""Colour images of a take's cameras, for what follows a body by its colours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.observations import ColourVideo
from kinefit.readers.take.file import Take
from kinefit.readers.take.silhouettes import in_calibration
from kinefit.readers.video import Video


def load_regions(take: Take, rig: Rig | None, images: Mapping[str, ImageFrame]) -> tuple[ColourVideo, ...]:
    """The videos of all `[[region]]` of a take, in its order, in the calibration's image frame.

    Raises
    ------
    KinefitError
        What reading a video raises.
    """
    out = []
    for entry in take.regions:
        assert rig is not None
        camera = next(c for c in take.cameras if c.name == entry.camera)
        assert camera.video is not None
        video, size, frame = Video(camera.video, rate=take.rate), rig[entry.camera].size, images[entry.camera]
        times = camera.time_offset + np.arange(len(video)) / video.rate
        image = lambda i, video=video, size=size, frame=frame: in_calibration(video.read(i), size, frame)
        out.append(ColourVideo(entry.camera, video.rate, times, size, image, str(camera.video)))
    return tuple(out)
