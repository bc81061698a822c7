"""How what closes a body's chains moves with parameters of a subject fit: central differences between bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences.closures import closed_at, closure_values
from kinefit.rows import DofRows

HELD = 1e-3
"""[m, rad] standard deviation of a hard closure where poses are fitted along with parameters: exact enough for these,
and no stiffer than what cameras see."""


def closing_rows(body: Body, state: BodyState) -> list[DofRows]:
    """Rows of a body's closures, where there are any."""
    return [closed_at(body, state).rows(HELD)] if body.closures else []


@dataclass(frozen=True, eq=False)
class ClosureMoves:
    """Closures of bodies with parameters to either side.

    Parameters
    ----------
    body : Body at the parameters
    pairs : of each parameter the bodies with less and with more of it; None where closures do not feel it
    steps : (p,) how much less and more
    """

    body: Body
    pairs: Sequence[tuple[Body, Body] | None]
    steps: NDArray

    def at(self, state: BodyState) -> NDArray:
        """(m, p) [m, rad] derivative of every equation's value c by the parameters, the pose as it is."""
        out = np.zeros((len(closure_values(self.body, state)), len(self.steps)))
        for k, pair in enumerate(self.pairs):
            if pair is not None:
                less, more = (closure_values(one, state) for one in pair)
                out[:, k] = (more - less) / (2.0 * self.steps[k])
        return out

    def whitened(self, state: BodyState) -> NDArray:
        """(m, p) the same over the deviations of the rows."""
        return self.at(state) * np.sqrt(closed_at(self.body, state).rows(HELD).weight)[:, None]
