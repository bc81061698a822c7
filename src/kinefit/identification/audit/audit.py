"""Audit of labelled takes: labels that changed places for a while or throughout, markers that left their segment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.marker_sets import MarkerSet, find_marker_set
from kinefit.errors import ObservationError
from kinefit.findings import runs_of
from kinefit.identification.audit.gaps import exchanges_in_gaps
from kinefit.identification.audit.plausible import elsewhere, places_of_model, places_of_set, swapped_throughout
from kinefit.identification.audit.resting import resting
from kinefit.identification.audit.swaps import JOIN, best_run, crossings, glitches, pair_gain, swap_gains
from kinefit.identification.model.learn import learn_model
from kinefit.identification.model.model import MarkerModel
from kinefit.identification.take.consistency import Consistency
from kinefit.observations import Markers
from kinefit.solvers.rigid_clusters import middle

PARTNERS = 6
"""Markers whose distances speak for a label: those that hold them best."""

FLOOR = 0.006
"""[m] least deviation of a distance here: of a clean take's segments, 1 % of the distances stray four times as far."""

STRAY, FINE = 5.0, 3.0
"""Deviations: a label is off its segment when half of its distances are off by more than the first; after a correction
those of the labels that it moves are below the second."""

FIRM = 0.02
"""[m] deviation beyond which a distance does not speak for a label: a shoulder's gives by 0.015, a joint's by more."""

GAIN = 8.0
"""What an exchange must take off a frame's sum of squares, per frame, for the distances alone to tell it; the sums of
clean takes' frames change by more in single frames only."""

STRAYED = 0.04
"""[m] a marker must be off to be told as a stray: toes bend, and skin slides, by up to three centimetres."""

FEW = 0.25
"""Share of the labels that may be off a model of the same subject, by labels that are wrong throughout."""

LEAST_FRAMES = 3
"""Fewer frames are a glitch, not a label; a correction of so few is told only where jumps at both ends say so too."""

LEAP = 0.02
"""[m] by which a trajectory that changes over to another marker's jumps, at least."""

MOST_FRAMES = 400
"""Frames at which all exchanges of two are tried, spread over the take; jumps are looked for in all."""

MOST_SWAPS = 40
"""Swaps after which a take is called wrong as a whole."""


@dataclass(frozen=True)
class AuditFinding:
    """One thing found in a labelled take.

    Parameters
    ----------
    kind : "swapped" (labels change places for a while), "throughout" (all the time), "stray" (off its segment for a
        while), "resting" (still in space while its neighbours move: fallen off, glued to a chair), or "elsewhere" (not
        where another subject wears it: no wrong name)
    labels : one, or the two of a swap
    first, last : numbers of the frames, counted from 0, both included
    size : [m] how far off, median over the frames; of a resting marker how far its neighbours move
    text : the same as a sentence
    """

    kind: str
    labels: tuple[str, ...]
    first: int
    last: int
    size: float
    text: str

    def __str__(self) -> str:
        return self.text


