"""A marker model from one labelled frame and a marker set (P5 2: "one frame ... that includes full feature points")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked, shaped
from kinefit.bodies.marker_sets import GIVE, MIN_COMMON_LABELS, MarkerSet
from kinefit.errors import ObservationError
from kinefit.geometry.se3 import nearest_rotation
from kinefit.markers.model.model import MarkerJoint, MarkerModel

DISTANCE_NOISE = 0.001
"""[m] standard deviation of a measured distance."""

JOINT_SPREAD = 0.02
"""[m] prior standard deviation of a virtual joint: body proportions and skin."""

MARKER_SPREAD = 0.01
"""[m] prior standard deviation of a joint at a marker that both segments share."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A marker set's segments, reduced to the labels of a take.

    Parameters
    ----------
    names, parents : of the S segments; the root first, with parent -1
    members : (k,) int each, indices into the take's M labels
    places, joints : (M, 3), (S, 3) [m] in the set; NaN where unknown
    unknown : indices of the labels that the set does not know
    give : [m] standard deviation of each member of each segment
    ranges : [rad] of each segment's joint; see SetSegment
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    members: tuple[tuple[int, ...], ...]
    places: NDArray
    joints: NDArray
    unknown: tuple[int, ...]
    give: tuple[tuple[float, ...], ...]
    ranges: tuple[float, ...]

    def shared(self, s: int) -> tuple[int, ...]:
        """Markers that a segment shares with its parent."""
        return () if self.parents[s] < 0 else tuple(m for m in self.members[s] if m in self.members[self.parents[s]])


def skeleton_of(labels: Sequence[str], marker_set: MarkerSet) -> Skeleton:
    """Reduce a marker set to the segments with a marker of their own among the labels; other segments are skipped.

    Children of a skipped segment are linked to its nearest remaining ancestor.

    Raises
    ------
    ObservationError
        The set knows fewer than four of the labels, or fewer than half; or the root would have fewer than three.
    """
    known = marker_set.match(labels)
    number = {name: i for i, name in enumerate(known) if name is not None}
    if len(number) < MIN_COMMON_LABELS or (2 * len(number) < len(labels) and 2 * len(number) < len(marker_set.labels)):
        raise ObservationError(
            f"marker set {marker_set.name} knows {len(number)} of {len(labels)} labels "
            f"({', '.join(labels[:6])}{' ...' if len(labels) > 6 else ''})",
            remedy=f"It has: {', '.join(marker_set.labels[:8])} ... Choose another set, or rename the markers.",
        )
    members = [tuple(number[m] for m in s.markers if m in number) for s in marker_set.segments]
    inherited: list[set[int]] = []
    for segment in marker_set.segments:
        inherited.append(set() if segment.parent < 0 else inherited[segment.parent] | set(members[segment.parent]))
    keep = [s for s in range(len(members)) if set(members[s]) - inherited[s]]
    keep = [s for i, s in enumerate(keep) if i or len(members[s]) >= 3] or keep
    while keep and len(members[keep[0]]) < 3:
        keep = keep[1:]
    if not keep:
        raise ObservationError("no segment has three markers", remedy="A root needs three; add markers to the trunk.")
    unassigned = {m for s in range(len(members)) if s not in keep for m in members[s]}
    unassigned -= {m for s in keep for m in members[s]}
    parents = []
    for i, s in enumerate(keep):
        p = marker_set.segments[s].parent
        while p >= 0 and p not in keep:
            p = marker_set.segments[p].parent
        parents.append(-1 if i == 0 else keep.index(p) if p >= 0 else 0)
    places = np.full((len(labels), 3), np.nan)
    for name, i in number.items():
        places[i] = marker_set.places[marker_set.labels.index(name)]
    joints = np.full((len(keep), 3), np.nan)
    for i, s in enumerate(keep):
        if marker_set.segments[s].joint is not None:
            joints[i] = marker_set.segments[s].joint
    unknown = tuple(sorted({i for i, name in enumerate(known) if name is None} | unassigned))
    give = []
    for segment in (marker_set.segments[s] for s in keep):
        each = segment.give or (GIVE,) * len(segment.markers)
        give.append(tuple(g for m, g in zip(segment.markers, each) if m in number))
    names = tuple(marker_set.segments[s].name for s in keep)
    own, ranges = tuple(members[s] for s in keep), tuple(marker_set.segments[s].range for s in keep)
    return Skeleton(names, tuple(parents), own, places, joints, unknown, tuple(give), ranges)


