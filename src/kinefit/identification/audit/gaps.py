"""Labels that change places for a few frames in a gap: no frame beside shows them, so the markers around decide."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.audit.swaps import passing, place_costs
from kinefit.solvers.rigid_clusters import middle, rigid_frames

MAX_ISLAND = 10
"""Frames of a trajectory inside a gap that is judged as a whole; of a longer one, the first and last two are."""

BETTER = 0.4
"""Of the distance to its own place, a label may be off the other's by at most this share. Of 384 exchanges drawn in the
takes of `benchmarks.markers_audit`, 0.35 finds 98.0 % and 0.42 finds 99.2 %; 0.5 invents one in a thousand islands."""

_MAX_ACROSS = 0.04
"""[m] a label may be off the other's place: beyond it, the place itself is carried badly. On a simulated take of which
half is hidden, 0.05 invents no exchange and 0.06 one."""

_MAX_END = 2  # frames of an exchange at the end of a trajectory, or of a leap off it
_CARRIERS = 6  # markers that carry a place: those that keep their distance to it best
_MAX_NEAR = 4  # frames before, and after, from which a place is carried: their median bears one wrong name
_MIN_REST = 50  # frames of a trajectory beside its end: a shorter one may be another label's as a whole
_AT_ONCE = 4096  # places that are carried together
_WINDOW = 64  # frames that are looked through at first
_MAX_OTHERS = 6  # labels that are tried for a point: those that its distances suit best

Exchange = tuple[int, int, int, int]


def exchanges_in_gaps(
    positions: NDArray, mean: NDArray, deviation: NDArray, *, least: float = 0.02
) -> list[Exchange]:
    """Exchanges (a, b, first, last) at the ends of trajectories, inside gaps, and where a label leaps into a gap.

    One label is where the other should be, and the other there, or not seen.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled, NaN where not seen
    mean, deviation : (K, K) [m] of distances
    least : [m] by which a label is off its own place, at least
    """
    places, found = _ExpectedPlaces(positions, deviation), list[Exchange]()
    taken = np.zeros(positions.shape[:2], bool)
    spans = _spans(positions, least)
    places.carry_own(spans)
    for a, first, last in spans:
        rows = slice(first, last + 1)
        if taken[rows, a].any() or not all(off > least for off in places.off(a, a, rows)):
            continue
        suits = place_costs(positions[rows], mean, deviation)[0][:, :, a].sum(axis=0)
        for b in [k for k in np.argsort(suits)[: _MAX_OTHERS + 1].tolist() if k != a][:_MAX_OTHERS]:
            fits = not taken[rows, b].any() and _goes(places, a, b, rows, least)
            if fits and np.isfinite(positions[rows, b]).any():
                fits = _goes(places, b, a, rows)  # not where it is seen in a part of the frames: NaN
            if fits:
                taken[rows, [a, b]] = True
                found.append((min(a, b), max(a, b), first, last))
                break
    return found


def _goes(places: _ExpectedPlaces, a: int, b: int, rows: slice, least: float = 0.0) -> bool:
    """Whether a label is off its own place by more than `least` in all frames, and much nearer to another's."""
    across = []
    for off in places.off(a, b, rows):
        if not off < _MAX_ACROSS:
            return False
        across.append(off)
    own = np.array([*places.off(a, a, rows, b)]).min()
    return bool(own > least and max(across) < BETTER * own)


def _spans(positions: NDArray, least: float) -> list[tuple[int, int, int]]:
    """(label, first, last) of the ends of all trajectories and of short leaps off them, the longer ones first."""
    frames, count = positions.shape[:2]
    edges = np.diff(np.pad(np.isfinite(positions[..., 0]).astype(int), ((1, 1), (0, 0))), axis=0)
    out: set[tuple[int, int, int]] = set()
    for a in range(count):
        for first, end in zip(np.flatnonzero(edges[:, a] > 0).tolist(), np.flatnonzero(edges[:, a] < 0).tolist()):
            if end - first <= min(MAX_ISLAND, frames - 1):
                out.add((a, first, end - 1))
            for length in range(1, min(_MAX_END, end - first) + 1):
                short, later = end - first - length < _MIN_REST, positions[first : first + length + 3, a][::-1]
                if short or _leaves(later, least):
                    out.add((a, first, first + length - 1))
                if short or _leaves(positions[end - length - 3 : end, a], least):
                    out.add((a, end - length, end - 1))
    for length in range(1, _MAX_END + 1):
        here, between = passing(positions, length)
        leaps = np.linalg.norm(here - between, axis=-1).min(axis=1) > least
        out |= {(a, f + 1, f + length) for f, a in np.argwhere(leaps).tolist()}
    return sorted(out, key=lambda span: (span[1] - span[2], span))


