"""Learn marker segments and their tree from motion alone: markers at near-constant distances form a segment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.marker_sets import GIVE, RANGE, bare
from kinefit.markers.model.from_frame import Skeleton
from kinefit.markers.model.rigid import joint_residual
from kinefit.solving.functional_joints import local, nan_median, rigid_frames, shape_of

MAX_SEGMENT_SIGMA = 0.012
"""[m] largest deviation of the distances within a segment: twice that of the catalogue's markers (0.004 m at each end).
Distances across a moving joint vary by centimetres."""

MAX_PAIR_SIGMA = 0.015
"""[m] two markers whose distance varies more are never of one segment: skin moves less."""

MAX_PAIR_DISTANCE = 0.6
"""[m] nor are two farther apart: only a tall man's trunk is longer. A joint without motion looks like one segment."""

DISTANCE_PENALTY = 0.002
"""[m deviation / m distance] penalty for long distances, so that nearby markers are grouped first in parts without
motion: 1 mm at 0.5 m."""

WIDENING_FACTOR = 1.5
"""Factor on MAX_SEGMENT_SIGMA for markers of a neighbour that complete a group of one or two."""

MAX_SHARED_SIGMA = 0.010
"""[m] a marker that varies less in the frame of a second segment may be shared with it: it sits on their joint."""

MAX_SHARED_MARKERS = 2
"""Most markers that two segments share: those on a hinge's axis."""

MAX_FRAMES = 300
"""Frames used here: every marker is fitted without itself, which is slow."""