def similarity(x: NDArray, y: NDArray, prior: NDArray) -> tuple[float, NDArray, NDArray]:
    """Least-squares scale s, rotation R, translation t with s R x + t = y.

    Parameters
    ----------
    x, y : (n, 3) [m], n >= 1
    prior : (3, 3) rotation that decides what the points leave undetermined; its weight is negligible otherwise
    """
    a, b = x - x.mean(0), y - y.mean(0)
    size = float((a * a).sum())
    cross = b.T @ a + (1e-4 * size + 1e-12) * prior
    R = nearest_rotation(cross)
    scale = float(np.sqrt((b * b).sum() / size)) if len(x) > 1 and size > 0 else 1.0
    return scale, R, y.mean(0) - scale * R @ x.mean(0)


def place_joints(positions: NDArray, skeleton: Skeleton) -> NDArray:
    """(S, 3) [m] each segment's joint with its parent in one frame; NaN for the root.

    Each segment of the set is fitted to its markers by a similarity, the root first. A joint is the mean of its places
    by parent and child. Without places in the set it lies between the two nearest markers.

    Parameters
    ----------
    positions : (M, 3) [m] of the skeleton's labels
    """
    count = len(skeleton.names)
    joints = np.full((count, 3), np.nan)
    fits: list[tuple[float, NDArray, NDArray]] = []
    for s in range(count):
        p = skeleton.parents[s]
        known = [m for m in skeleton.members[s] if np.isfinite(skeleton.places[m]).all()]
        x, y = skeleton.places[known], positions[known]
        prior = fits[p] if p >= 0 else (1.0, np.eye(3), np.zeros(3))
        if p >= 0 and np.isfinite(skeleton.joints[s]).all():
            joints[s] = prior[0] * prior[1] @ skeleton.joints[s] + prior[2]
            if len(known) >= 3:
                scale, R, t = similarity(x, y, prior[1])
                is_planar = np.linalg.svd(x - x.mean(0), compute_uv=False)[1] > 0.03  # [m]; else turned about a line
                own = scale * R @ skeleton.joints[s] + t
                joints[s] = 0.5 * (joints[s] + own) if is_planar else joints[s]
            x, y = np.vstack([x, skeleton.joints[s]]), np.vstack([y, joints[s]])
        fits.append(similarity(x, y, prior[1]) if len(x) > 1 else prior)
    for s in range(1, count):
        if not np.isfinite(joints[s]).all():
            own_points, parent_points = (positions[list(skeleton.members[k])] for k in (s, skeleton.parents[s]))
            gaps = np.linalg.norm(own_points[:, None] - parent_points, axis=-1)
            i, j = np.unravel_index(np.argmin(gaps), gaps.shape)
            joints[s] = 0.5 * (own_points[i] + parent_points[j])
    return joints


def reachable_distances(
    reference: NDArray, members: Sequence[Sequence[int]], joints: Sequence[MarkerJoint]
) -> tuple[NDArray, NDArray]:
    """(M, M) [m] each: least and largest distance of two markers that the segment tree allows in any pose.

    Within a segment both are the distance itself. Across joints the largest is the length of the chain of joints, and
    the least what remains of its longest piece if the others fold against it.

    Parameters
    ----------
    reference : (M, 3) [m]
    members : indices of the markers of each segment
    """
    count, size = len(reference), len(members)
    low, high = np.zeros((count, count)), np.full((count, count), np.inf)
    mean = np.linalg.norm(reference[:, None] - reference, axis=-1)
    joint_of = {j.child: j for j in joints}

    for a in range(size):
        for b in range(a, size):
            if a == b:
                i = np.ix_(list(members[a]), list(members[a]))
                low[i], high[i] = mean[i], mean[i]
                continue
            up, down = joints_between(a, b, {child: j.parent for child, j in joint_of.items()})
            chain = [(joint_of[s].in_child, joint_of[s].in_parent) for s in up]
            chain += [(joint_of[s].in_parent, joint_of[s].in_child) for s in reversed(down)]
            inner = [float(np.linalg.norm(k[1] - n[0])) for k, n in pairwise(chain)]
            first = np.linalg.norm(reference[list(members[a])] - chain[0][0], axis=-1)
            last = np.linalg.norm(reference[list(members[b])] - chain[-1][1], axis=-1)
            total = first[:, None] + last + sum(inner)
            longest = np.maximum(np.maximum(first[:, None], last), max(inner, default=0.0))
            i, j = np.ix_(list(members[a]), list(members[b])), np.ix_(list(members[b]), list(members[a]))
            least = np.maximum(2 * longest - total, 0.0)
            high[i] = np.minimum(high[i], total)
            low[i] = np.maximum(low[i], least)
            high[j], low[j] = high[i].T, low[i].T
    return low, np.maximum(high, low)


