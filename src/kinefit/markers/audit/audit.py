"""Audit labelled takes: find swapped labels, markers that left their segment, and markers that no longer move."""

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
from kinefit.markers.audit.plausible import moved_labels, permanent_swaps, places_of_model, places_of_set
from kinefit.markers.audit.swaps import MAX_GAP, best_run, find_crossings, gap_swaps, pair_gain, short_swaps, swap_gains
from kinefit.markers.model.learn import learn_model
from kinefit.markers.model.model import MarkerModel
from kinefit.markers.take.consistency import Consistency
from kinefit.observations import Markers
from kinefit.solving.functional_joints import nan_median

MAX_PARTNERS = 6
"""Other markers whose distances judge a label: those with the least deviation."""

MIN_DISTANCE_SIGMA = 0.006
"""[m] lower bound of a distance's sigma; in clean takes, 1 % of the distances deviate four times as far."""

OUTLIER_SIGMAS = 5.0
"""A label is off its segment if the median error of its distances exceeds this."""

INLIER_SIGMAS = 3.0
"""Upper bound of a label's median error after a correction."""

MAX_DISTANCE_SIGMA = 0.02
"""[m] distances with a larger standard deviation are ignored: at the shoulder it is 0.015, across joints larger."""

MIN_SWAP_GAIN = 8.0
"""By how much a swap without jumps must lower a frame's sum of squares; single frames of clean takes exceed it."""

MIN_STRAY_DISTANCE = 0.04
"""[m] least distance of a stray marker from its segment: toes bend and skin slides by up to three centimetres."""

MAX_OUTLIER_SHARE = 0.25
"""A model is of another subject if more than this share of the labels does not fit it."""

MIN_SPAN_FRAMES = 3
"""Least length of a swap or stray: shorter swaps are reported only where both ends show a jump."""

MIN_JUMP = 0.02
"""[m] least jump of a trajectory that switches to another marker."""

MAX_SWAP_FRAMES = 400
"""Frames, spread over the take, in which all pairs are tried; jumps are searched in all frames."""

MAX_SWAPS = 40
"""The search ends after this many swaps: the take is wrong as a whole."""


