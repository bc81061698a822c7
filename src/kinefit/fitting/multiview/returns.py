"""Re-identify people after an absence: pair their presence spans by size, clothes and path, at the highest odds.

Two spans, one of which begins after the other ended, have odds of showing one person: those of their appearance
(`same_log_ratio`) times those of the path between. All spans are paired jointly. A pair stays open, and is reported,
where another pairing is nearly as likely.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.fitting.multiview import likeness
from kinefit.fitting.multiview.association import MAX_SPEED, MAX_STEP, Node, assign, medians
from kinefit.fitting.multiview.likeness import Appearance, ImageSource
from kinefit.geometry.camera import Rig
from kinefit.observations import Keypoints

MAX_SHORT_ABSENCE_S = 1.0  # shorter absences are bridged by position alone: people walk less far than they stand apart
_MIN_SPAN_S = 0.3  # of spans that are compared: in shorter ones a detector's errors do not average out
_MAX_OVERLAP_SHARE = 0.05  # of the well visible frames of two spans that may overlap and be discarded
_PRIOR_ODDS = 2.0  # prior odds that a newcomer is a person who left before
_MIN_ODDS = 10.0  # of a re-identification: one in ten of these would be wrong
_MIN_RELIEF_S = 0.2  # gap in which one person may leave and another take the place
_WAY_SIGMAS = 0.3, 0.7  # [m], [m/s] constant and growth of the distance's standard deviation
_COMMON_AREA = 25.0  # [m²] seen by the cameras in common, where others appear anywhere
_ELSEWHERE_SHARE = 0.5  # of people who return, but at an unrelated place


@dataclass(frozen=True, eq=False)
class PresenceSpan:
    """A person's detections from one absence to the next.

    Parameters
    ----------
    nodes : for each frame the (record, detection) pairs
    path : for each frame the points (k, 3) [m]
    """

    nodes: Mapping[int, list[Node]]
    path: Mapping[int, NDArray]

    @property
    def ends(self) -> tuple[int, int]:
        """First and last frame in which two cameras see the person; (0, -1) without any."""
        frames = [f for f, nodes in self.nodes.items() if len(nodes) > 1]
        return (min(frames), max(frames)) if frames else (0, -1)


@dataclass(frozen=True)
class Return:
    """A person's absence that ended with a re-identification.

    Parameters
    ----------
    left, came : last frame before the absence, and first frame after it
    odds : that it is the same person, to one
    by : cues used: "size", "clothes", "way"
    """

    left: int
    came: int
    odds: float
    by: tuple[str, ...] = ("way",)


@dataclass(frozen=True, eq=False)
class Chain:
    """The spans that were identified as one person.

    Parameters
    ----------
    span : all of them joined
    members : their indices
    returns : the absences between them
    maybe : indices of earlier spans that may show the same person
    """

    span: PresenceSpan
    members: tuple[int, ...]
    returns: tuple[Return, ...] = ()
    maybe: tuple[int, ...] = ()


def link_spans(
    rig: Rig, keypoints: Sequence[Keypoints], spans: Sequence[PresenceSpan], needed: int, images: ImageSource | None
) -> list[Chain]:
    """Link the spans of each person across absences.

    Parameters
    ----------
    rig : Rig
    keypoints : records of one kind
    spans : of all people
    needed : least number of cameras that must see a person
    images : of the cameras, for colours; None without
    """
    rate = keypoints[0].rate
    spans = [part for span in spans for part in _split_at_replacement(rig, keypoints, span, needed, images)]
    spans, n = _cut_overlaps(spans, needed, rate), len(spans)
    ends = [s.ends for s in spans]
    visible_counts = [sum(len(nodes) >= needed for nodes in s.nodes.values()) for s in spans]
    long = [k for k in range(n) if visible_counts[k] >= _MIN_SPAN_S * rate]
    pairs = [(i, j) for i in long for j in long if ends[i][1] < ends[j][0] and _is_reachable(spans[i], spans[j], rate)]
    if not pairs:
        return [Chain(s, (k,)) for k, s in enumerate(spans)]
    looks = {k: _appearance(rig, keypoints, spans[k], images) for k in {k for pair in pairs for k in pair}}
    odds = np.full((n, n), -np.inf)
    for i, j in pairs:
        same, way = likeness.same_log_ratio(looks[i], looks[j]), _way_log_ratio(spans[i], spans[j], rate)
        odds[i, j] = np.log(_PRIOR_ODDS) + same + way if looks[i].is_known else -np.inf
    follows: dict[int, tuple[int, float]] = {}
    maybe: dict[int, tuple[int, ...]] = {}
    best = _best_pairs(odds)
    for i, j in best:
        other_odds = odds.copy()
        other_odds[i, j] = -np.inf
        margin = sum(odds[p] for p in best) - sum(odds[p] for p in _best_pairs(other_odds))
        if margin >= np.log(_MIN_ODDS):
            follows[i] = j, float(np.exp(min(margin, 50.0)))
    followers = {j for j, _ in follows.values()}
    for j in range(n):
        candidates = tuple(int(i) for i in np.flatnonzero(odds[:, j] > -np.log(_MIN_ODDS)) if i not in follows)
        if j not in followers and candidates:
            maybe[j] = candidates
    out = []
    for k in range(n):
        if k in followers:
            continue
        chain = Chain(spans[k], (k,), maybe=maybe.get(k, ()))
        while chain.members[-1] in follows:
            last = chain.members[-1]
            after, ratio = follows[last]
            cues = likeness.common_cues(looks[last], looks[after])
            away = Return(ends[last][1], ends[after][0], ratio, (*cues, "way"))
            joined = _join_spans(chain.span, spans[after], away)
            chain = replace(chain, span=joined, members=(*chain.members, after), returns=(*chain.returns, away))
        out.append(chain)
    return out


def _split_at_replacement(
    rig: Rig, keypoints: Sequence[Keypoints], span: PresenceSpan, needed: int, images: ImageSource | None
) -> list[PresenceSpan]:
    """Split a span where another person took the same place: size or clothes differ beyond doubt."""
    rate = keypoints[0].rate
    visible = np.sort([f for f, nodes in span.nodes.items() if len(nodes) > 1])
    for k in np.flatnonzero(np.diff(visible) > max(_MIN_RELIEF_S * rate, 1.0)):
        parts = _clip(span, -1, visible[k] + 1), _clip(span, visible[k + 1], np.inf)
        well_visible = [sum(len(nodes) >= needed for nodes in part.nodes.values()) for part in parts]
        if min(well_visible) < MAX_SHORT_ABSENCE_S * rate:
            continue
        before, after = (_appearance(rig, keypoints, part, images) for part in parts)
        same = likeness.same_log_ratio(before, after, wrong_size=0.0)
        odds = np.log(_PRIOR_ODDS) + same + _way_log_ratio(*parts, rate)
        if odds < -np.log(_MIN_ODDS):
            return [parts[0], *_split_at_replacement(rig, keypoints, parts[1], needed, images)]
    return [span]


def _cut_overlaps(spans: Sequence[PresenceSpan], needed: int, rate: float) -> list[PresenceSpan]:
    """Cut overlapping spans of which one may continue the other, so that they no longer overlap.

    After a person has left, a track may continue on false positives or duplicate detections in one or two views, and
    begin with them before the person comes. Enough cameras never see both spans in such an overlap.
    """
    out = list(spans)
    ends = [s.ends for s in out]
    well = [np.sort([f for f, nodes in s.nodes.items() if len(nodes) >= needed]) for s in out]
    long = [k for k in range(len(out)) if len(well[k]) >= _MIN_SPAN_S * rate]
    for i, j in ((i, j) for i in long for j in long if i != j):
        if not (ends[i][0] < ends[j][1] and ends[j][0] <= ends[i][1]):
            continue
        cuts = np.concatenate([well[i] + 1, well[j]])
        dropped = np.stack([len(well[i]) - np.searchsorted(well[i], cuts), np.searchsorted(well[j], cuts)])
        best = int(dropped.sum(axis=0).argmin())
        if np.all(dropped[:, best] <= _MAX_OVERLAP_SHARE * np.array([len(well[i]), len(well[j])])):
            cut = int(cuts[best])
            before, after = _clip(out[i], -1, cut), _clip(out[j], cut, np.inf)
            if _is_reachable(before, after, rate):
                out[i], out[j], ends[i], ends[j] = before, after, before.ends, after.ends
                well[i], well[j] = well[i][well[i] < cut], well[j][well[j] >= cut]
    return out


def _clip(span: PresenceSpan, first: float, end: float) -> PresenceSpan:
    """The part of a span in frames from `first` to before `end`."""
    return PresenceSpan(
        {f: v for f, v in span.nodes.items() if first <= f < end},
        {f: x for f, x in span.path.items() if first <= f < end},
    )


def _best_pairs(odds: NDArray) -> list[tuple[int, int]]:
    """The pairs (i, j) of largest total log odds (n, n), each with positive log odds."""
    better = odds > 0.0
    rows, columns = np.flatnonzero(better.any(axis=1)), np.flatnonzero(better.any(axis=0))
    cost = np.where(better, -odds, np.inf)[np.ix_(rows, columns)]
    return [(int(rows[i]), int(columns[j])) for i, j in assign(cost, 0.0)] if len(rows) else []


def _is_reachable(a: PresenceSpan, b: PresenceSpan, rate: float) -> bool:
    """Whether a person can walk from the end of one span to the beginning of another."""
    distance, waited = _gap_between(a, b, rate)
    return distance <= MAX_STEP + MAX_SPEED * waited


def _gap_between(a: PresenceSpan, b: PresenceSpan, rate: float) -> tuple[float, float]:
    """Distance [m] and time [s] from the end of one span to the beginning of another."""
    left, came = a.ends[1], b.ends[0]
    x, y = (medians(points.T) for points in (a.path[left], b.path[came]))
    return float(np.linalg.norm(y - x)), (came - left) / rate


def _way_log_ratio(a: PresenceSpan, b: PresenceSpan, rate: float) -> float:
    """Log likelihood ratio of the distance between two spans: same person against another, who appears anywhere."""
    distance, waited = _gap_between(a, b, rate)
    std = _WAY_SIGMAS[0] + _WAY_SIGMAS[1] * waited
    near = _COMMON_AREA / (2.0 * np.pi * std**2) * np.exp(-0.5 * (distance / std) ** 2)
    return float(np.log(_ELSEWHERE_SHARE + (1.0 - _ELSEWHERE_SHARE) * near))


def _appearance(rig: Rig, keypoints: Sequence[Keypoints], span: PresenceSpan, images: ImageSource | None) -> Appearance:
    views = {f: nodes for f, nodes in span.nodes.items() if len(nodes) > 1}
    looks = likeness.bones_of(rig, keypoints, views)
    return looks if images is None else replace(looks, colours=likeness.clothes_colours(keypoints, views, images))


def _join_spans(a: PresenceSpan, b: PresenceSpan, away: Return) -> PresenceSpan:
    """Join two spans, without the detections of either outside of its own side of the absence."""
    nodes = {f: v for f, v in b.nodes.items() if f > away.left} | {f: v for f, v in a.nodes.items() if f < away.came}
    path = {f: x for f, x in b.path.items() if f > away.left} | {f: x for f, x in a.path.items() if f < away.came}
    return PresenceSpan(nodes, path)