def joints_between(a: int, b: int, parent: Mapping[int, int]) -> tuple[list[int], list[int]]:
    """The segments whose parent joints lie on the path between segments a and b: upwards from a, and from b."""
    paths = []
    for s in (a, b):
        path = [s]
        while path[-1] in parent:
            path.append(parent[path[-1]])
        paths.append(path)
    common = next(s for s in paths[0] if s in paths[1])
    up, down = (path[: path.index(common)] for path in paths)
    return up, down


def prior_deviation(mean: NDArray, skeleton: Skeleton, low: NDArray, high: NDArray) -> NDArray:
    """(M, M) [m] standard deviations of distances without training: from skin within segments, else from the tree.

    Parameters
    ----------
    mean, low, high : (M, M) [m] mean, least and largest distances
    """
    deviation = (high - low) / np.sqrt(12.0)
    within = np.full(mean.shape, np.inf)
    for m, give in zip(skeleton.members, skeleton.give):
        i, g = np.ix_(list(m), list(m)), np.asarray(give)
        within[i] = np.minimum(within[i], np.sqrt(DISTANCE_NOISE**2 + g[:, None] ** 2 + g**2))
    deviation = np.where(np.isfinite(within), within, deviation + DISTANCE_NOISE)
    np.fill_diagonal(deviation, 0.0)
    return deviation


@checked
def model_from_frame(
    positions: ArrayLike, labels: Sequence[str], marker_set: MarkerSet, *, name: str = "subject"
) -> MarkerModel:
    """Make a subject's marker model from one labelled frame.

    Parameters
    ----------
    positions : (M, 3) [m]; a marker with NaN is excluded and listed in the model's gaps
    labels : (M,)
    marker_set : MarkerSet
        A label that it does not know goes to the nearest segment; computed points are excluded.

    Raises
    ------
    ObservationError
        Shapes disagree, a label appears twice, the set does not fit the labels, or the root has too few markers.
    """
    points = shaped(positions, (len(labels), 3), "positions")
    measured = [i for i, label in enumerate(labels) if not marker_set.is_computed(label) and not label.startswith("*")]
    kept = [i for i in measured if np.isfinite(points[i]).all()]
    labels, points, gaps = [labels[i] for i in kept], points[kept], tuple(labels[i] for i in measured if i not in kept)
    skeleton = skeleton_of(labels, marker_set)
    skeleton = assign_unknown(skeleton, np.linalg.norm(points[:, None] - points, axis=-1))
    places = place_joints(points, skeleton)
    joints = []
    for s in range(1, len(skeleton.names)):
        marker = shared_marker(skeleton, s, places[s], points)
        place = places[s] if marker is None else points[marker]
        spread = JOINT_SPREAD if marker is None else MARKER_SPREAD
        joints.append(MarkerJoint(skeleton.parents[s], s, place, place, spread, marker))
    mean = np.linalg.norm(points[:, None] - points, axis=-1)
    low, high = reachable_distances(points, skeleton.members, joints)
    deviation = prior_deviation(mean, skeleton, low, high)
    return MarkerModel(
        name, tuple(labels), points, skeleton.members, skeleton.names, tuple(joints), mean, deviation, low, high, gaps
    )


def shared_marker(skeleton: Skeleton, s: int, place: NDArray, reference: NDArray) -> int | None:
    """Index of the marker that a segment shares with its parent, nearest to their joint; None without one.

    Parameters
    ----------
    place : (3,) [m] the joint
    reference : (M, 3) [m]
    """
    shared = skeleton.shared(s)
    return min(shared, key=lambda m: float(np.linalg.norm(reference[m] - place))) if shared else None


def assign_unknown(skeleton: Skeleton, cost: NDArray) -> Skeleton:
    """Assign markers that the set does not know to the segment with the least mean cost to two of its markers.

    Parameters
    ----------
    cost : (M, M) [m] distances, or their standard deviations
    """
    members, give = [list(m) for m in skeleton.members], [list(g) for g in skeleton.give]
    for i in skeleton.unknown:
        costs = [np.sort(np.nan_to_num(cost[i, list(m)], nan=np.inf))[:2].mean() for m in skeleton.members]
        best = int(np.argmin(costs))
        members[best].append(i)
        give[best].append(2 * GIVE)  # the segment is a guess
    return replace(skeleton, members=tuple(map(tuple, members)), unknown=(), give=tuple(map(tuple, give)))
