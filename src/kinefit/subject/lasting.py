"""How much of a sensor's error lasts from frame to frame: frames of one take are not independent looks.

A detector errs in the same place for every posture alike, skin and soft parts slide with it, a model is not the person.
What lasts does not average out over the frames: a bias b that F frames have in common counts F times as much as jitter
of that size. That ratio is by how much the data of all frames say less than they seem to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched
from kinefit.sensors.channel_residuals import ChannelResiduals
from kinefit.solvers.bundle.whitened import residuals
from kinefit.solvers.trajectory.variance_components import variance_components

_MIN_RESIDUALS = 10  # of a sensor, below which nothing is said of their errors
_MAX_FOLLOWED = 0.75  # share of all lasting errors that a fit may be thought to follow
_MIN_EXCESS = 1e-3  # that is reported, of a sensor whose residuals are all but zero


@dataclass(frozen=True, eq=False)
class Seen:
    """Rows of one measurement of a frame, at the fit.

    Parameters
    ----------
    matched : with its sensor and channels
    rows : its rows, of any kind
    """

    matched: Matched
    rows: Sequence[AnyRows]


def excess(frames: Sequence[Sequence[Seen]], followed: float) -> dict[str, float]:
    """{sensor: factor} by which the variance of what all frames measure together is larger than rows say.

    It is that of a channel's jitter, and n times that of its bias, where n rows of it were seen. Below 1 where rows
    state more than is left over. Channels are points along each axis, whose biases are alike; of surfaces whole
    segments, because their errors last over a patch, and each counts with its own bias: one of many rows is seen well,
    and the bias of a hand is not that of a thigh.

    Parameters
    ----------
    frames : what every frame's sensors saw
    followed : number of mean residuals that a fit can make zero: degrees of freedom, and parameters that data give.
    """
    collected, of_points = ChannelResiduals(), dict[str, bool]()
    for f, several in enumerate(frames):
        for one in several:
            felt = [r.weight > 0.0 if r.weight.ndim == 1 else np.ones(len(r), bool) for r in one.rows]
            collected.add(f, one.matched, one.rows, [residuals(r) for r in one.rows], [w.astype(float) for w in felt])
            of_points[one.matched.sensor] = one.matched.of_points
    found = {s: both for s, both in collected.arrays(len(frames)).items() if both[1].sum() >= _MIN_RESIDUALS}
    looks = {
        s: float(count.any(axis=0).sum() if of_points[s] else count.sum() / len(frames))
        for s, (_, count) in found.items()
    }
    hidden, out = min(followed / max(sum(looks.values()), 1.0), _MAX_FOLLOWED), {}
    for s, (values, count) in found.items():
        C = values.shape[1]
        errors = variance_components(values, leverage=np.full(C, hidden * of_points[s]), group=np.arange(C))
        jitter, bias = (float(np.median(v)) ** 2 for v in (errors.jitter, errors.bias))
        rows = count.sum(axis=0)
        fresh, lasting = jitter * (count**2).sum(), bias * (rows**2).sum()
        if not of_points[s]:
            sums = np.nansum(np.where(errors.outlier[..., None], np.nan, values * count), axis=0)
            lasting = max((sums**2).sum() - fresh, 0.0)
        out[s] = max(float(fresh + lasting) / float(rows.sum()), _MIN_EXCESS)
    return out
