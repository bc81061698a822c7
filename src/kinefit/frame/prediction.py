"""What earlier frames predict of the next one: a Kalman filter with constant velocity over all degrees of freedom."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences.closures import looped
from kinefit.rows import ParameterRows
from kinefit.solvers.equations import inverse

_FIXED = 1e-4  # [m, rad] standard deviation of a root that stays where it is put


class Prediction:
    """Pose, velocity and their joint covariance, carried from frame to frame.

    Positions and velocities (per frame) of the n degrees of freedom make a state of 2n. Its prediction enters the next
    frame's fit as one row on all degrees of freedom together, so that what one frame left open is filled from those
    before it, and what it saw well is hardly touched.

    Parameters
    ----------
    body : Body
    dt : float [s] between frames.
    angle_acceleration, root_acceleration : float [rad/s²], [m/s²]
        One standard deviation of the random acceleration that drives the motion.
    memory : float [s]
        How long a velocity lasts that nothing confirms; of gear in a closed chain it lasts.
    """

    state_attributes = ("state", "_velocity", "_xx", "_vx", "_vv")  # see `save_state`

    def __init__(
        self, body: Body, dt: float, *, angle_acceleration: float, root_acceleration: float, memory: float
    ) -> None:
        n = body.tree.n_dofs
        self._bounds = body.tree.lower, body.tree.upper
        turns = np.concatenate([np.zeros(6, bool), looped(body) & ~np.isfinite(body.tree.spread)])
        self._keep = np.where(turns, 1.0, np.exp(-dt / memory))  # a crank goes on, a knee turns back
        jolt = np.concatenate([np.full(3, root_acceleration), np.full(n - 3, angle_acceleration)]) * dt**2
        self._moves = (np.arange(n) >= 6) | body.tree.root_free
        jolt = jolt * self._moves
        self._noise = [np.diag(jolt**2 * share) for share in (0.25, 0.5, 1.0)]
        self._first_velocity = np.diag(np.concatenate([np.full(3, 1.0), np.full(n - 3, 5.0)]) * dt) ** 2
        self._first_velocity *= self._moves
        self._wide = np.where(self._moves, np.concatenate([np.full(3, 0.5), np.full(n - 3, 1.0)]), _FIXED)
        self.state: BodyState | None = None
        self._velocity, self._halted = np.zeros(n), False

    def start(self, state: BodyState, std: NDArray | None = None) -> None:
        """Begin at a state whose velocity is unknown; std (n,) [m, rad], inf where nothing is known."""
        self.state, self._velocity = state, np.zeros_like(self._velocity)
        spread = self._wide if std is None else np.minimum(std, self._wide)
        self._xx, self._vv = np.diag(spread**2), self._first_velocity.copy()
        self._vx = np.zeros_like(self._xx)

    @property
    def velocity(self) -> NDArray:
        """(n,) [m, rad] a frame."""
        return self._velocity

    @property
    def std(self) -> NDArray:
        """(n,) [m, rad] standard deviation of the last state."""
        return np.sqrt(np.diag(self._xx))

    def go_on(self, state: BodyState, std: NDArray, velocity: NDArray) -> None:
        """Begin with what is known already; velocity (n,) [m, rad] a frame."""
        self.start(state, std)
        self._velocity = velocity * self._moves

    def change_chart(self, angles: NDArray, signs: NDArray) -> None:
        """Go on in other charts of some ball joints: their angles (D,), and the signs (D,) of how they change."""
        assert self.state is not None
        turned = np.concatenate([np.ones(6), signs])
        self.state = BodyState(self.state.T_world_root, angles)
        self._velocity = turned * self._velocity
        both = turned[:, None] * turned[None, :]
        self._xx, self._vx, self._vv = both * self._xx, both * self._vx, both * self._vv

    def halt(self) -> None:
        """Stay where the body was last seen: for a frame in which nothing is.

        That it stays is no knowledge: it may as well go on as it went, and its velocity does not fade.
        """
        self._vv = self._vv + np.outer(self._velocity, self._velocity)
        self._velocity, self._halted = np.zeros_like(self._velocity), True

    def ahead(self, steps: float = 1.0) -> tuple[BodyState, NDArray]:
        """The state some frames on, and the information (n, n) of it.

        More than one where frames were dropped, less where sensors take turns.
        """
        assert self.state is not None
        self._ahead = self.state
        whole = int(steps + 1e-6)
        for h in [1.0] * whole + [steps - whole] * (steps - whole > 1e-6):
            keep = np.ones(len(self._keep)) if self._halted else self._keep**h
            self._velocity = keep * self._velocity
            vx, vv = keep[:, None] * self._vx, keep[:, None] * self._vv * keep
            self._xx = self._xx + h * (vx + vx.T) + h**2 * vv + h**3 * self._noise[0]
            self._vx = vx + h * vv + h**2 * self._noise[1]
            self._vv = vv + h * self._noise[2]
            self._ahead = self._ahead.retract(h * self._velocity, self._bounds)
        self._information, self._halted = inverse(self._xx), False
        return self._ahead, self._information

    def correct(self, state: BodyState, posterior: NDArray) -> None:
        """Take the fitted state, with the covariance (n, n) that its normal matrix gives, prediction included."""
        gain = self._vx @ self._information
        self._velocity = (self._velocity + gain @ self._ahead.difference(state)) * self._moves
        vv = self._vv - gain @ (self._xx - posterior) @ gain.T
        self._vv = 0.5 * (vv + vv.T)
        self._vx = gain @ posterior
        self._xx = posterior
        self.state = state


def belief(state: BodyState, predicted: BodyState, information: NDArray) -> ParameterRows:
    """The prediction as one row on all degrees of freedom: r = predicted − state, weighed by an (n, n) information."""
    return ParameterRows(np.arange(len(information)), state.difference(predicted), information)


def forgetting(information: NDArray, lost: NDArray) -> NDArray:
    """Information (n, n) without some degrees of freedom (n,) bool; of the others what it was."""
    kept = np.flatnonzero(~lost)
    out = np.zeros_like(information)
    out[np.ix_(kept, kept)] = inverse(inverse(information)[np.ix_(kept, kept)])
    return out


def released_from(held: tuple[BodyState, NDArray] | None, free: NDArray | None) -> tuple[BodyState, NDArray] | None:
    """What is held, a state and its information (n, n), without some degrees of freedom (n,) bool, None for none."""
    return held if held is None or free is None else (held[0], forgetting(held[1], free))
