"""Points in space on which several cameras agree, left-right swaps corrected."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.triangulation import triangulate_robust
from kinefit.sensors.channels import Channels, exchange


def triangulated(channels: Channels, frames: NDArray, *, max_residual_px: float = 30.0) -> NDArray:
    """(F, K, 3) [m] points of some frames on which two cameras agree, NaN elsewhere; see `triangulated_frame`."""
    return np.stack(
        [
            triangulated_frame(channels, channels.uv[f], channels.confidence[f], max_residual_px=max_residual_px)[0]
            for f in frames
        ]
    )


def triangulated_frame(
    channels: Channels, uv: NDArray, confidence: NDArray, *, max_residual_px: float = 30.0
) -> tuple[NDArray, NDArray]:
    """Points (K, 3) [m] of one frame on which two cameras agree, NaN elsewhere; and which sources were exchanged.

    Where exchanging left and right in some sources makes more of them agree, it is done: one source after the other,
    the best first. (Q,) bool says which.
    """
    swapped = np.zeros(len(channels.sources), bool)
    best, support = _agreed(channels, uv, confidence, swapped, max_residual_px)
    while swapped.sum() < (len(swapped) - 1) // 2:
        trials = []
        for q in np.flatnonzero(~swapped):
            trial = swapped.copy()
            trial[q] = True
            trials.append((*_agreed(channels, uv, confidence, trial, max_residual_px), trial))
        x, more, trial = max(trials, key=lambda t: t[1])
        if more < support + 0.02 * len(channels.points):  # for nothing, believe the detector
            break
        best, support, swapped = x, more, trial
    return best, swapped


def rays(channels: Channels, uv: NDArray, seen: NDArray) -> NDArray:
    """(K, 2, 3) origin [m] and direction in the world of a ray on which each point of one frame lies; NaN where unseen.

    Of several cameras that see a point, the last.
    """
    out = np.full((len(channels.points), 2, 3), np.nan)
    for number in np.unique(channels.camera[seen]):
        camera, own = channels.rig.cameras[number], seen & (channels.camera == number)
        out[channels.column[own], 0], out[channels.column[own], 1] = camera.centre_world, camera.ray(uv[own])
    return out


def _agreed(
    channels: Channels, uv: NDArray, confidence: NDArray, swapped: NDArray, limit: float
) -> tuple[NDArray, float]:
    """Triangulated points of one frame, and the confidence of the views that agree, summed by how well they do."""
    uv, confidence = exchange(channels, uv, swapped), exchange(channels, confidence, swapped)
    view = np.full((len(channels.points), len(channels.rig), 2), np.nan)
    trust = np.zeros(view.shape[:2])
    use = np.isfinite(uv).all(axis=1) & (confidence > 0.1)
    view[channels.column[use], channels.camera[use]] = uv[use]
    trust[channels.column[use], channels.camera[use]] = confidence[use]
    x, inliers, residual = triangulate_robust(channels.rig, view, trust, max_residual_px=limit)
    closeness = np.where(inliers, 1.0 - np.square(np.where(inliers, residual, 0.0) / limit), 0.0)
    return x, float(np.sum(closeness * trust))