@checked
def audit_take(
    markers: Markers, *, model: MarkerModel | None = None, marker_set: MarkerSet | None = None
) -> list[AuditFinding]:
    """Wrong labels of a labelled take, swaps first.

    An exchange of two labels is told where distances fit much better with it, or where two markers go on from frame to
    frame where the other was, and distances do not speak against it; three that are turned round come as two such
    exchanges. A marker that leaves its segment with no label to go to is told as a stray. A swap that lasts through
    all of a take shows against the subject's model from other takes; else against the places of a marker set or of
    another subject's model, and by what each label moves with.

    Parameters
    ----------
    model : from other takes, of the same subject and session, or of another subject with the same marker set
        Default: learnt here, so that what most frames say holds.
    marker_set : default: the catalogue's set that knows the labels

    Raises
    ------
    ObservationError
        Too few labels, or the model knows fewer than four of them.
    """
    marker_set = marker_set or find_marker_set(markers.names)
    seen = [n for n, x in zip(markers.names, np.isfinite(markers.positions[..., 0]).any(0)) if x]
    if model is not None and len(set(seen) & set(model.labels)) < 4:
        known = len(set(seen) & set(model.labels))
        remedy = f"It has: {', '.join(model.labels[:8])} ..."
        raise ObservationError(f"the model knows {known} of the labels", remedy=remedy)
    still = [AuditFinding("resting", (label,), *span, size, text) for label, span, size, text in resting(markers)]
    other = model if model is not None and not _fits(markers, model) else None
    found: list[AuditFinding] = []
    if model is not None and other is None:
        names = _both(markers, model)
        swaps, positions = _swaps(markers.positions[:, [markers.names.index(n) for n in names]], model, names)
        return _sorted(swaps + _strays(positions, model, names) + still)
    positions = markers.positions
    for _ in range(2):  # the second time with a model of the corrected take
        own = learn_model(Markers(markers.names, markers.rate, positions), template=marker_set if marker_set else "")
        index = [markers.names.index(n) for n in own.labels]
        swaps, corrected = _swaps(positions[:, index], own, own.labels)
        found += swaps
        positions = positions.copy()
        positions[:, index] = corrected
        if not swaps:
            break
    places: list[NDArray] = []
    if other is not None:
        places = places_of_model(own, other)
        for label, size, text in elsewhere(own, places):
            found.append(AuditFinding("elsewhere", (label,), 0, len(markers) - 1, size, text))
    elif marker_set is not None:
        places = places_of_set(own, marker_set)
    found += [
        AuditFinding("throughout", pair, 0, len(markers) - 1, size, text)
        for pair, size, text in swapped_throughout(positions[:, index], own, places)
    ]
    return _sorted(found + _strays(positions[:, index], own, own.labels) + still)


def _sorted(found: list[AuditFinding]) -> list[AuditFinding]:
    """Throughout, swapped, stray, resting, elsewhere; spans of one pair that are nearly next to each other as one."""
    order = {"throughout": 0, "swapped": 1, "stray": 2, "resting": 3, "elsewhere": 4}
    out: list[AuditFinding] = []
    for f in sorted(found, key=lambda f: (order[f.kind], f.labels, f.first)):
        last = out[-1] if out else None
        same = last is not None and f.kind == "swapped" and (last.kind, last.labels) == (f.kind, f.labels)
        if last is not None and same and f.first - last.last <= JOIN:
            each = {g.text.partition(" in frames ")[0].removesuffix(", on and off,") for g in (last, f)}
            what = each.pop() if len(each) == 1 else f"{f.labels[0]} and {f.labels[1]} are swapped"
            text = f"{what}, on and off, in frames {last.first} to {f.last}"
            out[-1] = replace(last, last=f.last, text=text)
        else:
            out.append(f)
    return sorted(out, key=lambda f: (order[f.kind], f.first))


def _both(markers: Markers, model: MarkerModel) -> list[str]:
    return [n for n in model.labels if n in markers.names]


