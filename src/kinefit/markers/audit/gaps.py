"""Detect labels that swap for a few frames inside a gap, from the motion of the markers around them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from kinefit.markers.audit.swaps import interpolate_spans, place_costs
from kinefit.solving.functional_joints import nan_median, rigid_frames

MAX_ISLAND_FRAMES = 10
"""Longest piece of a trajectory between two gaps that is judged as a whole; of longer ones only the ends are."""

MAX_DISTANCE_RATIO = 0.4
"""Largest ratio of a label's distance to the other label's place over that to its own place. Of 384 simulated swaps in
the takes of benchmark `markers_audit`, 0.35 finds 98.0 % and 0.42 99.2 %; 0.5 has 0.1 % false positives."""

_MAX_SWAPPED_DISTANCE = 0.04
"""[m] largest distance of a label from the other label's place. On a simulated take with half of the points occluded,
0.05 gives no false positive and 0.06 one."""

_MAX_END_FRAMES = 2  # of a swap at the end of a trajectory, or of a jump away from it
_MAX_CARRIERS = 6  # markers that predict a place: those whose distances to it vary least
_MAX_SIDE_FRAMES = 4  # before, and after, that predict a place: their median tolerates one wrong name
_MIN_REST_FRAMES = 50  # of a trajectory without its end: a shorter one may be wrong as a whole
_BATCH_SIZE = 4096  # places per call
_FIRST_WINDOW_FRAMES = 64  # of the first search; later searches are four times as long
_MAX_CANDIDATES = 6  # labels tried for a point: those that fit its distances best

Swap = tuple[int, int, int, int]


def find_swaps_in_gaps(
    positions: NDArray, mean: NDArray, deviation: NDArray, *, least: float = 0.02
) -> list[Swap]:
    """Find swaps (a, b, first, last) at the ends of trajectories, inside gaps, and where a label jumps into a gap.

    One label is where the other should be, and the other label is at the first's place or not visible.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled; NaN where not visible
    mean, deviation : (K, K) [m] of distances
    least : [m] least distance of a label from its own place
    """
    places, found = _ExpectedPlaces(positions, deviation), list[Swap]()
    taken = np.zeros(positions.shape[:2], bool)
    spans = _spans(positions, least)
    places.carry_own(spans)
    for a, first, last in spans:
        rows = slice(first, last + 1)
        if taken[rows, a].any() or not all(off > least for off in places.off(a, a, rows)):
            continue
        costs = place_costs(positions[rows], mean, deviation)[0][:, :, a].sum(axis=0)
        for b in [k for k in np.argsort(costs)[: _MAX_CANDIDATES + 1].tolist() if k != a][:_MAX_CANDIDATES]:
            fits = not taken[rows, b].any() and _fits_place_of(places, a, b, rows, least)
            if fits and np.isfinite(positions[rows, b]).any():
                fits = _fits_place_of(places, b, a, rows)  # rejected (NaN) if only some frames show it
            if fits:
                taken[rows, [a, b]] = True
                found.append((min(a, b), max(a, b), first, last))
                break
    return found


def _fits_place_of(places: _ExpectedPlaces, a: int, b: int, rows: slice, least: float = 0.0) -> bool:
    """Whether label a is off its own place by more than `least` in all frames, and much nearer to that of b."""
    distances = []
    for off in places.off(a, b, rows):
        if not off < _MAX_SWAPPED_DISTANCE:
            return False
        distances.append(off)
    own_distance = np.array([*places.off(a, a, rows, b)]).min()
    return bool(own_distance > least and max(distances) < MAX_DISTANCE_RATIO * own_distance)


def _spans(positions: NDArray, least: float) -> list[tuple[int, int, int]]:
    """Spans (label, first, last) of the ends of all trajectories and of short jumps, the longest first."""
    frames, count = positions.shape[:2]
    edges = np.diff(np.pad(np.isfinite(positions[..., 0]).astype(int), ((1, 1), (0, 0))), axis=0)
    out: set[tuple[int, int, int]] = set()
    for a in range(count):
        for first, end in zip(np.flatnonzero(edges[:, a] > 0).tolist(), np.flatnonzero(edges[:, a] < 0).tolist()):
            if end - first <= min(MAX_ISLAND_FRAMES, frames - 1):
                out.add((a, first, end - 1))
            for length in range(1, min(_MAX_END_FRAMES, end - first) + 1):
                short, start = end - first - length < _MIN_REST_FRAMES, positions[first : first + length + 3, a][::-1]
                if short or _leaves(start, least):
                    out.add((a, first, first + length - 1))
                if short or _leaves(positions[end - length - 3 : end, a], least):
                    out.add((a, end - length, end - 1))
    for length in range(1, _MAX_END_FRAMES + 1):
        measured, interpolated = interpolate_spans(positions, length)
        jumps = np.linalg.norm(measured - interpolated, axis=-1).min(axis=1) > least
        out |= {(a, f + 1, f + length) for f, a in np.argwhere(jumps).tolist()}
    return sorted(out, key=lambda span: (span[1] - span[2], span))


def _leaves(x: NDArray, least: float) -> bool:
    """Whether a trajectory (3 + n, 3) [m] may leave its place by more than `least` [m] after three frames.

    A swapped label jumps that far; its own motion can hide at most half of the jump.
    """
    speed = (x[2] - x[0]) / 2.0
    return bool((np.linalg.norm(x[3:] - x[2] - np.arange(1, len(x) - 2)[:, None] * speed, axis=1) > 0.5 * least).any())


class _ExpectedPlaces:
    """Expected places of labels, predicted by the markers around them from the nearest frames that show them.

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
        """[m] distance of a label from the expected place of another label, per frame; NaN where that is unknown.

        Neither these two labels nor `other` predict the place, since their names are in question.
        """
        without = {label, place, other}
        for f in range(rows.start, rows.stop):
            yield float(np.linalg.norm(self.positions[f, label] - self._expected_place(place, f, rows, without)))

    def _expected_place(self, label: int, frame: int, rows: slice, without: set[int | None]) -> NDArray:
        """(3,) [m] place of a label in a frame, predicted from before and after `rows`; the nearer side weighs more."""
        key = self._key_of(label, frame, rows, without)
        if key is None:
            return np.full(3, np.nan)
        if key not in self._carried:
            self._carry([key])
        return self._carried[key]

    def carry_own(self, spans: list[tuple[int, int, int]]) -> None:
        """Predict the places of all labels in spans (label, first, last), in batches."""
        keys = (
            self._key_of(a, f, slice(first, last + 1), {a}) for a, first, last in spans for f in range(first, last + 1)
        )
        places = list(dict.fromkeys(key for key in keys if key is not None))
        for i in range(0, len(places), _BATCH_SIZE):
            self._carry(places[i : i + _BATCH_SIZE])

    def _key_of(self, label: int, frame: int, rows: slice, without: set[int | None]) -> tuple[int, ...] | None:
        """Key of a prediction: label, frame, first and end of the rows, carriers; None if fewer than three."""
        peers = [k for k in self.order[label] if self.seen[frame, k] and k not in without][:_MAX_CARRIERS]
        return (label, frame, rows.start, rows.stop, *peers) if len(peers) > 2 else None

    def _carry(self, places: list[tuple[int, ...]]) -> None:
        shape = len(places), 2, _MAX_SIDE_FRAMES
        x, weight = np.zeros((len(places), _MAX_CARRIERS, 3)), np.zeros((len(places), _MAX_CARRIERS))
        y, at, away = (np.full((*shape, *more), np.nan) for more in ((_MAX_CARRIERS, 3), (3,), ()))
        for i, (label, frame, start, stop, *peers) in enumerate(places):
            x[i, : len(peers)] = self.positions[frame, peers]
            weight[i, : len(peers)] = self.deviation[label, peers] ** -2.0 / self.deviation[label, peers].min() ** -2.0
            columns = [label, *peers]
            before = start - 1 - _nearest(self.seen[:start][::-1], columns)
            for side, near in enumerate((before, stop + _nearest(self.seen[stop:], columns))):
                there = self.positions[near][:, columns]
                y[i, side, : len(near), : len(peers)], at[i, side, : len(near)] = there[:, 1:], there[:, 0]
                away[i, side, : len(near)] = near - frame
        each = 2 * _MAX_SIDE_FRAMES
        R, t = rigid_frames(
            np.repeat(x, each, axis=0), y.reshape(-1, _MAX_CARRIERS, 3), weight=np.repeat(weight, each, axis=0)
        )
        carried = np.einsum("fji,fj->fi", R, at.reshape(-1, 3) - t).reshape(*shape, 3)
        share = 1.0 / np.abs(nan_median(away, axis=2))[..., None]
        total = np.nansum(share, axis=1)
        mean = np.nansum(share * nan_median(carried, axis=2), axis=1) / np.where(total > 0.0, total, np.nan)
        self._carried.update(zip(places, mean))


def _nearest(seen: NDArray, columns: list[int]) -> NDArray:
    """Indices of the first frames of (F, K) bool that show all these columns, at most _MAX_SIDE_FRAMES."""
    window = _FIRST_WINDOW_FRAMES
    while True:
        found = np.flatnonzero(seen[:window, columns].all(axis=1))[:_MAX_SIDE_FRAMES]
        if len(found) == _MAX_SIDE_FRAMES or window >= len(seen):
            return found
        window *= 4
