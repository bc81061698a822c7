"""Segments from motion alone: groups of near-constant distances, and the points that are constant in two of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.marker_sets import GIVE, RANGE, bare
from kinefit.identification.model.from_frame import Skeleton
from kinefit.identification.model.rigid import joint_residual
from kinefit.solvers.rigid_clusters import local, middle, rigid_frames, shape_of

GIVE_WITHIN = 0.012
"""[m] deviation of a distance up to which two markers are of one segment: twice what the catalogue's markers give by
(0.004 m at each end), so that a soft part holds together; joints that turn move theirs by centimetres."""

FIRMEST, LONGEST = 0.015, 0.6
"""[m] deviation of a distance, and the distance, beyond which two markers are of no segment together: skin gives less,
and of a body's parts only a tall man's trunk is longer. What was held still looks like one segment whatever it is."""

NEARER = 0.002
"""By which a distance, as if it were a deviation, counts against a group, so that of what was held still the near
markers come together: 1 mm at 0.5 m."""

LOOSE = 1.5
"""By how much more a distance may give to a marker of a neighbour that helps a group of one or two to a shape."""

SHARED_GIVE = 0.010
"""[m] a marker that strays less than this from a second segment may be that segment's too: it sits on their joint."""

MOST_SHARED = 2
"""Markers that two segments share at most: those on a hinge's axis."""

MOST_FRAMES = 300
"""Frames that are looked at here; every marker is fitted without itself."""


