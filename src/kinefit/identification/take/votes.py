"""What anchor frames say of pieces of trajectories, and who is who by that."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.frame.identify import Identification
from kinefit.identification.take.pieces import Pieces

MOST = 4.0
"""Weight of the surest vote, -log of its odds to be wrong: errors of one frame are not independent of the next's."""

NOTHING = 1.0
"""Weight of a point that no label is for: it says less than a name, as a body may hide its own points' names."""

CHANGE = 6.0
"""What a change of name within a piece must explain better, as weight: more than one vote, however sure."""


@dataclass(eq=False)
class Votes:
    """Votes of anchor frames, on points.

    Parameters
    ----------
    labels : M
    point, label, weight : of each vote; label M is "none"
    asked : frames that were identified
    """

    labels: int
    point: list[int] = field(default_factory=list)
    label: list[int] = field(default_factory=list)
    weight: list[float] = field(default_factory=list)
    asked: set[int] = field(default_factory=set)

    def add(self, pieces: Pieces, frame: int, found: Identification) -> None:
        """Take in what one frame says."""
        first, last = pieces.starts[frame], pieces.starts[frame + 1]
        guess = found.assignment if found.guess is None else found.guess
        named = np.zeros(last - first, bool)
        for m in np.flatnonzero(guess >= 0):
            named[guess[m]] = True
            sure = float(np.clip(found.confidence[m], 0.0, 1 - np.exp(-MOST)))
            if sure > 0.5:
                self.point.append(int(first + guess[m]))
                self.label.append(int(m))
                self.weight.append(float(np.log(sure / (1 - sure))))
        for i in np.flatnonzero(~named):
            self.point.append(int(first + i))
            self.label.append(self.labels)
            self.weight.append(NOTHING)
        self.asked.add(frame)

    def table(self, pieces: Pieces) -> NDArray:
        """(P, M + 1) sums over each piece; no vote counts for more than votes of this take are right."""
        wrong = self.wrong(pieces)
        most = float(np.clip(np.log((1 - wrong) / wrong), 0.2, MOST))
        out = np.zeros((pieces.count, self.labels + 1))
        np.add.at(out, (pieces.piece[self.point], np.asarray(self.label)), np.minimum(self.weight, most))
        return out

    def wrong(self, pieces: Pieces) -> float:
        """Share of votes that contradict most others of their piece, of pieces with three and more."""
        piece, label = pieces.piece[self.point], np.asarray(self.label)
        names = label < self.labels
        many = names & (np.bincount(piece[names], minlength=pieces.count)[piece] >= 3)
        out = np.zeros((pieces.count, self.labels))
        np.add.at(out, (piece[many], label[many]), np.asarray(self.weight)[many])
        against = label[many] != np.argmax(out[piece[many]], axis=1)
        return float((against.sum() + 0.5) / (many.sum() + 1)) if many.sum() > 20 else 0.01

    def changes(self, pieces: Pieces) -> list[tuple[int, int, int]]:
        """(piece, last point before, first point after) of each change of name within a piece, as votes tell it."""
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
            if gain[best] > CHANGE:
                out.append((int(piece[own[0]]), int(point[own[best]]), int(point[own[best + 1]])))
        return out


def assign_pieces(
    table: NDArray, pieces: Pieces, rows: list[NDArray], share: float = 0.6, least: float = 1.0
) -> NDArray:
    """(P,) label of each piece, -1 for none: the surest first, no label in two places at once.

    Parameters
    ----------
    table : (P, M + 1) votes
    share : of a piece's votes that a label must have; least : weight of them
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
