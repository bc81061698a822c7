"""How points of a body move with parameters: derivatives of rows of points, without the rows of other worlds.

A row of a point feels the body by where the point sits in its segment and where joints sit in their parents'. Both do
not depend on the pose: their derivatives are differences between bodies, taken once for all frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, KinematicTree, PointSet
from kinefit.rows import Rows

Place = tuple[str, str]
"""A set of points and a name in it; landmarks are in the set ""."""


class PointMoves:
    """Derivatives of a body's points and joints by some parameters that move nothing else.

    Parameters
    ----------
    pairs : parameters that change together, and bodies a step below and above in them
    some : (q,) the parameters that columns are wanted of
    steps : (p,)
    touches : (p,) of each parameter the segments whose points alone it moves; None for one that moves joints
    """

    def __init__(
        self, pairs: Sequence[tuple[list[int], Body, Body]], some: NDArray, steps: NDArray,
        touches: Sequence[frozenset[int] | None],
    ) -> None:  # fmt: skip
        body, column = pairs[0][1], {int(k): j for j, k in enumerate(some)}
        self._offsets = np.zeros((*body.tree.offsets.shape, len(some)))
        owner = np.concatenate([points.segments for points in _sets(body).values()])
        slopes = np.zeros((len(owner), 3, len(some)))
        for together, below, above in pairs:
            joints, points = above.tree.offsets - below.tree.offsets, _places(above) - _places(below)
            for k in together:
                touched, width = touches[k], 2.0 * steps[k]
                if touched is None:
                    self._offsets[:, :, column[k]] = joints / width
                felt = slice(None) if touched is None else np.isin(owner, list(touched))
                slopes[felt, :, column[k]] = points[felt] / width
        names = [(name, point) for name, points in _sets(body).items() for point in points.names]
        self._points = dict(zip(names, slopes))
        self._chosen: dict[tuple[Place, ...], NDArray] = {}

    def columns(self, places: Sequence[Place], rows: Rows, tree: KinematicTree, frames: NDArray) -> NDArray | None:
        """(N, p) how far the points of rows move along their directions, whitened; None where a point is not known.

        Parameters
        ----------
        places : of the points that rows number by group
        tree, frames : of the body, and (S, 12) of its segments
        """
        moves = self._of(tuple(places))
        if moves is None:
            return None
        turns = frames[:, :9].reshape(-1, 3, 3)
        which, first, row = np.unique(rows.group, return_index=True, return_inverse=True)
        owner = rows.segment[first]
        moved = self.joints(tree, frames)[owner] + turns[owner] @ moves[which]
        weighed = np.sqrt(rows.weight)[:, None] * rows.direction
        return np.asarray((weighed[:, None] @ moved[row])[:, 0])

    def joints(self, tree: KinematicTree, frames: NDArray) -> NDArray:
        """(S, 3, p) how joint centres move in the world, the pose as it is."""
        out = frames[:, :9].reshape(-1, 3, 3)[tree.parents] @ self._offsets
        out[0] = 0.0
        for s in range(1, len(out)):
            out[s] += out[tree.parents[s]]
        return out

    def _of(self, places: tuple[Place, ...]) -> NDArray | None:
        """(M, 3, p) derivatives of points in their segments."""
        if places not in self._chosen:
            if not all(place in self._points for place in places):
                return None
            self._chosen[places] = np.stack([self._points[place] for place in places])
        return self._chosen[places]


def _sets(body: Body) -> dict[str, PointSet]:
    """All sets of points; those of one name, of keypoints and of markers, are left out."""
    both = body.marker_sets.keys() & body.keypoint_sets.keys()
    sets = {**body.marker_sets, **body.keypoint_sets, "": body.landmarks}
    return {name: points for name, points in sets.items() if name not in both}


def _places(body: Body) -> NDArray:
    """(M, 3) [m] of all points of all sets in their segments."""
    return np.concatenate([points.points for points in _sets(body).values()])
