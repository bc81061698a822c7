"""Pieces of trajectories: the points that are one marker for certain, as long as that lasts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.take._kernels_tracks import link_points

ACCELERATION = 250.0
"""[m/s²] by which a marker's motion may change: a heel that strikes in a sprint reaches it."""

NOISE = 0.005
"""[m] of a point between frames, at its worst."""

SPEED = 3.0
"""[m/s] by which a marker's motion may differ from those of its neighbours."""

FASTEST = 15.0
"""[m/s] of a marker of which nothing is known yet: feet of a sprinter."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """All points of a take, piece by piece.

    Parameters
    ----------
    points : (T, 3) [m] all points that are seen, frame by frame
    frame, column, piece : (T,) int of each point
    starts : (F + 1,) the first point of each frame
    count : of pieces
    """

    points: NDArray
    frame: NDArray
    column: NDArray
    piece: NDArray
    starts: NDArray
    count: int

    @property
    def frames(self) -> int:
        """Of the take."""
        return len(self.starts) - 1

    def rows(self) -> list[NDArray]:
        """For each piece its points, in the order of their frames."""
        order = np.argsort(self.piece, kind="stable")
        return np.split(order, np.searchsorted(self.piece[order], np.arange(1, self.count)))

    def cut(self, piece: NDArray) -> Pieces:
        """The same points in other pieces: `piece` (T,) of any numbers."""
        _, numbers = np.unique(piece, return_inverse=True)
        return Pieces(self.points, self.frame, self.column, numbers, self.starts, int(numbers.max(initial=-1)) + 1)


def find_pieces(positions: NDArray, rate: float) -> Pieces:
    """Pieces of a take's columns (F, N, 3) [m]: ended by gaps and jumps, joined where one goes on in another column."""
    frame, column = np.nonzero(np.isfinite(positions).all(-1))
    points = np.ascontiguousarray(positions[frame, column])
    starts = np.searchsorted(frame, np.arange(len(positions) + 1))
    piece = np.zeros(len(points), np.int64)
    steady = ACCELERATION / rate**2 + NOISE
    count = link_points(
        points, starts, column.astype(np.int64), steady + FASTEST / rate, steady + SPEED / rate, steady, piece
    )
    return Pieces(points, frame, column, piece, starts, int(count))
