"""Fit the poses of a body to markers frame by frame, from a frame fitted without initial pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.marker_sets import bare, matched, subject_of
from kinefit.errors import ObservationError, TrackingError
from kinefit.fitting.initialization.from_points import pose_from_points
from kinefit.geometry.losses import Loss
from kinefit.observations import Markers
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.solving.trajectory.sequence import fit_sequence

_MIN_START_MARKERS = 6  # of the first frame
_MIN_START_SIGMA = 0.03  # [m] error of a body that does not have the subject's size yet
_MIN_FALL = 1.0  # of the cost to another, better minimum: less does not distinguish the two ends of a flat one
_GOOD_START_DISTANCE = 0.03  # [m] median distance at which no further start is tried


def columns(markers: Markers, names: Sequence[str]) -> NDArray:
    """(F, K, 3) [m] positions of the named markers of a recording; NaN for markers that it lacks.

    Labels are matched without subject, case and punctuation; exact spelling wins.

    Raises
    ------
    ObservationError
        A label belongs to more than one subject.
    """
    labels_of = matched(markers.names, names)
    is_exact = [label == bare(n) for n, label in zip(markers.names, labels_of)]
    where = {n: [i for i, label in enumerate(labels_of) if label == n] for n in names}
    where = {n: [i for i in candidates if is_exact[i]] or candidates for n, candidates in where.items()}
    duplicates = sorted(n for n, candidates in where.items() if len(candidates) > 1)
    if duplicates:
        raise ObservationError(
            f"{len(duplicates)} labels appear for more than one subject: {', '.join(duplicates[:6])}",
            file=markers.source or None, remedy="Fit one subject at a time: see `split_people`.",
        )
    out = np.full((len(markers), len(names), 3), np.nan)
    for k, name in enumerate(names):
        if where[name]:
            out[:, k] = markers.positions[:, where[name][0]]
    return out


def sequence_both_ways(
    body: Body, points: PointSet, x: NDArray, sigma: NDArray, *, start: BodyState | None = None,
    loss: Loss = MARKER_LOSS,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Roots (F, 4, 4) and angles (F, D) [rad] of all frames, fitted forwards and backwards, each frame's better fit.

    A limb that is in a worse minimum stays there from frame to frame until the minima meet. The fit in the other
    direction enters these frames from their far end, in the better one.

    Parameters
    ----------
    points : K points of the body
    x, sigma : (F, K, 3), (K,) [m] positions, NaN where not visible, and standard deviations
    start : before the first frame; default: fitted without initial pose to the frame that shows most

    Raises
    ------
    TrackingError
        No frame shows enough markers to start from.
    """
    given: dict[str, Any] = {"sigma": sigma, "loss": loss, "posture": 1.0}
    if start is None:
        first, start = _start(body, points, x, sigma)
        start = fit_sequence(body, start, points, x[: first + 1][::-1], **given).last
    ahead = fit_sequence(body, start, points, x, **given)
    back = fit_sequence(body, ahead.last, points, x[::-1], **given)
    better = back.costs[::-1] < ahead.costs - _MIN_FALL
    return (
        np.where(better[:, None, None], back.Ts_world_root[::-1], ahead.Ts_world_root),
        np.where(better[:, None], back.angles[::-1], ahead.angles),
    )


def _start(body: Body, points: PointSet, x: NDArray, sigma: NDArray) -> tuple[int, BodyState]:
    """Index and state of the first frame: the best fit of a few frames with most visible markers."""
    count = np.isfinite(x).all(axis=2).sum(axis=1)
    if not count.max(initial=0) >= _MIN_START_MARKERS:
        raise TrackingError(
            f"no frame shows enough markers to start from: {int(count.max(initial=0))} at most",
            remedy=f"Give at least one frame with {_MIN_START_MARKERS} markers.",
        )
    most = np.flatnonzero(count == count.max())
    spread = np.maximum(sigma, _MIN_START_SIGMA)
    best: tuple[float, int, BodyState] | None = None
    for frame in most[np.unique(np.linspace(0, len(most) - 1, min(len(most), 4)).astype(int))]:
        state, residual = pose_from_points(body, points, x[frame], sigma=spread)
        if best is None or residual < best[0]:
            best = residual, int(frame), state
        if residual < _GOOD_START_DISTANCE:
            break
    assert best is not None
    return best[1], best[2]


MIN_LABELS = 4
"""Least number of a person's labels; fewer belong to an object ("Sync:Sync")."""


@checked
def split_people(markers: Markers) -> dict[str, Markers]:
    """Split markers by person: a dictionary from prefix to markers whose labels have no prefix.

    Without any prefixed person, all labels belong to one person called "". Otherwise the others are excluded.

    Raises
    ------
    ObservationError
        A label appears twice for one person.
    """
    columns: dict[str, list[int]] = {}
    for i, name in enumerate(markers.names):
        columns.setdefault(subject_of(name), []).append(i)
    prefixed = {person: indices for person, indices in columns.items() if person and len(indices) >= MIN_LABELS}
    people = prefixed or {"": list(range(len(markers.names)))}
    out = {}
    for person, indices in people.items():
        labels = tuple(bare(markers.names[i]) for i in indices)
        duplicates = sorted({n for n in labels if labels.count(n) > 1})
        if duplicates:
            raise ObservationError(
                f"labels appear twice{f' for {person}' if person else ''}: {', '.join(duplicates)}",
                file=markers.source or None, remedy="Name every marker of a person once.",
            )
        residual = None if markers.residual is None else markers.residual[:, indices]
        x, others = markers.positions[:, indices], people.keys() - {person}
        events = tuple(event for event in markers.events if event.subject not in others)
        out[person] = replace(markers, names=labels, positions=x, residual=residual, events=events)
    return out