def _fits(markers: Markers, model: MarkerModel) -> bool:
    """Whether a model is of this subject and session: most labels keep its distances."""
    names = _both(markers, model)
    step = max(1, len(markers) // MOST_FRAMES)
    cost = _judge(model, names).own(markers.positions[::step][:, [markers.names.index(n) for n in names]])
    return bool(np.mean(np.nan_to_num(middle(cost, axis=0)) > FINE) < FEW)


def _judge(model: MarkerModel, labels: Sequence[str]) -> Consistency:
    """What speaks for a label: the judgement of `identify_take`, by fewer partners and firmer ones."""
    return Consistency(model, labels, count=PARTNERS, floor=FLOOR, firm=FIRM)


def _tables(model: MarkerModel, labels: Sequence[str]) -> tuple[NDArray, NDArray]:
    keep = [model.labels.index(n) for n in labels]
    i = np.ix_(keep, keep)
    return model.mean[i], np.maximum(model.deviation[i], FLOOR)


def _swaps(
    positions: NDArray, model: MarkerModel, labels: Sequence[str]
) -> tuple[list[AuditFinding], NDArray]:
    """Exchanges of two labels, the clearest first, each undone before the next is looked for; the positions undone."""
    mean, deviation = _tables(model, labels)
    agree = _judge(model, labels)
    positions = np.array(positions)
    step = max(1, -(-len(positions) // MOST_FRAMES))
    found: list[AuditFinding] = []
    broken = crossings(positions, LEAP)[1]
    for look in (glitches, partial(exchanges_in_gaps, mean=mean, deviation=deviation)):
        for a, b, first, last in look(positions, least=LEAP):
            span = slice(first, last + 1)
            better = pair_gain(positions[span], a, b, mean, deviation).sum() > 0
            if better and not _stay(agree, positions, broken, (a, b), first, last):
                found.append(_swap(positions[span], (a, b), labels, first, last, len(positions)))
                positions[span, a], positions[span, b] = positions[span, b].copy(), positions[span, a].copy()
    met, broken = crossings(positions, LEAP)
    refused: set[tuple[int, int, int, int]] = set()
    told = len(found)
    gains = swap_gains(positions[::step], mean, deviation)
    met_gains = {(a, b): pair_gain(positions, a, b, mean, deviation) for a, b in {_pair(c) for c in met}}
    while len(found) - told < MOST_SWAPS:
        spans = _candidates(gains, met_gains, positions, mean, deviation, met, broken, step)
        spans = [c for c in spans if c[1:] not in refused]
        if not spans:
            break
        _, a, b, first, last = max(spans)
        here = positions[first : last + 1].copy()
        here[:, [a, b]] = here[:, [b, a]]
        now = positions[first : last + 1]
        before = np.stack([agree.misfit(now[:, k], now, k) for k in (a, b)], axis=1)
        after = np.stack([agree.misfit(here[:, k], here, k) for k in (a, b)], axis=1)
        jumps = sum(c[0] in (first, last + 1) for c in met if {c[1], c[2]} == {a, b})
        if not _better(before, after, jumps) or _stay(agree, positions, broken, (a, b), first, last):
            refused.add((a, b, first, last))
            continue
        found.append(_swap(positions[first : last + 1], (a, b), labels, first, last, len(positions)))
        positions[first : last + 1] = here
        rows = slice(-(-first // step), last // step + 1)
        gains[rows] = swap_gains(positions[::step][rows], mean, deviation)
        for pair, gain in met_gains.items():
            gain[first : last + 1] = pair_gain(here, *pair, mean, deviation)
        refused = {c for c in refused if c[3] < first or c[2] > last}
        met = [c for c in met if _pair(c) != (a, b) or c[0] not in (first, last + 1)]
    return found, positions


def _stay(
    agree: Consistency, positions: NDArray, broken: NDArray, pair: tuple[int, int], first: int, last: int
) -> bool:
    """Whether at an end of a span both labels go on with their segments: then they did not change places there."""
    for end in (first, last + 1):
        near = range(max(end - JOIN, 1), min(end + JOIN + 1, len(positions)))
        if 0 < end < len(positions) and not any(_leaves(agree, positions, broken, f, k) for f in near for k in pair):
            return True
    return False


def _leaves(agree: Consistency, positions: NDArray, broken: NDArray, frame: int, label: int) -> bool:
    """Whether a label's trajectory is broken at a frame, and not because its segment moves fast."""
    if not broken[frame, label]:
        return False
    then, now = positions[frame - 1, label], positions[frame, label]
    if not np.isfinite(then).all() or not np.isfinite(now).all():
        return True
    return agree.carried(positions, frame - 1, frame, now, label)[0] > LEAP


def _better(before: NDArray, after: NDArray, jumps: int) -> bool:
    """Whether an exchange leaves both labels fine; where no distance speaks for either, two jumps must."""
    known = np.isfinite(after).mean(0) > 0.1
    if not known.any():
        return jumps > 1
    now = middle(after[:, known], axis=0)
    was = np.nanmedian(np.nan_to_num(before[:, known]), axis=0)
    return bool(now.min() < FINE and now.max() < STRAY and now.sum() < was.sum())


def _candidates(
    gains: NDArray, met_gains: dict[tuple[int, int], NDArray], positions: NDArray, mean: NDArray, deviation: NDArray,
    met: list[tuple[int, int, int]], broken: NDArray, step: int,
) -> list[tuple[float, int, int, int, int]]:
    """(worth, a, b, first, last) of exchanges that distances ask for, or jumps and not against the distances."""
    out = []
    total = len(positions)
    promising = np.argwhere(np.triu((np.clip(gains - GAIN, 0, 10 * GAIN)).sum(0) > 3 * GAIN, 1))
    for a, b in promising.tolist():
        first, last, worth = best_run(gains[:, a, b], GAIN)
        if worth <= 3 * GAIN:
            continue
        low, high = max(0, (first - 1) * step + 1), min(total - 1, (last + 1) * step - 1)
        first, last, worth = best_run(pair_gain(positions[low : high + 1], a, b, mean, deviation), GAIN)
        first, last = low + first, low + last
        if last - first + 1 >= LEAST_FRAMES and worth > 10 * GAIN:
            ends = [c[0] for c in met if {c[1], c[2]} == {a, b}]
            first, first_met = _snapped(first, [*ends, 0])
            last, last_met = _snapped(last + 1, [*ends, total])
            if _breaks(broken, (a, b), first) and _breaks(broken, (a, b), last):
                out.append((worth * (1 + first_met + last_met), a, b, first, last - 1))
    for a, b in {_pair(c) for c in met}:
        ends, gain = sorted({0, total, *(c[0] for c in met if _pair(c) == (a, b))}), met_gains[a, b]
        for first, end in pairwise(ends):
            if (first, end) != (0, total) and np.median(gain[first:end]) > 0:
                if (worth := float(np.clip(gain[first:end], -10 * GAIN, 10 * GAIN).sum())) > 0:
                    out.append((worth * 3, a, b, first, end - 1))
    return out


def _pair(crossing: tuple[int, int, int]) -> tuple[int, int]:
    return min(crossing[1:]), max(crossing[1:])


def _breaks(broken: NDArray, pair: tuple[int, int], frame: int) -> bool:
    """Whether labels may have changed places there: at an end of the take, or where one of both is broken."""
    near = broken[max(frame - JOIN, 0) : frame + JOIN + 1, pair]
    return frame < JOIN or frame > len(broken) - JOIN or bool(near.any())


def _snapped(frame: int, ends: Sequence[int]) -> tuple[int, bool]:
    """The nearest of the frames at which two markers cross, if one is near."""
    nearest = min(ends, key=lambda e: abs(e - frame))
    return (nearest, True) if abs(nearest - frame) <= JOIN else (frame, False)


def _strays(positions: NDArray, model: MarkerModel, labels: Sequence[str]) -> list[AuditFinding]:
    """Markers off their segment; of several that are off together the one that is off most."""
    agree = _judge(model, labels)
    cost = agree.own(positions)
    out = []
    for k, label in enumerate(labels):
        for first, stop in runs_of(cost[:, k] > STRAY, JOIN):
            last = stop - 1
            typical = middle(cost[first : last + 1], axis=0)
            if last - first + 1 < LEAST_FRAMES or typical[k] < np.nanmax(typical):
                continue
            x = positions[first : last + 1]
            off = np.abs(np.linalg.norm(x[:, k, None] - x[:, agree.who[k]], axis=-1) - agree.mean[k])
            size = float(np.nanmedian(off))
            if size < STRAYED:
                continue
            text = f"{label} is {100 * size:.0f} cm off its segment in frames {first} to {last}"
            out.append(AuditFinding("stray", (label,), first, last, size, text))
    return out


def _swap(
    points: NDArray, pair: tuple[int, int], labels: Sequence[str], first: int, last: int, total: int
) -> AuditFinding:
    """A finding of labels that change places; with one of them seldom seen, only the other's name is wrong."""
    pair = min(pair), max(pair)
    names = labels[pair[0]], labels[pair[1]]
    apart = np.linalg.norm(points[:, pair[0]] - points[:, pair[1]], axis=-1)
    seen = np.isfinite(points[:, pair, 0]).mean(0)
    size = float(np.nanmedian(apart)) if np.isfinite(apart).any() else float("nan")
    what = f"{names[0]} and {names[1]} are swapped"
    if seen.min() < 0.5:
        what = f"what is called {names[int(np.argmax(seen))]} is {names[int(np.argmin(seen))]}"
    always = last - first + 1 == total
    when = "throughout" if always else f"in frames {first} to {last}"
    text = f"{what} {when}" + (f" ({100 * size:.0f} cm apart)" if np.isfinite(size) else "")
    return AuditFinding("throughout" if always else "swapped", names, first, last, size, text)
