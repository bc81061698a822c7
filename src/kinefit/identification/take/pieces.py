"""Split a take into pieces of trajectories that certainly belong to one marker each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.take._kernels_tracks import link_points

MAX_ACCELERATION = 250.0
"""[m/s²] of a marker: reached at heel strike in a sprint."""

MAX_NOISE = 0.005
"""[m] largest measurement error of a point between frames."""

MAX_RELATIVE_SPEED = 3.0
"""[m/s] of a marker relative to its neighbours."""

MAX_SPEED = 15.0
"""[m/s] of a marker without known motion: feet of a sprinter."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """The points of a take, each assigned to a piece of a trajectory.

    Parameters
    ----------
    points : (T, 3) [m] all measured points, frame by frame
    frame, column, piece : (T,) int of each point
    starts : (F + 1,) int, first point of each frame
    count : number of pieces
    """

    points: NDArray
    frame: NDArray
    column: NDArray
    piece: NDArray
    starts: NDArray
    count: int

    @property
    def frames(self) -> int:
        """Number of frames of the take."""
        return len(self.starts) - 1

    def rows(self) -> list[NDArray]:
        """For each piece the indices (n,) of its points, in the order of frames."""
        order = np.argsort(self.piece, kind="stable")
        return np.split(order, np.searchsorted(self.piece[order], np.arange(1, self.count)))

    def cut(self, piece: NDArray) -> Pieces:
        """Assign the points to other pieces: `piece` (T,) int, numbered arbitrarily."""
        _, numbers = np.unique(piece, return_inverse=True)
        return Pieces(self.points, self.frame, self.column, numbers, self.starts, int(numbers.max(initial=-1)) + 1)


def find_pieces(positions: NDArray, rate: float) -> Pieces:
    """Split columns (F, N, 3) [m] at gaps and jumps, and join them across columns; rate in [Hz]."""
    frame, column = np.nonzero(np.isfinite(positions).all(-1))
    points = np.ascontiguousarray(positions[frame, column])
    starts = np.searchsorted(frame, np.arange(len(positions) + 1))
    piece = np.zeros(len(points), np.int64)
    tolerance = MAX_ACCELERATION / rate**2 + MAX_NOISE
    first, second = tolerance + MAX_SPEED / rate, tolerance + MAX_RELATIVE_SPEED / rate
    count = link_points(points, starts, column.astype(np.int64), first, second, tolerance, piece)
    return Pieces(points, frame, column, piece, starts, int(count))
