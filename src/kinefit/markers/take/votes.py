"""Collect the votes of anchor frames on the labels of trajectory pieces, and assign the labels."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.markers.frame.identify import Identification
from kinefit.markers.take._kernels_tracks import link_points

MAX_ACCELERATION = 250.0
"""[m/s²] of a marker: reached at heel strike in a sprint."""

MAX_NOISE = 0.005
"""[m] largest measurement error of a point between frames."""

MAX_RELATIVE_SPEED = 3.0
"""[m/s] of a marker relative to its neighbours."""

MAX_SPEED = 15.0
"""[m/s] of a marker without known motion: feet of a sprinter."""

MAX_VOTE_WEIGHT = 4.0
"""Largest weight of a vote, -log of its odds to be wrong: errors of consecutive frames are correlated."""

NONE_WEIGHT = 1.0
"""Weight of a vote for no label: it is weaker evidence, as true labels may be missed."""

MIN_CHANGE_WEIGHT = 6.0
"""Least gain of a change of label within a piece, as weight: more than one vote can have."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """The points of a take, each assigned to a piece of a trajectory.

    Parameters
    ----------
    points : (T, 3) [m] all measured points, frame by frame
    frame, column, piece : (T,) int of each point
    starts : (F + 1,) int, first point of each frame
    count : number of pieces
    """

    points: NDArray
    frame: NDArray
    column: NDArray
    piece: NDArray
    starts: NDArray
    count: int

    @property
    def frames(self) -> int:
        """Number of frames of the take."""
        return len(self.starts) - 1

    def rows(self) -> list[NDArray]:
        """For each piece the indices (n,) of its points, in the order of frames."""
        order = np.argsort(self.piece, kind="stable")
        return np.split(order, np.searchsorted(self.piece[order], np.arange(1, self.count)))

    def cut(self, piece: NDArray) -> Pieces:
        """Assign the points to other pieces: `piece` (T,) int, numbered arbitrarily."""
        _, numbers = np.unique(piece, return_inverse=True)
        return Pieces(self.points, self.frame, self.column, numbers, self.starts, int(numbers.max(initial=-1)) + 1)


def find_pieces(positions: NDArray, rate: float) -> Pieces:
    """Split columns (F, N, 3) [m] at gaps and jumps, and join them across columns; rate in [Hz]."""
    frame, column = np.nonzero(np.isfinite(positions).all(-1))
    points = np.ascontiguousarray(positions[frame, column])
    starts = np.searchsorted(frame, np.arange(len(positions) + 1))
    piece = np.zeros(len(points), np.int64)
    tolerance = MAX_ACCELERATION / rate**2 + MAX_NOISE
    first, second = tolerance + MAX_SPEED / rate, tolerance + MAX_RELATIVE_SPEED / rate
    count = link_points(points, starts, column.astype(np.int64), first, second, tolerance, piece)
    return Pieces(points, frame, column, piece, starts, int(count))


@dataclass(eq=False)
class Votes:
    """Votes of anchor frames on the labels of points.

    Parameters
    ----------
    labels : M
    point, label, weight : of each vote; label M means none
    asked : identified frames
    """

    labels: int
    point: list[int] = field(default_factory=list)
    label: list[int] = field(default_factory=list)
    weight: list[float] = field(default_factory=list)
    asked: set[int] = field(default_factory=set)

    def add(self, pieces: Pieces, frame: int, found: Identification) -> None:
        """Add the votes of one frame."""
        first, last = pieces.starts[frame], pieces.starts[frame + 1]
        guess = found.assignment if found.guess is None else found.guess
        named = np.zeros(last - first, bool)
        for m in np.flatnonzero(guess >= 0):
            named[guess[m]] = True
            probability = float(np.clip(found.confidence[m], 0.0, 1 - np.exp(-MAX_VOTE_WEIGHT)))
            if probability > 0.5:
                self.point.append(int(first + guess[m]))
                self.label.append(int(m))
                self.weight.append(float(np.log(probability / (1 - probability))))
        for i in np.flatnonzero(~named):
            self.point.append(int(first + i))
            self.label.append(self.labels)
            self.weight.append(NONE_WEIGHT)
        self.asked.add(frame)

    def table(self, pieces: Pieces) -> NDArray:
        """(P, M + 1) sums of weights per piece and label; limited by the share of correct votes in this take."""
        wrong = self.wrong(pieces)
        most = float(np.clip(np.log((1 - wrong) / wrong), 0.2, MAX_VOTE_WEIGHT))
        out = np.zeros((pieces.count, self.labels + 1))
        np.add.at(out, (pieces.piece[self.point], np.asarray(self.label)), np.minimum(self.weight, most))
        return out

    def wrong(self, pieces: Pieces) -> float:
        """Share (0 to 1) of votes that contradict the majority of their piece, in pieces with three or more votes."""
        piece, label = pieces.piece[self.point], np.asarray(self.label)
        names = label < self.labels
        counted = names & (np.bincount(piece[names], minlength=pieces.count)[piece] >= 3)
        out = np.zeros((pieces.count, self.labels))
        np.add.at(out, (piece[counted], label[counted]), np.asarray(self.weight)[counted])
        against = label[counted] != np.argmax(out[piece[counted]], axis=1)
        return float((against.sum() + 0.5) / (counted.sum() + 1)) if counted.sum() > 20 else 0.01

    def changes(self, pieces: Pieces) -> list[tuple[int, int, int]]:
        """(piece, last point before, first point after) of each change of label within a piece."""
        piece, point = pieces.piece[self.point], np.asarray(self.point)
        label, weight = np.asarray(self.label), np.asarray(self.weight)
        order = np.lexsort((pieces.frame[point], piece))
        out = []
        for own in np.split(order, np.flatnonzero(np.diff(piece[order])) + 1):
            own = own[label[own] < self.labels]
            if len(np.unique(label[own])) < 2:
                continue
            scores = np.zeros((len(own), self.labels))
            scores[np.arange(len(own)), label[own]] = weight[own]
            sums = np.cumsum(scores, axis=0)
            gain = sums[:-1].max(1) + (sums[-1] - sums[:-1]).max(1) - sums[-1].max()
            best = int(np.argmax(gain))
            if gain[best] > MIN_CHANGE_WEIGHT:
                out.append((int(piece[own[0]]), int(point[own[best]]), int(point[own[best + 1]])))
        return out


def assign_pieces(
    table: NDArray, pieces: Pieces, rows: list[NDArray], share: float = 0.6, least: float = 1.0
) -> NDArray:
    """(P,) label of each piece, -1 for none: assigned in order of weight, each label once per frame.

    Parameters
    ----------
    table : (P, M + 1) sums of weights
    rows : points of each piece
    share : least share (0 to 1) of a piece's weight for its label
    least : least weight of a label
    """
    labels = table.shape[1] - 1
    total = np.maximum(table.sum(1), 1e-9)
    taken = np.zeros((pieces.frames, labels), bool)
    out = np.full(pieces.count, -1)
    best = np.argmax(table[:, :labels], axis=1)
    weight = table[np.arange(pieces.count), best]
    for p in np.argsort(-weight, kind="stable"):
        if weight[p] < max(least, share * total[p]):
            continue
        frames = pieces.frame[rows[p]]
        if not taken[frames, best[p]].any():
            out[p] = best[p]
            taken[frames, best[p]] = True
    return out
