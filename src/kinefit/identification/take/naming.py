"""Names for the pieces of a take: votes of anchor frames, and what distances say for and against them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.frame.beliefs import Beliefs, learn_beliefs
from kinefit.identification.frame.identify import Identification
from kinefit.identification.model.model import MarkerModel
from kinefit.identification.take.consistency import Consistency
from kinefit.identification.take.pieces import Pieces
from kinefit.identification.take.votes import Votes, assign_pieces

Step = Callable[[str, int, int], None]

STRAY, FINE = 5.0, 2.5
"""Deviations by which half of a label's distances are off: where it is in doubt, and up to where it fits."""

SURE = 8.0
"""Weight of votes, two of the surest, with which a name is kept up to twice as far off: a body does bend elsewhere."""

APART = 2.0
"""Deviations by which another label must fit worse, where only distances speak."""

LATELY = 0.5
"""[s] across which the distances of a label to its neighbours are taken as what they were."""


class Naming:
    """A take while its names are found."""

    def __init__(
        self, model: MarkerModel, pieces: Pieces, rate: float, step: Step,
        identify_frame: Callable[[MarkerModel, NDArray, Beliefs | None], Identification],
    ):
        self.reach = max(1, round(LATELY * rate))
        self.model, self.pieces, self.step, self.identify_frame = model, pieces, step, identify_frame
        self.beliefs: Beliefs | None = None
        self.votes = Votes(len(model))
        self.agree = Consistency(model)
        self.rows = pieces.rows()
        self.label = np.full(pieces.count, -1)
        self.sure = np.zeros(pieces.count)
        self.named: list[float] = []  # share of labels found, of each frame asked
        self.found: dict[int, tuple[NDArray, Identification]] = {}

    def ask(self, frames: list[int]) -> None:
        """Identify frames, one by one."""
        done, total = len(self.votes.asked), len(self.votes.asked) + len(frames)
        for f in frames:
            points = self.pieces.points[self.pieces.starts[f] : self.pieces.starts[f + 1]]
            found = self.identify_frame(self.model, points, self.beliefs)
            self.votes.add(self.pieces, f, found)
            self.found[f] = points, found
            self.named.append(float((found.assignment >= 0).sum() / min(len(self.model), len(points))))
            done += 1
            self.step("identifying", done, total)

    def believe(self) -> None:
        """Learn presence and noise from the frames asked so far, and ask them again with that."""
        asked = sorted(self.found)
        self.beliefs = learn_beliefs(self.model, list(self.found.values()))
        self.votes, self.named = Votes(len(self.model)), []
        self.ask(asked)

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
        self.sure *= 1 - self.votes.wrong(self.pieces)
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
        named = np.flatnonzero(self.label >= 0).tolist()
        off = np.full(self.pieces.count, 0.0)
        for p in named:
            own = self.sample(p)
            z = self.agree.misfit(self.pieces.points[own], at[self.pieces.frame[own]], self.label[p])
            off[p] = np.nanmedian(z) if np.isfinite(z).any() else 0.0
            frames = self.pieces.frame[own]
            lately = self.agree.lately(self.pieces.points[own], frames, at, int(self.label[p]), self.reach)
            if lately > STRAY and (best[p] < SURE or self.fits_elsewhere(p, at)):
                off[p] = max(off[p], 2 * lately)
        bad = [p for p in named if off[p] > (STRAY if best[p] < SURE else 2 * STRAY)]
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

    def fits_elsewhere(self, p: int, at: NDArray) -> bool:
        """Whether a piece goes on where another label, free in its frames, has been a moment ago, or will be."""
        frames = self.pieces.frame[self.rows[p]]
        free = np.flatnonzero(~np.isfinite(at[frames, :, 0]).any(0))
        own = self.sample(p)
        points, frames = self.pieces.points[own], self.pieces.frame[own]
        return any(self.agree.lately(points, frames, at, int(m), self.reach) < FINE for m in free)

    def name_rest(self, table: NDArray) -> int:
        """Name pieces by distances alone, where one label fits that is free, and no other does; longest first.

        Only labels that votes found somewhere in the take.
        """
        at, point = self.positions()
        taken, worn = point >= 0, np.zeros(len(self.model), bool)
        worn[self.label[(self.label >= 0) & (table[:, :-1].sum(1) > 0)]] = True
        count = 0
        for p in sorted(np.flatnonzero(self.label < 0).tolist(), key=lambda p: -len(self.rows[p])):
            frames = self.pieces.frame[self.rows[p]]
            free = np.flatnonzero(worn & ~taken[frames].any(0))
            if not len(free):
                continue
            own = self.sample(p)
            z = self.agree.misfits(self.pieces.points[own], at[self.pieces.frame[own]])[:, free]
            told = np.isfinite(z).sum(0) * 2 >= len(own)
            z[:, ~told] = np.inf
            z = np.nanmedian(z, axis=0)
            close = np.flatnonzero(z < STRAY)
            for c in close:
                points, when = self.pieces.points[own], self.pieces.frame[own]
                lately = self.agree.lately(points, when, at, int(free[c]), self.reach)
                z[c] = lately if np.isfinite(lately) else z[c]
            if not len(close):
                continue
            best = int(close[np.argmin(z[close])])
            second = np.delete(z, best).min(initial=np.inf)
            m = int(free[best])
            favoured = table[p, m] > 0.5 * table[p, :-1].sum() > 0
            if z[best] < STRAY and second > z[best] * (1.0 if favoured else 1.5) + (0.0 if favoured else APART):
                self.label[p] = m
                self.sure[p] = 1 / (1 + np.exp(-np.clip(second - z[best], 0, 6)))
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
