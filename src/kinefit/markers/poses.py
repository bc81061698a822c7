"""Poses of a body that wears markers, frame after frame from one that is found with no pose given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.marker_sets import bare, matched
from kinefit.errors import ObservationError, TrackingError
from kinefit.initialization.from_points import pose_from_points
from kinefit.losses import Loss
from kinefit.observations import Markers
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.solvers.sequence import fit_sequence

_FEWEST = 6  # markers of a frame to start from
_ROUGH = 0.03  # [m] how far a body that is not yet the subject's may be off
_NEAR = 0.03  # [m] median distance of a start that needs no other


def columns(markers: Markers, names: Sequence[str]) -> NDArray:
    """(F, K, 3) [m] the named markers of a recording, by the rule for labels; NaN for those that it does not have."""
    meant = matched(markers.names, names)
    exact = [label == bare(n) for n, label in zip(markers.names, meant)]
    where = {n: [i for i, label in enumerate(meant) if label == n] for n in names}
    where = {n: [i for i in own if exact[i]] or own for n, own in where.items()}  # spelt as the set has it comes first
    twice = sorted(n for n, own in where.items() if len(own) > 1)
    if twice:
        raise ObservationError(
            f"{len(twice)} labels are there for more than one subject: {', '.join(twice[:6])}",
            file=markers.source or None, remedy="Fit one subject at a time: see `split_people`.",
        )
    out = np.full((len(markers), len(names), 3), np.nan)
    for k, name in enumerate(names):
        if where[name]:
            out[:, k] = markers.positions[:, where[name][0]]
    return out


def sequence_both_ways(
    body: Body, points: PointSet, x: NDArray, sigma: NDArray, *, loss: Loss = MARKER_LOSS, limits: bool = True
) -> tuple[NDArray, NDArray]:
    """Roots (F, 4, 4) and angles (F, D) of all frames, from the one that shows most, onwards and backwards.

    Raises
    ------
    TrackingError
        No frame shows enough markers to start from.
    """
    first, state = _start(body, points, x, sigma)
    given: dict[str, Any] = {"sigma": sigma, "loss": loss, "limits": limits, "posture": 1.0}
    after = fit_sequence(body, state, points, x[first:], **given)
    state = BodyState(after.Ts_world_root[0], after.angles[0])
    before = fit_sequence(body, state, points, x[: first + 1][::-1], **given)
    roots = np.concatenate([before.Ts_world_root[:0:-1], after.Ts_world_root])
    return roots, np.concatenate([before.angles[:0:-1], after.angles])


def _start(body: Body, points: PointSet, x: NDArray, sigma: NDArray) -> tuple[int, BodyState]:
    """The frame to start from, and its state, found with no pose given: the best of a few that show most."""
    count = np.isfinite(x).all(axis=2).sum(axis=1)
    if not count.max(initial=0) >= _FEWEST:
        raise TrackingError(
            f"no frame shows enough markers to start from: {int(count.max(initial=0))} at most",
            remedy=f"{_FEWEST} markers in one frame are the least.",
        )
    most = np.flatnonzero(count == count.max())
    spread = np.maximum(sigma, _ROUGH)
    best: tuple[float, int, BodyState] | None = None
    for frame in most[np.unique(np.linspace(0, len(most) - 1, min(len(most), 4)).astype(int))]:
        state, left = pose_from_points(body, points, x[frame], sigma=spread)
        if best is None or left < best[0]:
            best = left, int(frame), state
        if left < _NEAR:
            break
    assert best is not None
    return best[1], best[2]
