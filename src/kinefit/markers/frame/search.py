"""Search the segment tree: the choices of points for every segment, given each choice of its parent."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.markers.frame._kernels_evidence import place_joint
from kinefit.markers.frame._kernels_identify import cheapest_compatible, expand_segment, range_cost
from kinefit.markers.frame.tables import Beliefs, SegmentTable

MAX_JOINT_SIGMA = 0.15
"""[m] a joint that the parent places with a larger standard deviation does not constrain the child."""

MAX_CHOICES = 48
"""Choices kept of a segment per choice of its parent; the least likely are dropped."""

MAX_EXCESS_COST = 10.0
"""Choices whose cost exceeds the best by more are dropped: e^-10 of its likelihood."""

MAX_BRANCH_EXCESS_COST = 20.0
"""The same in the search of a single branch: a missing marker costs 8 to 12 at a noise of 1 to 2 cm."""


@dataclass(frozen=True, eq=False)
class UnlabelledFrame:
    """The points of a frame, with the prior on missing markers and unrelated points.

    Parameters
    ----------
    points, gaps : (N, 3), (N, N) [m] positions and their distances
    volume : [m³] of their bounding box
    gain : gain of a matched marker over a missing one, log(1/m³)
    gate : standard deviations by which a distance may differ
    work : (1,) distance tests that remain for all searches of the frame; reduced by each of them
    beliefs : presence and noise estimated from other frames of the take
    """

    points: NDArray
    gaps: NDArray
    volume: float
    gain: float
    gate: float
    work: NDArray = field(default_factory=lambda: np.full(1, np.inf))
    beliefs: Beliefs | None = None

    @property
    def is_exhausted(self) -> bool:
        """Whether the frame's work is used up."""
        return bool(self.work[0] <= 0)


@dataclass(frozen=True, eq=False)
class JointPrior:
    """Prior of a segment's joint, given the choice of its parent.

    Parameters
    ----------
    pivot, sigma : (3,) [m] its position and standard deviation; sigma < 0 if unknown
    anchors, reach, deviation : (A, 3), (A,), (A,) [m] points, its distances from them, their standard deviations
    """

    pivot: NDArray = field(default_factory=lambda: np.zeros(3))
    sigma: float = -1.0
    anchors: NDArray = field(default_factory=lambda: np.zeros((0, 3)))
    reach: NDArray = field(default_factory=lambda: np.zeros(0))
    deviation: NDArray = field(default_factory=lambda: np.zeros(0))


UNKNOWN_JOINT = JointPrior()


@dataclass(eq=False)
class Node:
    """The choices of a segment for one context, that is for one statement of its parent about it.

    Parameters
    ----------
    index : (C, k) int, points of the k markers, -1 for none
    cost, squares : (C,) own cost and weighted sum of squared residuals
    new, all : (C, W) uint64 bits of the points chosen here, and with those given by the parent
    union : (W,) uint64, bits of the points chosen here by any choice
    prior : the constraint of the joint
    empty : index of the choice of no point
    below : for each choice the nodes of the children; None if it was not followed
    best : (C,) cost with the best choices of all descendants; inf if not followed
    allowed : choices whose total cost exceeds this were not followed
    """

    table: SegmentTable
    context: tuple
    index: NDArray
    cost: NDArray
    squares: NDArray
    new: NDArray
    all: NDArray
    union: NDArray
    prior: JointPrior
    empty: int
    below: list[list[Node] | None]
    best: NDArray
    allowed: float = -np.inf


