"""Derivatives of rows of points by parameters, without making rows of changed worlds.

A row of a point depends on the body through the point's place in its segment and the joints' places in their parents.
Neither depends on the pose, so their derivatives are computed once for all frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, KinematicTree, PointSet
from kinefit.solving import _kernels_linear
from kinefit.solving.correspondences.closures import closed_at, closure_values
from kinefit.solving.rows import DofRows, Rows

Place = tuple[str, str]
"""Name of a set of points, and of a point in it; landmarks are in the set ""."""


Slopes = Callable[[NDArray, slice, str | None, NDArray, NDArray, NDArray], None]
"""Analytic derivatives of a kind of parameters, see `Parameters`."""


class PointMoves:
    """Derivatives of a body's points and joints by q parameters that move nothing else.

    Parameters
    ----------
    body : Body at the parameters
    joints : (S, 3, q) derivatives of every joint in its parent's frame
    of_set : name of a set -> derivatives (K, 3, q) of its points in their segments' frames
    """

    def __init__(self, body: Body, joints: NDArray, of_set: Callable[[str], NDArray]) -> None:
        self._body, self._joints, self._of_set = body, np.ascontiguousarray(joints), of_set
        self._chosen: dict[int, tuple[Sequence[Place], NDArray | None]] = {}

    @classmethod
    def from_slopes(
        cls, body: Body, made: Sequence[tuple[Slopes, NDArray, slice, Body]], some: NDArray, count: int
    ) -> PointMoves:
        """Analytic derivatives, from the slopes of each kind of parameters.

        Parameters
        ----------
        made : for each kind, in order of application: its slopes, values, columns, and the body with them applied
        some : (q,) int, the parameters to derive by, out of `count`
        """

        def slopes(name: str | None, segment: NDArray, points: Callable[[Body], NDArray]) -> NDArray:
            out = np.zeros((len(segment), 3, count))
            for add_slopes, values, own, applied in made:
                add_slopes(values, own, name, segment, points(applied), out)
            return out[:, :, some]

        def of_set(name: str) -> NDArray:
            return slopes(name, _points(body, name).segments, lambda b: _points(b, name).points)

        return cls(body, slopes(None, np.maximum(body.tree.parents, 0), lambda b: b.tree.offsets), of_set)

    @classmethod
    def from_differences(
        cls, pairs: Sequence[tuple[list[int], Body, Body]], some: NDArray, steps: NDArray,
        touches: Sequence[frozenset[int] | None],
    ) -> PointMoves:  # fmt: skip
        """Numeric derivatives, from differences between bodies.

        Parameters
        ----------
        pairs : parameters that change together, and bodies one step below and above in them
        some : (q,) int, the parameters to derive by
        steps : (p,) of the parameters
        touches : (p,) for each parameter the segments that it moves, or whose points; None for any
        """
        body, column = pairs[0][1], {int(k): j for j, k in enumerate(some)}

        def slopes(of: Callable[[Body], NDArray], owner: NDArray) -> NDArray:
            out = np.zeros((len(owner), 3, len(some)))
            for together, below, above in pairs:
                moved = of(above) - of(below)
                for k in together:
                    touched = touches[k]
                    here = np.ones(len(owner), bool) if touched is None else np.isin(owner, list(touched))
                    out[here, :, column[k]] = moved[here] / (2.0 * steps[k])
            return out

        joints = slopes(lambda b: b.tree.offsets, np.arange(len(body.tree.segments)))
        return cls(body, joints, lambda name: slopes(lambda b: _points(b, name).points, _points(body, name).segments))

    def columns(self, places: Sequence[Place], rows: Rows, tree: KinematicTree, frames: NDArray) -> NDArray | None:
        """(N, q) whitened derivatives of rows of points; None if the body lacks one of the points.

        Parameters
        ----------
        places : of the points, in the order of the rows' groups; the list must not change between calls
        tree : of the body
        frames : (S, 12) rotation and origin of each segment in the world
        """
        moves = self._of(places)
        if moves is None:
            return None
        out = np.empty((len(rows), moves.shape[2]))
        joints = self.joints(tree, frames)
        _kernels_linear.point_columns(rows.data, rows.segment, rows.group, frames, joints, moves, out)
        return out

    def joints(self, tree: KinematicTree, frames: NDArray) -> NDArray:
        """(S, 3, q) derivatives of the joint centres in the world, for a fixed pose; frames (S, 12) of the segments."""
        out = np.empty(self._joints.shape)
        _kernels_linear.joint_columns(tree.parents, frames, self._joints, out)
        return out

    def _of(self, places: Sequence[Place]) -> NDArray | None:
        """(M, 3, q) derivatives of points in their segments."""
        if id(places) not in self._chosen:
            self._chosen[id(places)] = places, self._slopes(places)
        return self._chosen[id(places)][1]

    def _slopes(self, places: Sequence[Place]) -> NDArray | None:
        both = self._body.marker_sets.keys() & self._body.keypoint_sets.keys()
        sets = {name for name, _ in places}
        if not sets or sets & both or not sets <= {"", *self._body.marker_sets, *self._body.keypoint_sets}:
            return None
        row = {name: {p: k for k, p in enumerate(_points(self._body, name).names)} for name in sets}
        if not all(point in row[name] for name, point in places):
            return None
        slopes = {name: self._of_set(name) for name in sets}
        return np.stack([slopes[name][row[name][point]] for name, point in places])


def _points(body: Body, name: str) -> PointSet:
    """The set of points of this name; landmarks for an empty name."""
    if not name:
        return body.landmarks
    return body.marker_sets[name] if name in body.marker_sets else body.keypoints(name)


CLOSURE_STD = 1e-3
"""[m, rad] standard deviation of a hard closure in a joint fit of poses and parameters: exact enough for these, and no
stiffer than the measurements of cameras."""


def closing_rows(body: Body, state: BodyState) -> list[DofRows]:
    """Rows of a body's closures; an empty list for a body without closures."""
    return [closed_at(body, state).rows(CLOSURE_STD)] if body.closures else []


@dataclass(frozen=True, eq=False)
class ClosureMoves:
    """Derivatives of a body's closures by p parameters.

    Parameters
    ----------
    body : Body at the parameters
    pairs : for each parameter the bodies one step below and above; None where closures do not depend on it
    steps : (p,) of the parameters
    """

    body: Body
    pairs: Sequence[tuple[Body, Body] | None]
    steps: NDArray

    def at(self, state: BodyState) -> NDArray:
        """(m, p) derivative of every equation's value c [m, rad] by the parameters, for a fixed pose."""
        out = np.zeros((len(closure_values(self.body, state)), len(self.steps)))
        for k, pair in enumerate(self.pairs):
            if pair is not None:
                below, above = (closure_values(body, state) for body in pair)
                out[:, k] = (above - below) / (2.0 * self.steps[k])
        return out

    def whitened(self, state: BodyState) -> NDArray:
        """(m, p) the same, divided by the standard deviations of the rows."""
        return self.at(state) * np.sqrt(closed_at(self.body, state).rows(CLOSURE_STD).weight)[:, None]
