"""Robust losses: limit the influence of outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.losses import _kernels as kernels


@dataclass(frozen=True)
class Loss:
    """Loss ρ(s²) of a residual of s standard deviations; made by `huber`, `tukey`, `geman_mcclure`.

    Parameters
    ----------
    kind : int, code of the kernel.
    scale : float or (N,) [standard deviations]
        Residual from which the influence decreases; one for all measurements, or one for each row.

    Raises
    ------
    ObservationError
        A scale that is not positive.
    """

    kind: int = kernels.NO_LOSS
    scale: float | NDArray = 1.0

    def __post_init__(self) -> None:
        if not np.all(np.asarray(self.scale) > 0):
            raise ObservationError(f"the scale of a loss must be positive, got {self.scale}")

    def weigh(self, s2: NDArray) -> tuple[NDArray, NDArray]:
        """Losses ρ (N,) and robust weights (N,) in 0..1 of squared residuals s2 (N,) [variances]; any shape."""
        flat = np.ascontiguousarray(s2, float).ravel()
        scale = np.ascontiguousarray(np.broadcast_to(np.asarray(self.scale, float), np.shape(s2))).ravel()
        rho, factor = np.empty((2, flat.size))
        kernels.robust_all(self.kind, scale, flat, rho, factor)
        return rho.reshape(np.shape(s2)), factor.reshape(np.shape(s2))

    def factor(self, s2: NDArray) -> NDArray:
        """Robust weights (N,) in 0..1 of squared residuals s2 (N,) [variances]; any shape."""
        return self.weigh(s2)[1]

    def of_rows(self, data: NDArray, group: NDArray) -> tuple[NDArray, float]:
        """Robust weights (N,) of rows, data (8, N) as in `Rows`, and the cost Σ ρ; a group shares one weight.

        With a scale for each row, every row is a measurement of its own.
        """
        if np.ndim(self.scale) == 0:
            factor = np.empty(len(group))
            return factor, float(kernels.weigh(data, group, len(group), self.kind, float(self.scale), factor))
        rho, factor = self.weigh(data[7] * data[6] ** 2)
        return factor, float(rho.sum())


SQUARED = Loss()


def huber(scale: float | NDArray = 1.345) -> Loss:
    """Huber loss: quadratic, then linear; bounded influence, convex.

    scale [standard deviations], a number or (N,); the default is 95 % efficient for normal errors.
    """
    return Loss(kernels.HUBER, scale)


def tukey(scale: float | NDArray = 4.685) -> Loss:
    """Tukey's biweight: no influence beyond `scale`.

    scale [standard deviations], a number or (N,); the default is 95 % efficient for normal errors.
    """
    return Loss(kernels.TUKEY, scale)


def geman_mcclure(scale: float | NDArray = 3.0) -> Loss:
    """Geman-McClure loss s² / (1 + s²/scale²): the influence decreases smoothly, but never to zero.

    scale [standard deviations], a number or (N,).
    """
    return Loss(kernels.GEMAN_MCCLURE, scale)
