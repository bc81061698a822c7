"""Background subtraction for a static depth camera, learnt while a body is tracked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera
from kinefit.sensors.surfaces import _kernels_background as kernels

_CELL_COLUMNS = 320  # finer cells cost more, and a wrist at 3 m is four wide
_OUTLIER_SIGMAS = 3.0  # beyond which a depth is a new object's
_BODY_MARGIN_PX = 2  # of the rendered body (at most 160 columns) by which it may be off the measured one
_ROW_INTERLEAVE = 4  # each image teaches every fourth row of cells


class Background:
    """The background of one static depth camera.

    In the first image everything but the body is background. Later a new object away from the body is background at
    once; near it (a table that the person walks up to, an object put down) after `wait` images in which no part of the
    body is there. A depth behind the known background shows that an object has gone.

    Parameters
    ----------
    camera : Camera of the depth images
    sigma : float [m] standard deviation of a depth at the body; it grows with the depth squared.
    wait : int, images
    """

    state_attributes = ("_mean", "_spread", "_count", "_waiting", "_bound", "_variance", "_empty", "_turn")

    def __init__(self, camera: Camera, sigma: float, wait: int) -> None:
        self.camera, self.wait, self._sigma = camera, wait, sigma
        width, height = camera.size
        self._cell = max(width // _CELL_COLUMNS, 1)
        shape = -(-height // self._cell), -(-width // self._cell)
        self._mean, self._spread, self._count, self._waiting = np.zeros((4, *shape))
        self._bound = np.full(shape, np.inf)
        self._variance: NDArray | None = None
        self._empty, self._turn = True, 0

    def learn(self, depth: NDArray, shown: NDArray, box: tuple[NDArray, NDArray], sure: bool) -> None:
        """Learn from an image (H, W) [m] after the body has been fitted to it.

        Parameters
        ----------
        shown : (h, w) [m] the body's rendered depth, inf outside.
        box : (3,), (3,) [m] corners of the box that the body may be in.
        sure : bool
            Whether no segment is lost: only then objects near the body are learnt.
        """
        seen = np.isfinite(shown)
        if self._variance is None:
            self._variance = self._prior_variance(float(np.median(shown[seen])) if seen.any() else 2.0)
        if self._empty and not sure:
            return
        about = np.empty(shown.shape, np.float32)
        kernels.widened(shown, _BODY_MARGIN_PX, about)
        kernels.learn(
            depth, self.camera.ray_table, self.camera.packed, *box, about, self._cell,
            *((0, 1) if self._empty else (self._turn, _ROW_INTERLEAVE)), self._variance, _OUTLIER_SIGMAS**2,
            1 if self._empty else max(self.wait // _ROW_INTERLEAVE, 1), sure,
            self._mean, self._spread, self._count, self._waiting, self._bound,
        )  # fmt: skip
        self._empty, self._turn = False, (self._turn + 1) % _ROW_INTERLEAVE

    def know(self, depth: NDArray) -> None:
        """Set the background from an image (H, W) [m] of the empty scene; 0 where it is unknown."""
        z = np.asarray(depth, float)[:: self._cell, :: self._cell]
        known = z > 0.0
        if self._variance is None:
            self._variance = self._prior_variance(float(np.median(z[known])) if known.any() else 2.0)
        self._mean[known], self._count[known] = z[known], 4.0  # as much weight as four images
        self._spread[:] = self._variance[0] + self._variance[1] * z**4
        self._bound[known] = (z - _OUTLIER_SIGMAS * np.sqrt(self._spread))[known]
        self._empty = False

    def _prior_variance(self, at: float) -> NDArray:
        """(2,) a, b of the variance a + b z⁴ that is sigma² at a depth [m]."""
        return np.array((0.25, 0.75 / at**4)) * self._sigma**2

    def marked(self, depth: NDArray, first: tuple[int, int], last: tuple[int, int]) -> NDArray:
        """A copy of an image (H, W) [m], negative at background pixels within first..last (row, column)."""
        out = np.array(depth, np.float32)
        if not self._empty:
            low, high = ((a // self._cell, b // self._cell) for a, b in (first, (last[0] - 1, last[1] - 1)))
            end = high[0] + 1, high[1] + 1
            kernels.mark(out, self._bound, self._cell, low, end)
        return out
