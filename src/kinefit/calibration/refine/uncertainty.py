"""Uncertainty of refined cameras: random errors from the residuals, systematic errors from a jackknife by segments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.calibration.refine.gauge import aligned, covariance_in_gauge
from kinefit.calibration.refine.sightings import PersonSighting, correlation_time
from kinefit.solvers.bundle.body_bundle import Bundle, BundleState, adjust
from kinefit.solvers.bundle.cameras import CameraPrior, PointPixels, departure
from kinefit.solvers.bundle.shape import PixelFrames, ShapeParameters

_MAX_JACKKNIFE_FRAMES = 40


def chance(bundle: Bundle, prior: CameraPrior, seen: PersonSighting, frames: NDArray) -> NDArray:
    """Covariance (C · 10, C · 10) of the cameras from random errors.

    Their variance and correlation time are those of the residuals without each channel's mean.
    """
    values = seen.trusted
    counts = np.isfinite(values).all(axis=-1).sum(axis=0)
    mean = np.nansum(values, axis=0) / np.maximum(counts, 1)[:, None]
    new = min(1.0, len(values) / max(len(frames), 1) / correlation_time(values - mean))  # independent share of frames
    share = seen.confidence / np.square(seen.channels.sigma)
    power = float(np.nanmean(np.sum((values - mean) ** 2, axis=-1) * share)) / 2.0
    free = prior.freedom.ravel() > 0
    return covariance_in_gauge(bundle.rig, bundle.S * new / max(power, 1e-12), free)


def bias(
    model: ShapeParameters, bundle: Bundle, frames: PixelFrames, prior: CameraPrior, static: PointPixels
) -> NDArray:
    """Covariance (C · 10, C · 10) of the cameras from systematic errors.

    A detector's points are biased against the anatomical ones, differently in each view. Grouped jackknife (M.
    Quenouille, 1956; J. Tukey, 1958): fit the cameras without the points of each segment in turn.
    """
    some = np.unique(np.linspace(0, len(frames.uv) - 1, min(_MAX_JACKKNIFE_FRAMES, len(frames.uv))).astype(int))
    owner = frames.points.segments[frames.column]
    groups = np.unique(owner)

    def fit(start: BundleState, without: int | None) -> Bundle:
        kept = np.ones(len(owner)) if without is None else (owner != without).astype(float)
        velocity = None if frames.velocity is None else frames.velocity[some]
        part = replace(frames, uv=frames.uv[some], weight=frames.weight[some] * kept, velocity=velocity)
        start = replace(start, offsets=bundle.offsets)
        return adjust(
            start, prior, static, model=model, frames=part, max_iterations=6, tolerance=1e-3
        )  # fmt: skip

    whole = fit(replace(bundle, states=[bundle.states[f] for f in some]), None)
    away = []
    for group in groups:
        part = fit(whole, int(group))
        row = departure(aligned(part.rig, whole.rig)[0], whole.rig)
        row[:, -1] = part.offsets - whole.offsets
        away.append(row.ravel())
    spread = np.array(away) - np.mean(away, axis=0)
    return (len(groups) - 1) / len(groups) * spread.T @ spread
