"""Bundle adjustment: cameras and blocks of other unknowns that they see (B. Triggs et al., 1999).

One elimination (`Arrow`), one Levenberg-Marquardt loop (`descend`): what is seen, such as free points, boards, bars or
a body, is a `BundleProblem`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.geometry.camera import Rig
from kinefit.solving.bundle.arrow import Arrow
from kinefit.solving.bundle.cameras import CameraPrior
from kinefit.solving.least_squares import Damping, descend


@dataclass(frozen=True, eq=False)
class BundleState:
    """Values of all unknowns.

    Parameters
    ----------
    rig : Rig
    offsets : (C,) [s]
    blocks : unknowns of blocks, such as free points (P, 3) [m] or poses of a board (F, 4, 4)
    theta : (p,) shape parameters of a body
    states : its poses
    """

    rig: Rig
    offsets: NDArray
    blocks: NDArray
    theta: NDArray = field(default_factory=lambda: np.zeros(0))
    states: Sequence[BodyState] = ()


class BundleProblem(Protocol):
    """What the cameras see."""

    def linearised(self, state: BundleState, prior: CameraPrior) -> tuple[Arrow, float, Any]:
        """Equations, cost and what else the problem keeps of them, all without the cameras' prior.

        Parameters of the border are those of the problem (p,), then the cameras' free ones.
        """
        ...

    def moved(self, state: BundleState, delta: NDArray, moves: Sequence[NDArray]) -> BundleState:
        """The state after a step of the problem's parameters (p,) and of each kind of blocks (F, n)."""
        ...


@dataclass(frozen=True, eq=False)
class Bundle:
    """A state with its equations.

    Parameters
    ----------
    state : BundleState
    prior : CameraPrior
    arrow : Arrow, without the cameras' prior
    cost : float, with it
    departure : (q,) of the cameras from the prior's mean
    detail : what the problem keeps
    """

    state: BundleState
    prior: CameraPrior
    arrow: Arrow
    cost: float
    departure: NDArray
    detail: Any

    @property
    def posterior(self) -> Arrow:
        """The equations with the cameras' prior."""
        return self.prior.added(self.arrow, self.departure)

    @property
    def S(self) -> NDArray:
        """(C · 16, C · 16) information of the data on the cameras, all other unknowns eliminated."""
        S = self.arrow.reduced(*self.arrow.relative(0.0))[0]
        p = len(S) - len(self.prior.precision)
        return self.prior.full(S[p:, p:] - S[p:, :p] @ np.linalg.solve(S[:p, :p], S[:p, p:]))


def adjust(
    start: BundleState, prior: CameraPrior, problem: BundleProblem, *, iterations: int = 30, tolerance: float = 1e-4,
    damping: float = 1e-3,
) -> Bundle:  # fmt: skip
    """Minimise the cost of a problem and of the cameras' prior over all unknowns.

    Parameters
    ----------
    prior : CameraPrior
        Fixed parameters declare the gauge. If neither they nor the prior fix it, only the damping does.
    iterations : number of steps tried, at most
    tolerance : share of the cost; a step that is predicted to lower it by less is not taken
    damping : first λ, as a share of the equations' diagonals
    """

    def at(state: BundleState) -> Bundle:
        arrow, cost, detail = problem.linearised(state, prior)
        away = prior.departure(state.rig, state.offsets)
        return Bundle(state, prior, arrow, cost + float(prior.precision @ away**2), away, detail)

    def follow(now: Bundle, move: tuple[NDArray, list[NDArray]]) -> Bundle | None:
        (delta, moves), old = move, now.state
        p = len(delta) - len(prior.precision)
        try:
            rig, offsets = prior.moved(old.rig, old.offsets, delta[p:])
            return at(replace(problem.moved(old, delta[:p], moves), rig=rig, offsets=offsets))
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):  # no camera: its distortion overflows
            return None

    return descend(
        at(start), lambda now, damping: now.posterior.relative_step(damping), follow, iterations=iterations,
        tolerance=tolerance, damping=Damping(damping),
    ).at  # fmt: skip
