"""Triangulate the bar in every frame, and assign its targets in every camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate
from kinefit.geometry.se3 import transform


@dataclass(frozen=True, eq=False)
class BarPlacement:
    """Ends (F, 2, 3) [m], NaN where unknown; pixels (F, C, 2, 2) in their order, NaN where unused; ambiguous (F,)."""

    x_world: NDArray
    uv: NDArray
    ambiguous: NDArray


def place(rig: Rig, uv: NDArray, length: float, limit: float, tolerance: float) -> BarPlacement:
    """Triangulate the bar in every frame, in the order of targets with the lowest cost in all cameras and the length.

    Frames in which two orders fit alike (two cameras and a bar in the plane through both) are discarded.

    Parameters
    ----------
    uv : (F, C, 2, 2) [px], targets in any order.
    limit : float [px] largest error of a camera that agrees.
    tolerance : float [m] standard deviation of the length.
    """
    F, C = uv.shape[:2]
    seen = np.isfinite(uv).all(axis=(2, 3))
    costs, ends, orders = [np.full(F, np.inf)], [np.full((F, 2, 3), np.nan)], [np.zeros((F, C), bool)]
    for i, j in combinations(range(C), 2):
        both = np.flatnonzero(seen[:, i] & seen[:, j])
        pair = Rig((rig.cameras[i], rig.cameras[j]))
        for crossed in (False, True) if len(both) else ():
            pixels = np.stack([uv[both, i], uv[both, j][:, ::-1] if crossed else uv[both, j]], axis=2)
            cost, x, order = np.full(F, np.inf), np.full((F, 2, 3), np.nan), np.zeros((F, C), bool)
            x[both] = triangulate(pair, pixels.reshape(-1, 2, 2)).reshape(-1, 2, 3)
            off = (np.linalg.norm(x[both, 1] - x[both, 0], axis=1) - length) / tolerance
            agreed, order[both] = _agreement(rig, x[both], uv[both], limit)
            cost[both] = agreed + np.minimum(np.nan_to_num(off**2), 25.0)
            costs, ends, orders = [*costs, cost], [*ends, x], [*orders, order]
    rows, best = np.arange(F), np.argmin(costs, axis=0)
    x_world, order = np.array(ends)[best, rows], np.array(orders)[best, rows]
    differs = (np.array(orders) ^ order) & seen
    other = differs.any(axis=2) & (differs != seen).any(axis=2)  # all swapped is the same bar
    rival = np.where(other, costs, np.inf).min(axis=0)
    least = np.array(costs)[best, rows]
    ambiguous = np.isfinite(least) & (rival < least + 9.0)  # three standard deviations
    ordered = np.where(order[:, :, None, None], uv[:, :, ::-1], uv)
    projected = np.stack([camera.project(np.nan_to_num(x_world)) for camera in rig], axis=1)
    off = np.linalg.norm(projected - ordered, axis=3).max(axis=2)
    used = seen & (off < limit) & ~ambiguous[:, None]
    keeps = np.abs(np.linalg.norm(x_world[:, 1] - x_world[:, 0], axis=1) - length) < 5 * tolerance
    used &= ((used.sum(axis=1) >= 2) & keeps)[:, None]
    x_world[~used.any(axis=1)] = np.nan
    return BarPlacement(x_world, np.where(used[:, :, None, None], ordered, np.nan), ambiguous)


def _agreement(rig: Rig, x: NDArray, uv: NDArray, limit: float) -> tuple[NDArray, NDArray]:
    """Truncated costs (F,) of ends x (F, 2, 3), a third of the limit counting 1, and (F, C) cameras that swap them."""
    cost, exchanged = np.zeros(len(x)), np.zeros(uv.shape[:2], bool)
    for c, camera in enumerate(rig):
        seen = np.isfinite(uv[:, c]).all(axis=(1, 2))
        at = camera.project(np.nan_to_num(x))
        both = [np.sum((at - uv[:, c][:, order]) ** 2, axis=(1, 2)) for order in ((0, 1), (1, 0))]
        both = [np.where(np.isfinite(square), square, np.inf) for square in both]
        exchanged[:, c] = both[1] < both[0]
        cost += np.where(seen, np.minimum(np.minimum(*both), 2 * limit**2), 0.0) / (limit / 3) ** 2
    return np.where(np.isfinite(x).all(axis=(1, 2)), cost, np.inf), exchanged


_MIN_FLOOR_ASPECT = 0.1  # width over length of the points on the floor: narrower ones determine no plane


def on_floor(rig: Rig, x_world: NDArray, frames: NDArray, floor: Sequence[int]) -> tuple[Rig, NDArray, str]:
    """The rig in the requested world, T_new_world (4, 4), and a description of that world.

    Parameters
    ----------
    x_world : (F, 2, 3) [m] ends of the bar; frames (F,) their numbers.
    floor : frames in which the bar lies on the floor; empty: the world stays.

    Raises
    ------
    CalibrationError
        A frame without the bar, or points on one line.
    """
    first = rig.names[0]
    if not floor:
        return rig, np.eye(4), (
            f"The world is the frame of {first} (x right, y down, z forward in its image): its -y points up if {first} "
            "was level. Lay the bar on the floor in two directions and name the frames to have z up."
        )  # fmt: skip
    absent = [frame for frame in floor if frame not in frames]
    if absent:
        nearest = int(frames[np.argmin(np.abs(frames - absent[0]))])
        raise CalibrationError(
            f"two cameras do not see the bar in frame {absent[0]}, in which it should lie on the floor", place="floor",
            remedy=f"The nearest frame with the bar is {nearest}; the last is {int(frames[-1])}.",
        )  # fmt: skip
    points = x_world[np.searchsorted(frames, np.array(floor))].reshape(-1, 3)
    middle = points.mean(axis=0)
    size, axes = np.linalg.svd(points - middle)[1:]
    if len(floor) < 2 or size[1] < _MIN_FLOOR_ASPECT * size[0]:
        raise CalibrationError(
            "the bar on the floor lies along one line, which does not determine the vertical", place="floor",
            remedy="Lay it there in two directions, and give a frame of each.",
        )  # fmt: skip
    above = np.mean([camera.centre_world for camera in rig], axis=0) - middle
    up = axes[2] * np.sign(axes[2] @ above)
    along = points[1] - points[0]
    along -= (along @ up) * up
    along /= np.linalg.norm(along)
    R = np.stack([along, np.cross(up, along), up])
    T = transform(R, -R @ points[0])
    height = 1e3 * float(np.sqrt(np.mean(((points - middle) @ up) ** 2)))
    listed = ", ".join(map(str, floor))
    return rig.moved(T), T, (
        f"Origin in a target of the bar on the floor (frame {floor[0]}), x along the bar, z up; the targets of frames "
        f'{listed} lie in a plane to {height:.1f} mm RMS. Write up = "z" in the take.'
    )