def _leaves(x: NDArray, least: float) -> bool:
    """Whether a trajectory (3 + n, 3) [m] may leave its place by more than `least` after three frames.

    A label that is where another should be leaps there, by less than half of that only with its own motion against it.
    """
    speed = (x[2] - x[0]) / 2.0
    return bool((np.linalg.norm(x[3:] - x[2] - np.arange(1, len(x) - 2)[:, None] * speed, axis=1) > 0.5 * least).any())


class _ExpectedPlaces:
    """Where labels should be: carried by the markers around them from the nearest frames that show them.

    Parameters
    ----------
    positions : (F, K, 3) [m]
    deviation : (K, K) [m] of distances
    """

    def __init__(self, positions: NDArray, deviation: NDArray) -> None:
        self.positions, self.deviation, self.seen = positions, deviation, np.isfinite(positions[..., 0])
        known = np.isfinite(deviation).sum(axis=1)
        self.order = [row[:n].tolist() for row, n in zip(np.argsort(deviation, axis=1), known)]  # NaN comes last
        self._carried: dict[tuple[int, ...], NDArray] = {}

    def off(self, label: int, place: int, rows: slice, other: int | None = None) -> Iterator[float]:
        """[m] how far a label is from the place of one, frame after frame; NaN where that is not known.

        Neither these two nor the other carry the place: their names are in question.
        """
        without = {label, place, other}
        for f in range(rows.start, rows.stop):
            yield float(np.linalg.norm(self.positions[f, label] - self._of(place, f, rows, without)))

    def _of(self, label: int, frame: int, rows: slice, without: set[int | None]) -> NDArray:
        """(3,) [m] place of a label in a frame, carried from before and after `rows`: the nearer side counts more."""
        place = self._place(label, frame, rows, without)
        if place is None:
            return np.full(3, np.nan)
        if place not in self._carried:
            self._carry([place])
        return self._carried[place]

    def carry_own(self, spans: list[tuple[int, int, int]]) -> None:
        """Carry the places of all labels in spans (label, first, last), many at a time."""
        asked = (
            self._place(a, f, slice(first, last + 1), {a}) for a, first, last in spans for f in range(first, last + 1)
        )
        places = list(dict.fromkeys(place for place in asked if place is not None))
        for i in range(0, len(places), _AT_ONCE):
            self._carry(places[i : i + _AT_ONCE])

    def _place(self, label: int, frame: int, rows: slice, without: set[int | None]) -> tuple[int, ...] | None:
        """What a place is carried by: label, frame, first and end of the rows, carriers; None with fewer than three."""
        peers = [k for k in self.order[label] if self.seen[frame, k] and k not in without][:_CARRIERS]
        return (label, frame, rows.start, rows.stop, *peers) if len(peers) > 2 else None

    def _carry(self, places: list[tuple[int, ...]]) -> None:
        shape = len(places), 2, _MAX_NEAR
        x, weight = np.zeros((len(places), _CARRIERS, 3)), np.zeros((len(places), _CARRIERS))
        y, at, away = (np.full((*shape, *more), np.nan) for more in ((_CARRIERS, 3), (3,), ()))
        for i, (label, frame, start, stop, *peers) in enumerate(places):
            x[i, : len(peers)] = self.positions[frame, peers]
            weight[i, : len(peers)] = self.deviation[label, peers] ** -2.0 / self.deviation[label, peers].min() ** -2.0
            columns = [label, *peers]
            before = start - 1 - _nearest(self.seen[:start][::-1], columns)
            for side, near in enumerate((before, stop + _nearest(self.seen[stop:], columns))):
                there = self.positions[near][:, columns]
                y[i, side, : len(near), : len(peers)], at[i, side, : len(near)] = there[:, 1:], there[:, 0]
                away[i, side, : len(near)] = near - frame
        each = 2 * _MAX_NEAR
        R, t = rigid_frames(
            np.repeat(x, each, axis=0), y.reshape(-1, _CARRIERS, 3), weight=np.repeat(weight, each, axis=0)
        )
        carried = np.einsum("fji,fj->fi", R, at.reshape(-1, 3) - t).reshape(*shape, 3)
        share = 1.0 / np.abs(middle(away, axis=2))[..., None]
        total = np.nansum(share, axis=1)
        mean = np.nansum(share * middle(carried, axis=2), axis=1) / np.where(total > 0.0, total, np.nan)
        self._carried.update(zip(places, mean))


def _nearest(seen: NDArray, columns: list[int]) -> NDArray:
    """Numbers of the first frames of (F, K) bool in which all these columns are seen, as many as carry a place."""
    reach = _WINDOW
    while True:
        found = np.flatnonzero(seen[:reach, columns].all(axis=1))[:_MAX_NEAR]
        if len(found) == _MAX_NEAR or reach >= len(seen):
            return found
        reach *= 4
