"""Where a depth camera must be for its points to lie on the person, whose poses are known from the videos.

Only the camera moves. Points and surface are matched and solved in turn from several starts within the prior, with
weights that end at a distance which shrinks. What a place is worth is its truncated distances: of every point that was
measured, with new correspondences, frame by frame. So places can be compared, and one in which nearest points only
settled is told from the right one.
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

CLEAR = 3.0
"""Standard errors, over the frames, by which truncated distances of one place must be above those of another."""

NEAR = 0.1
"""[m] at which a distance counts in full."""

FAR, FINE = (0.3, 0.3, 0.2, 0.2, 0.15, 0.1), (0.1, 0.08, 0.06, 0.05)
"""[m] at which weights end, round by round: of the starts, and of what the best of them becomes."""

_SURFACE, _SHARE = (
    0.03,
    0.02,
)  # [m] of a point from a surface of simple shapes; share that is independent
_HEIGHTS, _CLOSE = np.linspace(-0.06, 0.06, 9), 0.05  # [m] that are tried, and at which a distance then counts in full


@dataclass(frozen=True, eq=False)
class Registration:
    """What one sensor saw, in frames whose poses are known.

    Parameters
    ----------
    sensor : name
    steps : F lists, what it measured in each frame, as `Displaced` measurements about `centre`.
    scenes : F scenes, at the poses that are known.
    centre : (3,) [m] about which its frame turns.
    information : (6, 6) of the prior of shift and turn.
    """

    sensor: str
    steps: Sequence[Sequence[Measurement]]
    scenes: Sequence[Scene]
    centre: NDArray
    information: NDArray

    def rows(self, twist: NDArray, reach: float) -> list[list[Rows]]:
        """Of each frame: rows of measured points first, then of others, with the sensor at a twist (7,)."""
        values = {self.sensor: values_of(twist)}
        out = []
        for several, scene in zip(self.steps, self.scenes):
            there = scene.at(scene.state, values=values)
            each = [rows_at(matched_by(m, there, reach), there) for m in several if m.sensor == self.sensor]
            out.append([r for rows in each for r in rows if isinstance(r, Rows)])
        return out

    def costs(self, twist: NDArray, near: float = NEAR) -> NDArray:
        """(F,) [m²] truncated squared distances of measured points, less those of points that are all far away."""
        squares = [np.square(rows[0].residual) if rows else np.zeros(0) for rows in self.rows(twist, near)]
        return np.array([np.sum(np.minimum(r, near**2) - near**2) for r in squares])

    def above(self, twist: NDArray, other: NDArray) -> bool:
        """Whether distances at a twist (7,) are clearly above those at another one."""
        return clearly_above(self.costs(twist), self.costs(other))

    def settled(self, twist: NDArray, reach: Sequence[float]) -> NDArray:
        """(7,) where the sensor comes to rest from a twist; the clock stays."""
        shift, R, clock = twist[:3], se3.exp_so3(twist[3:6]), twist[6:]
        for end in reach:
            now = np.concatenate([shift, se3.log_so3(R)])
            H, g = self.information.copy(), self.information @ now
            for rows in (r for several in self.rows(np.append(now, clock), end) for r in several):
                point, way = rows.data[:3].T - (self.centre + shift), rows.data[3:6].T
                A = np.hstack([way, np.cross(point, way)])
                weight = _SHARE / _SURFACE**2 * np.square(np.clip(1.0 - np.square(rows.residual / end), 0.0, None))
                H += (weight[:, None] * A).T @ A
                g += A.T @ (weight * rows.residual)
            step = np.linalg.solve(H, g)
            shift, R = shift - step[:3], se3.exp_so3(-step[3:]) @ R
        return np.concatenate([shift, se3.log_so3(R), clock])

    def height(self, twist: NDArray, up: NDArray) -> NDArray:
        """(7,) a twist raised so that the points lie nearest to the surface.

        Correspondences slide along a standing person: matched and solved in turn, heights come 3 % nearer in a round.
        So heights are tried, and the smallest truncated distances of all points, with new correspondences, are found.
        """
        way = np.append(up, np.zeros(4))
        cost = np.array([self.costs(twist + raised * way, _CLOSE).sum() for raised in _HEIGHTS])
        least = int(np.clip(np.argmin(cost), 2, len(_HEIGHTS) - 3))
        a, b, _ = np.polyfit(_HEIGHTS[least - 2 : least + 3], cost[least - 2 : least + 3], 2)
        best = -0.5 * b / a if a > 0.0 else _HEIGHTS[least]
        return twist + float(np.clip(best, _HEIGHTS[0], _HEIGHTS[-1])) * way


@dataclass(frozen=True, eq=False)
class Ends:
    """Where starts came to rest.

    Parameters
    ----------
    registration : Registration
    twists : of (7,)
    """

    registration: Registration
    twists: tuple[NDArray, ...]

    @cached_property
    def best(self) -> NDArray:
        """(7,) the one of the smallest truncated distances."""
        return min(self.twists, key=lambda twist: float(self.registration.costs(twist).sum()))

    @property
    def rivals(self) -> tuple[NDArray, ...]:
        """Of (7,): what leads from the best one to each other whose distances are not clearly above."""
        return tuple(apart(t, self.best) for t in self.twists if not self.registration.above(t, self.best))


def clearly_above(costs: NDArray, others: NDArray) -> bool:
    """Whether costs (F,) of one place are above those of another one by more than chance; see `CLEAR`."""
    more = costs - others
    return bool(more.mean() > CLEAR * more.std(ddof=1) / np.sqrt(len(more)))


def starts(origin: NDArray, centre: NDArray, std: tuple[float, float]) -> list[NDArray]:
    """Twists (7,): none; one and two deviations of turn about the origin across the way to the centre, of shift along.

    Parameters
    ----------
    origin, centre : (3,) [m] of the sensor's frame, and of what it saw.
    std : [m], [rad] of the origin's shift, and of the turn.
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
    """The scene's values of a sensor at a twist (7,)."""
    return dict(zip((*AXES, CLOCK), np.asarray(twist, float).tolist()))


def apart(twist: NDArray, other: NDArray) -> NDArray:
    """(7,) shift of the centre, turn and clock that lead from another twist to one."""
    at = lambda t: displacement(values_of(t), np.zeros(3))[:3, :3]
    return np.concatenate([twist[:3] - other[:3], se3.log_so3(at(twist) @ at(other).T), twist[6:] - other[6:]])


def twist_of(values: Mapping[str, float]) -> NDArray:
    """(7,) of a scene's values of a sensor."""
    return np.array([values[what] for what in (*AXES, CLOCK)])
