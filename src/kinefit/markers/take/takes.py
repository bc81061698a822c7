"""Who is who in a whole take of unlabelled markers: anchor frames, spread along trajectories (P5 3, tracking)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.marker_sets import find_marker_set
from kinefit.errors import ObservationError, located
from kinefit.findings import runs_of
from kinefit.markers.frame.identify import IdentifySettings, identify
from kinefit.markers.frame.tables import Beliefs, Identification
from kinefit.markers.model.model import MarkerModel, load_model
from kinefit.markers.take.consistency import Consistency, fill_gaps
from kinefit.markers.take.naming import INLIER_SIGMAS, OUTLIER_SIGMAS, Naming, Step, find_pieces
from kinefit.observations import Markers
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations

FIRST_FRAMES = 12
"""Frames that are identified first, to check the model."""

TRIAL_FRAMES = 4
"""The first of these; with a wrong model, which is slow, only these."""

MIN_LABEL_SHARE = 0.7
"""Share of labels that one trial frame and half of the first frames must show. Another subject's model finds at most
half of the labels, the right one more than 90 %."""

ANCHOR_SETTINGS = IdentifySettings(searches=6, work=5e7)
"""Limits for an anchor frame: one that needs more is replaced by others."""


@dataclass(frozen=True)
class TakeSettings:
    """Settings of `identify_take`.

    Parameters
    ----------
    every : [s] between the first anchor frames
    most : largest share of the frames, 0 to 1, that become anchors if pieces stay unknown
    rounds : number of rounds with further anchors
    fill, fill_alone : [s] longest gap filled by its segment; by a cubic. 0: none
    certain : least confidence, 0 to 1, of a label without doubt
    """

    every: float = 0.33
    most: float = 0.15
    rounds: int = 3
    fill: float = 0.5
    fill_alone: float = 0.1
    certain: float = 0.9


@dataclass(frozen=True)
class Doubt:
    """Frames with a doubtful label.

    Parameters
    ----------
    first, last : first and last frame, counted from 0
    label : of the marker
    kind : "unsure" (low probability) or "off" (its segment)
    confidence : the least in these frames, 0 to 1
    text : the doubt as a sentence
    """

    first: int
    last: int
    label: str
    kind: str
    confidence: float
    text: str


@dataclass(frozen=True, eq=False)
class TakeIdentification:
    """A labelled take.

    Parameters
    ----------
    labels : (M,) of the model
    positions : (F, M, 3) [m]; NaN where a label is not visible or unknown
    confidence : (F, M) probability of each label, 0 to 1; 0 without one
    filled : (F, M) bool, interpolated positions
    column : (F, M) int, column of the take; -1 for none
    doubts : the worst first
    anchors : frames that were identified separately
    ghosts : number of unassigned points
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
        """Labelled markers with the rate, unit and events of `like`, the take before labelling."""
        residual = None
        if like.residual is not None:
            rows = np.arange(len(self.column))[:, None]
            residual = np.where(self.column >= 0, like.residual[rows, self.column], 0.0)
        return replace(like, names=self.labels, positions=self.positions, residual=residual)


def identify_anchor(model: MarkerModel, points: NDArray, beliefs: Beliefs | None = None) -> Identification:
    """Identify the points (N, 3) [m] of an anchor frame: `identify` with less work."""
    return identify(model, points, beliefs=beliefs, settings=ANCHOR_SETTINGS)


