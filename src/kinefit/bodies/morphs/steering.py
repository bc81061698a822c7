"""Weight of a morph as a function of a joint angle: weighting functions ω(t) (P1 3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from kinefit.errors import BodyError, check_choice

_MIN_ROOT_T = 1e-3  # below, √t is replaced by a straight line: its slope at 0 is unbounded
_DIFFERENCE_STEP = 1e-5  # of t, for numerical slopes

Weight = Callable[[float], tuple[float, float]]


def _root(t: float) -> tuple[float, float]:
    if t < _MIN_ROOT_T:
        return 1.0 - t / math.sqrt(_MIN_ROOT_T), -1.0 / math.sqrt(_MIN_ROOT_T)
    return 1.0 - math.sqrt(t), -0.5 / math.sqrt(t)


# ω(t) and its slope: ω(0) = 1, ω(1) = 0 (P1 3.2, figure 6)
WEIGHTS: dict[str, Weight] = {
    "linear": lambda t: (1.0 - t, -1.0),
    "sqrt": _root,
    "square": lambda t: (1.0 - t * t, -2.0 * t),
    "smoothstep": lambda t: (1.0 - t * t * (3.0 - 2.0 * t), -6.0 * t * (1.0 - t)),
}


def weight_function(weight: str | ArrayLike | Callable[[float], float]) -> Weight:
    """Function t -> (ω, dω/dt), from a name in `WEIGHTS`, a table (K, 2) of t and ω, or any function ω(t).

    Raises
    ------
    BodyError
        An unknown name; a table or function that does not go from ω(0) = 1 to ω(1) = 0.
    """
    if isinstance(weight, str):
        check_choice("weighting", weight, WEIGHTS, BodyError, remedy="Or give a table of t and ω.")
        return WEIGHTS[weight]
    if callable(weight):
        value = weight
    else:
        table = np.asarray(weight, float)
        if table.ndim != 2 or table.shape[1] != 2 or len(table) < 2 or not np.all(np.diff(table[:, 0]) > 0):
            raise BodyError(f"a table of weights of shape {table.shape}", remedy="Give rows (t, ω) with t rising.")
        value = lambda t: float(np.interp(t, table[:, 0], table[:, 1]))
    ends = float(value(0.0)), float(value(1.0))
    if not (abs(ends[0] - 1.0) < 1e-9 and abs(ends[1]) < 1e-9):
        raise BodyError(f"a weighting with ω(0) = {ends[0]} and ω(1) = {ends[1]}", remedy="It must go from 1 to 0.")

    def with_slope(t: float) -> tuple[float, float]:
        low, high = max(t - _DIFFERENCE_STEP, 0.0), min(t + _DIFFERENCE_STEP, 1.0)
        return float(value(t)), (float(value(high)) - float(value(low))) / (high - low)

    return with_slope


@dataclass(frozen=True, eq=False)
class Steering:
    """Weight of an operator as a function of a joint angle.

    Parameters
    ----------
    coordinate : str, name of the angle.
    start, end : [rad] or [m], angles of weight 0 and 1: t goes from 0 to 1 between them.
    weight : name in `WEIGHTS`, table (K, 2) of t and ω, or function ω(t).
    beyond : bool
        Whether the weight is proportional to the angle without limits, like λ θ of P1's local morphs; needs the weight
        "linear".
    """

    coordinate: str
    start: float = 0.0
    end: float = 1.0
    weight: str | ArrayLike | Callable[[float], float] = "linear"
    beyond: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start) and math.isfinite(self.end)) or self.start == self.end:
            problem = f"a morph steered by {self.coordinate} from {self.start} to {self.end}"
            raise BodyError(problem, remedy="Give two different angles.")
        if self.beyond and not (isinstance(self.weight, str) and self.weight == "linear"):
            raise BodyError("a weighting that continues beyond its ends must be linear", remedy="Remove `beyond`.")
        self._function  # noqa: B018  raises its errors at construction

    @cached_property
    def _function(self) -> Weight:
        return weight_function(self.weight)

    def at(self, angle: float) -> tuple[float, float]:
        """Weight s = 1 − ω (a number) at an angle [rad, m], and its derivative ∂s/∂angle."""
        span = self.end - self.start
        t = (angle - self.start) / span
        if not self.beyond and not 0.0 <= t <= 1.0:
            return (0.0 if t < 0.0 else 1.0), 0.0
        omega, slope = self._function(t)
        return 1.0 - omega, -slope / span
