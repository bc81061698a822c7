"""BodyState: the pose of a body at one time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import _kernels
from kinefit.errors import BodyError


@dataclass(frozen=True, eq=False)
class BodyState:
    """Pose of the root and all joint coordinates.

    Parameters
    ----------
    T_world_root : (4, 4) [m]
    angles : (D,) [rad], or [m] for prismatic joints.
    """

    T_world_root: NDArray
    angles: NDArray

    def __post_init__(self) -> None:
        for name in ("T_world_root", "angles"):
            try:
                array = np.array(getattr(self, name), dtype=float, order="C")
            except (TypeError, ValueError) as error:
                problem = f"a state whose {name} is a {type(getattr(self, name)).__name__}, not an array of numbers"
                raise BodyError(problem, remedy="Give a (4, 4) pose and a number for each coordinate.") from error
            if not math.isfinite(array.sum()):
                raise BodyError(f"{name} of a state are not finite", remedy="Remove unknown values.")
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def retract(self, delta: NDArray, bounds: tuple[NDArray, NDArray] | None = None) -> BodyState:
        """Move the state by δ (6 + D,): the root's twist (v, ω) [m, rad] in the world about its origin, then angles.

        bounds: lower and upper limits (D,) to which the angles are clipped; default none.

        Raises
        ------
        BodyError
            A δ of another length.
        """
        root, angles = np.empty((4, 4)), np.empty(len(self.angles))
        if bounds is None:
            free = np.full(len(self.angles), np.inf)
            bounds = -free, free
        delta = np.ascontiguousarray(delta, dtype=float)
        if delta.shape != (6 + len(angles),):
            problem = f"a step of shape {delta.shape} for a state with {len(angles)} angles"
            raise BodyError(problem, remedy=f"Give {6 + len(angles)} numbers.")
        _kernels.retract(self.T_world_root, self.angles, delta, bounds[0], bounds[1], root, angles)
        return BodyState(root, angles)

    def difference(self, other: BodyState) -> NDArray:
        """δ (6 + D,) such that `self.retract(δ)` is `other`."""
        out = np.empty(6 + len(self.angles))
        _kernels.difference(self.T_world_root, other.T_world_root, self.angles, other.angles, out)
        return out