@checked
def identify_take(
    model: MarkerModel, markers: Markers, *, settings: TakeSettings | None = None, progress: Step | None = None,
    identify_frame: Callable[[MarkerModel, NDArray, Beliefs | None], Identification] = identify_anchor,
) -> TakeIdentification:
    """Label all points of a take, whatever the names of its columns and wherever trajectories break.

    Trajectories are split into pieces that certainly belong to one marker. Anchor frames are identified separately and
    vote on the pieces; a piece is cut where its votes change. Distances within the body then confirm or reject each
    label, and label pieces without votes. Points that fit no label are ghosts.

    Parameters
    ----------
    progress : (what, done, total) -> None
    identify_frame : (model, points (N, 3) [m], beliefs from the frames so far) -> Identification

    Raises
    ------
    ObservationError
        No frame shows three points, or the take does not fit the model.
    """
    settings = settings or TakeSettings()
    step = progress or (lambda what, done, total: None)
    pieces = find_pieces(markers.positions, markers.rate)
    counts = np.diff(pieces.starts)
    if counts.max(initial=0) < 3:
        raise ObservationError("no frame shows three markers", file=markers.source or None, remedy="Check the take.")
    work = Naming(model, pieces, markers.rate, step, identify_frame)
    anchors = _anchors(counts, max(1, round(settings.every * markers.rate)))
    first = anchors[:: max(1, len(anchors) // FIRST_FRAMES)]
    trial = first[:: max(1, len(first) // TRIAL_FRAMES)]
    work.identify_frames(trial)
    share = max(work.label_shares)
    if share >= MIN_LABEL_SHARE:
        work.identify_frames(sorted(set(first) - set(trial)))
        share = float(np.median(work.label_shares))
    if share < MIN_LABEL_SHARE:
        raise ObservationError(
            f"the take does not fit the model of {model.name}: {_mismatch(work, share)}", file=markers.source or None,
            remedy="Check that subject, markers and unit are the same." + _marker_set_advice(model),
        )
    work.update_beliefs()
    work.identify_frames(sorted(set(anchors) - set(first)))
    budget = max(20, int(settings.most * len(markers)))
    for _ in range(settings.rounds):
        work.cut_changes()
        work.assign_labels()
        more = work.unknown_frames(min(budget - len(work.votes.asked), max(10, len(work.votes.asked))))
        if not more:
            break
        work.identify_frames(more)
    work.cut_changes()
    work.assign_labels()
    return _result(work, markers.rate, settings)


def _mismatch(work: Naming, share: float) -> str:
    """Describe the share of labels found in the identified frames, and the segments that are missing."""
    votes = [label for label in work.votes.label if label < len(work.model)]
    found = np.bincount(votes, minlength=len(work.model)) / max(len(work.label_shares), 1)
    lacking = [n for n, s in zip(work.model.names, work.model.segments) if found[list(s)].mean() < 0.5]
    text = f"in {len(work.label_shares)} frames it finds {100 * share:.0f} % of the labels"
    return f"{text} at most, least of {', '.join(lacking[:6])}{' ...' if len(lacking) > 6 else ''}" if lacking else text


def _marker_set_advice(model: MarkerModel) -> str:
    """Advice for a model whose segments come from motion alone; empty for others."""
    if find_marker_set(model.labels) is not None:
        return ""
    return (
        " No set of the catalogue knows its labels, so its segments may be wrong: write a set (`kinefit markers "
        "set TAKE -o set.toml`), correct it, and learn with --set set.toml."
    )


def _anchors(counts: NDArray, every: int) -> list[int]:
    """The frame with most points of every `every` frames."""
    best = [a + int(np.argmax(counts[a : a + every])) for a in range(0, len(counts), every)]
    return [f for f in best if counts[f] > 2]


def _result(work: Naming, rate: float, settings: TakeSettings) -> TakeIdentification:
    """The result, with gaps filled and doubts listed."""
    positions, point = work.positions()
    column = np.where(point >= 0, work.pieces.column[point], -1)
    votes = work.confidence[work.pieces.piece][point]
    anchors = tuple(sorted(work.votes.asked))
    return judge_labels(work.model, positions, column, votes, rate, settings, anchors, len(work.pieces.points))


def judge_labels(
    model: MarkerModel, positions: NDArray, column: NDArray, probability: NDArray, rate: float, settings: TakeSettings,
    anchors: tuple[int, ...], points: int,
) -> TakeIdentification:
    """Judge labels by the distances within the body: confidence, doubts, filled gaps.

    Parameters
    ----------
    positions : (F, M, 3) [m] of the labels; NaN where not visible or unknown
    column : (F, M) column of the take that each label comes from; -1 for none
    probability : (F, M) of each label before its distances are compared, 0 to 1
    rate : [Hz]
    anchors : frames that were identified separately
    points : number of points of the take
    """
    visible = column >= 0
    misfits = Consistency(model).own(positions)
    fit_factor = np.exp(-0.5 * np.clip(np.nan_to_num(misfits) - INLIER_SIGMAS, 0.0, None) ** 2 / INLIER_SIGMAS**2)
    confidence = np.where(visible, probability * fit_factor, 0.0)
    doubts = list_doubts(model.labels, confidence, misfits, visible, settings.certain)
    filled = np.zeros(visible.shape, bool)
    if settings.fill > 0:
        positions, filled = fill_gaps(model, positions, rate, settings.fill, settings.fill_alone)
    ghosts = int(points - visible.sum())
    return TakeIdentification(model.labels, positions, confidence, filled, column, tuple(doubts), anchors, ghosts)


def list_doubts(
    labels: tuple[str, ...], confidence: NDArray, off: NDArray, seen: NDArray, certain: float
) -> list[Doubt]:
    """List spans of frames with a doubtful label, the worst first.

    Parameters
    ----------
    confidence, off, seen : (F, M) probability 0 to 1, misfit in standard deviations, visibility (bool)
    certain : least confidence without doubt, 0 to 1
    """
    out = []
    for m, label in enumerate(labels):
        unsure = seen[:, m] & (confidence[:, m] < certain)
        for first, stop in runs_of(unsure, 10):
            last, frames = stop - 1, first + np.flatnonzero(unsure[first:stop])
            least = float(confidence[frames, m].min())
            misfit = float(np.nanmax(np.append(off[frames, m], 0.0)))
            kind = "off" if misfit > OUTLIER_SIGMAS else "unsure"
            text = f"{label} in frames {first} to {last}: " + (
                f"off its segment by {misfit:.0f} standard deviations" if kind == "off" else f"probability {least:.2f}"
            )
            out.append(Doubt(first, last, label, kind, least, text))
    return sorted(out, key=lambda d: (d.confidence, d.first))


def named_markers(
    markers: Markers, model: MarkerModel | str | PathLike[str], *, settings: TakeSettings | None = None,
    progress: Step | None = None,
) -> Markers:
    """Label markers by a subject's model, whatever the names of their columns and wherever trajectories break.

    Only measured points with a certain label are kept: gaps are not filled, and unassigned points are excluded.

    Parameters
    ----------
    model : of the subject, or its file: see `learn_model`, `kinefit markers learn`
    settings : TakeSettings; `certain` is the least confidence (0 to 1) of a label that is kept
    progress : (what, done, total) -> None

    Returns
    -------
    Markers of the model's M labels with the rate, unit and events of `markers`; NaN where a label is unknown.

    Raises
    ------
    ObservationError
        No frame shows three points, or the model is of another subject.
    FileError
        The file is no marker model.
    """
    model = model if isinstance(model, MarkerModel) else load_model(model)
    settings = replace(settings or TakeSettings(), fill=0.0, fill_alone=0.0)
    found = identify_take(model, markers, settings=settings, progress=progress)
    out = found.markers(markers)
    is_certain = found.confidence >= settings.certain
    return replace(out, positions=np.where(is_certain[..., None], out.positions, np.nan))


def with_names(take: Take, seen: Observations, *, progress: Step | None = None) -> Observations:
    """Label the markers of every `[[markers]]` entry of a take that has a `model`.

    Raises
    ------
    ObservationError, FileError
        As `named_markers`, with the entry.
    """
    if not any(entry.model for entry in take.markers):
        return seen
    out = []
    for entry, markers in zip(take.markers, seen.markers):
        with located(take.path, f"markers {entry.file.name}"):
            out.append(named_markers(markers, entry.model, progress=progress) if entry.model else markers)
    return replace(seen, markers=tuple(out))


@checked
def identify_people(
    models: Sequence[MarkerModel], markers: Markers, *, settings: TakeSettings | None = None,
    progress: Step | None = None, method: Callable[..., TakeIdentification] = identify_take,
) -> list[TakeIdentification]:
    """Label several subjects in one take, one after the other, the one with most markers first.

    Each subject is searched among the points that are not certainly labelled yet. Columns refer to `markers`.

    Parameters
    ----------
    models : of the subjects, with different names
    markers : (F, N, 3) [m], unlabelled or wrongly labelled
    settings : default: `TakeSettings()`
    progress : (what, done, total) -> None
    method : labels one subject; called as `identify_take`

    Returns
    -------
    one result per model, in the order of `models`

    Raises
    ------
    ObservationError
        There is no model, two have the same name, or a subject is not found.
    """
    names = [m.name for m in models]
    if not models or len(set(names)) < len(names):
        problem = f"subjects called {', '.join(names)}" if names else "no subject"
        raise ObservationError(problem, remedy="Give every subject a name of its own: kinefit markers learn --name.")
    settings = settings or TakeSettings()
    remaining = np.array(markers.positions)
    out: dict[int, TakeIdentification] = {}
    for i in sorted(range(len(models)), key=lambda i: -len(models[i])):
        out[i] = method(models[i], replace(markers, positions=remaining), settings=settings, progress=progress)
        column, is_certain = out[i].column, out[i].confidence >= settings.certain
        rows = np.broadcast_to(np.arange(len(column))[:, None], column.shape)
        remaining[rows[is_certain], column[is_certain]] = np.nan
    return [out[i] for i in range(len(models))]


def one_after_the_other(takes: Sequence[Markers]) -> Markers:
    """Concatenate takes; a label is NaN in takes without it.

    Raises
    ------
    ObservationError
        There is no take.
    """
    if not takes:
        raise ObservationError("no take", remedy="Name at least one.")
    names = tuple(dict.fromkeys(n for t in takes for n in t.names))
    positions = np.full((sum(map(len, takes)), len(names), 3), np.nan)
    at = 0
    for t in takes:
        positions[at : at + len(t), [names.index(n) for n in t.names]] = t.positions
        at += len(t)
    return Markers(names, takes[0].rate, positions, up=takes[0].up, source=takes[0].source, unit=takes[0].unit)
