"""Detect swaps that last a whole take, and markers worn elsewhere, by a marker set or another subject's model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.marker_sets import MarkerSet
from kinefit.markers.model.from_frame import similarity
from kinefit.markers.model.learn import distance_statistics
from kinefit.markers.model.model import MarkerModel

MIN_PLACEMENT_RMS = 0.035
"""[m] root mean square of a segment's placement errors below which nothing is reported: laboratories and bodies differ
by that much from the catalogue's mean places."""

MAX_RATIO_AFTER_SWAP = 0.5
"""A swap must lower the placement error, or the deviation of distances, to this share or less."""

MAX_OWN_DEVIATION = 0.02
"""[m] deviation of a label's distances to its segment above which it may be another segment's; shoulders have 0.015."""

PairFinding = tuple[tuple[str, str], float, str]


def permanent_swaps(positions: NDArray, model: MarkerModel, places: Sequence[NDArray]) -> list[PairFinding]:
    """Pairs of labels that are swapped in the whole take: the pair, [m] how far off it is, a sentence.

    Parameters
    ----------
    positions : (F, M, 3) [m] of the model's labels
    model : learnt from the take itself
    places : for each segment of the model (k + j, 3) [m], expected places of its k markers and then of its j joints, at
        any scale; NaN where unknown. See `places_of_set`, `places_of_model`.
    """
    found = list(_swaps_by_motion(positions, model))
    for s in range(len(places)):
        found += _swaps_by_place(model, s, places)
    return found


def places_of_set(model: MarkerModel, marker_set: MarkerSet) -> list[NDArray]:
    """Expected places of a model's markers and joints by a marker set.

    Returns
    -------
    for each segment (k + j, 3) [m]: its k markers, then its j joints; NaN where the set does not know them
    """
    known = marker_set.match(model.labels)
    at = np.full((len(model), 3), np.nan)
    for i, name in enumerate(known):
        if name is not None:
            at[i] = marker_set.places[marker_set.labels.index(name)]
    joints = {s.name: s.joint for s in marker_set.segments if s.joint is not None}
    return [np.vstack([at[list(m)], *_joints(model, s, joints)]) for s, m in enumerate(model.segments)]


def places_of_model(model: MarkerModel, other: MarkerModel) -> list[NDArray]:
    """Expected places of a model's markers and joints by another subject's model.

    Returns
    -------
    for each segment (k + j, 3) [m]: its k markers, then its j joints; NaN where `other` does not know them
    """
    at = np.full((len(model), 3), np.nan)
    for i, label in enumerate(model.labels):
        if label in other.labels:
            at[i] = other.reference[other.labels.index(label)]
    out = []
    for s, members in enumerate(model.segments):
        name = model.names[s]
        joints: dict[str, NDArray] = {}
        for j in other.joints:
            if other.names[j.child] == name:
                joints[name] = j.in_child
            elif other.names[j.parent] == name:
                joints[other.names[j.child]] = j.in_parent
        out.append(np.vstack([at[list(members)], *_joints(model, s, joints)]))
    return out


def _joints(model: MarkerModel, s: int, joints: dict[str, NDArray]) -> list[NDArray]:
    """(3,) each: joints of a segment with its parent and children, in the model's order; NaN where unknown."""
    unknown = np.full(3, np.nan)
    return [joints.get(model.names[j.child], unknown) for j in model.joints if s in (j.parent, j.child)]


def _fits_other_segments(model: MarkerModel, places: Sequence[NDArray], s: int, pair: tuple[int, int]) -> bool:
    """Whether the other segments of both labels still fit their places after a swap."""
    swapped = np.array(model.reference)
    swapped[list(pair)] = swapped[list(pair[::-1])]
    for t, members in enumerate(model.segments):
        if t == s or not set(pair) & set(members):
            continue
        known = np.isfinite(places[t]).all(1)
        if known.sum() < 3:
            continue
        actual = (np.vstack([x[list(members)], *_joint_places(model, t)])[known] for x in (model.reference, swapped))
        before, after = (_placement_rms(places[t][known], x) for x in actual)
        if after > max(before, MIN_PLACEMENT_RMS):
            return False
    return True


def _placement_rms(expected: NDArray, actual: NDArray) -> float:
    """Root mean square [m] of places (k, 3) about the expected ones, fitted by a similarity, at the expected scale."""
    scale, R, t = similarity(expected, actual, np.eye(3))
    return float(np.sqrt(((actual - (scale * expected @ R.T + t)) ** 2).sum(1).mean()) / max(scale, 1e-6))


