"""Who is who in a whole take of unlabelled markers: anchor frames, spread along trajectories (P5 3, tracking)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.marker_sets import find_marker_set
from kinefit.errors import ObservationError
from kinefit.findings import runs_of
from kinefit.identification.frame.beliefs import Beliefs
from kinefit.identification.frame.identify import Identification, IdentifySettings, identify
from kinefit.identification.model.model import MarkerModel
from kinefit.identification.take.consistency import fill_gaps
from kinefit.identification.take.naming import FINE, STRAY, Naming, Step
from kinefit.identification.take.pieces import find_pieces
from kinefit.observations import Markers

FIRST, TRIAL, FITS = 12, 4, 0.7
"""Frames that are asked first, how many of them before all others, and the share of labels that must be found in half
of them (in one of the trial): a model of another subject finds half at most, and takes long; the right one finds more
than nine in ten."""


ANCHOR = IdentifySettings(searches=6, work=5e7)
"""Of an anchor frame: one that needs more is no good anchor, and there are others."""


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
    ghosts : number of points that are unassigned
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


def identify_anchor(model: MarkerModel, points: NDArray, beliefs: Beliefs | None = None) -> Identification:
    """An anchor frame, as `identify`, but not for long."""
    return identify(model, points, beliefs=beliefs, settings=ANCHOR)


@checked
def identify_take(
    model: MarkerModel, markers: Markers, *, settings: TakeSettings | None = None, progress: Step | None = None,
    identify_frame: Callable[[MarkerModel, NDArray, Beliefs | None], Identification] = identify_anchor,
) -> TakeIdentification:
    """Names for all points of a take, whatever its columns are called and wherever they break.

    Trajectories are followed as far as that is certain. Anchor frames, identified each on its own, vote on the pieces;
    a piece whose votes change has swapped and is cut. Distances within the body then say of every piece whether its
    name fits, and name those that no vote reached; what fits nowhere is a ghost.

    Parameters
    ----------
    progress : (what, done, total) -> None
    identify_frame : model, points (N, 3) [m], what frames have told so far -> Identification

    Raises
    ------
    ObservationError
        No frame shows three points, or the model is of another subject.
    """
    settings = settings or TakeSettings()
    step = progress or (lambda what, done, total: None)
    pieces = find_pieces(markers.positions, markers.rate)
    counts = np.diff(pieces.starts)
    if counts.max(initial=0) < 3:
        raise ObservationError("no frame shows three markers", file=markers.source or None, remedy="Check the take.")
    work = Naming(model, pieces, markers.rate, step, identify_frame)
    anchors = _anchors(counts, max(1, round(settings.every * markers.rate)))
    first = anchors[:: max(1, len(anchors) // FIRST)]
    trial = first[:: max(1, len(first) // TRIAL)]
    work.ask(trial)
    share = max(work.named)
    if share >= FITS:
        work.ask(sorted(set(first) - set(trial)))
        share = float(np.median(work.named))
    if share < FITS:
        raise ObservationError(
            f"the take does not fit the model of {model.name}: {_refusal(work, share)}", file=markers.source or None,
            remedy="Is it the same subject, with the same markers, and the right unit?" + _unknown_set(model),
        )
    work.believe()
    work.ask(sorted(set(anchors) - set(first)))
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
    return _result(work, markers.rate, settings)


def _refusal(work: Naming, share: float) -> str:
    """What the frames that were asked found, and which segments they did not."""
    votes = [label for label in work.votes.label if label < len(work.model)]
    found = np.bincount(votes, minlength=len(work.model)) / max(len(work.named), 1)
    lacking = [n for n, s in zip(work.model.names, work.model.segments) if found[list(s)].mean() < 0.5]
    text = f"in {len(work.named)} frames it finds {100 * share:.0f} % of the labels"
    return f"{text} at most, least of {', '.join(lacking[:6])}{' ...' if len(lacking) > 6 else ''}" if lacking else text


def _unknown_set(model: MarkerModel) -> str:
    """What to do where the segments come from motion alone."""
    if find_marker_set(model.labels) is not None:
        return ""
    return (
        " No set of the catalogue knows its labels, so that its segments may be none: write a set (`kinefit markers "
        "set TAKE -o set.toml`), put it right, and learn with --set set.toml."
    )


def _anchors(counts: NDArray, every: int) -> list[int]:
    """The frame that shows most points in each stretch."""
    best = [a + int(np.argmax(counts[a : a + every])) for a in range(0, len(counts), every)]
    return [f for f in best if counts[f] > 2]


def _result(work: Naming, rate: float, settings: TakeSettings) -> TakeIdentification:
    """All of it, with gaps filled and doubts told."""
    at, point = work.positions()
    seen = point >= 0
    off = work.agree.own(at)
    known = work.sure[work.pieces.piece][point]
    fits = np.exp(-0.5 * np.clip(np.nan_to_num(off) - FINE, 0.0, None) ** 2 / FINE**2)
    confidence = np.where(seen, known * fits, 0.0)
    doubts = list_doubts(work.model.labels, confidence, off, seen, settings.certain)
    filled = np.zeros(seen.shape, bool)
    if settings.fill > 0:
        at, filled = fill_gaps(work.model, at, rate, settings.fill, settings.fill_alone)
    column = np.where(seen, work.pieces.column[point], -1)
    return TakeIdentification(
        work.model.labels, at, confidence, filled, column, tuple(doubts), tuple(sorted(work.votes.asked)),
        int(len(work.pieces.points) - seen.sum()),
    )


def list_doubts(
    labels: tuple[str, ...], confidence: NDArray, off: NDArray, seen: NDArray, certain: float
) -> list[Doubt]:
    """Spans of frames in which a name is not sure, worst first."""
    out = []
    for m, label in enumerate(labels):
        unsure = seen[:, m] & (confidence[:, m] < certain)
        for first, stop in runs_of(unsure, 10):
            last, own = stop - 1, first + np.flatnonzero(unsure[first:stop])
            least = float(confidence[own, m].min())
            stray = float(np.nanmax(np.append(off[own, m], 0.0)))
            kind = "off" if stray > STRAY else "unsure"
            text = f"{label} in frames {first} to {last}: " + (
                f"off its segment by {stray:.0f} deviations" if kind == "off" else f"probability {least:.2f}"
            )
            out.append(Doubt(first, last, label, kind, least, text))
    return sorted(out, key=lambda d: (d.confidence, d.first))
