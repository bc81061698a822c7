"""Who is who in a whole take of unlabelled markers: anchor frames, spread along trajectories (P5 3, tracking)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.identification._consistency import Consistency, fill_gaps
from kinefit.identification._pieces import Pieces, find_pieces
from kinefit.identification._votes import Votes, assign_pieces
from kinefit.identification.identify import Identification, identify
from kinefit.identification.model import MarkerModel
from kinefit.observations import Markers

Step = Callable[[str, int, int], None]

STRAY, FINE = 5.0, 2.5
"""Deviations by which half of a label's distances are off: where it is in doubt, and up to where it fits."""

APART = 2.0
"""Deviations by which another label must fit worse, where only distances speak."""


@dataclass(frozen=True)
class TakeSettings:
    """How `identify_take` goes about it.

    Parameters
    ----------
    every : [s] between anchor frames at first
    most : share of the frames that may become anchors, where pieces stay unknown
    rounds : of further anchors
    fill, fill_alone : [s] longest gap that is filled with its segment; from itself. 0: none
    certain : a label less confident is doubtful
    """

    every: float = 0.33
    most: float = 0.15
    rounds: int = 3
    fill: float = 0.5
    fill_alone: float = 0.1
    certain: float = 0.9


@dataclass(frozen=True)
class Doubt:
    """Frames that someone should look at.

    Parameters
    ----------
    first, last : numbers of the frames, counted from 0, both included
    label : of the marker
    kind : "unsure" (name), "off" (its segment)
    confidence : the least in these frames
    text : the same as a sentence
    """

    first: int
    last: int
    label: str
    kind: str
    confidence: float
    text: str


@dataclass(frozen=True, eq=False)
class TakeIdentification:
    """A take with names.

    Parameters
    ----------
    labels : (M,) of the model
    positions : (F, M, 3) [m]; NaN where a label is not seen or not known
    confidence : (F, M) probability of each name; 0 where there is none
    filled : (F, M) bool, positions that were not measured
    column : (F, M) int, which column of the take each is; -1 where none
    doubts : worst first
    anchors : frames that were identified one by one
    ghosts : number of points that are nobody's
    """

    labels: tuple[str, ...]
    positions: NDArray
    confidence: NDArray
    filled: NDArray
    column: NDArray
    doubts: tuple[Doubt, ...]
    anchors: tuple[int, ...]
    ghosts: int

    def markers(self, like: Markers) -> Markers:
        """As markers with labels, with rate, unit, events of the take that they were found in."""
        residual = None
        if like.residual is not None:
            rows = np.arange(len(self.column))[:, None]
            residual = np.where(self.column >= 0, like.residual[rows, self.column], 0.0)
        return replace(like, names=self.labels, positions=self.positions, residual=residual)


def identify_take(
    model: MarkerModel, markers: Markers, *, settings: TakeSettings | None = None, progress: Step | None = None,
    identify_frame: Callable[[MarkerModel, NDArray], Identification] = identify,
) -> TakeIdentification:
    """Names for all points of a take, whatever its columns are called and wherever they break.

    Trajectories are followed as far as that is certain. Anchor frames, identified each on its own, vote on the pieces;
    a piece whose votes change has swapped and is cut. Distances within the body then say of every piece whether its
    name fits, and name those that no vote reached; what fits nowhere is a ghost.

    Parameters
    ----------
    progress : (what, done, total) -> None
    identify_frame : model, points (N, 3) [m] -> Identification

    Raises
    ------
    ObservationError
        No frame shows three points, or no name was found at all.
    """
    settings = settings or TakeSettings()
    step = progress or (lambda what, done, total: None)
    pieces = find_pieces(markers.positions, markers.rate)
    counts = np.diff(pieces.starts)
    if counts.max(initial=0) < 3:
        raise ObservationError("no frame shows three markers", file=markers.source or None, remedy="Check the take.")
    work = _Work(model, pieces, identify_frame, step)
    work.ask(_anchors(counts, max(1, round(settings.every * markers.rate))))
    budget = max(20, int(settings.most * len(markers)))
    for _ in range(settings.rounds):
        work.cut_changes()
        work.settle()
        more = work.unknown_frames(min(budget - len(work.votes.asked), max(10, len(work.votes.asked))))
        if not more:
            break
        work.ask(more)
    work.cut_changes()
    work.settle()
    if (work.label < 0).all():
        raise ObservationError(
            f"none of {len(work.votes.asked)} frames fits the model of {model.name}", file=markers.source or None,
            remedy="Is it the same subject, with the same markers, and the right unit?",
        )
    return work.result(markers.rate, settings)