def _swaps_by_place(model: MarkerModel, s: int, places: Sequence[NDArray]) -> Iterator[PairFinding]:
    """Pairs of labels of a segment that lie at each other's expected place."""
    members, expected = model.segments[s], places[s]
    actual = _segment_points(model, s)
    known = np.isfinite(expected).all(1)
    firm = np.flatnonzero(known[: len(members)])
    if known.sum() < 4:
        return
    rms = _placement_rms(expected[known], actual[known])
    if rms < MIN_PLACEMENT_RMS:
        return
    trials = []
    for a, b in combinations(firm.tolist(), 2):
        swapped = actual.copy()
        swapped[[a, b]] = swapped[[b, a]]
        trials.append((_placement_rms(expected[known], swapped[known]), a, b))
    rms_after, a, b = min(trials, default=(np.inf, 0, 0))
    if rms_after < MAX_RATIO_AFTER_SWAP * rms and _fits_other_segments(model, places, s, (members[a], members[b])):
        pair = (model.labels[members[a]], model.labels[members[b]])
        text = f"{pair[0]} and {pair[1]} are swapped throughout: {model.names[s]} is {100 * rms:.0f} cm off its markers"
        yield pair, rms, f"{text}, after a swap {100 * rms_after:.0f} cm"


def moved_labels(model: MarkerModel, places: Sequence[NDArray]) -> list[tuple[str, float, str]]:
    """Labels that move with their segment but sit elsewhere on it than expected: (label, [m] distance, sentence).

    Their names are right: the marker was placed otherwise, or moved. Each label is compared with a fit of the others.

    Parameters
    ----------
    places : for each segment (k + j, 3) [m], as in `permanent_swaps`
    """
    out: dict[str, tuple[float, str]] = {}
    for s, members in enumerate(model.segments):
        expected, actual = places[s], _segment_points(model, s)
        known = np.isfinite(expected).all(1)
        for k in np.flatnonzero(known[: len(members)]).tolist():
            others = known & (np.arange(len(actual)) != k)
            x = expected[others]
            if others.sum() < 3 or np.linalg.svd(x - x.mean(0), compute_uv=False)[1] < MIN_PLACEMENT_RMS:
                continue
            scale, R, t = similarity(x, actual[others], np.eye(3))
            distance = float(np.linalg.norm(actual[k] - (scale * R @ expected[k] + t)))
            residuals = np.linalg.norm(actual[others] - (scale * x @ R.T + t), axis=1)
            label = model.labels[members[k]]
            if distance > max(2 * MIN_PLACEMENT_RMS, 2 * residuals.max(), out.get(label, (0.0, ""))[0]):
                text = f"{label} is {100 * distance:.0f} cm off its position on {model.names[s]} and moves with it"
                out[label] = (distance, f"{text}: placed differently, not mislabelled")
    return [(label, size, text) for label, (size, text) in sorted(out.items(), key=lambda item: -item[1][0])]


def _segment_points(model: MarkerModel, s: int) -> NDArray:
    """(k + j, 3) [m] a segment's markers and its joints."""
    return np.vstack([model.reference[list(model.segments[s])], *_joint_places(model, s)])


def _joint_places(model: MarkerModel, s: int) -> list[NDArray]:
    """(3,) [m] each: the joints of a segment, in its frame."""
    return [j.in_parent if s == j.parent else j.in_child for j in model.joints if s in (j.parent, j.child)]


def _swaps_by_motion(positions: NDArray, model: MarkerModel) -> Iterator[PairFinding]:
    """Pairs of labels that each move with the other's segment."""
    deviation = np.nan_to_num(distance_statistics(positions[:: max(1, len(positions) // 400)])[1])
    mates_of: dict[int, list[int]] = {}
    for members in model.segments:
        for m in members:
            mates_of.setdefault(m, []).extend(k for k in members if k != m)
    suspects = [m for m, mates in mates_of.items() if mates and np.median(deviation[m, mates]) > MAX_OWN_DEVIATION]
    best: dict[int, tuple[float, int, int, float]] = {}
    for a, b in combinations(sorted(suspects), 2):
        mates, other_mates = [k for k in mates_of[a] if k != b], [k for k in mates_of[b] if k != a]
        if not mates or not other_mates or a in other_mates:
            continue
        before = float(np.median(deviation[a, mates]) + np.median(deviation[b, other_mates]))
        after = float(np.median(deviation[b, mates]) + np.median(deviation[a, other_mates]))
        if after < MAX_RATIO_AFTER_SWAP * before:
            for m in (a, b):
                best[m] = min(best.get(m, (np.inf, 0, 0, 0.0)), (after / before, a, b, before / 2))
    for a, b, size in sorted({(a, b, size) for m, (_, a, b, size) in best.items() if best[a][1:3] == best[b][1:3]}):
        pair = (model.labels[a], model.labels[b])
        text = f"{pair[0]} and {pair[1]} are swapped throughout: each moves with the other's segment"
        yield pair, size, text