class LabelSearch:
    """Search of one frame at one noise level. Limbs in different branches may use the same point: see `polish`.

    Parameters
    ----------
    scale : factor on the model's deviations
    budget : number of nodes after which only first choices are followed; then `cut` is set
    quota : number of nodes for each choice of the root
    share : of the frame's remaining work that this search may use, 0 to 1
    """

    def __init__(
        self, tables: tuple[SegmentTable, ...], frame: UnlabelledFrame, scale: float, budget: int = 0, quota: int = 0,
        share: float = 1.0,
    ):
        self.tables, self.frame, self.scale = tables, frame, scale
        self.by_index = {t.index: t for t in tables}
        prior = frame.beliefs
        self.sigma = {t.index: t.sigma * scale * (prior.noise[t.index] if prior else 1.0) for t in tables}
        odds = {t.index: prior.odds[t.markers] if prior else np.zeros(len(t.markers)) for t in tables}
        self.gain = {s: frame.gain + own for s, own in odds.items()}
        self.has_ranges = {t.index: bool((t.width > 0).any()) for t in tables}
        count = len(frame.points)
        self.bits = np.zeros((count + 1, (count + 63) // 64), np.uint64)  # the last row: no point
        for i in range(count):
            self.bits[i, i // 64] = np.uint64(1) << np.uint64(i % 64)
        self.outside = self.bits[-1]  # points that may not be used
        self.memo: dict[tuple, Node] = {}
        self.promise = {t.index: 0.0 for t in tables}  # least cost so far of a segment with its descendants
        self.cut, self.slack = False, MAX_EXCESS_COST
        self.budget, self.nodes_per_choice, self.quota = budget, quota, quota
        self.set_work_share(share)

    def without_points(self, outside: NDArray, slack: float = MAX_EXCESS_COST) -> LabelSearch:
        """A new search of this frame without the points `outside` (W,) uint64 bits; `slack` is a number (cost)."""
        local = copy(self)
        local.slack = slack
        local.memo, local.promise, local.cut = {}, dict.fromkeys(self.promise, 0.0), False
        local.outside = outside
        return local

    def set_node_budget(self, nodes: int) -> None:
        """Set the number of nodes from now on."""
        self.budget = self.quota = len(self.memo) + nodes
        self.nodes_per_choice = nodes

    def set_work_share(self, share: float) -> None:
        """Set the share (0 to 1) of the frame's remaining work that this search may use from now on."""
        self.floor = (1 - share) * float(self.frame.work[0]) if share < 1 else 0.0

    @property
    def is_exhausted(self) -> bool:
        """Whether the search has used its share of the work."""
        return bool(self.frame.work[0] <= self.floor)

    @property
    def is_spent(self) -> bool:
        """Whether the search has used its nodes or its share of the work."""
        return self.is_exhausted or len(self.memo) > min(self.quota, self.budget)

    def node(self, table: SegmentTable, parent: Node | None, choice: int, allowed: float = np.inf) -> Node:
        """The node of a segment given its parent's choice, with choices followed up to the cost (number) `allowed`."""
        found = self.make_node(table, parent, choice)
        if found.allowed < allowed:
            self.follow_choices(found, allowed)
        return found

    def make_node(self, table: SegmentTable, parent: Node | None, choice: int) -> Node:
        """The node of a segment given a choice of its parent, from the memo or new."""
        given = np.full(len(table.markers), -2, np.int64)
        prior, taken = UNKNOWN_JOINT, self.bits[-1]
        context: tuple = ()
        if parent is not None:
            points, taken = parent.index[choice], parent.all[choice]
            given[table.common] = points[table.shared[table.common]]
            context = tuple(given[table.common].tolist())
            if max(context, default=-1) < 0:
                prior = self.joint(parent, choice, table)
                context = (parent.table.index, parent.context, tuple(points.tolist()))
        key = (table.index, context)
        found = self.memo.get(key)
        if found is None:
            found = self.memo[key] = self.expand(table, context, given, prior, self.bits[-1])
            hope = float(found.cost.min()) + sum(self.promise[child] for child in table.children)
            self.promise[table.index] = min(self.promise[table.index], hope)
        clash = found.union & taken
        if clash.any():  # without these points other choices may be near the best
            context = (context, tuple(clash.tolist()))
            key = (table.index, context)
            found = self.memo.get(key)
            if found is None:
                found = self.memo[key] = self.expand(table, context, given, prior, taken)
        return found

    def joint(self, parent: Node, choice: int, table: SegmentTable) -> JointPrior:
        """The joint by a choice of the parent: a position, or distances from one or two points, or unknown."""
        at = np.empty(3)
        x, y, sigma = self.fit_points(parent, choice)
        if not len(x):
            return UNKNOWN_JOINT
        spread = table.spread * min(self.scale, 1.0)
        if len(x) > 1:
            variance = place_joint(len(x), x, y, sigma, table.joint_there, at)
            deviation = float(np.sqrt(variance + spread**2))
            if deviation < MAX_JOINT_SIGMA:
                return JointPrior(at, deviation)
        reach = np.linalg.norm(x - table.joint_there, axis=1)
        return JointPrior(anchors=y[:2], reach=reach[:2], deviation=np.sqrt(sigma[:2] ** 2 + spread**2))

    def fit_points(self, node: Node, choice: int) -> tuple[NDArray, NDArray, NDArray]:
        """A choice's points and joint: (n, 3) in the segment, (n, 3) measured, (n,) standard deviations, all [m]."""
        points, t = node.index[choice], node.table
        matched = points >= 0
        x, y, sigma = t.x[matched], self.frame.points[points[matched]], self.sigma[t.index][matched]
        if node.prior.sigma > 0 and t.joint_here is not None:
            x, y = np.vstack([x, t.joint_here]), np.vstack([y, node.prior.pivot])
            sigma = np.append(sigma, node.prior.sigma)
        return x, y, sigma

    def expand(
        self, table: SegmentTable, context: tuple, given: NDArray, prior: JointPrior, taken: NDArray,
        kept: float | None = None,
    ) -> Node:
        """A node with the choices of a segment, none followed yet.

        given (k,) int as in `enumerate_segment`; taken (W,) bits; `kept`: largest cost (number) above the best.
        """
        frame = self.frame
        free = prior.sigma <= 0 and bool((given < 0).all())
        joint = table.joint_here if table.joint_here is not None else np.zeros(3)
        volume = frame.volume
        if len(prior.reach):
            span = np.linalg.norm(table.x - joint, axis=1).max() + prior.reach.min()
            volume = min(volume, 4 / 3 * np.pi * span**3)
        index, cost, squares, new, every, union, empty = expand_segment(
            frame.points, frame.gaps, self.bits, taken | self.outside, table.x, table.D, self.sigma[table.index], given,
            joint, prior.pivot, prior.sigma, prior.anchors, prior.reach, prior.deviation, float(np.log(volume)),
            frame.gate, self.gain[table.index], self.slack, 2 if free else 1, frame.work, MAX_CHOICES,
            self.slack if kept is None else kept,
        )  # fmt: skip
        self.cut |= frame.is_exhausted
        return Node(
            table, context, index, cost, squares, new, every, union, prior, empty, [None] * len(cost), np.empty(0)
        )

    def search_alone(self, table: SegmentTable) -> tuple[float, int, float]:
        """Search a segment without its parent: least cost, number of markers matched, cost margin to the next choice.

        The next choice must give a point to another marker; merely leaving markers out does not count.
        """
        found = self.expand(table, (), np.full(len(table.markers), -2, np.int64), UNKNOWN_JOINT, self.bits[-1], np.inf)
        index, cost, best = found.index, found.cost, 0
        is_other = ((index != index[best]) & (index >= 0)).any(1) | (index < 0).all(1)
        return float(cost[best]), int((index[best] >= 0).sum()), float(cost[is_other].min(initial=0.0) - cost[best])

    def follow_choices(self, node: Node, allowed: float) -> None:
        """Follow each choice to the children while its least total cost stays low enough.

        It must stay below `allowed` (a number) and at most the slack above the best choice of this node.
        """
        node.allowed = allowed
        node.best = np.full(len(node.cost), np.inf)
        children = [self.by_index[child] for child in node.table.children]
        best = np.inf
        for c in range(len(node.cost)):
            if node.table.parent < 0:
                self.quota = len(self.memo) + self.nodes_per_choice
            below: list[Node] = []
            bound = float(node.cost[c]) + sum(self.promise[t.index] for t in children)
            limit = min(allowed, best + self.slack)
            follow = not self.is_spent or (c == 0 and c != node.empty)
            self.cut |= not follow and bound <= limit
            if bound > limit and c < node.empty:  # as do all later choices
                node.below[node.empty] = [self.absent(t) for t in children]
                node.best[node.empty] = node.cost[node.empty]
                break
            for t in children if follow and bound <= limit else ():
                bound -= self.promise[t.index]
                child = self.node(t, node, c, limit - bound)
                low = cheapest_compatible(
                    self.frame.points, node.index[c], child.index, t.low, t.high, t.width, self.has_ranges[t.index],
                    child.new, child.best, node.all[c],
                )  # fmt: skip
                bound += low
                self.promise[t.index] = min(self.promise[t.index], low)
                below.append(child)
                if bound > limit:
                    break
            if len(below) == len(children) and bound <= limit:
                node.below[c], node.best[c] = below, bound
            elif c == node.empty:  # needed if all others conflict with choices elsewhere
                node.below[c] = [self.absent(t) for t in children]
                node.best[c] = node.cost[c]
            else:
                node.below[c] = None
            best = min(best, node.best[c])

    def absent(self, table: SegmentTable) -> Node:
        """The node of a segment without any point, nor in its descendants."""
        key = (table.index, "absent")
        if key not in self.memo:
            index, zero = np.full((1, len(table.markers)), -1, np.int64), np.zeros(1)
            bits = self.bits[index[:, 0]]
            below: list[list[Node] | None] = [[self.absent(self.by_index[child]) for child in table.children]]
            self.memo[key] = Node(
                table, (), index, zero, zero, bits, bits, bits[0], UNKNOWN_JOINT, 0, below, zero.copy(), np.inf
            )
        return self.memo[key]

    def range_costs(self, node: Node, choice: int, child: Node) -> NDArray:
        """(C,) costs of a child's choices given one of its parent, by the training ranges of distances."""
        t, out = child.table, np.zeros(len(child.cost))
        if self.has_ranges[t.index]:
            range_cost(self.frame.points, node.index[choice], child.index, t.low, t.high, t.width, out)
        return out

    def branch_costs(self, node: Node, above: tuple[Node, int] | None) -> NDArray:
        """(C,) cost of each choice with the best below it, given a choice of the parent; inf where both use a point."""
        if above is None:
            return node.best
        compatible = ~(node.new & above[0].all[above[1]]).any(1)
        return np.where(compatible, node.best + self.range_costs(*above, node), np.inf)

    def decode(self, node: Node, above: tuple[Node, int] | None = None) -> list[tuple[Node, int]]:
        """The best choices of a node and its descendants, parents first."""
        return self.follow(node, int(np.argmin(self.branch_costs(node, above))))

    def follow(self, node: Node, choice: int) -> list[tuple[Node, int]]:
        """A given choice of a node and the best ones of its descendants, parents first."""
        found = [(node, choice)]
        for child in node.below[choice] or ():
            found += self.decode(child, (node, choice))
        return found
