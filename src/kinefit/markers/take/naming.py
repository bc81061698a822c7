"""Label the pieces of a take by the votes of anchor frames, checked by distances within the body.

Collect the votes of anchor frames on the labels of trajectory pieces, and assign the labels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.markers.frame.tables import Beliefs, Identification, learn_beliefs
from kinefit.markers.model.model import MarkerModel
from kinefit.markers.take._kernels_tracks import link_points
from kinefit.markers.take.consistency import Consistency

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


Step = Callable[[str, int, int], None]

OUTLIER_SIGMAS = 5.0
"""A label is in doubt if the median error of its distances exceeds this."""

INLIER_SIGMAS = 2.5
"""A label fits up to this median error."""

MIN_CERTAIN_WEIGHT = 8.0
"""Weight of votes (two of the largest) with which a label is kept at twice that error: training misses some motions."""

MIN_MARGIN_SIGMAS = 2.0
"""Least margin to the second-best label if there are no votes."""

RECENT_S = 0.5
"""Time over which the distances of a label to its neighbours count as constant."""


class Naming:
    """The state of a take while its pieces are labelled."""

    def __init__(
        self, model: MarkerModel, pieces: Pieces, rate: float, step: Step,
        identify_frame: Callable[[MarkerModel, NDArray, Beliefs | None], Identification],
    ):
        self.reach = max(1, round(RECENT_S * rate))
        self.model, self.pieces, self.step, self.identify_frame = model, pieces, step, identify_frame
        self.beliefs: Beliefs | None = None
        self.votes = Votes(len(model))
        self.consistency = Consistency(model)
        self.rows = pieces.rows()
        self.label = np.full(pieces.count, -1)
        self.confidence = np.zeros(pieces.count)
        self.label_shares: list[float] = []  # share of labels found in each identified frame
        self.found: dict[int, tuple[NDArray, Identification]] = {}

    def identify_frames(self, frames: list[int]) -> None:
        """Identify frames separately and add their votes."""
        done, total = len(self.votes.asked), len(self.votes.asked) + len(frames)
        for f in frames:
            points = self.pieces.points[self.pieces.starts[f] : self.pieces.starts[f + 1]]
            found = self.identify_frame(self.model, points, self.beliefs)
            self.votes.add(self.pieces, f, found)
            self.found[f] = points, found
            self.label_shares.append(float((found.assignment >= 0).sum() / min(len(self.model), len(points))))
            done += 1
            self.step("identifying", done, total)

    def update_beliefs(self) -> None:
        """Learn presence and noise from the frames identified so far, and identify them again."""
        asked = sorted(self.found)
        self.beliefs = learn_beliefs(self.model, list(self.found.values()))
        self.votes, self.label_shares = Votes(len(self.model)), []
        self.identify_frames(asked)

    def cut_changes(self) -> None:
        """Cut pieces whose label changes at the largest jump, after a bisection by further frames."""
        for _ in range(20):
            changes = self.votes.changes(self.pieces)
            if not changes:
                return
            frame = self.pieces.frame
            between = {(frame[a] + frame[b]) // 2 for _, a, b in changes if frame[b] - frame[a] > 4}
            between -= self.votes.asked
            if between:
                self.identify_frames(sorted(int(f) for f in between))
                changes = self.votes.changes(self.pieces)
            piece = self.pieces.piece.copy()
            fresh = self.pieces.count
            for p, a, b in changes:
                if frame[b] - frame[a] > 4 and (frame[a] + frame[b]) // 2 not in self.votes.asked:
                    continue
                own = self.rows[p]
                i, j = np.searchsorted(own, [a, b])
                x = self.pieces.points[own[max(i - 1, 0) : j + 2]]
                jump = np.linalg.norm(x[2:] - 2 * x[1:-1] + x[:-2], axis=1)
                where = min(max(max(i - 1, 0) + 1 + int(np.argmax(jump)), i + 1), j) if len(jump) else j
                piece[own[where:]] = fresh
                fresh += 1
            if fresh == self.pieces.count:
                continue
            self.pieces = self.pieces.cut(piece)
            self.rows = self.pieces.rows()

    def assign_labels(self) -> None:
        """Assign labels by votes, then reject and add labels by distances."""
        table = self.votes.table(self.pieces)
        self.label = assign_pieces(table, self.pieces, self.rows)
        labelled = self.label >= 0
        best = np.where(labelled, table[np.arange(len(table)), self.label], 0.0)
        other_weight = table.sum(1) - best
        self.confidence = np.where(labelled, 1 / (1 + np.exp(-np.clip(best - other_weight, -30, 30))), 0.0)
        self.confidence *= 1 - self.votes.wrong(self.pieces)
        for _ in range(6):
            changed = self.reject_outliers(best) + self.label_by_distances(table)
            if not changed:
                break

    def positions(self) -> tuple[NDArray, NDArray]:
        """(F, M, 3) [m] of the labels, and the index (F, M) of each point, -1 for none."""
        labels = self.label[self.pieces.piece]
        known = np.flatnonzero(labels >= 0)
        point = np.full((self.pieces.frames, len(self.model)), -1)
        point[self.pieces.frame[known], labels[known]] = known
        at = np.where((point >= 0)[..., None], self.pieces.points[point], np.nan)
        return at, point

    def sample(self, p: int, most: int = 40) -> NDArray:
        """Indices (n,) of at most `most` points of a piece, spread over it."""
        own = self.rows[p]
        return own[np.unique(np.linspace(0, len(own) - 1, min(most, len(own))).astype(int))]

    def reject_outliers(self, best: NDArray) -> int:
        """Remove labels that distances contradict, the one with least votes first; returns their number."""
        at, _ = self.positions()
        labelled = np.flatnonzero(self.label >= 0).tolist()
        misfits = np.full(self.pieces.count, 0.0)
        for p in labelled:
            own = self.sample(p)
            z = self.consistency.misfit(self.pieces.points[own], at[self.pieces.frame[own]], self.label[p])
            misfits[p] = np.nanmedian(z) if np.isfinite(z).any() else 0.0
            frames = self.pieces.frame[own]
            recent = self.consistency.recent_misfit(self.pieces.points[own], frames, at, int(self.label[p]), self.reach)
            if recent > OUTLIER_SIGMAS and (best[p] < MIN_CERTAIN_WEIGHT or self.continues_other_label(p, at)):
                misfits[p] = max(misfits[p], 2 * recent)
        bad = [p for p in labelled if misfits[p] > OUTLIER_SIGMAS * (1 if best[p] < MIN_CERTAIN_WEIGHT else 2)]
        dropped: list[int] = []
        for p in sorted(bad, key=lambda p: best[p] / misfits[p]):
            near = set(self.consistency.partners[self.label[p]].tolist())
            frames = self.pieces.frame[self.rows[p]]
            blamed = any(
                self.label[q] in near and self.pieces.frame[self.rows[q][0]] <= frames[-1]
                and self.pieces.frame[self.rows[q][-1]] >= frames[0] for q in dropped
            )
            if not blamed:
                dropped.append(p)
        for p in dropped:
            self.label[p], self.confidence[p] = -1, 0.0
        return len(dropped)

    def continues_other_label(self, p: int, positions: NDArray) -> bool:
        """Whether a piece continues another label that is free in its frames; at (F, M, 3) [m]."""
        frames = self.pieces.frame[self.rows[p]]
        free = np.flatnonzero(~np.isfinite(positions[frames, :, 0]).any(0))
        own = self.sample(p)
        points, frames = self.pieces.points[own], self.pieces.frame[own]
        misfits = (self.consistency.recent_misfit(points, frames, positions, int(m), self.reach) for m in free)
        return any(misfit < INLIER_SIGMAS for misfit in misfits)

    def label_by_distances(self, table: NDArray) -> int:
        """Label pieces (longest first) by distances if exactly one free label fits; returns their number.

        table : (P, M + 1) votes; only labels with votes somewhere in the take are used
        """
        positions, point = self.positions()
        taken, in_take = point >= 0, np.zeros(len(self.model), bool)
        in_take[self.label[(self.label >= 0) & (table[:, :-1].sum(1) > 0)]] = True
        count = 0
        for p in sorted(np.flatnonzero(self.label < 0).tolist(), key=lambda p: -len(self.rows[p])):
            frames = self.pieces.frame[self.rows[p]]
            free = np.flatnonzero(in_take & ~taken[frames].any(0))
            if not len(free):
                continue
            own = self.sample(p)
            z = self.consistency.misfits(self.pieces.points[own], positions[self.pieces.frame[own]])[:, free]
            is_known = np.isfinite(z).sum(0) * 2 >= len(own)
            z[:, ~is_known] = np.inf
            z = np.nanmedian(z, axis=0)
            close = np.flatnonzero(z < OUTLIER_SIGMAS)
            for c in close:
                points, frame_of = self.pieces.points[own], self.pieces.frame[own]
                recent = self.consistency.recent_misfit(points, frame_of, positions, int(free[c]), self.reach)
                z[c] = recent if np.isfinite(recent) else z[c]
            if not len(close):
                continue
            best = int(close[np.argmin(z[close])])
            second = np.delete(z, best).min(initial=np.inf)
            m = int(free[best])
            favoured = table[p, m] > 0.5 * table[p, :-1].sum() > 0
            bound = z[best] if favoured else 1.5 * z[best] + MIN_MARGIN_SIGMAS
            if z[best] < OUTLIER_SIGMAS and second > bound:
                self.label[p] = m
                self.confidence[p] = 1 / (1 + np.exp(-np.clip(second - z[best], 0, 6)))
                positions[frames, m] = self.pieces.points[self.rows[p]]
                taken[frames, m] = True
                count += 1
        return count

    def unknown_frames(self, most: int) -> list[int]:
        """At most `most` frames with missing labels and the most unlabelled pieces without votes."""
        has_votes = np.zeros(self.pieces.count, bool)
        has_votes[self.pieces.piece[self.votes.point]] = True
        _, point = self.positions()
        is_incomplete = (point < 0).any(1)
        out: list[int] = []
        waiting = (self.label < 0) & ~has_votes
        while len(out) < most and waiting.any():
            unlabelled = waiting[self.pieces.piece]
            count = np.bincount(self.pieces.frame[unlabelled], minlength=self.pieces.frames) * is_incomplete
            count[list(self.votes.asked) + out] = 0
            f = int(np.argmax(count))
            if count[f] == 0:
                break
            out.append(f)
            waiting[self.pieces.piece[self.pieces.starts[f] : self.pieces.starts[f + 1]]] = False
        return sorted(out)