def _anchors(counts: NDArray, every: int) -> list[int]:
    """The frame that shows most points in each stretch."""
    return [a + int(np.argmax(counts[a : a + every])) for a in range(0, len(counts), every) if counts[a : a + every].max() > 2]


class _Work:
    """A take while its names are found."""

    def __init__(
        self, model: MarkerModel, pieces: Pieces, identify_frame: Callable[[MarkerModel, NDArray], Identification], step: Step
    ):
        self.model, self.pieces, self.step, self.identify_frame = model, pieces, step, identify_frame
        self.votes = Votes(len(model))
        self.agree = Consistency(model)
        self.rows = pieces.rows()
        self.label = np.full(pieces.count, -1)
        self.sure = np.zeros(pieces.count)

    def ask(self, frames: list[int]) -> None:
        """Identify frames, one by one."""
        done, total = len(self.votes.asked), len(self.votes.asked) + len(frames)
        for f in frames:
            points = self.pieces.points[self.pieces.starts[f] : self.pieces.starts[f + 1]]
            self.votes.add(self.pieces, f, self.identify_frame(self.model, points))
            done += 1
            self.step("identifying", done, total)

    def cut_changes(self) -> None:
        """Cut pieces whose name changes, asking frames between until it is known when, and where it jumps there."""
        for _ in range(20):
            changes = self.votes.changes(self.pieces)
            if not changes:
                return
            frame = self.pieces.frame
            between = {(frame[a] + frame[b]) // 2 for _, a, b in changes if frame[b] - frame[a] > 4}
            between -= self.votes.asked
            if between:
                self.ask(sorted(int(f) for f in between))
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
                if frame[b] - frame[a] > 4 and {(frame[a] + frame[b]) // 2} - self.votes.asked:
                    continue
                piece[own[where:]] = fresh
                fresh += 1
            if fresh == self.pieces.count:
                continue
            self.pieces = self.pieces.cut(piece)
            self.rows = self.pieces.rows()

    def settle(self) -> None:
        """Names by votes; then what distances say for and against them."""
        table = self.votes.table(self.pieces)
        self.label = assign_pieces(table, self.pieces, self.rows)
        named = self.label >= 0
        best = np.where(named, table[np.arange(len(table)), self.label], 0.0)
        rest = table.sum(1) - best
        self.sure = np.where(named, 1 / (1 + np.exp(-np.clip(best - rest, -30, 30))), 0.0)
        for _ in range(6):
            changed = self.drop_strays(best) + self.name_rest(table)
            if not changed:
                break

    def positions(self) -> tuple[NDArray, NDArray]:
        """(F, M, 3) [m] of the labels, and the point (F, M) each is, -1 where none."""
        labels = self.label[self.pieces.piece]
        known = np.flatnonzero(labels >= 0)
        point = np.full((self.pieces.frames, len(self.model)), -1)
        point[self.pieces.frame[known], labels[known]] = known
        at = np.where((point >= 0)[..., None], self.pieces.points[point], np.nan)
        return at, point

    def sample(self, p: int, most: int = 40) -> NDArray:
        """Points of a piece, spread over it."""
        own = self.rows[p]
        return own[np.unique(np.linspace(0, len(own) - 1, min(most, len(own))).astype(int))]

    def drop_strays(self, best: NDArray) -> int:
        """Take away names that the distances speak against: of those that blame each other, the least voted for."""
        at, _ = self.positions()
        named = np.flatnonzero(self.label >= 0)
        off = np.full(self.pieces.count, 0.0)
        for p in named:
            own = self.sample(p)
            z = self.agree.misfit(self.pieces.points[own], at[self.pieces.frame[own]], self.label[p])
            off[p] = np.nanmedian(z) if np.isfinite(z).any() else 0.0
        bad = [p for p in named if off[p] > STRAY]
        dropped: list[int] = []
        for p in sorted(bad, key=lambda p: best[p] / off[p]):
            near = set(self.agree.who[self.label[p]].tolist())
            frames = self.pieces.frame[self.rows[p]]
            blamed = any(
                self.label[q] in near and self.pieces.frame[self.rows[q][0]] <= frames[-1]
                and self.pieces.frame[self.rows[q][-1]] >= frames[0] for q in dropped
            )
            if not blamed:
                dropped.append(p)
        for p in dropped:
            self.label[p], self.sure[p] = -1, 0.0
        return len(dropped)

    def name_rest(self, table: NDArray) -> int:
        """Name pieces by distances alone, where one label fits that is free, and no other does; longest first."""
        at, point = self.positions()
        taken = point >= 0
        count = 0
        for p in sorted(np.flatnonzero(self.label < 0), key=lambda p: -len(self.rows[p])):
            own = self.rows[p]
            free = np.flatnonzero(~taken[self.pieces.frame[own]].any(0))
            if not len(free):
                continue
            own = self.sample(p)
            z = self.agree.misfits(self.pieces.points[own], at[self.pieces.frame[own]])
            z = np.where(np.isfinite(z).sum(0) * 2 >= len(own), np.nanmedian(z, axis=0), np.inf)
            z[np.setdiff1d(np.arange(len(z)), free)] = np.inf
            order = np.argsort(z)
            m = int(order[0])
            second = z[order[1]] if len(order) > 1 else np.inf
            favoured = table[p, m] > 0.5 * table[p, : len(self.model)].sum() > 0
            if z[m] < FINE and (second > z[m] + APART or (favoured and second > z[m])):
                self.label[p] = m
                self.sure[p] = 1 / (1 + np.exp(-np.clip(second - z[m], 0, 6)))
                frames = self.pieces.frame[self.rows[p]]
                at[frames, m] = self.pieces.points[self.rows[p]]
                taken[frames, m] = True
                count += 1
        return count

    def unknown_frames(self, most: int) -> list[int]:
        """Frames in which most unnamed points are that no frame was asked for, while labels are missing there."""
        asked = np.zeros(self.pieces.count, bool)
        asked[self.pieces.piece[self.votes.point]] = True
        _, point = self.positions()
        lacking = (point < 0).any(1)
        out: list[int] = []
        waiting = (self.label < 0) & ~asked
        while len(out) < most and waiting.any():
            here = waiting[self.pieces.piece]
            count = np.bincount(self.pieces.frame[here], minlength=self.pieces.frames) * lacking
            count[list(self.votes.asked) + out] = 0
            f = int(np.argmax(count))
            if count[f] == 0:
                break
            out.append(f)
            waiting[self.pieces.piece[self.pieces.starts[f] : self.pieces.starts[f + 1]]] = False
        return sorted(out)

    def result(self, rate: float, settings: TakeSettings) -> TakeIdentification:
        """All of it, with gaps filled and doubts told."""
        at, point = self.positions()
        seen = point >= 0
        off = self.agree.own(at)
        known = self.sure[self.pieces.piece][point]
        fits = np.exp(-0.5 * np.clip(np.nan_to_num(off) - FINE, 0.0, None) ** 2 / FINE**2)
        confidence = np.where(seen, known * fits, 0.0)
        doubts = list_doubts(self.model.labels, confidence, off, seen, settings.certain)
        filled = np.zeros(seen.shape, bool)
        if settings.fill > 0:
            at, filled = fill_gaps(self.model, at, rate, settings.fill, settings.fill_alone)
        column = np.where(seen, self.pieces.column[point], -1)
        return TakeIdentification(
            self.model.labels, at, confidence, filled, column, tuple(doubts), tuple(sorted(self.votes.asked)),
            int(len(self.pieces.points) - seen.sum()),
        )


def list_doubts(labels: tuple[str, ...], confidence: NDArray, off: NDArray, seen: NDArray, certain: float) -> list[Doubt]:
    """Spans of frames in which a name is not sure, worst first."""
    out = []
    for m, label in enumerate(labels):
        unsure = seen[:, m] & (confidence[:, m] < certain)
        at = np.flatnonzero(unsure)
        for own in np.split(at, np.flatnonzero(np.diff(at) > 10) + 1):
            if not len(own):
                continue
            first, last, least = int(own[0]), int(own[-1]), float(confidence[own, m].min())
            stray = float(np.nanmax(np.append(off[own, m], 0.0)))
            kind = "off" if stray > STRAY else "unsure"
            text = f"{label} in frames {first} to {last}: " + (
                f"off its segment by {stray:.0f} deviations" if kind == "off" else f"probability {least:.2f}"
            )
            out.append(Doubt(first, last, label, kind, least, text))
    return sorted(out, key=lambda d: (d.confidence, d.first))
