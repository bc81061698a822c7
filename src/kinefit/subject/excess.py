"""Estimate the share of bias in a sensor's error: frames of one take are not independent measurements.

A detector has the same bias in every posture, soft tissue moves with the posture, and a model differs from the person.
A bias does not average out over frames: a bias b common to F frames counts F times as much as jitter of that size. The
excess is the factor by which the variance of all frames together exceeds that of independent errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched
from kinefit.sensors.channel_residuals import ChannelResiduals
from kinefit.solvers.equations import residuals
from kinefit.solvers.trajectory.variance_components import variance_components

_MIN_RESIDUALS = 10  # of a sensor: with fewer its excess is not estimated
_MAX_ABSORBED = 0.75  # share of all biases that parameters of the fit may absorb
_MIN_EXCESS = 1e-3  # reported for a sensor whose residuals are almost zero


@dataclass(frozen=True, eq=False)
class FrameRows:
    """Rows of one measurement of a frame, at the fit.

    Parameters
    ----------
    matched : the measurement's match, with sensor and channels
    rows : its rows, of any kind
    """

    matched: Matched
    rows: Sequence[AnyRows]


def excess(frames: Sequence[Sequence[FrameRows]], followed: float) -> dict[str, float]:
    """{sensor: factor} by which the variance of all frames together exceeds that of their rows.

    The variance of a channel with n rows is that of its jitter plus n times that of its bias. The factor is below 1
    where residuals are smaller than the rows' standard deviations. Channels of points are points along each axis, with
    biases of one size. Channels of surfaces are whole segments, because surface errors are constant over a patch; each
    has a bias of its own size, since segments differ in the number of rows and in their bias.

    Parameters
    ----------
    frames : rows of every measurement of each frame
    followed : number of mean residuals that a fit can make zero: degrees of freedom, and parameters that data determine
    """
    collected, of_points = ChannelResiduals(), dict[str, bool]()
    for f, measured in enumerate(frames):
        for m in measured:
            used = [r.weight > 0.0 if r.weight.ndim == 1 else np.ones(len(r), bool) for r in m.rows]
            collected.add(f, m.matched, m.rows, [residuals(r) for r in m.rows], [w.astype(float) for w in used])
            of_points[m.matched.sensor] = m.matched.of_points
    found = {s: both for s, both in collected.arrays(len(frames)).items() if both[1].sum() >= _MIN_RESIDUALS}
    looks = {
        s: float(count.any(axis=0).sum() if of_points[s] else count.sum() / len(frames))
        for s, (_, count) in found.items()
    }
    absorbed, out = min(followed / max(sum(looks.values()), 1.0), _MAX_ABSORBED), {}
    for s, (values, count) in found.items():
        C = values.shape[1]
        errors = variance_components(values, leverage=np.full(C, absorbed * of_points[s]), group=np.arange(C))
        jitter, bias = (float(np.median(v)) ** 2 for v in (errors.jitter, errors.bias))
        rows = count.sum(axis=0)
        white, constant = jitter * (count**2).sum(), bias * (rows**2).sum()
        if not of_points[s]:
            sums = np.nansum(np.where(errors.outlier[..., None], np.nan, values * count), axis=0)
            constant = max((sums**2).sum() - white, 0.0)
        out[s] = max(float(white + constant) / float(rows.sum()), _MIN_EXCESS)
    return out
