"""A marker model learnt from labelled takes: what holds its distance to what, and where segments meet (P5 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.marker_sets import MarkerSet, find_marker_set, load_marker_set
from kinefit.errors import ObservationError
from kinefit.identification.model.clusters import learn_segments
from kinefit.identification.model.from_frame import (
    JOINT_SPREAD,
    MARKER_SPREAD,
    NOISE,
    Skeleton,
    adopt,
    guess_deviation,
    pivot,
    place_joints,
    reach,
    skeleton_of,
)
from kinefit.identification.model.model import MarkerJoint, MarkerModel
from kinefit.identification.model.rigid import meet, told, turned, usual_turn
from kinefit.observations import Markers
from kinefit.solvers.rigid_clusters import middle, rigid_frames

MOST_FRAMES = 1000
"""Frames that are looked at, spread over the take: neighbours in time say the same."""

SELDOM = 0.01
"""A label that fewer of the frames show is left out: mostly a rest of somebody's editing ("RBAC-1")."""


WIDEST = 4.0
"""[m] that the markers of one subject spread over at most."""


@checked
def learn_model(markers: Markers, *, name: str = "subject", template: MarkerSet | str | None = None) -> MarkerModel:
    """What the markers of a labelled take hold to each other.

    Parameters
    ----------
    markers : Markers, labelled; several takes of the subject put one after the other are one take
    template : MarkerSet, or the name or file of one
        Its segments and joints are taken as the start, so that joints which were held still do not merge segments.
        Default: the catalogue's set that knows the labels. "" learns segments from the motion alone.

    Raises
    ------
    ObservationError
        The template does not fit the labels, or no frame shows three markers of the root.
    """
    marker_set = load_marker_set(template) if isinstance(template, str) and template else template
    if template is None:
        marker_set = find_marker_set(markers.names)
    positions, labels, gaps = usable(markers, marker_set or None)
    with np.errstate(all="ignore"):
        extent = float(np.nanmedian(np.nanmax(positions, axis=1) - np.nanmin(positions, axis=1), axis=0).max())
    if not extent < WIDEST:
        raise ObservationError(
            f"the labels spread over {extent:.4g} m", file=markers.source or None,
            remedy="One subject at a time, in the right unit (--unit mm ...).",
        )
    tables = distances(positions)
    if isinstance(marker_set, MarkerSet):
        skeleton = adopt(skeleton_of(labels, marker_set), tables[1])
    else:
        skeleton = learn_segments(positions, labels, tables[0], tables[1])
    return fit_model(positions, labels, skeleton, tables, name, gaps)