@dataclass(frozen=True)
class AuditFinding:
    """One problem found in a labelled take.

    Parameters
    ----------
    kind : "swapped" (two labels, in some frames), "throughout" (in all), "stray" (off its segment), "resting" (fixed in
        space while its neighbours move), or "elsewhere" (worn elsewhere, correctly named)
    labels : the label, or the two labels of a swap
    first, last : first and last frame, counted from 0
    size : [m] median distance off; for "resting" how far the neighbours move
    text : the finding as a sentence
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
    """Find wrong labels in a labelled take, swaps first.

    Two labels are reported as swapped if the distances fit much better after a swap, or if both trajectories continue
    where the other was and the distances do not contradict it. A cycle of three labels gives two swaps. A marker off
    its segment that matches no other label is a stray. A swap that lasts the whole take shows against the subject's
    model from other takes, or else against a marker set, another subject's model, and the common motion of labels.

    Parameters
    ----------
    model : of the same subject and session, or of another subject with the same marker set
        Default: learnt from this take, so that the majority of its frames is taken as correct.
    marker_set : default: the catalogue's set that knows the labels

    Raises
    ------
    ObservationError
        Too few labels, or the model knows fewer than four of them.
    """
    marker_set = marker_set or find_marker_set(markers.names)
    visible = [n for n, x in zip(markers.names, np.isfinite(markers.positions[..., 0]).any(0)) if x]
    if model is not None and len(set(visible) & set(model.labels)) < 4:
        known = len(set(visible) & set(model.labels))
        remedy = f"It has: {', '.join(model.labels[:8])} ..."
        raise ObservationError(f"the model knows {known} of the labels", remedy=remedy)
    resting = [AuditFinding("resting", (k,), *span, size, text) for k, span, size, text in resting_markers(markers)]
    foreign = model if model is not None and not _fits_model(markers, model) else None
    found: list[AuditFinding] = []
    if model is not None and foreign is None:
        names = _common_labels(markers, model)
        swaps, positions = _find_swaps(markers.positions[:, [markers.names.index(n) for n in names]], model, names)
        return _sort_findings(swaps + _find_strays(positions, model, names) + resting)
    positions = markers.positions
    for _ in range(2):  # the second time with a model of the corrected take
        own = learn_model(Markers(markers.names, markers.rate, positions), template=marker_set if marker_set else "")
        index = [markers.names.index(n) for n in own.labels]
        swaps, corrected = _find_swaps(positions[:, index], own, own.labels)
        found += swaps
        positions = positions.copy()
        positions[:, index] = corrected
        if not swaps:
            break
    places: list[NDArray] = []
    if foreign is not None:
        places = places_of_model(own, foreign)
        for label, size, text in moved_labels(own, places):
            found.append(AuditFinding("elsewhere", (label,), 0, len(markers) - 1, size, text))
    elif marker_set is not None:
        places = places_of_set(own, marker_set)
    found += [
        AuditFinding("throughout", pair, 0, len(markers) - 1, size, text)
        for pair, size, text in permanent_swaps(positions[:, index], own, places)
    ]
    return _sort_findings(found + _find_strays(positions[:, index], own, own.labels) + resting)


def _sort_findings(found: list[AuditFinding]) -> list[AuditFinding]:
    """Sort by kind (throughout, swapped, stray, resting, elsewhere); join nearby swaps of the same pair."""
    order = {"throughout": 0, "swapped": 1, "stray": 2, "resting": 3, "elsewhere": 4}
    out: list[AuditFinding] = []
    for f in sorted(found, key=lambda f: (order[f.kind], f.labels, f.first)):
        last = out[-1] if out else None
        same = last is not None and f.kind == "swapped" and (last.kind, last.labels) == (f.kind, f.labels)
        if last is not None and same and f.first - last.last <= MAX_GAP:
            each = {g.text.partition(" in frames ")[0].removesuffix(", on and off,") for g in (last, f)}
            what = each.pop() if len(each) == 1 else f"{f.labels[0]} and {f.labels[1]} are swapped"
            text = f"{what}, on and off, in frames {last.first} to {f.last}"
            out[-1] = replace(last, last=f.last, text=text)
        else:
            out.append(f)
    return sorted(out, key=lambda f: (order[f.kind], f.first))


def _common_labels(markers: Markers, model: MarkerModel) -> list[str]:
    return [n for n in model.labels if n in markers.names]


def _fits_model(markers: Markers, model: MarkerModel) -> bool:
    """Whether a model is of this subject and session: most labels keep its distances."""
    names = _common_labels(markers, model)
    step = max(1, len(markers) // MAX_SWAP_FRAMES)
    cost = _consistency_of(model, names).own(markers.positions[::step][:, [markers.names.index(n) for n in names]])
    return bool(np.mean(np.nan_to_num(nan_median(cost, axis=0)) > INLIER_SIGMAS) < MAX_OUTLIER_SHARE)


def _consistency_of(model: MarkerModel, labels: Sequence[str]) -> Consistency:
    """The consistency measure of `identify_take`, with fewer and more rigid partners."""
    return Consistency(model, labels, count=MAX_PARTNERS, floor=MIN_DISTANCE_SIGMA, firm=MAX_DISTANCE_SIGMA)


def _distance_tables(model: MarkerModel, labels: Sequence[str]) -> tuple[NDArray, NDArray]:
    keep = [model.labels.index(n) for n in labels]
    i = np.ix_(keep, keep)
    return model.mean[i], np.maximum(model.deviation[i], MIN_DISTANCE_SIGMA)


def _find_swaps(positions: NDArray, model: MarkerModel, labels: Sequence[str]) -> tuple[list[AuditFinding], NDArray]:
    """Find and undo swaps of two labels, the largest gain first; returns them and the corrected positions."""
    mean, deviation = _distance_tables(model, labels)
    consistency = _consistency_of(model, labels)
    positions = np.array(positions)
    step = max(1, -(-len(positions) // MAX_SWAP_FRAMES))
    found: list[AuditFinding] = []
    broken = find_crossings(positions, MIN_JUMP)[1]
    for find in (short_swaps, partial(gap_swaps, mean=mean, deviation=deviation)):
        for a, b, first, last in find(positions, least=MIN_JUMP):
            span = slice(first, last + 1)
            better = pair_gain(positions[span], a, b, mean, deviation).sum() > 0
            if better and not _keep_segments(consistency, positions, broken, (a, b), first, last):
                found.append(_swap_finding(positions[span], (a, b), labels, first, last, len(positions)))
                positions[span, a], positions[span, b] = positions[span, b].copy(), positions[span, a].copy()
    crossings, broken = find_crossings(positions, MIN_JUMP)
    rejected: set[tuple[int, int, int, int]] = set()
    count_before = len(found)
    gains = swap_gains(positions[::step], mean, deviation)
    pair_gains = {(a, b): pair_gain(positions, a, b, mean, deviation) for a, b in {_label_pair(c) for c in crossings}}
    while len(found) - count_before < MAX_SWAPS:
        spans = _swap_candidates(gains, pair_gains, positions, mean, deviation, crossings, broken, step)
        spans = [c for c in spans if c[1:] not in rejected]
        if not spans:
            break
        _, a, b, first, last = max(spans)
        swapped = positions[first : last + 1].copy()
        swapped[:, [a, b]] = swapped[:, [b, a]]
        current = positions[first : last + 1]
        before = np.stack([consistency.misfit(current[:, k], current, k) for k in (a, b)], axis=1)
        after = np.stack([consistency.misfit(swapped[:, k], swapped, k) for k in (a, b)], axis=1)
        jumps = sum(c[0] in (first, last + 1) for c in crossings if {c[1], c[2]} == {a, b})
        if not _is_better(before, after, jumps) or _keep_segments(consistency, positions, broken, (a, b), first, last):
            rejected.add((a, b, first, last))
            continue
        found.append(_swap_finding(positions[first : last + 1], (a, b), labels, first, last, len(positions)))
        positions[first : last + 1] = swapped
        rows = slice(-(-first // step), last // step + 1)
        gains[rows] = swap_gains(positions[::step][rows], mean, deviation)
        for pair, gain in pair_gains.items():
            gain[first : last + 1] = pair_gain(swapped, *pair, mean, deviation)
        rejected = {c for c in rejected if c[3] < first or c[2] > last}
        crossings = [c for c in crossings if _label_pair(c) != (a, b) or c[0] not in (first, last + 1)]
    return found, positions


def _keep_segments(
    consistency: Consistency, positions: NDArray, broken: NDArray, pair: tuple[int, int], first: int, last: int
) -> bool:
    """Whether both labels stay with their segments at an end of a span, which contradicts a swap there."""
    for end in (first, last + 1):
        near = range(max(end - MAX_GAP, 1), min(end + MAX_GAP + 1, len(positions)))
        if 0 < end < len(positions) and not any(
            _leaves_segment(consistency, positions, broken, f, k) for f in near for k in pair
        ):
            return True
    return False


def _leaves_segment(consistency: Consistency, positions: NDArray, broken: NDArray, frame: int, label: int) -> bool:
    """Whether a label's trajectory breaks at a frame without a matching motion of its segment."""
    if not broken[frame, label]:
        return False
    previous, current = positions[frame - 1, label], positions[frame, label]
    if not np.isfinite(previous).all() or not np.isfinite(current).all():
        return True
    return consistency.motion_misfit(positions, frame - 1, frame, current, label)[0] > MIN_JUMP


