"""Robust losses: how much a measurement that does not fit may pull."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.solvers import _kernels


@dataclass(frozen=True)
class Loss:
    """ρ(s²) of a measurement s standard deviations off; make one with `huber`, `tukey`, `geman_mcclure`.

    Parameters
    ----------
    kind : int, code of the kernel.
    scale : float [standard deviations] where it starts to give way.
    """

    kind: int = _kernels.NO_LOSS
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not self.scale > 0:
            raise ObservationError(f"the scale of a loss must be positive, got {self.scale}")

    def factor(self, s2: NDArray) -> NDArray:
        """Robust factors, in 0..1, of squared residuals (...) in variances."""
        s2 = np.ascontiguousarray(s2, float)
        out = np.empty(s2.size)
        _kernels.robust_factors(self.kind, self.scale, s2.ravel(), out)
        return out.reshape(s2.shape)


SQUARED = Loss()


def huber(scale: float = 1.345) -> Loss:
    """Quadratic, then linear: bounded influence, convex (95 % efficient for a normal error at the default)."""
    return Loss(_kernels.HUBER, scale)


def tukey(scale: float = 4.685) -> Loss:
    """Biweight: no influence at all beyond `scale` (95 % efficient for a normal error at the default)."""
    return Loss(_kernels.TUKEY, scale)


def geman_mcclure(scale: float = 3.0) -> Loss:
    """s² / (1 + s²/scale²): influence falls off smoothly and never quite to nothing."""
    return Loss(_kernels.GEMAN_MCCLURE, scale)
