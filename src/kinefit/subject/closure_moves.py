"""Derivatives of a body's closures by parameters of a subject fit: central differences between bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences.closures import closed_at, closure_values
from kinefit.rows import DofRows

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