def _is_better(before: NDArray, after: NDArray, jumps: int) -> bool:
    """Whether a swap makes both labels inliers; without any usable distance, whether both its ends show jumps."""
    known = np.isfinite(after).mean(0) > 0.1
    if not known.any():
        return jumps > 1
    medians = nan_median(after[:, known], axis=0)
    earlier = np.nanmedian(np.nan_to_num(before[:, known]), axis=0)
    return bool(medians.min() < INLIER_SIGMAS and medians.max() < OUTLIER_SIGMAS and medians.sum() < earlier.sum())


def _swap_candidates(
    gains: NDArray, pair_gains: dict[tuple[int, int], NDArray], positions: NDArray, mean: NDArray, deviation: NDArray,
    crossings: list[tuple[int, int, int]], broken: NDArray, step: int,
) -> list[tuple[float, int, int, int, int]]:
    """(worth, a, b, first, last) of swaps supported by distances, or by jumps that distances do not contradict."""
    out = []
    total = len(positions)
    excess = np.clip(gains - MIN_SWAP_GAIN, 0, 10 * MIN_SWAP_GAIN)
    promising = np.argwhere(np.triu(excess.sum(0) > 3 * MIN_SWAP_GAIN, 1))
    for a, b in promising.tolist():
        first, last, worth = best_run(gains[:, a, b], MIN_SWAP_GAIN)
        if worth <= 3 * MIN_SWAP_GAIN:
            continue
        low, high = max(0, (first - 1) * step + 1), min(total - 1, (last + 1) * step - 1)
        first, last, worth = best_run(pair_gain(positions[low : high + 1], a, b, mean, deviation), MIN_SWAP_GAIN)
        first, last = low + first, low + last
        if last - first + 1 >= MIN_SPAN_FRAMES and worth > 10 * MIN_SWAP_GAIN:
            ends = [c[0] for c in crossings if {c[1], c[2]} == {a, b}]
            first, first_met = _snap_to_crossing(first, [*ends, 0])
            last, last_met = _snap_to_crossing(last + 1, [*ends, total])
            if _has_break(broken, (a, b), first) and _has_break(broken, (a, b), last):
                out.append((worth * (1 + first_met + last_met), a, b, first, last - 1))
    for a, b in {_label_pair(c) for c in crossings}:
        ends, gain = sorted({0, total, *(c[0] for c in crossings if _label_pair(c) == (a, b))}), pair_gains[a, b]
        for first, end in pairwise(ends):
            if (first, end) != (0, total) and np.median(gain[first:end]) > 0:
                if (worth := float(np.clip(gain[first:end], -10 * MIN_SWAP_GAIN, 10 * MIN_SWAP_GAIN).sum())) > 0:
                    out.append((worth * 3, a, b, first, end - 1))
    return out


