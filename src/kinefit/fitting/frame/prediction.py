"""Predict the next frame's pose: a Kalman filter with constant velocity over all degrees of freedom."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.solving.correspondences.closures import looped
from kinefit.solving.equations import inverse
from kinefit.solving.rows import ParameterRows

_FIXED_ROOT_STD = 1e-4  # [m, rad] of a root that does not move


class Prediction:
    """Pose, velocity and their joint covariance, predicted from frame to frame.

    The filter's state has 2n entries: position and velocity (per frame) of the n degrees of freedom. The prediction
    enters the next frame's fit as one row on all degrees of freedom. It fills in degrees of freedom that the frame does
    not observe, and hardly changes those that it observes well.

    Parameters
    ----------
    body : Body
    dt : float [s] between frames.
    angle_acceleration, root_acceleration : float [rad/s²], [m/s²]
        One standard deviation of the random acceleration that drives the motion.
    memory : float [s]
        Time constant with which an unobserved velocity decays. Velocities of gear in a closed chain do not decay.
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
        self._wide = np.where(self._moves, np.concatenate([np.full(3, 0.5), np.full(n - 3, 1.0)]), _FIXED_ROOT_STD)
        self.state: BodyState | None = None
        self._velocity, self._halted = np.zeros(n), False

    def start(self, state: BodyState, std: NDArray | None = None) -> None:
        """Start at a state with unknown velocity; std (n,) [m, rad] of the state, inf where it is unknown."""
        self.state, self._velocity = state, np.zeros_like(self._velocity)
        spread = self._wide if std is None else np.minimum(std, self._wide)
        self._xx, self._vv = np.diag(spread**2), self._first_velocity.copy()
        self._vx = np.zeros_like(self._xx)

    @property
    def velocity(self) -> NDArray:
        """(n,) [m, rad] per frame."""
        return self._velocity

    @property
    def std(self) -> NDArray:
        """(n,) [m, rad] standard deviation of the last state."""
        return np.sqrt(np.diag(self._xx))

    def go_on(self, state: BodyState, std: NDArray, velocity: NDArray) -> None:
        """Start with a known velocity; std (n,) [m, rad] of the state, velocity (n,) [m, rad] per frame."""
        self.start(state, std)
        self._velocity = velocity * self._moves

    def change_chart(self, angles: NDArray, signs: NDArray) -> None:
        """Express the filter's state in other charts of ball joints: angles (D,), and signs (D,) of their changes."""
        assert self.state is not None
        turned = np.concatenate([np.ones(6), signs])
        self.state = BodyState(self.state.T_world_root, angles)
        self._velocity = turned * self._velocity
        both = turned[:, None] * turned[None, :]
        self._xx, self._vx, self._vv = both * self._xx, both * self._vx, both * self._vv

    def halt(self) -> None:
        """Hold the body at its last pose, for a frame without measurements.

        The square of the dropped velocity is added to its variance, because the body may as well have moved on.
        The velocity does not decay in this frame.
        """
        self._vv = self._vv + np.outer(self._velocity, self._velocity)
        self._velocity, self._halted = np.zeros_like(self._velocity), True

    def ahead(self, steps: float = 1.0) -> tuple[BodyState, NDArray]:
        """Predict the state some frames ahead, with its information (n, n).

        Parameters
        ----------
        steps : number of frames; above 1 after dropped frames, below 1 where sensors alternate
        """
        assert self.state is not None
        self._ahead = self.state
        whole = int(steps + 1e-6)
        for h in [1.0] * whole + [steps - whole] * bool(steps - whole > 1e-6):
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
        """Update the filter with the fitted state and its covariance (n, n), prediction included."""
        gain = self._vx @ self._information
        self._velocity = (self._velocity + gain @ self._ahead.difference(state)) * self._moves
        vv = self._vv - gain @ (self._xx - posterior) @ gain.T
        self._vv = 0.5 * (vv + vv.T)
        self._vx = gain @ posterior
        self._xx = posterior
        self.state = state


def prediction_row(state: BodyState, predicted: BodyState, information: NDArray) -> ParameterRows:
    """The prediction as one row on all degrees of freedom: r = predicted − state, weighted by information (n, n)."""
    return ParameterRows(np.arange(len(information)), state.difference(predicted), information)


def marginal_information(information: NDArray, lost: NDArray) -> NDArray:
    """Information (n, n) with the degrees of freedom `lost` (n,) bool marginalised: their rows and columns are 0."""
    kept_dofs = np.flatnonzero(~lost)
    out = np.zeros_like(information)
    out[np.ix_(kept_dofs, kept_dofs)] = inverse(inverse(information)[np.ix_(kept_dofs, kept_dofs)])
    return out


def release_dofs(held: tuple[BodyState, NDArray] | None, free: NDArray | None) -> tuple[BodyState, NDArray] | None:
    """A predicted state and its information (n, n), without some degrees of freedom (n,) bool; None for none."""
    return held if held is None or free is None else (held[0], marginal_information(held[1], free))