def learn_segments(positions: NDArray, labels: Sequence[str], mean: NDArray, deviation: NDArray) -> Skeleton:
    """Segments and their tree, by what moves together.

    Complete linkage over the deviations of distances gives groups; each marker then goes to the group from whose
    rigid motion it strays least, and to a second one too if it hardly strays from that. Groups are joined into a tree
    by the points that are most nearly constant in both frames. No two of a segment vary by more than FIRMEST, nor are
    further apart than LONGEST.

    Parameters
    ----------
    positions : (F, M, 3) [m]
    mean, deviation : (M, M) [m] of distances, NaN for two that are never seen together
    """
    positions = positions[:: -(-len(positions) // MOST_FRAMES)]
    firm = (deviation <= FIRMEST) & (mean <= LONGEST)
    np.fill_diagonal(firm, True)
    apart = np.where(firm, deviation + NEARER * mean, np.inf)
    groups = settle(positions, linkage(apart, GIVE_WITHIN), firm)
    small = [g for g in groups if len(g) < 3]
    index = sorted(set().union(*small))  # of these, two and two that are nearly of one segment
    groups = [g for g in groups if len(g) >= 3]
    groups += [{index[i] for i in g} for g in linkage(apart[np.ix_(index, index)], LOOSE * GIVE_WITHIN)]
    members = [tuple(sorted(g)) for g in groups]
    wide = [widened(g, apart) for g in groups]
    shared = share(positions, members, wide, firm)
    cost = joint_costs(positions, shared, deviation)
    order, parents = rooted(cost, [len(m) for m in members])
    place = {g: i for i, g in enumerate(order)}
    segments = []
    for g in order:
        near = [c for c in order if parents[c] == g] + ([parents[g]] if parents[g] >= 0 else [])
        own = list(members[g])
        for m in sorted(set().union(*(shared[g] & set(members[c]) for c in near)) - set(own)):
            own += [m] if firm[m, own].all() else []
        segments.append(tuple(sorted(own)))
    names = tuple(named([labels[m] for m in members[g]]) for g in order)
    names = tuple(n if names.count(n) == 1 else f"{n}_{i}" for i, n in enumerate(names))
    unknown = np.full((len(labels), 3), np.nan)
    return Skeleton(
        names, tuple(-1 if parents[g] < 0 else place[parents[g]] for g in order), tuple(segments), unknown,
        np.full((len(order), 3), np.nan), (), tuple((GIVE,) * len(s) for s in segments), (RANGE,) * len(order),
    )


def linkage(apart: NDArray, most: float) -> list[set[int]]:
    """Groups by complete linkage: the two groups whose farthest members are nearest are merged, up to `most`."""
    groups = [{i} for i in range(len(apart))]
    d = np.array(apart, float)
    np.fill_diagonal(d, np.inf)
    while len(groups) > 1:
        i, j = np.unravel_index(np.argmin(d), d.shape)
        if d[i, j] > most:
            break
        i, j = min(i, j), max(i, j)
        groups[i] |= groups.pop(j)
        d[i] = d[:, i] = np.maximum(d[i], d[j])
        d = np.delete(np.delete(d, j, 0), j, 1)
        d[i, i] = np.inf
    return groups


def settle(positions: NDArray, groups: list[set[int]], firm: NDArray) -> list[set[int]]:
    """Each marker in the group from which it strays least, of those to all of whose markers it is `firm` (M, M).

    Groups too small for a motion of their own stay.
    """
    for _ in range(3):
        whole = [g for g in groups if len(g) >= 3]
        stray = np.stack([strays(positions, g) for g in whole]) if whole else np.empty((0, positions.shape[1]))
        moved = False
        for number, g in enumerate(whole):
            for m in sorted(g):
                best = _nearest(stray[:, m], whole, firm[m])
                if best >= 0 and best != number and len(g) > 3 and stray[best, m] < 0.7 * stray[number, m]:
                    g.discard(m)
                    whole[best].add(m)
                    moved = True
        for g in [g for g in groups if len(g) < 3]:
            for m in sorted(g):
                best = _nearest(stray[:, m], whole, firm[m])
                if best >= 0 and stray[best, m] < GIVE_WITHIN / 2:
                    g.discard(m)
                    whole[best].add(m)
                    moved = True
        groups = [g for g in groups if g]
        if not moved:
            break
    return groups


def _nearest(stray: NDArray, groups: list[set[int]], firm: NDArray) -> int:
    """The group that a marker strays least from, of those to which it is firm; -1 for none."""
    held = [i for i, g in enumerate(groups) if firm[sorted(g)].all()]
    return min(held, key=lambda i: stray[i], default=-1)


def strays(positions: NDArray, group: set[int]) -> NDArray:
    """(M,) [m] how far each marker strays from its mean place in the frame of a group (without itself), on one axis."""
    out = np.full(positions.shape[1], np.inf)
    inside = sorted(group)
    for leave in [None, *inside] if len(inside) > 3 else [None]:
        used = [m for m in inside if m != leave]
        R, t = rigid_frames(shape_of(positions[:, used]), positions[:, used])
        who = [leave] if leave is not None else list(range(positions.shape[1]))
        back = local(R, t, positions[:, who])
        away = middle(((back - middle(back, axis=0)) ** 2).sum(-1), axis=0)
        out[who] = np.where(np.isfinite(away), np.sqrt(away / 3), np.inf)
    return out


def widened(group: set[int], apart: NDArray) -> set[int]:
    """A group of one or two with markers of others that hold their distances to it, the firmest first, up to four."""
    out = set(group)
    while len(group) < 3 and len(out) < 4:
        firm = apart[sorted(out)].max(0)
        firm[sorted(out)] = np.inf
        if firm.min() > LOOSE * GIVE_WITHIN:
            break
        out.add(int(np.argmin(firm)))
    return out


def share(
    positions: NDArray, members: list[tuple[int, ...]], wide: list[set[int]], held: NDArray
) -> list[set[int]]:
    """Each group with markers of others that hardly stray from it: of each other group the two that do least."""
    out = []
    for g, more in zip(members, wide):
        found = set(more)
        if len(g) >= 3:
            stray = strays(positions, set(g))
            for other in members:
                if other is not g:
                    near = (m for m in other if stray[m] < SHARED_GIVE and held[m, list(g)].all())
                    firm = sorted(near, key=lambda m: stray[m])
                    found |= set(firm[:MOST_SHARED])
        out.append(found)
    return out


def joint_costs(positions: NDArray, groups: list[set[int]], deviation: NDArray) -> NDArray:
    """(G, G) [m] how badly two groups meet in a point that is constant in both, with half of its way to their markers.

    The way counts since a point far from both is nearly constant for any two that turn little.
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
            near = np.nanmin(middle(near, axis=0)) if np.isfinite(near).any() else np.inf
            cost[a, b] = cost[b, a] = cost[a, b] + 0.1 * near
    return cost


def rooted(cost: NDArray, sizes: Sequence[int]) -> tuple[list[int], list[int]]:
    """Order (parents first, depth first) and parents (-1 for the root) of the tree of least total cost.

    The root has most markers times neighbours (P5 3.2: more points, and more segments linked to it, than most).
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


def named(labels: Sequence[str]) -> str:
    """A group's name: its first two labels, without the subject."""
    plain = [bare(label) for label in labels]
    return "+".join(plain[:2]) + ("+" if len(plain) > 2 else "")
