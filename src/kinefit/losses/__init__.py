"""Robust losses: how much a measurement that does not fit may pull."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.losses import _kernels as kernels


@dataclass(frozen=True)
class Loss:
    """ρ(s²) of a measurement s standard deviations off; make one with `huber`, `tukey`, `geman_mcclure`.

    Parameters
    ----------
    kind : int, code of the kernel.
    scale : float or (N,) [standard deviations]
        Where it starts to give way; one for all measurements, or one for each row.
    """

    kind: int = kernels.NO_LOSS
    scale: float | NDArray = 1.0

    def __post_init__(self) -> None:
        if not np.all(np.asarray(self.scale) > 0):
            raise ObservationError(f"the scale of a loss must be positive, got {self.scale}")

    def weigh(self, s2: NDArray) -> tuple[NDArray, NDArray]:
        """ρ and robust factors, in 0..1, of squared residuals (...) in variances."""
        flat = np.ascontiguousarray(s2, float).ravel()
        scale = np.ascontiguousarray(np.broadcast_to(np.asarray(self.scale, float), np.shape(s2))).ravel()
        rho, factor = np.empty((2, flat.size))
        kernels.robust_all(self.kind, scale, flat, rho, factor)
        return rho.reshape(np.shape(s2)), factor.reshape(np.shape(s2))

    def factor(self, s2: NDArray) -> NDArray:
        """Robust factors, in 0..1, of squared residuals (...) in variances."""
        return self.weigh(s2)[1]

    def of_rows(self, data: NDArray, group: NDArray) -> tuple[NDArray, float]:
        """Robust factor of every row, data (8, N) as `Rows` have it, and the cost Σ ρ; a group shares one factor.

        With a scale for each row every row is a measurement by itself.
        """
        if np.ndim(self.scale) == 0:
            factor = np.empty(len(group))
            return factor, float(kernels.weigh(data, group, len(group), self.kind, float(self.scale), factor))
        rho, factor = self.weigh(data[7] * data[6] ** 2)
        return factor, float(rho.sum())


SQUARED = Loss()


def huber(scale: float | NDArray = 1.345) -> Loss:
    """Quadratic, then linear: bounded influence, convex (95 % efficient for a normal error at the default)."""
    return Loss(kernels.HUBER, scale)


def tukey(scale: float | NDArray = 4.685) -> Loss:
    """Biweight: no influence at all beyond `scale` (95 % efficient for a normal error at the default)."""
    return Loss(kernels.TUKEY, scale)


def geman_mcclure(scale: float | NDArray = 3.0) -> Loss:
    """s² / (1 + s²/scale²): influence falls off smoothly and never quite to nothing."""
    return Loss(kernels.GEMAN_MCCLURE, scale)