def _label_pair(crossing: tuple[int, int, int]) -> tuple[int, int]:
    return min(crossing[1:]), max(crossing[1:])


def _has_break(broken: NDArray, pair: tuple[int, int], frame: int) -> bool:
    """Whether labels may swap at a frame: an end of the take, or a break in either trajectory."""
    near = broken[max(frame - MAX_GAP, 0) : frame + MAX_GAP + 1, pair]
    return frame < MAX_GAP or frame > len(broken) - MAX_GAP or bool(near.any())


def _snap_to_crossing(frame: int, ends: Sequence[int]) -> tuple[int, bool]:
    """The nearest of the frames `ends` if one is near, else the frame itself; and whether one is."""
    nearest = min(ends, key=lambda e: abs(e - frame))
    return (nearest, True) if abs(nearest - frame) <= MAX_GAP else (frame, False)


def _find_strays(positions: NDArray, model: MarkerModel, labels: Sequence[str]) -> list[AuditFinding]:
    """Markers off their segment; of several at the same time the one with the largest error."""
    consistency = _consistency_of(model, labels)
    misfits = consistency.own(positions)
    out = []
    for k, label in enumerate(labels):
        for first, stop in runs_of(misfits[:, k] > OUTLIER_SIGMAS, MAX_GAP):
            last = stop - 1
            typical = nan_median(misfits[first : last + 1], axis=0)
            if last - first + 1 < MIN_SPAN_FRAMES or typical[k] < np.nanmax(typical):
                continue
            x = positions[first : last + 1]
            off = np.abs(np.linalg.norm(x[:, k, None] - x[:, consistency.partners[k]], axis=-1) - consistency.mean[k])
            size = float(np.nanmedian(off))
            if size < MIN_STRAY_DISTANCE:
                continue
            text = f"{label} is {100 * size:.0f} cm off its segment in frames {first} to {last}"
            out.append(AuditFinding("stray", (label,), first, last, size, text))
    return out