def learn_segments(positions: NDArray, labels: Sequence[str], mean: NDArray, deviation: NDArray) -> Skeleton:
    """Learn segments and their tree from common motion.

    Complete linkage over the deviations of distances gives groups. Each marker is then reassigned to the group in whose
    frame it varies least, and shared with a second group if it hardly varies there. The tree joins the groups by the
    points that are most nearly constant in both frames.

    Parameters
    ----------
    positions : (F, M, 3) [m]; NaN where not visible
    labels : M names
    mean, deviation : (M, M) [m] of distances; NaN for pairs that are never visible together
    """
    positions = positions[:: -(-len(positions) // MAX_FRAMES)]
    firm = (deviation <= MAX_PAIR_SIGMA) & (mean <= MAX_PAIR_DISTANCE)
    np.fill_diagonal(firm, True)
    costs = np.where(firm, deviation + DISTANCE_PENALTY * mean, np.inf)
    groups = reassign_markers(positions, complete_linkage(costs, MAX_SEGMENT_SIGMA), firm)
    small = [g for g in groups if len(g) < 3]
    index = sorted(set().union(*small))  # of these, pairs that nearly form a segment are joined
    groups = [g for g in groups if len(g) >= 3]
    joined = complete_linkage(costs[np.ix_(index, index)], WIDENING_FACTOR * MAX_SEGMENT_SIGMA)
    groups += [{index[i] for i in g} for g in joined]
    members = [tuple(sorted(g)) for g in groups]
    widened = [widen_group(g, costs) for g in groups]
    shared = share_markers(positions, members, widened, firm)
    cost = joint_costs(positions, shared, deviation)
    order, parents = root_tree(cost, [len(m) for m in members])
    place = {g: i for i, g in enumerate(order)}
    segments = []
    for g in order:
        near = [c for c in order if parents[c] == g] + ([parents[g]] if parents[g] >= 0 else [])
        own = list(members[g])
        for m in sorted(set().union(*(shared[g] & set(members[c]) for c in near)) - set(own)):
            own += [m] if firm[m, own].all() else []
        segments.append(tuple(sorted(own)))
    names = tuple(group_name([labels[m] for m in members[g]]) for g in order)
    names = tuple(n if names.count(n) == 1 else f"{n}_{i}" for i, n in enumerate(names))
    unknown = np.full((len(labels), 3), np.nan)
    return Skeleton(
        names, tuple(-1 if parents[g] < 0 else place[parents[g]] for g in order), tuple(segments), unknown,
        np.full((len(order), 3), np.nan), (), tuple((GIVE,) * len(s) for s in segments), (RANGE,) * len(order),
    )


def complete_linkage(costs: NDArray, most: float) -> list[set[int]]:
    """Complete linkage: merge the two groups with the least largest cost until it exceeds `most`.

    Parameters
    ----------
    costs : (M, M) [m] cost of each pair
    most : [m]
    """
    if len(costs) < 2:
        return [{k} for k in range(len(costs))]
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial.distance import squareform

    finite = np.minimum(costs, 2.0 * most)  # which changes no group: beyond `most` nothing is merged
    of = fcluster(linkage(squareform(finite, checks=False), "complete"), most, "distance")
    return [set(np.flatnonzero(of == of[k]).tolist()) for k in sorted(np.unique(of, return_index=True)[1])]


def reassign_markers(positions: NDArray, groups: list[set[int]], firm: NDArray) -> list[set[int]]:
    """Move each marker to the group in whose frame it varies least; groups of one or two stay.

    Parameters
    ----------
    positions : (F, M, 3) [m]
    firm : (M, M) bool, pairs that may be of one group
    """
    for _ in range(3):
        large = [g for g in groups if len(g) >= 3]
        sigmas = np.stack([marker_sigmas(positions, g) for g in large]) if large else np.empty((0, positions.shape[1]))
        moved = False
        for number, g in enumerate(large):
            for m in sorted(g):
                best = _best_group(sigmas[:, m], large, firm[m])
                if best >= 0 and best != number and len(g) > 3 and sigmas[best, m] < 0.7 * sigmas[number, m]:
                    g.discard(m)
                    large[best].add(m)
                    moved = True
        for g in [g for g in groups if len(g) < 3]:
            for m in sorted(g):
                best = _best_group(sigmas[:, m], large, firm[m])
                if best >= 0 and sigmas[best, m] < MAX_SEGMENT_SIGMA / 2:
                    g.discard(m)
                    large[best].add(m)
                    moved = True
        groups = [g for g in groups if g]
        if not moved:
            break
    return groups


def _best_group(sigmas: NDArray, groups: list[set[int]], firm: NDArray) -> int:
    """The group in which a marker varies least, of those with all of which it is `firm`; -1 for none."""
    allowed = [i for i, g in enumerate(groups) if firm[sorted(g)].all()]
    return min(allowed, key=lambda i: sigmas[i], default=-1)


def marker_sigmas(positions: NDArray, group: set[int]) -> NDArray:
    """(M,) [m] standard deviation of each marker in the frame of a group, without itself, per axis; inf if unknown.

    Parameters
    ----------
    positions : (F, M, 3) [m]; NaN where not visible
    group : indices of markers
    """
    out = np.full(positions.shape[1], np.inf)
    inside = sorted(group)
    for excluded in [None, *inside] if len(inside) > 3 else [None]:
        used = [m for m in inside if m != excluded]
        R, t = rigid_frames(shape_of(positions[:, used]), positions[:, used])
        evaluated = [excluded] if excluded is not None else list(range(positions.shape[1]))
        local_points = local(R, t, positions[:, evaluated])
        variance = nan_median(((local_points - nan_median(local_points, axis=0)) ** 2).sum(-1), axis=0)
        out[evaluated] = np.where(np.isfinite(variance), np.sqrt(variance / 3), np.inf)
    return out


def widen_group(group: set[int], costs: NDArray) -> set[int]:
    """Add to a group of one or two up to two markers of other groups, those with the least cost first.

    Parameters
    ----------
    costs : (M, M) [m] of pairs
    """
    out = set(group)
    while len(group) < 3 and len(out) < 4:
        worst = costs[sorted(out)].max(0)
        worst[sorted(out)] = np.inf
        if worst.min() > WIDENING_FACTOR * MAX_SEGMENT_SIGMA:
            break
        out.add(int(np.argmin(worst)))
    return out


def share_markers(
    positions: NDArray, members: list[tuple[int, ...]], wide: list[set[int]], is_firm: NDArray
) -> list[set[int]]:
    """Add to each group the markers of others that hardly vary in its frame, at most two of each other group.

    Parameters
    ----------
    positions : (F, M, 3) [m]
    members, wide : the groups, and the same widened
    is_firm : (M, M) bool, pairs that may be of one group
    """
    out = []
    for g, extra in zip(members, wide):
        found = set(extra)
        if len(g) >= 3:
            sigmas = marker_sigmas(positions, set(g))
            for neighbour in members:
                if neighbour is not g:
                    near = (m for m in neighbour if sigmas[m] < MAX_SHARED_SIGMA and is_firm[m, list(g)].all())
                    ranked = sorted(near, key=lambda m: sigmas[m])
                    found |= set(ranked[:MAX_SHARED_MARKERS])
        out.append(found)
    return out


def joint_costs(positions: NDArray, groups: list[set[int]], deviation: NDArray) -> NDArray:
    """(G, G) [m] residual of the best joint of each two groups, plus a tenth of the distance of their nearest markers.

    The distance counts because a far point is nearly constant for any two groups that turn little.

    Parameters
    ----------
    positions : (F, M, 3) [m]; deviation : (M, M) [m] of distances
    """
    count = len(groups)
    cost = np.full((count, count), np.inf)
    frames = []
    for g in groups:
        x = shape_of(positions[:, sorted(g)])
        frames.append((x, *rigid_frames(x, positions[:, sorted(g)])) if len(g) >= 3 else None)
    for a in range(count):
        for b in range(a):
            first, second = (a, b) if frames[a] is not None else (b, a)
            parent = frames[first]
            if groups[a] & groups[b]:
                cost[a, b] = 0.0
            elif parent is None:
                between = deviation[np.ix_(sorted(groups[a]), sorted(groups[b]))]
                cost[a, b] = np.nanmin(between, initial=np.inf) + 0.05
            else:
                cost[a, b] = joint_residual(parent, frames[second], positions[:, sorted(groups[second])])
            near = np.linalg.norm(
                positions[:, sorted(groups[a])][:, :, None] - positions[:, sorted(groups[b])][:, None], axis=-1
            )
            near = np.nanmin(nan_median(near, axis=0)) if np.isfinite(near).any() else np.inf
            cost[a, b] = cost[b, a] = cost[a, b] + 0.1 * near
    return cost


def root_tree(cost: NDArray, sizes: Sequence[int]) -> tuple[list[int], list[int]]:
    """Minimum spanning tree over `cost` (G, G) [m]: order (parents first, depth first) and parents (-1 for the root).

    The root has the largest product of markers and neighbours.

    Source: P5 3.2 (the segment with most points and most links).
    """
    count = len(cost)
    links: list[set[int]] = [set() for _ in range(count)]
    best, nearest, outside = cost[0].copy(), np.zeros(count, int), set(range(1, count))
    while outside:
        g = min(outside, key=lambda k: best[k])
        links[g].add(int(nearest[g]))
        links[int(nearest[g])].add(g)
        outside.discard(g)
        closer = cost[g] < best
        best, nearest = np.where(closer, cost[g], best), np.where(closer, g, nearest)
    root = max(range(count), key=lambda g: sizes[g] * max(len(links[g]), 1))
    order, parents, stack = [], [-1] * count, [root]
    while stack:
        g = stack.pop()
        order.append(g)
        for c in sorted(links[g] - {parents[g]}, reverse=True):
            parents[c] = g
            stack.append(c)
    return order, parents


def group_name(labels: Sequence[str]) -> str:
    """A group's name: its first two labels, without the subject's prefix."""
    plain = [bare(label) for label in labels]
    return "+".join(plain[:2]) + ("+" if len(plain) > 2 else "")
