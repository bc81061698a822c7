"""A pose from silhouettes that are far off: coarse to fine in image, reach, normals and surface (P1 2.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.frame.fit import FrameFit
from kinefit.frame.results import FrameResult
from kinefit.frame.routing import Sensors
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteFrame
from kinefit.sensors.regions.silhouette import SilhouetteMeasurement
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.visibility.surface import TrackedSurface


class Level(NamedTuple):
    """One step from coarse to fine.

    Parameters
    ----------
    side : int [px], longer side of the image in which outlines are compared.
    far, near : float [m], bound of correspondences in the first iteration and in the last.
    angle : float [rad], largest one between normals of a pair.
    """

    side: int
    far: float
    near: float
    angle: float


LEVELS = (Level(40, 0.8, 0.4, 1.5), Level(80, 0.5, 0.2, 1.4), Level(160, 0.3, 0.1, 1.2), Level(320, 0.15, 0.03, 1.0))
_GAIN = 0.01  # of overlap that a coarser start must add: what outlines of one pose differ by from level to level
_PATIENCE = 3  # times as many iterations in each level as a frame of a sequence gets


class FarFit(NamedTuple):
    """What was found from afar: the judged pose, and its overlap 0..1 with the silhouettes (mean IoU)."""

    result: FrameResult
    overlap: float


def coarse_to_fine(
    body: Body, rig: Rig, frames: Sequence[SilhouetteFrame], state: BodyState, *,
    sigma: Mapping[str, float] | None = None, levels: Sequence[Level] = LEVELS,
    low_pass: bool = True, settings: TrackSettings | None = None,
) -> FarFit:  # fmt: skip
    """Fit silhouettes of one time from a pose that may be tens of degrees off in every joint.

    Coarse levels reach far, but may leave a pose that is near; so it is begun at every level in turn, with low-pass
    approximations of the surface and without, and what overlaps the silhouettes most is taken.

    Parameters
    ----------
    sigma : {"silhouette CAMERA": standard deviation [px]}, others as in the settings.
    levels : the last one alone is what the tracker does from frame to frame.
    low_pass : whether it is also begun with low-pass approximations of the body's surface (`Morphing.levels`, P1 2.4).

    Raises
    ------
    ObservationError
        No silhouettes, or no levels.
    """
    if not frames or not levels:
        raise ObservationError("no silhouettes to fit, or no levels", remedy="Give those of one camera or more.")
    settings = settings or TrackSettings()
    owns = [
        replace(
            settings, outline=level.side, far=level.far, near=level.near, angle=level.angle,
            iterations=settings.iterations * _PATIENCE,
        )
        for level in levels
    ]  # fmt: skip
    whole = TrackedSurface(body, settings.samples)
    fits = [(FrameFit(body, own), Sensors(rig, 1.0, dict(sigma or {}), own)) for own in owns]
    plain = [Scene(body, state, rig, samples=settings.samples, surface=whole)] * len(levels)
    chains = [(first, plain) for first in range(len(levels) - 1, -1, -1)]
    if low_pass:
        surfaces = [whole.with_shape(shape) for shape in whole.morphing.levels(len(levels))]
        smooth = [Scene(body, state, rig, samples=settings.samples, surface=surface) for surface in surfaces]
        chains += [(first, smooth) for first in range(len(levels) - 2, -1, -1)]
    best: FarFit | None = None
    for first, scenes in chains:
        now = state
        for (fit, sensors), scene in list(zip(fits, scenes))[first:]:
            there = scene.at(now)
            result = fit.run(there, None, sensors.measurements(frames, there)).result
            now = result.state
        there = plain[-1].at(now)
        last = fits[-1][1].measurements(frames, there)
        overlap = float(np.mean([cast(SilhouetteMeasurement, m).overlap(there) for m in last]))
        if best is None or overlap > best.overlap + _GAIN:
            best = FarFit(result, overlap)
    assert best is not None
    return best
