"""Who comes back: spans of people before and after an absence, paired by size, clothes and way at the best odds.

For every two spans of which one begins after the other ended there are odds that they are of one person: those of
their looks (`likeness`) and of the way between. All are paired at once. What stays open, as another pairing
would do nearly as well, is left apart and said.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Rig
from kinefit.multiview.association import SPEED, STRIDE, Node
from kinefit.multiview.likeness import Looks, Pictures, bones_of, both_know, colours_of, likeness
from kinefit.multiview.medians import medians
from kinefit.observations import Keypoints
from kinefit.solvers.assignment import assign

BRIEF = 1.0  # [s] who is away for no longer goes on by place alone: in it people walk less far than they stand apart
_SHORTEST = 0.3  # [s] of spans that are compared: in less, detectors err once and for all
_BESIDE = 0.05  # share of the frames in which enough cameras see somebody that may be wrong, beside who follows
_RETURNS = 2.0  # odds, before anything is known of them, that who comes after somebody left is that one
_SURE = 10.0  # odds, from which on somebody is taken for another: one in ten such returns would be wrong
_RELIEVED = 0.2  # [s] without anybody in which one may leave and another come to within a stride
_WAY = 0.3, 0.7  # [m], [m/s] standard deviation of the way: a stride, and those who turn round out of view
_ROOM = 25.0  # [m²] that cameras see in common, in which others come anywhere
_ANYWHERE = 0.5  # share of those who come back elsewhere, by another door


@dataclass(frozen=True, eq=False)
class PresenceSpan:
    """Somebody from one absence to the next.

    Parameters
    ----------
    nodes : {frame: detections}
    path : {frame: (k, 3) [m]} points
    """

    nodes: Mapping[int, list[Node]]
    path: Mapping[int, NDArray]

    @property
    def ends(self) -> tuple[int, int]:
        """First and last frame in which two cameras see the person; one tells no place."""
        frames = [f for f, nodes in self.nodes.items() if len(nodes) > 1]
        return (min(frames), max(frames)) if frames else (0, -1)


@dataclass(frozen=True)
class Return:
    """Somebody was away and came back.

    Parameters
    ----------
    left, came : frames
    odds : to one, that it is the same person
    by : what told
    """

    left: int
    came: int
    odds: float
    by: tuple[str, ...] = ("way",)


@dataclass(frozen=True, eq=False)
class Chain:
    """All spans of one person.

    Parameters
    ----------
    span : all of them together
    members : their numbers
    returns : between them
    maybe : numbers of other spans before the first one that may be of the same person
    """

    span: PresenceSpan
    members: tuple[int, ...]
    returns: tuple[Return, ...] = ()
    maybe: tuple[int, ...] = ()


def chains_of(
    rig: Rig, keypoints: Sequence[Keypoints], spans: Sequence[PresenceSpan], needed: int, pictures: Pictures | None
) -> list[Chain]:
    """Spans of one person together.

    Parameters
    ----------
    rig : Rig
    keypoints : records of one kind
    spans : of everybody
    needed : int, how many cameras must see somebody to count
    pictures : of the cameras, where there are any
    """
    rate = keypoints[0].rate
    spans = [part for span in spans for part in _relieved(rig, keypoints, span, needed, pictures)]
    spans, n = _parted(spans, needed, rate), len(spans)
    ends = [s.ends for s in spans]
    seen = [sum(len(nodes) >= needed for nodes in s.nodes.values()) for s in spans]
    long = [k for k in range(n) if seen[k] >= _SHORTEST * rate]
    pairs = [(i, j) for i in long for j in long if ends[i][1] < ends[j][0] and _in_reach(spans[i], spans[j], rate)]
    if not pairs:
        return [Chain(s, (k,)) for k, s in enumerate(spans)]
    looks = {k: _looks(rig, keypoints, spans[k], pictures) for k in {k for pair in pairs for k in pair}}
    odds = np.full((n, n), -np.inf)
    for i, j in pairs:
        way = _way(spans[i], spans[j], rate)
        odds[i, j] = np.log(_RETURNS) + likeness(looks[i], looks[j]) + way if looks[i].is_known else -np.inf
    follows: dict[int, tuple[int, float]] = {}
    maybe: dict[int, tuple[int, ...]] = {}
    best = _paired(odds)
    for i, j in best:
        without = odds.copy()
        without[i, j] = -np.inf
        surer = sum(odds[p] for p in best) - sum(odds[p] for p in _paired(without))
        if surer >= np.log(_SURE):
            follows[i] = j, float(np.exp(min(surer, 50.0)))
    taken = {j for j, _ in follows.values()}
    for j in range(n):
        open_ = tuple(int(i) for i in np.flatnonzero(odds[:, j] > -np.log(_SURE)) if i not in follows)
        if j not in taken and open_:
            maybe[j] = open_
    out = []
    for k in range(n):
        if k in taken:
            continue
        chain = Chain(spans[k], (k,), maybe=maybe.get(k, ()))
        while chain.members[-1] in follows:
            last = chain.members[-1]
            following, sure = follows[last]
            back = Return(ends[last][1], ends[following][0], sure, (*both_know(looks[last], looks[following]), "way"))
            joined = _joined(chain.span, spans[following], back)
            chain = replace(chain, span=joined, members=(*chain.members, following), returns=(*chain.returns, back))
        out.append(chain)
    return out


def _relieved(
    rig: Rig, keypoints: Sequence[Keypoints], span: PresenceSpan, needed: int, pictures: Pictures | None
) -> list[PresenceSpan]:
    """A span, cut where somebody left and another came to the same place: size or clothes differ beyond doubt."""
    rate = keypoints[0].rate
    seen = np.sort([f for f, nodes in span.nodes.items() if len(nodes) > 1])
    for k in np.flatnonzero(np.diff(seen) > max(_RELIEVED * rate, 1.0)):
        parts = _within(span, -1, seen[k] + 1), _within(span, seen[k + 1], np.inf)
        well = [sum(len(nodes) >= needed for nodes in part.nodes.values()) for part in parts]
        if min(well) < BRIEF * rate:
            continue
        before, after = (_looks(rig, keypoints, part, pictures) for part in parts)
        odds = np.log(_RETURNS) + likeness(before, after, wrong_size=0.0) + _way(*parts, rate)
        if odds < -np.log(_SURE):
            return [parts[0], *_relieved(rig, keypoints, parts[1], needed, pictures)]
    return [span]


def _parted(spans: Sequence[PresenceSpan], needed: int, rate: float) -> list[PresenceSpan]:
    """Spans of which one may go on with another, without what one or two views took for them beside the other.

    Who is gone is followed on by single views of things and of others' second detections, and found so before having
    come, too. Enough cameras never see both then.
    """
    out = list(spans)
    ends = [s.ends for s in out]
    well = [np.sort([f for f, nodes in s.nodes.items() if len(nodes) >= needed]) for s in out]
    long = [k for k in range(len(out)) if len(well[k]) >= _SHORTEST * rate]
    for i, j in ((i, j) for i in long for j in long if i != j):
        if not (ends[i][0] < ends[j][1] and ends[j][0] <= ends[i][1]):
            continue
        cuts = np.concatenate([well[i] + 1, well[j]])
        dropped = np.stack([len(well[i]) - np.searchsorted(well[i], cuts), np.searchsorted(well[j], cuts)])
        best = int(dropped.sum(axis=0).argmin())
        if np.all(dropped[:, best] <= _BESIDE * np.array([len(well[i]), len(well[j])])):
            cut = int(cuts[best])
            before, after = _within(out[i], -1, cut), _within(out[j], cut, np.inf)
            if _in_reach(before, after, rate):
                out[i], out[j], ends[i], ends[j] = before, after, before.ends, after.ends
                well[i], well[j] = well[i][well[i] < cut], well[j][well[j] >= cut]
    return out


def _within(span: PresenceSpan, first: float, end: float) -> PresenceSpan:
    """What of a span lies in frames from `first` to before `end`."""
    return PresenceSpan(
        {f: v for f, v in span.nodes.items() if first <= f < end},
        {f: x for f, x in span.path.items() if first <= f < end},
    )


def _paired(odds: NDArray) -> list[tuple[int, int]]:
    """The pairs of greatest total, each of which is better than none."""
    better = odds > 0.0
    rows, columns = np.flatnonzero(better.any(axis=1)), np.flatnonzero(better.any(axis=0))
    cost = np.where(better, -odds, np.inf)[np.ix_(rows, columns)]
    return [(int(rows[i]), int(columns[j])) for i, j in assign(cost, 0.0)] if len(rows) else []


def _in_reach(a: PresenceSpan, b: PresenceSpan, rate: float) -> bool:
    """Whether somebody could have gone from the end of one span to the beginning of another."""
    apart, waited = _between(a, b, rate)
    return apart <= STRIDE + SPEED * waited


def _between(a: PresenceSpan, b: PresenceSpan, rate: float) -> tuple[float, float]:
    """[m] and [s] from the end of one span to the beginning of another."""
    left, came = a.ends[1], b.ends[0]
    x, y = (medians(points.T) for points in (a.path[left], b.path[came]))
    return float(np.linalg.norm(y - x)), (came - left) / rate


def _way(a: PresenceSpan, b: PresenceSpan, rate: float) -> float:
    """Logarithm of how much likelier a way is for one who comes back than for another, who comes anywhere."""
    apart, waited = _between(a, b, rate)
    std = _WAY[0] + _WAY[1] * waited
    near = _ROOM / (2.0 * np.pi * std**2) * np.exp(-0.5 * (apart / std) ** 2)
    return float(np.log(_ANYWHERE + (1.0 - _ANYWHERE) * near))


def _looks(rig: Rig, keypoints: Sequence[Keypoints], span: PresenceSpan, pictures: Pictures | None) -> Looks:
    views = {f: nodes for f, nodes in span.nodes.items() if len(nodes) > 1}
    looks = bones_of(rig, keypoints, views)
    return looks if pictures is None else replace(looks, colours=colours_of(keypoints, views, pictures))


def _joined(a: PresenceSpan, b: PresenceSpan, back: Return) -> PresenceSpan:
    """Both spans; what one camera alone saw of the one while the other was in view is left out."""
    nodes = {f: v for f, v in b.nodes.items() if f > back.left} | {f: v for f, v in a.nodes.items() if f < back.came}
    path = {f: x for f, x in b.path.items() if f > back.left} | {f: x for f, x in a.path.items() if f < back.came}
    return PresenceSpan(nodes, path)
