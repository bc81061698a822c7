"""Register a depth camera to a person whose poses are known from videos.

Only the camera moves. Iterative closest points run from several starts within the prior, with a correspondence distance
that shrinks. The cost of a camera pose is the sum of truncated squared distances of all measured points, with new
correspondences in each frame. Costs of two poses are comparable, which separates a local minimum from the right pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.rows import Rows
from kinefit.sensors.base import Measurement, matched_by, rows_at
from kinefit.sensors.displaced import AXES, CLOCK, displacement
from kinefit.sensors.scene import Scene

MIN_COST_GAP_SIGMAS = 3.0
"""Standard errors, over the frames, by which the cost of one pose must exceed that of another."""

TRUNCATION_DISTANCE = 0.1
"""[m] above which the squared distance of a point is truncated."""

COARSE_DISTANCES = (0.3, 0.3, 0.2, 0.2, 0.15, 0.1)
"""[m] correspondence distance of each round, from all starts."""

FINE_DISTANCES = (0.1, 0.08, 0.06, 0.05)
"""[m] correspondence distance of each round, from the best of them."""

_SURFACE_SIGMA = 0.03  # [m] of a point from a surface of simple shapes
_INDEPENDENT_SHARE = 0.02  # of the points: neighbours err alike
_TRIED_HEIGHTS = np.linspace(-0.06, 0.06, 9)  # [m]
_HEIGHT_TRUNCATION = 0.05  # [m] in place of `TRUNCATION_DISTANCE` while heights are tried


@dataclass(frozen=True, eq=False)
class Registration:
    """Measurements of one sensor in frames with known poses.

    Parameters
    ----------
    sensor : name
    steps : F lists of its `Displaced` measurements about `centre`, one for each frame.
    scenes : F scenes, at the known poses.
    centre : (3,) [m] about which its frame turns.
    information : (6, 6) of the prior of shift and turn.
    """

    sensor: str
    steps: Sequence[Sequence[Measurement]]
    scenes: Sequence[Scene]
    centre: NDArray
    information: NDArray

    def rows(self, twist: NDArray, reach: float) -> list[list[Rows]]:
        """Rows of each frame with the sensor at a twist (7,), measured points first; `reach` [m] as of `match`."""
        values = {self.sensor: values_of(twist)}
        out = []
        for several, scene in zip(self.steps, self.scenes):
            there = scene.at(scene.state, values=values)
            each = [rows_at(matched_by(m, there, reach), there) for m in several if m.sensor == self.sensor]
            out.append([r for rows in each for r in rows if isinstance(r, Rows)])
        return out

    def costs(self, twist: NDArray, near: float = TRUNCATION_DISTANCE) -> NDArray:
        """(F,) [m²] sums of squared distances truncated at `near` [m], minus their value if all were truncated."""
        squares = [np.square(rows[0].residual) if rows else np.zeros(0) for rows in self.rows(twist, near)]
        return np.array([np.sum(np.minimum(r, near**2) - near**2) for r in squares])

    def above(self, twist: NDArray, other: NDArray) -> bool:
        """Whether the cost at a twist (7,) is significantly above that at another (7,)."""
        return clearly_above(self.costs(twist), self.costs(other))

    def settled(self, twist: NDArray, reach: Sequence[float]) -> NDArray:
        """(7,) local minimum from a start (7,), a round for each correspondence distance [m]; the clock is fixed."""
        shift, R, clock = twist[:3], se3.exp_so3(twist[3:6]), twist[6:]
        for end in reach:
            now = np.concatenate([shift, se3.log_so3(R)])
            H, g = self.information.copy(), self.information @ now
            for rows in (r for several in self.rows(np.append(now, clock), end) for r in several):
                point, way = rows.data[:3].T - (self.centre + shift), rows.data[3:6].T
                A = np.hstack([way, np.cross(point, way)])
                inside = np.clip(1.0 - np.square(rows.residual / end), 0.0, None)
                weight = _INDEPENDENT_SHARE / _SURFACE_SIGMA**2 * np.square(inside)
                H += (weight[:, None] * A).T @ A
                g += A.T @ (weight * rows.residual)
            step = np.linalg.solve(H, g)
            shift, R = shift - step[:3], se3.exp_so3(-step[3:]) @ R
        return np.concatenate([shift, se3.log_so3(R), clock])

    def height(self, twist: NDArray, up: NDArray) -> NDArray:
        """(7,) a twist (7,) raised along `up` (3,) to the height of lowest cost.

        Correspondences slide along a standing person: a round of closest points reduces the error of the height by 3 %
        only. So heights are tried, and a parabola through the costs gives the best one.
        """
        way = np.append(up, np.zeros(4))
        cost = np.array([self.costs(twist + raised * way, _HEIGHT_TRUNCATION).sum() for raised in _TRIED_HEIGHTS])
        least = int(np.clip(np.argmin(cost), 2, len(_TRIED_HEIGHTS) - 3))
        a, b, _ = np.polyfit(_TRIED_HEIGHTS[least - 2 : least + 3], cost[least - 2 : least + 3], 2)
        best = -0.5 * b / a if a > 0.0 else _TRIED_HEIGHTS[least]
        return twist + float(np.clip(best, _TRIED_HEIGHTS[0], _TRIED_HEIGHTS[-1])) * way


@dataclass(frozen=True, eq=False)
class Ends:
    """Local minima of several starts.

    Parameters
    ----------
    registration : Registration
    twists : of (7,)
    """

    registration: Registration
    twists: tuple[NDArray, ...]

    @cached_property
    def best(self) -> NDArray:
        """(7,) the twist of lowest cost."""
        return min(self.twists, key=lambda twist: float(self.registration.costs(twist).sum()))

    @property
    def rivals(self) -> tuple[NDArray, ...]:
        """Differences (7,) from the best minimum to each other that is not significantly worse."""
        return tuple(apart(t, self.best) for t in self.twists if not self.registration.above(t, self.best))


def clearly_above(costs: NDArray, others: NDArray) -> bool:
    """Whether costs (F,) of one pose are significantly above those of another (F,); see `MIN_COST_GAP_SIGMAS`."""
    more = costs - others
    return bool(more.mean() > MIN_COST_GAP_SIGMAS * more.std(ddof=1) / np.sqrt(len(more)))


def starts(origin: NDArray, centre: NDArray, std: tuple[float, float]) -> list[NDArray]:
    """Start twists (7,): zero, turns about the origin and shifts towards the centre by one and two sigmas.

    Parameters
    ----------
    origin, centre : (3,) [m] of the sensor's frame, and of its points.
    std : [m], [rad] standard deviations of the origin's shift, and of the turn.
    """
    way = centre - origin
    length = float(np.linalg.norm(way))
    axes = np.linalg.svd(way[None])[2][1:]  # across
    out = [np.zeros(7)]
    for size in (1.0, -1.0, 2.0, -2.0):
        for axis in axes:
            turn = size * std[1] * axis
            out.append(np.concatenate([se3.exp_so3(turn) @ way - way, turn, [0.0]]))
        out.append(np.concatenate([size * std[0] * way / max(length, 1e-9), np.zeros(4)]))
    return out


def values_of(twist: NDArray) -> dict[str, float]:
    """{name: value} [m, rad, s] of a sensor in a scene, from a twist (7,)."""
    return dict(zip((*AXES, CLOCK), np.asarray(twist, float).tolist()))


def apart(twist: NDArray, other: NDArray) -> NDArray:
    """(7,) shift of the centre, turn and clock offset from another twist (7,) to one (7,)."""
    at = lambda t: displacement(values_of(t), np.zeros(3))[:3, :3]
    return np.concatenate([twist[:3] - other[:3], se3.log_so3(at(twist) @ at(other).T), twist[6:] - other[6:]])


def twist_of(values: Mapping[str, float]) -> NDArray:
    """(7,) twist [m, rad, s] of a scene's values of a sensor; inverse of `values_of`."""
    return np.array([values[what] for what in (*AXES, CLOCK)])
