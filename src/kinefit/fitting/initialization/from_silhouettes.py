"""Fit silhouettes from a distant pose, coarse to fine in image, correspondences, normals and surface (P1 2.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.fitting.frame.fit import FrameFit
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.frame.routing import Sensors
from kinefit.geometry.camera import Rig
from kinefit.observations import SilhouetteFrame
from kinefit.sensors.regions.silhouette import SilhouetteMeasurement
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.visibility.visibility import TrackedSurface


class Level(NamedTuple):
    """One level of the coarse-to-fine fit.

    Parameters
    ----------
    side : [px] longer side of the image in which contours are compared
    far, near : [m] correspondence distance in the first and in the last iteration
    angle : [rad] largest angle between the normals of a pair
    """

    side: int
    far: float
    near: float
    angle: float


LEVELS = (Level(40, 0.8, 0.4, 1.5), Level(80, 0.5, 0.2, 1.4), Level(160, 0.3, 0.1, 1.2), Level(320, 0.15, 0.03, 1.0))
_MIN_OVERLAP_GAIN = 0.01  # of a coarser start: contours of one pose differ by that between levels
_ITERATION_FACTOR = 3  # on the iterations per frame of a sequence


class FarFit(NamedTuple):
    """Result of the coarse-to-fine fit, and its overlap (0 to 1) with the silhouettes (mean IoU)."""

    result: FrameResult
    overlap: float


def coarse_to_fine(
    body: Body, rig: Rig, frames: Sequence[SilhouetteFrame], state: BodyState, *,
    sigma: Mapping[str, float] | None = None, levels: Sequence[Level] = LEVELS,
    low_pass: bool = True, settings: TrackSettings | None = None,
) -> FarFit:  # fmt: skip
    """Fit silhouettes of one time from a pose that may be tens of degrees off in every joint.

    Coarse levels have a large basin of attraction, but may lose a close pose. So the fit starts at every level in turn,
    with and without low-pass approximations of the surface. The result with the largest overlap is returned.

    Parameters
    ----------
    frames : silhouettes, one or more
    sigma : [px] standard deviations by "silhouette CAMERA"; default: the settings'
    levels : from coarse to fine; the last one is what the tracker does between frames
    low_pass : whether to try low-pass approximations of the body's surface too (`Morphing.levels`, P1 2.4)

    Raises
    ------
    ObservationError
        There are no silhouettes or no levels.
    """
    if not frames or not levels:
        raise ObservationError("no silhouettes to fit, or no levels", remedy="Give silhouettes of one camera or more.")
    settings = settings or TrackSettings()
    level_settings = [
        replace(
            settings, outline=level.side, far=level.far, near=level.near, angle=level.angle,
            iterations=settings.iterations * _ITERATION_FACTOR,
        )
        for level in levels
    ]  # fmt: skip
    whole = TrackedSurface(body, settings.samples)
    fits = [(FrameFit(body, own), Sensors(rig, 1.0, dict(sigma or {}), own)) for own in level_settings]
    full_scenes = [Scene(body, state, rig, samples=settings.samples, surface=whole)] * len(levels)
    chains = [(first, full_scenes) for first in range(len(levels) - 1, -1, -1)]
    if low_pass:
        surfaces = [whole.with_shape(shape) for shape in whole.morphing.levels(len(levels))]
        smooth = [Scene(body, state, rig, samples=settings.samples, surface=surface) for surface in surfaces]
        chains += [(first, smooth) for first in range(len(levels) - 2, -1, -1)]
    best: FarFit | None = None
    for first, scenes in chains:
        current = state
        for (fit, sensors), scene in list(zip(fits, scenes))[first:]:
            scene_at = scene.at(current)
            result = fit.run(scene_at, None, sensors.measurements(frames, scene_at)).result
            current = result.state
        scene_at = full_scenes[-1].at(current)
        last = fits[-1][1].measurements(frames, scene_at)
        overlap = float(np.mean([cast(SilhouetteMeasurement, m).overlap(scene_at) for m in last]))
        if best is None or overlap > best.overlap + _MIN_OVERLAP_GAIN:
            best = FarFit(result, overlap)
    assert best is not None
    return best
