"""Joints of a take that were clicked in images."""

from __future__ import annotations

import numpy as np

from kinefit.errors import TakeError, choices
from kinefit.observations import ClickVideo
from kinefit.readers.landmarks.annotations import read_clicks
from kinefit.readers.take.cameras import TakeCameras, stated_rate

_CLICK_CROSS_PX = 20.0  # from a click to the ends of the two lines that cross there: short, that no lens bends them


def load_clicks(cameras: TakeCameras) -> tuple[ClickVideo, ...]:
    """Joints that were clicked: each is two image lines that cross in it, along u and v, with its landmark on both.

    Raises
    ------
    TakeError
        Nothing states the rate; a camera that the take does not have.
    FileError
        As `read_clicks`.
    """
    take, images, out = cameras.take, cameras.images, list[ClickVideo]()
    if take.clicks is None:
        return ()
    steps = read_clicks(take.clicks)
    for camera in dict.fromkeys(camera for of in steps for camera in of.points):
        if camera not in images:
            problem = choices("camera", camera, images)
            raise TakeError(problem, file=take.clicks, place="[start] clicks", remedy="Remove its clicks.")
        rate = stated_rate(cameras.fastest, take.path)
        mine = [of for of in steps if of.points.get(camera)]
        names = tuple(dict.fromkeys(name for of in mine for name in of.points[camera]))
        uv = np.array([[of.points[camera].get(name, (np.nan, np.nan)) for name in names] for of in mine])
        cross = _CLICK_CROSS_PX * np.array([[[0, -1], [0, 1]], [[-1, 0], [1, 0]]])
        ends = images[camera].to_calibration(uv[:, :, None, None] + cross).reshape(len(mine), -1, 2, 2)
        offset = cameras.offset(camera)
        times = offset + np.array([round(of.step - offset * rate) for of in mine]) / rate
        titles = tuple(f"{name} {axis}" for name in names for axis in "uv")
        landmarks = tuple((name,) for name in names for _ in "uv")
        out.append(ClickVideo(camera, rate, times, titles, landmarks, ends, source=str(take.clicks)))
    return tuple(out)