def _swap_finding(
    points: NDArray, pair: tuple[int, int], labels: Sequence[str], first: int, last: int, total: int
) -> AuditFinding:
    """The finding of a swap; if one label is rarely visible, only the other is reported as misnamed."""
    pair = min(pair), max(pair)
    names = labels[pair[0]], labels[pair[1]]
    gaps = np.linalg.norm(points[:, pair[0]] - points[:, pair[1]], axis=-1)
    visible_shares = np.isfinite(points[:, pair, 0]).mean(0)
    size = float(np.nanmedian(gaps)) if np.isfinite(gaps).any() else float("nan")
    what = f"{names[0]} and {names[1]} are swapped"
    if visible_shares.min() < 0.5:
        what = f"the label {names[int(np.argmax(visible_shares))]} is on {names[int(np.argmin(visible_shares))]}"
    always = last - first + 1 == total
    when = "throughout" if always else f"in frames {first} to {last}"
    text = f"{what} {when}" + (f" ({100 * size:.0f} cm apart)" if np.isfinite(size) else "")
    return AuditFinding("throughout" if always else "swapped", names, first, last, size, text)


MAX_RESTING_DISTANCE = 0.005
"""[m] a resting marker stays this close to its mean position in a window."""

MIN_NEIGHBOUR_DISTANCE = 0.05
"""[m] from its mean position that each neighbour of a resting marker moves."""

RESTING_WINDOW_S = 1.0
"""Length of a window: a foot stands for less, and so does a toe after the heel has lifted."""

MIN_NEIGHBOURS = 3
"""Nearest markers that must all move: of a hand on a table or a foot on the floor several rest together."""

_MAX_DISTANCE_FRAMES = 50  # frames in which distances are compared


def resting_markers(markers: Markers) -> list[tuple[str, tuple[int, int], float, str]]:
    """Find markers that rest in space while their neighbours move.

    They may rest in most frames of a take, where a model learnt from the same take would accept them.

    Returns
    -------
    list of (label, (first frame, last frame), median movement of the neighbours [m], sentence)
    """
    positions, length = markers.positions, max(2, round(RESTING_WINDOW_S * markers.rate))
    starts = np.arange(0, len(positions) - length + 1, max(1, length // 2))  # empty in a shorter take
    reach = np.array([_reach(positions[a : a + length]) for a in starts]).reshape(len(starts), positions.shape[1])
    out = []
    for k in np.flatnonzero((reach < MAX_RESTING_DISTANCE).any(axis=0)).tolist():
        near, label = _nearest(positions, k), markers.names[k]
        if len(near) < MIN_NEIGHBOURS:
            continue
        least = reach[:, near].min(axis=1)  # NaN where one is not visible: no finding
        for a, b in runs_of((reach[:, k] < MAX_RESTING_DISTANCE) & (least > MIN_NEIGHBOUR_DISTANCE)):
            span, moved = (int(starts[a]), int(starts[b - 1]) + length - 1), float(np.median(least[a:b]))
            text = f"{label} stays still in frames {span[0]} to {span[1]} but its neighbours move {100 * moved:.0f} cm"
            out.append((label, span, moved, f"{text}: it is not on their segments"))
    return out


def _reach(x: NDArray) -> NDArray:
    """(K,) [m] largest distance of each marker from its mean; NaN if it is visible in less than half of the frames."""
    visible = np.isfinite(x[..., 0])
    count = visible.sum(axis=0)
    mean = np.where(visible[..., None], x, 0.0).sum(axis=0) / np.maximum(count, 1)[:, None]
    far = np.where(visible, np.linalg.norm(x - mean, axis=2), 0.0).max(axis=0)
    return np.where(2 * count >= len(x), far, np.nan)


def _nearest(positions: NDArray, k: int) -> NDArray:
    """Indices of the markers with the least median distance to marker k over the take."""
    x = positions[:: max(1, len(positions) // _MAX_DISTANCE_FRAMES)]
    gaps = np.linalg.norm(x - x[:, k, None], axis=2)
    is_neighbour = np.isfinite(gaps).mean(axis=0) > 0.5
    is_neighbour[k] = False
    neighbours = np.flatnonzero(is_neighbour)
    return neighbours[np.argsort(np.nanmedian(gaps[:, neighbours], axis=0))[:MIN_NEIGHBOURS]]
