"""Detect swapped labels of a take from distances between markers, and from jumps that a swap would undo.

For a few frames inside a gap they are detected from the motion of the markers around them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from kinefit.solving.functional_joints import nan_median, rigid_frames

MAX_SIGMAS = 5.0
"""Errors of distances are truncated here: a larger one carries no more information."""

TAIL_FACTOR = 1.5
"""Factor on the learnt standard deviations, which come from medians and are too small for the tails."""

MAX_GAP = 10
"""[frames] between two spans of the same kind that are reported as one."""


def place_costs(positions: NDArray, mean: NDArray, deviation: NDArray) -> tuple[NDArray, NDArray]:
    """Cost of giving a point another point's label.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled; NaN where not visible
    mean, deviation : (K, K) [m] of distances; NaN where unknown

    Returns
    -------
    (F, K, K), (F, K, K)
        C[f, i, q]: sum over k, without i and q, of min(((|x_q - x_k| - mean_ik) / deviation_ik)², TRUNCATION_SIGMAS²),
        where k keeps its label; t[f, i, j]: the term of i and j. Zero where a point is not visible.
    """
    frames, count = positions.shape[:2]
    d = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1).astype(np.float32)
    cost = np.zeros((frames, count, count), np.float32)
    own = np.zeros((frames, count, count), np.float32)
    for i in range(count):
        z = (d - mean[i].astype(np.float32)) / (TAIL_FACTOR * deviation[i]).astype(np.float32)  # (F, q, k)
        z = np.fmax(np.minimum(z * z, MAX_SIGMAS**2), np.float32(0.0))  # 0 for what is not seen
        z[:, :, i] = 0.0
        z[:, np.arange(count), np.arange(count)] = 0.0
        cost[:, i] = z.sum(-1)
        own[:, i] = z[:, i]
    return cost, own


def swap_gains(positions: NDArray, mean: NDArray, deviation: NDArray) -> NDArray:
    """(F, K, K) by how much the sum of squares falls if two labels are swapped in a frame; symmetric.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled; NaN where not visible
    mean, deviation : (K, K) [m] of distances
    """
    cost, pair_terms = place_costs(positions, mean, deviation)
    current = np.einsum("fii->fi", cost)
    return current[:, :, None] + current[:, None] - 2 * pair_terms - cost - cost.transpose(0, 2, 1)


def pair_gain(positions: NDArray, i: int, j: int, mean: NDArray, deviation: NDArray) -> NDArray:
    """(F,) by how much the sum of squares falls if labels i and j are swapped; see `swap_gains`."""
    gain = np.zeros(len(positions))
    for a, b in ((i, j), (j, i)):
        d = np.linalg.norm(positions - positions[:, a, None], axis=-1)
        for label, sign in ((a, 1), (b, -1)):
            z = np.nan_to_num(np.minimum(((d - mean[label]) / (TAIL_FACTOR * deviation[label])) ** 2, MAX_SIGMAS**2))
            z[:, [i, j]] = 0.0
            gain += sign * z.sum(1)
    return gain


def best_run(gain: NDArray, least: float) -> tuple[int, int, float]:
    """First and last index, and sum, of the run of `gain` (F,) with the largest sum of gain - least.

    A frame counts at most ten times `least`; both are numbers without unit, as `swap_gains` gives them.
    """
    worth = np.clip(gain - least, -10 * least, 10 * least)
    total = np.concatenate([[0.0], np.cumsum(worth)])
    lowest = np.minimum.accumulate(total)
    last = int(np.argmax(total - lowest))
    first = int(np.argmin(total[: last + 1]))
    return first, last - 1, float(total[last] - total[first])


def find_crossings(
    positions: NDArray, least: float = 0.02, better: float = 0.35
) -> tuple[list[tuple[int, int, int]], NDArray]:
    """Frames at which two trajectories continue where the other one was.

    Each position is predicted from the last two visible ones, over gaps of up to ten frames. Two markers cross if both
    miss their predictions by more than `least` [m], and a swap lowers their total error below the share `better` of it.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled; NaN where not visible

    Returns
    -------
    list, (F, K) bool
        Crossings (frame, i, j), the swap lying between this frame and the last; whether a trajectory jumps, begins or
        ends at a frame.
    """
    frames, count = positions.shape[:2]
    found = []
    broken = np.zeros((frames, count), bool)
    at, speed = positions[0].copy(), np.zeros((count, 3))
    age = np.where(np.isfinite(at[:, 0]), 0, 99)
    for f in range(1, frames):
        current = positions[f]
        predicted = at + speed * (age[:, None] + 1)
        off = np.linalg.norm(current - predicted, axis=-1)
        jumped = np.flatnonzero((off > least) & (age <= 10))
        broken[f, jumped] = True
        broken[f] |= np.isfinite(current[:, 0]) != (age == 0)
        if len(jumped) > 1:
            across = np.linalg.norm(current[jumped] - predicted[jumped][:, None], axis=-1)
            both = across + across.T
            np.fill_diagonal(both, np.inf)
            for a in range(len(jumped)):
                b = int(np.argmin(both[a]))
                if a < b and both[a, b] < better * (across[a, a] + across[b, b]):
                    found.append((f, int(jumped[a]), int(jumped[b])))
        visible = np.isfinite(current[:, 0])
        fresh = visible & (age == 0)
        speed = np.where(fresh[:, None], current - at, np.where(visible[:, None], 0.0, speed))
        for _, i, j in (c for c in found if c[0] == f):
            speed[[i, j]] = 0.0
        at = np.where(visible[:, None], current, at)
        age = np.where(visible, 0, age + 1)
    return found, broken


def interpolate_spans(positions: NDArray, length: int) -> tuple[NDArray, NDArray]:
    """Positions in all spans of `length` frames, measured and interpolated between the frames around each span.

    Parameters
    ----------
    positions : (F, K, 3) [m]; NaN where not visible
    length : number of frames

    Returns
    -------
    (n, length, K, 3), (n, length, K, 3) [m]
    """
    before, after = positions[: -length - 1], positions[length + 1 :]
    interpolated = np.stack([before + (after - before) * (i + 1) / (length + 1) for i in range(length)], axis=1)
    measured = np.stack([positions[i + 1 : len(positions) - length + i] for i in range(length)], axis=1)
    return measured, interpolated


def short_swaps(
    positions: NDArray, longest: int = 2, least: float = 0.02, better: float = 0.35
) -> list[tuple[int, int, int, int]]:
    """Swaps of up to `longest` frames (a, b, first, last), found by interpolation from the frames around them.

    One label is where the other one is expected, and the other label is at the first's place or not visible.

    Parameters
    ----------
    positions : (F, K, 3) [m], labelled; NaN where not visible
    least, better : [m] and share: see `find_crossings`
    """
    found: list[tuple[int, int, int, int]] = []
    taken = np.zeros(positions.shape[:2], bool)
    for length in range(1, longest + 1):
        measured, expected = interpolate_spans(positions, length)
        off = np.linalg.norm(measured - expected, axis=-1).min(axis=1)  # (F, K), NaN where not seen throughout
        for f, a in np.argwhere(off > least).tolist():
            across = np.linalg.norm(measured[f][:, a, None] - expected[f], axis=-1).max(axis=0)
            across[a] = np.inf
            if not np.isfinite(across).any():
                continue
            b = int(np.nanargmin(across))
            missing = not np.isfinite(measured[f][:, b]).any()
            back_error = np.linalg.norm(measured[f][:, b] - expected[f][:, a], axis=-1).max()
            own_error = np.linalg.norm(measured[f][:, b] - expected[f][:, b], axis=-1).min()
            rows = slice(f + 1, f + 1 + length)
            fits = across[b] < better * off[f, a] and (missing or back_error < better * own_error)
            if fits and not taken[rows][:, [a, b]].any():
                taken[rows, a] = taken[rows, b] = True
                found.append((min(a, b), max(a, b), f + 1, f + length))
    return found


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


def gap_swaps(
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
