"""The search over the tree of segments: every segment's choices under each choice of its parent."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.identification._kernels_evidence import place_joint
from kinefit.identification._kernels_identify import enumerate_segment, range_cost, weigh_child
from kinefit.identification._tables import SegmentTable

LOOSE = 0.15
"""[m] a joint that the parent places worse than this tells its child nothing."""

ROOM = 48
"""Choices kept of a segment under one choice of its parent; the unlikeliest are dropped."""

SLACK = 10.0
"""Choices whose cost is this much above the best are dropped: e^-10 of its likelihood."""

BUDGET = 600
"""Nodes; a search that needs more has a wrong noise level or too few points: from then on only first choices count."""

QUOTA = 200
"""Nodes for each choice of the root."""


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


@dataclass(eq=False)
class Node:
    """A segment's choices where its parent says one and the same of it.

    Parameters
    ----------
    context : what the parent says, as a key
    index : (C, k) int, points, -1 for none; cost : (C,) own; squares : (C,) weighted residual squares
    new : (C, W) uint64, points that are chosen here (not given by the parent), as bits; all : given ones too
    empty : the choice of no point at all
    loss : (C,) what leaving contested points out costs, of choices that do nothing else; else 0
    below : for each choice the nodes of the children; None where it is not followed
    best : (C,) cost with the best below; total : (C,) -log of the sum over all below; inf where not followed
    allowed : choices dearer than this with all below were not followed
    """

    table: SegmentTable
    context: tuple
    index: NDArray
    cost: NDArray
    squares: NDArray
    new: NDArray
    all: NDArray
    hold: Hold
    empty: int
    loss: NDArray
    below: list[list[Node] | None]
    best: NDArray
    total: NDArray
    allowed: float = -np.inf


class Search:
    """One frame at one noise level.

    Parameters
    ----------
    points : (N, 3) [m]
    scale : factor on the model's deviations
    gain : what a matched marker earns against a missing one, log(1/m³)
    contested : (W,) bits of points that several segments want: each is tried without them, whatever that costs it
    """

    def __init__(
        self,
        tables: tuple[SegmentTable, ...],
        points: NDArray,
        gaps: NDArray,
        scale: float,
        gain: float,
        volume: float,
        gate: float,
        contested: NDArray | None = None,
    ):
        self.tables = tables
        self.by_index = {t.index: t for t in tables}
        self.points, self.gaps, self.scale, self.gain, self.gate = points, gaps, scale, gain, gate
        self.volume = volume
        self.sigma = {t.index: t.sigma * scale for t in tables}
        self.tells = {t.index: bool((t.width > 0).any()) for t in tables}
        self.memo: dict[tuple, Node] = {}
        words = (len(points) + 63) // 64
        self.bits = np.zeros((len(points) + 1, words), np.uint64)  # the last row: no point
        for i in range(len(points)):
            self.bits[i, i // 64] = np.uint64(1) << np.uint64(i % 64)
        self.contested = np.zeros(words, np.uint64) if contested is None else contested
        self.wanted = np.zeros(words, np.uint64)  # bits of points that a segment would choose, had its parent not
        self.quota = QUOTA
        self.nodes: list[Node] = []
        self.bids = {t.index: np.zeros(len(points)) for t in tables}  # what each point costs a segment: see `bid`
        self.promise = {t.index: 0.0 for t in tables}  # least cost so far of a segment and all below

    @property
    def spent(self) -> bool:
        """Whether the search has had its nodes."""
        return len(self.memo) > min(self.quota, BUDGET)

    def node(self, table: SegmentTable, parent: Node | None, choice: int, allowed: float = np.inf) -> Node:
        """The node of a segment under a choice of its parent's."""
        given = np.full(len(table.markers), -2, np.int64)
        hold, taken = Hold(), self.bits[-1]
        context: tuple = ()
        if parent is not None:
            points, taken = parent.index[choice], parent.all[choice]
            common = table.shared >= 0
            given[common] = points[table.shared[common]]
            context = tuple(given[common].tolist())
            if not (given >= 0).any():
                hold = self.joint(parent, choice, table)
                context = (parent.table.index, parent.context, tuple(points.tolist()))
        key = (table.index, context)
        found = self.memo.get(key)
        if found is None:
            found = self.memo[key] = self.expand(table, context, given, hold, self.bits[-1])
            hope = float(found.cost.min()) + sum(self.promise[child] for child in table.children)
            self.promise[table.index] = min(self.promise[table.index], hope)
        clash = np.bitwise_or.reduce(found.new, 0) & taken
        if clash.any():  # others may come near the best without these points
            self.wanted |= found.new[0] & taken
            context = (context, tuple(clash.tolist()))
            key = (table.index, context)
            found = self.memo.get(key)
            if found is None:
                found = self.memo[key] = self.expand(table, context, given, hold, taken)
        if found.allowed < allowed:
            self.complete(found, allowed)
        return found

    def joint(self, parent: Node, choice: int, table: SegmentTable) -> Hold:
        """What a choice of the parent says of the joint: a place, or distances from one or two points, or nothing."""
        at = np.empty(3)
        x, y, sigma = self.fitted(parent, choice)
        if not len(x):
            return Hold()
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
        x, y, sigma = t.x[here], self.points[points[here]], self.sigma[t.index][here]
        if node.hold.sigma > 0 and t.joint_here is not None:
            x, y = np.vstack([x, t.joint_here]), np.vstack([y, node.hold.pivot])
            sigma = np.append(sigma, node.hold.sigma)
        return x, y, sigma

    def choices(
        self, table: SegmentTable, given: NDArray, hold: Hold, taken: NDArray, slack: float = SLACK
    ) -> tuple[NDArray, NDArray, NDArray]:
        """(C, k) points, (C,) costs, (C,) weighted squares of likely choices; the first is to choose none."""
        k = len(table.markers)
        index, cost, squares = np.empty((ROOM, k), np.int64), np.empty(ROOM), np.empty(ROOM)
        free = hold.sigma <= 0 and not (given >= 0).any()
        joint = table.joint_here if table.joint_here is not None else np.zeros(3)
        blocked = (self.bits[:-1] & taken).any(1)
        blocked[given[given >= 0]] = False
        volume = self.volume
        if len(hold.reach):
            span = np.linalg.norm(table.x - joint, axis=1).max() + hold.reach.min()
            volume = min(volume, 4 / 3 * np.pi * span**3)
        count = enumerate_segment(
            self.points, self.gaps, blocked, table.x, table.D, self.sigma[table.index], given, joint,
            hold.pivot, hold.sigma,
            hold.anchors, hold.reach, hold.deviation, float(np.log(volume)), self.gate, self.gain, slack,
            2 if free else 1, index, cost, squares,
        )  # fmt: skip
        return index[:count], cost[:count], squares[:count]

    def expand(self, table: SegmentTable, context: tuple, given: NDArray, hold: Hold, taken: NDArray) -> Node:
        """Choices of a segment, none followed yet."""
        index, cost, squares = self.choices(table, given, hold, taken)
        keep = np.flatnonzero(cost <= cost.min() + SLACK)
        keep = keep[np.argsort(cost[keep])]
        if 0 not in keep:  # no choice at all
            keep = np.append(keep, 0)
        empty = int(np.flatnonzero(keep == 0)[0])
        index, cost, squares, loss = index[keep], cost[keep], squares[keep], np.zeros(len(keep))
        best = index[0]
        if (np.bitwise_or.reduce(self.bits[np.where(given == -2, best, -1)], 0) & self.contested).any():
            more = self.without(table, given, hold, best)
            new = ~(more[0][:, None] == index).all(-1).any(1)
            index, cost, squares = (np.concatenate([a, b[new]]) for a, b in zip((index, cost, squares), more))
            less = ((index == best) | (index < 0)).all(1) & (index >= 0).any(1)
            loss = np.where(less, cost - cost[0], 0.0)
        new = np.where(given == -2, index, -1)
        return Node(
            table, context, index, cost, squares,
            np.bitwise_or.reduce(self.bits[new], 1), np.bitwise_or.reduce(self.bits[index], 1),
            hold, empty, loss, [None] * len(cost), np.empty(0), np.empty(0),
        )  # fmt: skip

    def without(self, table: SegmentTable, given: NDArray, hold: Hold, best: NDArray) -> tuple[NDArray, ...]:
        """The best choice without some of the contested points: indexes, costs, squares."""
        others = np.bitwise_or.reduce(self.bits[:-1], 0) & ~np.bitwise_or.reduce(self.bits[best], 0)
        index, cost, squares = self.choices(table, given, hold, others, np.inf)
        own = self.bits[best] & self.contested
        may = own.any(1) & (given == -2)
        keep = ((index == best) | (may & (index < 0))).all(1)
        return index[keep], cost[keep], squares[keep]

    def alone(self, table: SegmentTable) -> tuple[float, int, float]:
        """Of a segment on its own: the least cost, how many markers that has, by how much any other choice is dearer.

        Others are those that give a point to another marker; leaving markers out is no other choice.
        """
        index, cost, _ = self.choices(table, np.full(len(table.markers), -2, np.int64), Hold(), self.bits[-1])
        best = int(np.argmin(cost))
        other = ((index != index[best]) & (index >= 0)).any(1) | (index < 0).all(1)
        return float(cost[best]), int((index[best] >= 0).sum()), float(cost[other].min(initial=0.0) - cost[best])

    def complete(self, node: Node, allowed: float) -> None:
        """Follow each choice downwards while its cost, with the best known of what is still to come, stays near.

        Near is: below `allowed`, and SLACK above the best choice here at most.
        """
        node.allowed = allowed
        node.best, node.total = np.full(len(node.cost), np.inf), np.full(len(node.cost), np.inf)
        children = [self.by_index[child] for child in node.table.children]
        best = np.inf
        for c in range(len(node.cost)):
            if node.table.parent < 0:
                self.quota = len(self.memo) + QUOTA
            below: list[Node] = []
            bound = total = float(node.cost[c])
            bound += sum(self.promise[t.index] for t in children)
            limit = min(allowed, best + SLACK) + float(node.loss[c])
            follow = not self.spent or (c == 0 and c != node.empty)
            for t in children if follow and bound <= limit else ():
                bound -= self.promise[t.index]
                child = self.node(t, node, c, limit - bound)
                low, sums = weigh_child(child.new, child.best, child.total, self.between(node, c, child), node.all[c])
                bound, total = bound + low, total + sums
                self.promise[t.index] = min(self.promise[t.index], low)
                below.append(child)
                if bound > limit:
                    break
            if len(below) == len(children) and bound <= limit:
                node.below[c], node.best[c], node.total[c] = below, bound, total
            elif c == node.empty:  # for when every other clashes with what is chosen elsewhere
                node.below[c] = [self.absent(t) for t in children]
                node.best[c] = node.total[c] = node.cost[c]
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
                table, (), index, zero, zero, bits, bits, Hold(), 0, zero, below, zero.copy(), zero.copy(), np.inf
            )
        return self.memo[key]

    def weigh(self, node: Node, extra: NDArray | None = None) -> None:
        """Costs of each choice with all below it: `best` and `total`."""
        own = node.cost if extra is None else node.cost + extra
        node.best = np.array([np.inf if below is None else cost for cost, below in zip(own, node.below)])
        node.total = node.best.copy()
        for c, below in enumerate(node.below):
            for child in below or ():
                low, total = weigh_child(child.new, child.best, child.total, self.between(node, c, child), node.all[c])
                node.best[c] += low
                node.total[c] += total

    def between(self, node: Node, choice: int, child: Node) -> NDArray:
        """(C,) what a child's choices cost beside one of its parent, by the distances of training."""
        t, out = child.table, np.zeros(len(child.cost))
        if self.tells[t.index]:
            range_cost(self.points, node.index[choice], child.index, t.low, t.high, t.width, out)
        return out

    def gather(self, root: Node) -> None:
        """`nodes`: all that count, children before their parents."""
        self.nodes, seen = [], set()

        def visit(node: Node) -> None:
            seen.add(id(node))
            for below in node.below:
                for child in below or ():
                    if id(child) not in seen:
                        visit(child)
            self.nodes.append(node)

        visit(root)

    def decode(self, node: Node, above: tuple[Node, int] | None = None) -> list[tuple[Node, int]]:
        """The best choices of a node and all below it, top down."""
        cost = node.best
        if above is not None:
            fits = ~(node.new & above[0].all[above[1]]).any(1)
            cost = np.where(fits, node.best + self.between(*above, node), np.inf)
        c = int(np.argmin(cost))
        found = [(node, c)]
        for child in node.below[c] or ():
            found += self.decode(child, (node, c))
        return found

    def reweigh(self) -> None:
        """Weigh all nodes anew, with bids."""
        for node in self.nodes:
            self.weigh(node, self.price(node, self.bids[node.table.index]))

    def price(self, node: Node, price: NDArray) -> NDArray:
        """(C,) what the points that each choice takes cost."""
        padded = np.append(price, 0.0)
        new = np.where(node.table.shared >= 0, -1, node.index)
        return padded[new].sum(1)

    def cost_of(self, chosen: list[tuple[Node, int]]) -> float:
        """Of decoded choices, without bids."""
        node, c = chosen[0]
        return float(node.best[c] - sum(self.price(n, self.bids[n.table.index])[k] for n, k in chosen))