def usable(markers: Markers, marker_set: MarkerSet | None) -> tuple[NDArray, list[str], tuple[str, ...]]:
    """Positions (F, M, 3) [m] of real, labelled markers in at most MOST_FRAMES frames, labels, those seldom seen."""
    seen = np.isfinite(markers.positions[..., 0])
    keep = [
        i for i, label in enumerate(markers.names)
        if seen[:, i].sum() >= max(3, SELDOM * len(seen)) and not label.startswith("*")
        and not (marker_set and marker_set.is_computed(label))
    ]
    left_out = [n for i, n in enumerate(markers.names) if i not in keep and not n.startswith("*")]
    left_out = [n for n in left_out if not (marker_set and marker_set.is_computed(n))]
    if len(keep) < 3:
        problem, remedy = f"{len(keep)} labelled markers are ever seen", "A model needs three and more."
        if all(label.startswith("*") for label in markers.names):
            problem = f"{len(markers.names)} trajectories without names"
            remedy = "Identify first: `kinefit markers identify TAKE SUBJECT.json`; a subject is learnt from names."
        raise ObservationError(problem, file=markers.source or None, remedy=remedy)
    rows = np.flatnonzero(seen[:, keep].sum(1) >= 3)
    step = max(1, -(-len(rows) // MOST_FRAMES))
    gaps = left_out + [markers.names[i] for i in keep if seen[:, i].mean() < 0.1]
    return markers.positions[rows[::step]][:, keep], [markers.names[i] for i in keep], tuple(gaps)


def distances(positions: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """(M, M) [m] each: mean, standard deviation, least and largest distance; robust to a few wrong labels.

    Deviations beyond five times the median one count as five; least and largest are the 0.5 and 99.5 % quantiles.
    NaN for two that were never seen together.
    """
    count = positions.shape[1]
    mean, deviation, low, high = (np.full((count, count), np.nan) for _ in range(4))
    for i in range(count):
        d = np.linalg.norm(positions[:, i:] - positions[:, i, None], axis=-1)
        seen = np.isfinite(d)
        for gaps in (False, True):  # numpy takes many times as long for columns in which there may be a NaN
            some = np.flatnonzero(seen.any(0) & (seen.all(0) != gaps))
            if not some.size:
                continue
            x, median, quantile = d[:, some], *((np.nanmedian, np.nanquantile) if gaps else (np.median, np.quantile))
            usual = median(x, axis=0)
            most = 5 * 1.4826 * median(np.abs(x - usual), axis=0) + 1e-4
            inside = np.clip(x, usual - most, usual + most)
            found = np.nanmean(inside, axis=0), np.nanstd(inside, axis=0), *quantile(x, [0.005, 0.995], axis=0)
            for table, values in zip((mean, deviation, low, high), found):
                table[i, i + some] = table[i + some, i] = values
    return mean, deviation, low, high


def fit_model(
    positions: NDArray, labels: list[str], skeleton: Skeleton, tables: tuple[NDArray, NDArray, NDArray, NDArray],
    name: str, gaps: tuple[str, ...],
) -> MarkerModel:
    """The model of segments that are known."""
    mean, deviation, low, high = tables
    reference = mean_shape(positions, skeleton.members, mean)
    places = place_joints(reference, skeleton)
    joints: list[MarkerJoint] = []
    Rs: list[NDArray] = []
    ts: list[NDArray] = []
    for s, members in enumerate(skeleton.members):
        p = skeleton.parents[s]
        x, y = reference[list(members)], positions[:, list(members)]
        if p < 0:
            R, t = rigid_frames(x, y, np.broadcast_to(np.eye(3), (len(y), 3, 3)))
        else:
            marker = pivot(skeleton, s, places[s], reference)
            guess = places[s] if marker is None else reference[marker]
            a = b = guess
            if marker is None:
                R, t = rigid_frames(x, y, Rs[p])
                a, b = meet(Rs[p], ts[p], R, t, x, y, guess)
            known = Rs[p] @ a + ts[p]
            R, t = rigid_frames(np.vstack([x, b]), np.concatenate([y, known[:, None]], 1), Rs[p])
            spread = np.linalg.norm(known - (R @ b + t), axis=-1)
            spread = spread[np.isfinite(spread)]
            typical = float(np.sqrt(np.median(spread**2))) if len(spread) else JOINT_SPREAD
            enough = np.isfinite(y[..., 0]).sum(1) >= min(3, len(x))
            ranges = turned(Rs[p], R, enough)
            joint = MarkerJoint(p, s, a, b, typical, marker, ranges[0], ranges)
            share = told(joint, skeleton.ranges[s])
            turn, give = usual_turn(Rs[p], R, enough, skeleton.ranges[s])
            joint = replace(joint, turn=turn, give=give)
            usual = max(typical, MARKER_SPREAD if marker is not None else JOINT_SPREAD)
            joints.append(replace(joint, spread=float(np.sqrt(share * typical**2 + (1 - share) * usual**2))))
        Rs.append(R)
        ts.append(t)
    tree_low, tree_high = reach(reference, skeleton.members, joints)
    own = np.linalg.norm(reference[:, None] - reference, axis=-1)
    mean = np.where(np.isfinite(mean), mean, own)
    guess = guess_deviation(mean, skeleton, tree_low, tree_high)
    known = np.where(np.isfinite(deviation), exercise(skeleton, joints, len(labels)), 0.0)
    deviation = np.nan_to_num(np.hypot(deviation, NOISE))
    deviation = np.sqrt(known * deviation**2 + (1 - known) * np.maximum(deviation, guess) ** 2)
    np.fill_diagonal(deviation, 0.0)
    low, high = np.fmin(low, mean), np.fmax(high, mean)
    low, high = low + (1 - known) * np.minimum(tree_low - low, 0), high + (1 - known) * np.maximum(tree_high - high, 0)
    segments = skeleton.members
    return MarkerModel(
        name, tuple(labels), reference, segments, skeleton.names, tuple(joints), mean, deviation, low, high, gaps
    )


def exercise(skeleton: Skeleton, joints: Sequence[MarkerJoint], count: int) -> NDArray:
    """(M, M) in 0..1: how far the motion tells what a distance does.

    Across joints: the least of the joints between. Within a segment: the mean of its joints, as skin is moved by them.
    """
    members = skeleton.members
    share = {j.child: told(j, skeleton.ranges[j.child]) for j in joints}
    parent = {j.child: j.parent for j in joints}
    known = np.ones((count, count))
    for a in range(len(members)):
        for b in range(a, len(members)):
            if a == b:
                around = [v for c, v in share.items() if a in (c, parent[c])]
                value = float(np.mean(around)) if around else 1.0
            else:
                value = min(share[s] for s in _between(a, b, parent))
            i, j = np.ix_(list(members[a]), list(members[b])), np.ix_(list(members[b]), list(members[a]))
            known[i] = np.minimum(known[i], value)
            known[j] = np.minimum(known[j], value)
    return known


def _between(a: int, b: int, parent: dict[int, int]) -> list[int]:
    """The segments whose joints with their parents lie between two segments."""
    ways = []
    for s in (a, b):
        way = [s]
        while way[-1] in parent:
            way.append(parent[way[-1]])
        ways.append(way)
    common = next(s for s in ways[0] if s in ways[1])
    return [s for way in ways for s in way[: way.index(common)]]


def mean_shape(positions: NDArray, segments: tuple[tuple[int, ...], ...], mean: NDArray) -> NDArray:
    """(M, 3) [m] each segment's mean shape, laid onto the frame that shows most, with the most usual distances."""
    seen = np.isfinite(positions[..., 0])
    best = np.flatnonzero(seen.sum(1) == seen.sum(1).max())
    best = best[:: max(1, len(best) // 200)]
    within = np.zeros(mean.shape, bool)
    for m in segments:
        within[np.ix_(m, m)] = True
    misfit = []
    for f in best:
        d = np.abs(np.linalg.norm(positions[f][:, None] - positions[f], axis=-1) - mean)[within]
        misfit.append(np.nanmean(d))
    frame = positions[best[int(np.argmin(misfit))]]
    sums, weights = np.zeros_like(frame), np.zeros(len(frame))
    prior = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    for m in segments:
        index = list(m)
        y = positions[:, index]
        shape = frame[index]
        if not np.isfinite(shape).all():
            whole = np.isfinite(y[..., 0]).sum(1)
            shape = y[int(np.argmax(whole))]
            shape = np.where(np.isfinite(shape), shape, np.nanmean(shape, axis=0))
        for _ in range(4):
            R, t = rigid_frames(shape, y, prior)
            back = np.einsum("fji,fkj->fki", R, y - t[:, None])
            here = np.isfinite(back[..., 0])
            typical = middle(np.where(here[..., None], back, np.nan), axis=0)
            shape = np.where(np.isfinite(typical), typical, shape)
        R, t = rigid_frames(shape, frame[None, index], prior[:1])
        if np.isfinite(t).all():
            sums[index] += shape @ R[0].T + t[0]
            weights[index] += 1
    placed = weights > 0
    if not placed.all():
        raise ObservationError("no frame shows all segments", remedy="Give a take in which every marker is seen.")
    return sums / weights[:, None]
