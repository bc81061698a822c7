"""Frames of a take as a tracker left them: what smoothing begins with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.frame.results import FrameResult
from kinefit.sensors.base import Leftover, Measurement, pixels_of
from kinefit.sensors.channels import Channels
from kinefit.smoothing.linearised import ApartRows, SceneOf
from kinefit.smoothing.spool import STRETCH


@dataclass(frozen=True, eq=False)
class TrackedFrames:
    """F consecutive frames as a tracker left them.

    Parameters
    ----------
    results : F frames, with those matches alone that offer packed `pixels`, all in one layout
    measurements : of each of them what all other sensors measured, without whole images
    leftovers : of each of them what the fit leaves over of every sensor
    times : (F,) [s]
    rate : float [Hz]
    scene_of, apart : those of the tracker
    """

    results: Sequence[FrameResult]
    measurements: Sequence[tuple[Measurement, ...]]
    leftovers: Sequence[tuple[Leftover, ...]]
    times: NDArray
    rate: float
    scene_of: SceneOf
    apart: ApartRows

    def pixels(self) -> tuple[Channels, NDArray]:
        """The points in images of all frames as they were measured, and (F, N) bool: which changed sides."""
        F, layout, swapped = len(self.results), None, np.zeros((len(self.results), 0), bool)
        uv, confidence = room((F, 0, 2)), room((F, 0))
        for f, result in enumerate(self.results):
            if f % STRETCH == 0:
                release(uv, confidence)
            for m in pixels_of(result.matched):
                if layout is None:
                    layout, N = m.measurement.layout, len(m.swapped)
                    uv, confidence, swapped = room((F, N, 2)), room((F, N)), np.zeros((F, N), bool)
                    uv[:] = np.nan
                uv[f], confidence[f], swapped[f] = m.measurement.uv, m.measurement.confidence, m.swapped
        if layout is None:
            return Channels.none(self.scene_of(self.results[0].state, 0.0).rig, F), swapped
        return replace(layout.channels, uv=uv, confidence=confidence), swapped
