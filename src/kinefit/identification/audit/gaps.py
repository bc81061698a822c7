"""Labels that change places for a few frames in a gap: no frame beside shows them, so the markers around decide."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.audit.swaps import passing, place_costs
from kinefit.solvers.rigid_clusters import rigid_frames

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
    for a, first, last in _spans(positions, least):
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
    own = np.array([*places.off(a, a, rows, b)]).min()
    return bool(own > least) and all(off < min(BETTER * own, _MAX_ACROSS) for off in places.off(a, b, rows))


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
                out |= {(a, first, first + length - 1), (a, end - length, end - 1)}
    for length in range(1, _MAX_END + 1):
        here, between = passing(positions, length)
        leaps = np.linalg.norm(here - between, axis=-1).min(axis=1) > least
        out |= {(a, f + 1, f + length) for f, a in np.argwhere(leaps).tolist()}
    return sorted(out, key=lambda span: (span[1] - span[2], span))


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
        peers = [k for k in self.order[label] if self.seen[frame, k] and k not in without][:_CARRIERS]
        if len(peers) < 3:
            return np.full(3, np.nan)
        key = label, frame, rows.start, rows.stop, *peers  # the same whichever other labels are in question
        if key not in self._carried:
            self._carried[key] = self._by(label, frame, rows, peers)
        return self._carried[key]

    def _by(self, label: int, frame: int, rows: slice, peers: list[int]) -> NDArray:
        """The same, carried by some labels."""
        shown = np.flatnonzero(self.seen[:, [label, *peers]].all(axis=1))
        sides = [shown[shown < rows.start][-_MAX_NEAR:], shown[shown >= rows.stop][:_MAX_NEAR]]
        near = np.concatenate(sides)
        weight = self.deviation[label, peers] ** -2.0
        R, t = rigid_frames(self.positions[frame, peers], self.positions[near][:, peers], weight=weight)
        carried = np.split(np.einsum("fji,fj->fi", R, self.positions[near, label] - t), [len(sides[0])])
        estimates = [(np.median(x, axis=0), 1.0 / abs(np.median(n) - frame)) for x, n in zip(carried, sides) if len(n)]
        if not estimates:
            return np.full(3, np.nan)
        return np.asarray(np.average([x for x, _ in estimates], axis=0, weights=[share for _, share in estimates]))
