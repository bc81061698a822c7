"""Whether labels sit, and move, where a marker set or another subject says: swaps that last all through a take."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.marker_sets import MarkerSet
from kinefit.identification.model.from_frame import similarity
from kinefit.identification.model.learn import distances
from kinefit.identification.model.model import MarkerModel

MISPLACED = 0.035
"""[m] root mean square of a segment's markers off their places, below which nothing is said: laboratories and bodies
differ by that much from the catalogue's average places."""

BETTER = 0.5
"""Of what was, an exchange must leave at most this: in distance off places, or in how much distances vary."""

LOOSE = 0.02
"""[m] deviation of a label's distances to its own segment, above which it may be another's; shoulders have 0.015."""

Found = tuple[tuple[str, str], float, str]


def swapped_throughout(positions: NDArray, model: MarkerModel, places: Sequence[NDArray]) -> list[Found]:
    """Pairs of labels that are exchanged all through a take: the pair, [m] how far off it is, a sentence.

    Parameters
    ----------
    positions : (F, M, 3) [m] of the model's labels
    model : learnt from the take itself
    places : for each segment of the model (k + j, 3) [m], where its markers and then the joints that it is part of
        should be, of whatever size; NaN where not known. See `places_of_set`, `places_of_model`.
    """
    found = list(_by_motion(positions, model))
    for s in range(len(places)):
        found += _by_place(model, s, places)
    return found


def places_of_set(model: MarkerModel, marker_set: MarkerSet) -> list[NDArray]:
    """Places of a catalogue's set for a model's segments."""
    known = marker_set.match(model.labels)
    at = np.full((len(model), 3), np.nan)
    for i, name in enumerate(known):
        if name is not None:
            at[i] = marker_set.places[marker_set.labels.index(name)]
    joints = {s.name: s.joint for s in marker_set.segments if s.joint is not None}
    return [np.vstack([at[list(m)], *_joints(model, s, joints)]) for s, m in enumerate(model.segments)]


def places_of_model(model: MarkerModel, other: MarkerModel) -> list[NDArray]:
    """Another subject's places for a model's segments."""
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
    """(3,) each: the joints of a segment with its parent and children, in the order of the model's joints."""
    nothing = np.full(3, np.nan)
    return [joints.get(model.names[j.child], nothing) for j in model.joints if s in (j.parent, j.child)]


def _fits_elsewhere(model: MarkerModel, places: Sequence[NDArray], s: int, pair: tuple[int, int]) -> bool:
    """Whether an exchange leaves the other segments that either label belongs to where they should be."""
    swapped = np.array(model.reference)
    swapped[list(pair)] = swapped[list(pair[::-1])]
    for t, members in enumerate(model.segments):
        if t == s or not set(pair) & set(members):
            continue
        known = np.isfinite(places[t]).all(1)
        if known.sum() < 3:
            continue
        misfit = []
        for reference in (model.reference, swapped):
            have = np.vstack([reference[list(members)], *_joint_places(model, t)])
            scale, R, shift = similarity(places[t][known], have[known], np.eye(3))
            rest = have[known] - (scale * places[t][known] @ R.T + shift)
            misfit.append(float(np.sqrt((rest**2).sum(1).mean()) / max(scale, 1e-6)))
        if misfit[1] > max(misfit[0], MISPLACED):
            return False
    return True


def _by_place(model: MarkerModel, s: int, places: Sequence[NDArray]) -> Iterator[Found]:
    """Two labels of a segment that lie each where the other should."""
    members, should = model.segments[s], places[s]
    have = _own(model, s)
    known = np.isfinite(should).all(1)
    firm = np.flatnonzero(known[: len(members)])
    if known.sum() < 4:
        return

    def off(order: NDArray) -> float:
        scale, R, t = similarity(should[known], have[order][known], np.eye(3))
        rest = have[order][known] - (scale * should[known] @ R.T + t)
        return float(np.sqrt((rest**2).sum(1).mean()) / max(scale, 1e-6))

    start = np.arange(len(have))
    now = off(start)
    if now < MISPLACED:
        return
    trials = []
    for a, b in combinations(firm.tolist(), 2):
        order = start.copy()
        order[[a, b]] = order[[b, a]]
        trials.append((off(order), a, b))
    left, a, b = min(trials, default=(np.inf, 0, 0))
    if left < BETTER * now and _fits_elsewhere(model, places, s, (members[a], members[b])):
        pair = (model.labels[members[a]], model.labels[members[b]])
        text = f"{pair[0]} and {pair[1]} are swapped throughout: {model.names[s]} is {100 * now:.0f} cm off its places"
        yield pair, now, f"{text}, with them exchanged {100 * left:.0f} cm"


