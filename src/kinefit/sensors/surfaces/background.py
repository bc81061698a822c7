"""What stands still about a body: learnt from depth images while it is tracked, and marked in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera
from kinefit.sensors.surfaces import _kernels_background as kernels

_COLUMNS = 320  # of the cells: finer ones cost more, and a wrist at 3 m is four wide
_DEVIATIONS = 3.0  # beyond which a depth is something new
_ABOUT = 2  # pixels of the drawn body (at most 160 columns) by which it may lie beside the measured one
_TURNS = 4  # of the rows of cells: with each image one of so many is learnt


class Background:
    """The scene behind a body, for one depth camera that stands still.

    At the first image all that is not the body is taken for background. From then on what is seen for the first time
    away from the body is background at once; near it (a table that it walks up to, a thing that is put down) after
    `wait` images in which no part of the body is thought to be there. What is farther than was known shows that what
    was known has gone.

    Parameters
    ----------
    camera : Camera of the depth images
    sigma : float [m] standard deviation of a depth at the body; it is taken to grow with the depth squared.
    wait : int, images
    """

    state_attributes = ("_mean", "_spread", "_count", "_waiting", "_bound", "_variance", "_empty", "_turn")

    def __init__(self, camera: Camera, sigma: float, wait: int) -> None:
        self.camera, self.wait, self._sigma = camera, wait, sigma
        width, height = camera.size
        self._cell = max(width // _COLUMNS, 1)
        shape = -(-height // self._cell), -(-width // self._cell)
        self._mean, self._spread, self._count, self._waiting = np.zeros((4, *shape))
        self._bound = np.full(shape, np.inf)
        self._variance: NDArray | None = None
        self._empty, self._turn = True, 0

    def learn(self, depth: NDArray, shown: NDArray, box: tuple[NDArray, NDArray], sure: bool) -> None:
        """Learn from an image (H, W) [m] once the body has been found in it.

        Parameters
        ----------
        shown : (h, w) [m] the body's own depth, inf where it is not.
        box : (3,), (3,) [m] corners of the box that the body may be in.
        sure : bool
            Whether all of the body has been found: what is near it is learnt only then.
        """
        seen = np.isfinite(shown)
        if self._variance is None:
            self._variance = self._usual(float(np.median(shown[seen])) if seen.any() else 2.0)
        if self._empty and not sure:
            return
        about = np.empty(shown.shape, np.float32)
        kernels.widened(shown, _ABOUT, about)
        kernels.learn(
            depth, self.camera.ray_table, self.camera.packed, *box, about, self._cell,
            *((0, 1) if self._empty else (self._turn, _TURNS)), self._variance, _DEVIATIONS**2,
            1 if self._empty else max(self.wait // _TURNS, 1), sure,
            self._mean, self._spread, self._count, self._waiting, self._bound,
        )  # fmt: skip
        self._empty, self._turn = False, (self._turn + 1) % _TURNS

    def know(self, depth: NDArray) -> None:
        """Take an image (H, W) [m] of the empty scene for what stands still; 0 where that is not known."""
        z = np.asarray(depth, float)[:: self._cell, :: self._cell]
        known = z > 0.0
        if self._variance is None:
            self._variance = self._usual(float(np.median(z[known])) if known.any() else 2.0)
        self._mean[known], self._count[known] = z[known], 4.0  # as sure as a few images make it
        self._spread[:] = self._variance[0] + self._variance[1] * z**4
        self._bound[known] = (z - _DEVIATIONS * np.sqrt(self._spread))[known]
        self._empty = False

    def _usual(self, at: float) -> NDArray:
        """(2,) a, b of the variance a + b z⁴ that is sigma² at a depth [m]."""
        return np.array((0.25, 0.75 / at**4)) * self._sigma**2

    def marked(self, depth: NDArray, first: tuple[int, int], last: tuple[int, int]) -> NDArray:
        """A copy of an image (H, W) [m], negative where it shows what stands still within first..last (row, column)."""
        out = np.array(depth, np.float32)
        if not self._empty:
            low, high = ((a // self._cell, b // self._cell) for a, b in (first, (last[0] - 1, last[1] - 1)))
            end = high[0] + 1, high[1] + 1
            kernels.mark(out, self._bound, self._cell, low, end)
        return out
