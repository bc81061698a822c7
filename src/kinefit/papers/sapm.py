"""Segment-based articulated point matching as published by Holstein and Li (P5): candidate tables, then the hierarchy.

For reliable labels use `kinefit.markers.frame.identify`; this is the published method.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.geometry import se3
from kinefit.markers.model.model import MarkerModel
from kinefit.papers import _sapm_steps as steps
from kinefit.papers._sapm_steps import candidate_table, coarse_updates, errors, mean_distance, nearest, triples

MAX_CORRECTIONS = 3
"""Matches of a segment that are tried until its children can be matched (backward correction)."""


@dataclass(frozen=True, eq=False)
class SapmProblem:
    """A model and a frame.

    Parameters
    ----------
    epsilon, beta : ε of (2) and (4), β of (3)
    """

    model: MarkerModel
    points: NDArray
    epsilon: float
    beta: float

    def markers(self, s: int) -> list[int]:
        """Labels of a segment."""
        return list(self.model.segments[s])

    def places(self, s: int) -> NDArray:
        """Positions (k, 3) [m] of the model's points."""
        return np.asarray(self.model.reference, float)[self.markers(s)]


def sapm(model: MarkerModel, points: ArrayLike, *, epsilon: float = 0.1, beta: float = 0.8) -> NDArray:
    """Match points to labels: point (M,) int of each label, -1 for none (P5 3).

    Parameters
    ----------
    points : (N, 3) [m]
    epsilon : tolerated distortion, as a share of a segment's mean distance; 0.10 to 0.15 for people in the paper
    beta : share of a segment's points that a match must exceed; 0.8 to 0.9 in the paper

    Raises
    ------
    ObservationError
        Points of the wrong shape or not finite.
    """
    at = shaped(points, ("N", 3), "points", finite=True)
    subject = SapmProblem(model, at, epsilon, beta)
    size = [len(m) for m in model.segments]
    root = max(range(len(size)), key=lambda s: (size[s], sum(s in (j.parent, j.child) for j in model.joints)))
    found, broken = identify_below(subject, root, -1, np.full(len(model), -1))
    for s in broken:  # segments of broken chains come last, without a pivot
        if (found[subject.markers(s)] < 0).any():
            found, _ = identify_below(subject, s, -1, found, alone=True)
    return found


def identify_below(
    subject: SapmProblem, s: int, parent: int, found: NDArray, alone: bool = False
) -> tuple[NDArray, list[int]]:
    """Match a segment and all below it, depth first: point (M,) of each label, and segments of broken chains (P5 3.2).

    The matches of its children confirm a match. If a child has none, the segment's next match is tried, and the match
    with most points is kept.
    """
    links = [(j.parent + j.child - s) for j in subject.model.joints if s in (j.parent, j.child)]
    children = [c for c in links if c != parent and not (alone and (found[subject.markers(c)] >= 0).all())]
    best, best_broken, most = found, children, -1
    for match in islice(segment_matches(subject, s, parent, found), MAX_CORRECTIONS):
        now, broken = found.copy(), []
        now[subject.markers(s)] = match
        for child in children:
            now, lost = identify_below(subject, child, s, now)
            broken += lost
        if (now >= 0).sum() > most:
            best, best_broken, most = now, broken, int((now >= 0).sum())
        if not broken:
            break
    return (best, best_broken) if most >= 0 else (found, [] if alone else below(subject, s, parent))


def below(subject: SapmProblem, s: int, parent: int) -> list[int]:
    """A segment and all its descendants, as seen from its parent, nearest first."""
    found, above = [s], {parent}
    for a in found:
        above.add(a)
        found += [j.parent + j.child - a for j in subject.model.joints if a in (j.parent, j.child)
                  and j.parent + j.child - a not in above]  # fmt: skip
    return found


def segment_matches(subject: SapmProblem, s: int, parent: int, found: NDArray) -> Iterator[NDArray]:
    """Matches (k,) of a segment that satisfy (2) and (3), from its tables in order of priority (P5 Fig. 1)."""
    x, epsilon, points = subject.places(s), subject.epsilon, subject.points
    length, count = mean_distance(x), len(x)
    known = found[subject.markers(s)]
    free = ~np.isin(np.arange(len(points)), found[found >= 0])
    free[known[known >= 0]] = True
    seen: set[tuple[int, ...]] = set()
    for tables, model, at in pivots(subject, s, parent, found, free):
        tables = [t for t in tables if t.filled > subject.beta * len(model)]
        for table in sorted(tables, key=lambda t: -t.size):
            update = coarse_updates if count >= steps.MIN_COARSE_POINTS else triples
            for T in update(table, model, at, epsilon * length):
                match = nearest(x, T, points, free, 2 * length * epsilon)
                here = match >= 0
                if here.sum() < max(min(3, count), 2) or here.sum() <= subject.beta * count or tuple(match) in seen:
                    continue
                e, _ = errors(x[here], points[match[here]])
                if e.mean() < epsilon * length and (known < 0).any() | (match == known).any():
                    seen.add(tuple(match))
                    yield match


def pivots(subject: SapmProblem, s: int, parent: int, found: NDArray, free: NDArray) -> Iterator[tuple]:
    """Candidate tables of a segment for each pivot: its joint if matched or virtual, else any point (k, 3)."""
    x, points, epsilon = subject.places(s), subject.points, subject.epsilon
    known = found[subject.markers(s)]
    at = np.vstack([points, np.zeros(3)])
    if (known >= 0).any():
        i = int(np.flatnonzero(known >= 0)[0])
        yield [candidate_table(x, points, free, i, points[known[i]], known[i], epsilon)], x, at
        return
    above = subject.places(parent) if parent >= 0 else np.empty((0, 3))
    match = found[subject.markers(parent)] if parent >= 0 else np.empty(0, int)
    if (match >= 0).sum() >= 3:  # a virtual joint
        joint = next(j for j in subject.model.joints if {j.parent, j.child} == {s, parent})
        there, here = (joint.in_parent, joint.in_child) if joint.parent == parent else (joint.in_child, joint.in_parent)
        _, T = errors(above[match >= 0], points[match[match >= 0]])
        at[-1] = se3.apply(T, there)
        model = np.vstack([x, here])
        yield [candidate_table(model, points, free, len(x), at[-1], -1, epsilon)], model, at
        return
    for i in range(max(1, round((1 - subject.beta) * len(x)))):
        yield [candidate_table(x, points, free, i, points[q], int(q), epsilon) for q in np.flatnonzero(free)], x, at
