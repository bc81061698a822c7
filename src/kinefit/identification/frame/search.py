"""The search over the tree of segments: every segment's choices under each choice of its parent."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.frame._kernels_evidence import place_joint
from kinefit.identification.frame._kernels_identify import range_cost
from kinefit.identification.frame._kernels_nodes import cheapest_beside, expand_segment
from kinefit.identification.frame.beliefs import Beliefs
from kinefit.identification.frame.tables import SegmentTable

LOOSE = 0.15
"""[m] a joint that the parent places worse than this tells its child nothing."""

ROOM = 48
"""Choices kept of a segment under one choice of its parent; the unlikeliest are dropped."""

SLACK = 10.0
"""Choices whose cost is this much above the best are dropped: e^-10 of its likelihood."""

WIDE = 20.0
"""The same where one branch is looked at: a marker that is left out costs 8 to 12 at a noise of 1 to 2 cm."""


@dataclass(frozen=True, eq=False)
class UnlabelledFrame:
    """Points to be named, and what is thought of missing and strange ones.

    Parameters
    ----------
    points : (N, 3) [m]; gaps : (N, N) [m] their distances
    volume : [m³] of the box they are in
    gain : what a matched marker earns against a missing one, log(1/m³)
    beliefs : what other frames of the take have shown of presence and noise
    gate : deviations by which a distance may differ
    work : (1,) tries that are left for all searches of the frame together; they use it up
    """

    points: NDArray
    gaps: NDArray
    volume: float
    gain: float
    gate: float
    work: NDArray = field(default_factory=lambda: np.full(1, np.inf))
    beliefs: Beliefs | None = None

    @property
    def idle(self) -> bool:
        """Whether nothing is left to search with: what was found so far has to do."""
        return bool(self.work[0] <= 0)


@dataclass(frozen=True, eq=False)
class Hold:
    """What is known of a segment's joint before its own markers.

    Parameters
    ----------
    pivot, sigma : (3,) [m] its place, with a standard deviation; sigma < 0 where it is not known
    anchors, reach, deviation : (A, 3), (A,), (A,) [m] points from which it is `reach` away
    """

    pivot: NDArray = field(default_factory=lambda: np.zeros(3))
    sigma: float = -1.0
    anchors: NDArray = field(default_factory=lambda: np.zeros((0, 3)))
    reach: NDArray = field(default_factory=lambda: np.zeros(0))
    deviation: NDArray = field(default_factory=lambda: np.zeros(0))


NOTHING = Hold()


@dataclass(eq=False)
class Node:
    """A segment's choices where its parent says one and the same of it.

    Parameters
    ----------
    index : (C, k) int, points, -1 for none; cost : (C,) own; squares : (C,) weighted residual squares
    new : (C, W) uint64, points that are chosen here (not given by the parent), as bits; all : given ones too
    union : (W,) of all that any choice takes here
    empty : the choice of no point at all
    below : for each choice the nodes of the children; None where it is not followed
    best : (C,) cost with the best below; inf where not followed
    allowed : choices dearer than this with all below were not followed
    """

    table: SegmentTable
    context: tuple
    index: NDArray
    cost: NDArray
    squares: NDArray
    new: NDArray
    all: NDArray
    union: NDArray
    hold: Hold
    empty: int
    below: list[list[Node] | None]
    best: NDArray
    allowed: float = -np.inf


class LabelSearch:
    """One frame at one noise level. Limbs that do not hang on each other may take the same point: see `polish`.

    Parameters
    ----------
    scale : factor on the model's deviations
    budget : nodes; from then on only first choices count, and `cut` tells so
    quota : nodes for each choice of the root
    share : of the frame's work that is left, that this search may take
    """

    def __init__(
        self, tables: tuple[SegmentTable, ...], frame: UnlabelledFrame, scale: float, budget: int = 0, quota: int = 0,
        share: float = 1.0,
    ):
        self.tables, self.frame, self.scale = tables, frame, scale
        self.by_index = {t.index: t for t in tables}
        told = frame.beliefs
        self.sigma = {t.index: t.sigma * scale * (told.noise[t.index] if told else 1.0) for t in tables}
        self.gain = {t.index: frame.gain + (told.odds[t.markers] if told else np.zeros(len(t.markers))) for t in tables}
        self.tells = {t.index: bool((t.width > 0).any()) for t in tables}
        count = len(frame.points)
        self.bits = np.zeros((count + 1, (count + 63) // 64), np.uint64)  # the last row: no point
        for i in range(count):
            self.bits[i, i // 64] = np.uint64(1) << np.uint64(i % 64)
        self.outside = self.bits[-1]  # points that nobody may take
        self.memo: dict[tuple, Node] = {}
        self.promise = {t.index: 0.0 for t in tables}  # least cost so far of a segment and all below
        self.cut, self.slack = False, SLACK
        self.budget, self.each, self.quota = budget, quota, quota
        self.allow(share)

    def beside(self, outside: NDArray, slack: float = SLACK) -> LabelSearch:
        """The same search, nothing of it known yet, without the points `outside` (W,) bits."""
        local = copy(self)
        local.slack = slack
        local.memo, local.promise, local.cut = {}, dict.fromkeys(self.promise, 0.0), False
        local.outside = outside
        return local

    def grant(self, nodes: int) -> None:
        """So many nodes from now on."""
        self.budget = self.quota = len(self.memo) + nodes
        self.each = nodes

    def allow(self, share: float) -> None:
        """This share of the frame's work that is left, from now on."""
        self.floor = (1 - share) * float(self.frame.work[0]) if share < 1 else 0.0

    @property
    def idle(self) -> bool:
        """Whether the search has had its share of the work."""
        return bool(self.frame.work[0] <= self.floor)

    @property
    def spent(self) -> bool:
        """Whether the search has had its nodes, or its share of the work."""
        return self.idle or len(self.memo) > min(self.quota, self.budget)

    def node(self, table: SegmentTable, parent: Node | None, choice: int, allowed: float = np.inf) -> Node:
        """The node of a segment under a choice of its parent's, its choices followed downwards."""
        found = self.seat(table, parent, choice)
        if found.allowed < allowed:
            self.complete(found, allowed)
        return found

    def seat(self, table: SegmentTable, parent: Node | None, choice: int) -> Node:
        """The node of a segment under a choice of its parent's."""
        given = np.full(len(table.markers), -2, np.int64)
        hold, taken = NOTHING, self.bits[-1]
        context: tuple = ()
        if parent is not None:
            points, taken = parent.index[choice], parent.all[choice]
            given[table.common] = points[table.shared[table.common]]
            context = tuple(given[table.common].tolist())
            if max(context, default=-1) < 0:
                hold = self.joint(parent, choice, table)
                context = (parent.table.index, parent.context, tuple(points.tolist()))
        key = (table.index, context)
        found = self.memo.get(key)
        if found is None:
            found = self.memo[key] = self.expand(table, context, given, hold, self.bits[-1])
            hope = float(found.cost.min()) + sum(self.promise[child] for child in table.children)
            self.promise[table.index] = min(self.promise[table.index], hope)
        clash = found.union & taken
        if clash.any():  # others may come near the best without these points
            context = (context, tuple(clash.tolist()))
            key = (table.index, context)
            found = self.memo.get(key)
            if found is None:
                found = self.memo[key] = self.expand(table, context, given, hold, taken)
        return found

    def joint(self, parent: Node, choice: int, table: SegmentTable) -> Hold:
        """What a choice of the parent says of the joint: a place, or distances from one or two points, or nothing."""
        at = np.empty(3)
        x, y, sigma = self.fitted(parent, choice)
        if not len(x):
            return NOTHING
        spread = table.spread * min(self.scale, 1.0)
        if len(x) > 1:
            variance = place_joint(len(x), x, y, sigma, table.joint_there, at)
            deviation = float(np.sqrt(variance + spread**2))
            if deviation < LOOSE:
                return Hold(at, deviation)
        reach = np.linalg.norm(x - table.joint_there, axis=1)
        return Hold(anchors=y[:2], reach=reach[:2], deviation=np.sqrt(sigma[:2] ** 2 + spread**2))

    def fitted(self, node: Node, choice: int) -> tuple[NDArray, NDArray, NDArray]:
        """(n, 3) places in the segment, (n, 3) where they are, (n,) deviations: a choice's points and its pivot [m]."""
        points, t = node.index[choice], node.table
        here = points >= 0
        x, y, sigma = t.x[here], self.frame.points[points[here]], self.sigma[t.index][here]
        if node.hold.sigma > 0 and t.joint_here is not None:
            x, y = np.vstack([x, t.joint_here]), np.vstack([y, node.hold.pivot])
            sigma = np.append(sigma, node.hold.sigma)
        return x, y, sigma

    def expand(
        self, table: SegmentTable, context: tuple, given: NDArray, hold: Hold, taken: NDArray, kept: float | None = None
    ) -> Node:
        """Choices of a segment, none followed yet; `kept` is by how much dearer than the best they may be."""
        frame = self.frame
        free = hold.sigma <= 0 and bool((given < 0).all())
        joint = table.joint_here if table.joint_here is not None else np.zeros(3)
        volume = frame.volume
        if len(hold.reach):
            span = np.linalg.norm(table.x - joint, axis=1).max() + hold.reach.min()
            volume = min(volume, 4 / 3 * np.pi * span**3)
        index, cost, squares, new, every, union, empty = expand_segment(
            frame.points, frame.gaps, self.bits, taken | self.outside, table.x, table.D, self.sigma[table.index], given,
            joint, hold.pivot, hold.sigma, hold.anchors, hold.reach, hold.deviation, float(np.log(volume)),
            frame.gate, self.gain[table.index], self.slack, 2 if free else 1, frame.work, ROOM,
            self.slack if kept is None else kept,
        )  # fmt: skip
        self.cut |= frame.idle
        return Node(
            table, context, index, cost, squares, new, every, union, hold, empty, [None] * len(cost), np.empty(0)
        )

    def alone(self, table: SegmentTable) -> tuple[float, int, float]:
        """Of a segment on its own: the least cost, how many markers that has, by how much any other choice is dearer.

        Others are those that give a point to another marker; leaving markers out is no other choice.
        """
        found = self.expand(table, (), np.full(len(table.markers), -2, np.int64), NOTHING, self.bits[-1], np.inf)
        index, cost, best = found.index, found.cost, 0
        other = ((index != index[best]) & (index >= 0)).any(1) | (index < 0).all(1)
        return float(cost[best]), int((index[best] >= 0).sum()), float(cost[other].min(initial=0.0) - cost[best])

    def complete(self, node: Node, allowed: float) -> None:
        """Follow each choice downwards while its cost, with the best known of what is still to come, stays near.

        Near is: below `allowed`, and the slack above the best choice here at most.
        """
        node.allowed = allowed
        node.best = np.full(len(node.cost), np.inf)
        children = [self.by_index[child] for child in node.table.children]
        best = np.inf
        for c in range(len(node.cost)):
            if node.table.parent < 0:
                self.quota = len(self.memo) + self.each
            below: list[Node] = []
            bound = float(node.cost[c]) + sum(self.promise[t.index] for t in children)
            limit = min(allowed, best + self.slack)
            follow = not self.spent or (c == 0 and c != node.empty)
            self.cut |= not follow and bound <= limit
            if bound > limit and c < node.empty:  # and so are all after it
                node.below[node.empty] = [self.absent(t) for t in children]
                node.best[node.empty] = node.cost[node.empty]
                break
            for t in children if follow and bound <= limit else ():
                bound -= self.promise[t.index]
                child = self.node(t, node, c, limit - bound)
                low = cheapest_beside(
                    self.frame.points, node.index[c], child.index, t.low, t.high, t.width, self.tells[t.index],
                    child.new, child.best, node.all[c],
                )  # fmt: skip
                bound += low
                self.promise[t.index] = min(self.promise[t.index], low)
                below.append(child)
                if bound > limit:
                    break
            if len(below) == len(children) and bound <= limit:
                node.below[c], node.best[c] = below, bound
            elif c == node.empty:  # for when every other clashes with what is chosen elsewhere
                node.below[c] = [self.absent(t) for t in children]
                node.best[c] = node.cost[c]
            else:
                node.below[c] = None
            best = min(best, node.best[c])

    def absent(self, table: SegmentTable) -> Node:
        """A segment of which nothing is seen, nor of any below it."""
        key = (table.index, "absent")
        if key not in self.memo:
            index, zero = np.full((1, len(table.markers)), -1, np.int64), np.zeros(1)
            bits = self.bits[index[:, 0]]
            below: list[list[Node] | None] = [[self.absent(self.by_index[child]) for child in table.children]]
            self.memo[key] = Node(
                table, (), index, zero, zero, bits, bits, bits[0], NOTHING, 0, below, zero.copy(), np.inf
            )
        return self.memo[key]

    def between(self, node: Node, choice: int, child: Node) -> NDArray:
        """(C,) what a child's choices cost beside one of its parent, by the distances of training."""
        t, out = child.table, np.zeros(len(child.cost))
        if self.tells[t.index]:
            range_cost(self.frame.points, node.index[choice], child.index, t.low, t.high, t.width, out)
        return out

    def beneath(self, node: Node, above: tuple[Node, int] | None) -> NDArray:
        """(C,) cost of each choice with the best below it, beside a choice of the parent's; inf where they clash."""
        if above is None:
            return node.best
        fits = ~(node.new & above[0].all[above[1]]).any(1)
        return np.where(fits, node.best + self.between(*above, node), np.inf)

    def decode(self, node: Node, above: tuple[Node, int] | None = None) -> list[tuple[Node, int]]:
        """The best choices of a node and all below it, parents first."""
        return self.follow(node, int(np.argmin(self.beneath(node, above))))

    def follow(self, node: Node, choice: int) -> list[tuple[Node, int]]:
        """One choice of a node and the best below it, parents first."""
        found = [(node, choice)]
        for child in node.below[choice] or ():
            found += self.decode(child, (node, choice))
        return found
