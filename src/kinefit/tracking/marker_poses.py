"""Poses of a body that wears markers, frame after frame from one that is found with no pose given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import ObservationError, TrackingError
from kinefit.observations import Markers
from kinefit.solvers.losses import Loss, geman_mcclure
from kinefit.solvers.sequence import fit_sequence
from kinefit.tracking.initialise import pose_from_points

LOSS = geman_mcclure(5.0)
"""Of a marker: three residuals in one, which are 1.7 standard deviations long on average."""

POSTURE = 0.01
"""Share of the posture prior in a frame's fit: enough to decide what the markers leave open."""


def bare(label: str) -> str:
    """A label without its subject's prefix: "Anna:LASI" -> "LASI"."""
    return label.rpartition(":")[2].strip()


def columns(markers: Markers, names: Sequence[str]) -> NDArray:
    """(F, K, 3) [m] the named markers of a recording, NaN for those that it does not have."""
    labels = [bare(n) for n in markers.names]
    twice = sorted({n for n in names if labels.count(n) > 1})
    if twice:
        raise ObservationError(
            f"{len(twice)} labels are there for more than one subject: {', '.join(twice[:6])}",
            file=markers.source or None, remedy="Fit one subject at a time: see `split_people`.",
        )
    out = np.full((len(markers), len(names), 3), np.nan)
    for k, name in enumerate(names):
        if name in labels:
            out[:, k] = markers.positions[:, labels.index(name)]
    return out


def sequence_both_ways(
    body: Body, points: PointSet, x: NDArray, sigma: NDArray, *, loss: Loss = LOSS, limits: bool = True
) -> tuple[NDArray, NDArray]:
    """Roots (F, 4, 4) and angles (F, D) of all frames, from the one that shows most, onwards and backwards.

    Raises
    ------
    TrackingError
        No frame shows enough markers to start from.
    """
    first, state = _start(body, points, x, sigma)
    given: dict[str, Any] = {"sigma": sigma, "loss": loss, "limits": limits, "posture": POSTURE}
    after = fit_sequence(body, state, points, x[first:], **given)
    state = BodyState(after.Ts_world_root[0], after.angles[0])
    before = fit_sequence(body, state, points, x[: first + 1][::-1], **given)
    roots = np.concatenate([before.Ts_world_root[:0:-1], after.Ts_world_root])
    return roots, np.concatenate([before.angles[:0:-1], after.angles])


def _start(body: Body, points: PointSet, x: NDArray, sigma: NDArray) -> tuple[int, BodyState]:
    """The frame to start from, and its state, found with no pose given: the best of a few that show most."""
    seen = np.isfinite(x).all(axis=2)
    count = seen.sum(axis=1)
    most = np.flatnonzero(count >= count.max())
    tries = most[np.unique(np.linspace(0, len(most) - 1, min(len(most), 4)).astype(int))]
    fits = []
    spread = np.maximum(sigma, 0.02)  # [m] wide enough for a start that is far off
    for frame in tries:
        try:
            state, left = pose_from_points(body, points, x[frame], sigma=spread)
        except TrackingError:
            continue
        fits.append((left, int(frame), state))
        if left < 0.03:
            break
    if not fits:
        raise TrackingError(
            f"no frame shows enough markers to start from: {int(count.max(initial=0))} at most",
            remedy="Six markers in one frame are the least.",
        )
    _, frame, state = min(fits, key=lambda f: f[0])
    return frame, state