def elsewhere(model: MarkerModel, places: Sequence[NDArray]) -> list[tuple[str, float, str]]:
    """Labels that move with their segment but sit elsewhere on it than the places say: label, [m] how far, a sentence.

    Not a wrong name: another placing, or a marker that was moved. Each is judged by a fit of all the others.
    """
    out: dict[str, tuple[float, str]] = {}
    for s, members in enumerate(model.segments):
        should, have = places[s], _own(model, s)
        known = np.isfinite(should).all(1)
        for k in np.flatnonzero(known[: len(members)]).tolist():
            rest = known & (np.arange(len(have)) != k)
            if rest.sum() < 3 or np.linalg.svd(should[rest] - should[rest].mean(0), compute_uv=False)[1] < MISPLACED:
                continue
            scale, R, t = similarity(should[rest], have[rest], np.eye(3))
            off = float(np.linalg.norm(have[k] - (scale * R @ should[k] + t)))
            fit = np.linalg.norm(have[rest] - (scale * should[rest] @ R.T + t), axis=1)
            label = model.labels[members[k]]
            if off > 2 * MISPLACED and off > 2 * fit.max() and off > out.get(label, (0.0, ""))[0]:
                text = f"{label} sits {100 * off:.0f} cm elsewhere on {model.names[s]} and moves with it"
                out[label] = (off, f"{text}: placed otherwise, not misnamed")
    return [(label, size, text) for label, (size, text) in sorted(out.items(), key=lambda item: -item[1][0])]


def _own(model: MarkerModel, s: int) -> NDArray:
    """(k + j, 3) [m] a segment's markers and the joints that it is part of."""
    return np.vstack([model.reference[list(model.segments[s])], *_joint_places(model, s)])


def _joint_places(model: MarkerModel, s: int) -> list[NDArray]:
    """(3,) [m] each of the joints that a segment is part of."""
    return [j.in_parent if s == j.parent else j.in_child for j in model.joints if s in (j.parent, j.child)]


def _by_motion(positions: NDArray, model: MarkerModel) -> Iterator[Found]:
    """Two labels each of which moves with the other's segment."""
    varies = np.nan_to_num(distances(positions[:: max(1, len(positions) // 400)])[1])
    segment: dict[int, list[int]] = {}
    for members in model.segments:
        for m in members:
            segment.setdefault(m, []).extend(k for k in members if k != m)
    loose = [m for m, mates in segment.items() if mates and np.median(varies[m, mates]) > LOOSE]
    best: dict[int, tuple[float, int, int, float]] = {}
    for a, b in combinations(sorted(loose), 2):
        mates, others = [k for k in segment[a] if k != b], [k for k in segment[b] if k != a]
        if not mates or not others or a in others:
            continue
        now = float(np.median(varies[a, mates]) + np.median(varies[b, others]))
        then = float(np.median(varies[b, mates]) + np.median(varies[a, others]))
        if then < BETTER * now:
            for m in (a, b):
                best[m] = min(best.get(m, (np.inf, 0, 0, 0.0)), (then / now, a, b, now / 2))
    for a, b, size in sorted({(a, b, size) for m, (_, a, b, size) in best.items() if best[a][1:3] == best[b][1:3]}):
        pair = (model.labels[a], model.labels[b])
        text = f"{pair[0]} and {pair[1]} are swapped throughout: each moves with the other's segment"
        yield pair, size, text
