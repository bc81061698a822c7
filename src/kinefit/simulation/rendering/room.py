"""A room around a motion: floor, walls, ceiling and a table, as triangles that face inwards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera
from kinefit.motion import UP_AXES, Motion
from kinefit.rendering import subdivided
from kinefit.simulation.placing import places

PARTS = ("floor", "wall", "table")
_BEHIND = 1.0  # [m] from the body to the wall behind it
_BESIDE = 1.3  # [m] from the body to the walls beside it
_HIGH = 3.0  # [m] the ceiling
_REACH = 0.1  # [m] by which a body's skin lies beyond its landmarks
_TABLE = np.array([0.6, 0.72, 0.8])  # [m] wide, high, deep
_APART = 0.25  # [m] from the body to the table
_CELL = 0.5  # [m] longest edge of a triangle: lenses bend corners only


@dataclass(frozen=True, eq=False)
class Room:
    """Triangles that do not move.

    Parameters
    ----------
    vertices : (V, 3) [m] in the world
    faces : (T, 3) int, counter-clockwise as seen from within the room
    parts : (T,) int, which of `PARTS` each is.
    """

    vertices: NDArray
    faces: NDArray
    parts: NDArray


def room(motion: Motion, camera: Camera) -> Room:
    """A room that holds a motion, with the camera looking into it at a wall behind the body.

    Parameters
    ----------
    motion : Motion
        Stands on the floor with the lowest of its landmarks; the table stands beside all of it.
    camera : Camera in the motion's world.
    """
    up = np.array(UP_AXES[motion.up])
    ahead = camera.T_camera_world[2, :3] - (camera.T_camera_world[2, :3] @ up) * up
    if np.linalg.norm(ahead) < 1e-3:  # looks straight down or up
        ahead = camera.T_camera_world[1, :3] - (camera.T_camera_world[1, :3] @ up) * up
    ahead /= np.linalg.norm(ahead)
    axes = np.stack([np.cross(ahead, up), up, ahead])  # right, up, ahead of the camera
    body = places(motion) @ axes.T
    low, high = body.min(axis=0) - [_REACH, 0.03, _REACH], body.max(axis=0) + _REACH
    eye = axes @ camera.centre_world
    left, right = min(low[0], eye[0]) - _BESIDE, max(high[0], eye[0]) + _BESIDE + _TABLE[0]
    front, back, floor = min(low[2], eye[2]) - 0.3, high[2] + _BEHIND, low[1]
    top = max(floor + _HIGH, eye[1] + 0.3)
    table = np.array([high[0] + _APART, floor, 0.5 * (low[2] + high[2])])
    pieces = [
        (0, _rectangle([left, floor, front], [right - left, 0, 0], [0, 0, back - front])),
        (1, _rectangle([left, floor, back], [right - left, 0, 0], [0, top - floor, 0])),
        (1, _rectangle([left, floor, front], [0, 0, back - front], [0, top - floor, 0])),
        (1, _rectangle([right, floor, back], [0, 0, front - back], [0, top - floor, 0])),
        (1, _rectangle([right, floor, front], [left - right, 0, 0], [0, top - floor, 0])),
        (1, _rectangle([right, top, front], [left - right, 0, 0], [0, 0, back - front])),
        *((2, side) for side in _box(table, _TABLE)),
    ]
    cut = [subdivided(corners, np.array([[0, 1, 2], [0, 2, 3]]), _CELL) for _, corners in pieces]
    starts = np.cumsum([0, *(len(x) for x, _ in cut)])
    return Room(
        np.concatenate([x for x, _ in cut]) @ axes,
        np.concatenate([f + start for (_, f), start in zip(cut, starts)]),
        np.concatenate([np.full(len(f), part) for (_, f), (part, _) in zip(cut, pieces)]),
    )


def _rectangle(corner: list[float], across: list[float], along: list[float]) -> NDArray:
    """(4, 3) corners that go round counter-clockwise as seen from the side that across × along looks away from.

    The axes right, up and ahead are left-handed, so the product taken in them is turned round.
    """
    a, b, c = (np.array(v, float) for v in (corner, across, along))
    return np.stack([a, a + b, a + b + c, a + c])


def _box(corner: NDArray, size: NDArray) -> list[NDArray]:
    """The five sides of a box that do not lie on the floor, from outside."""
    (x, y, z), (w, h, d) = corner, size
    return [
        _rectangle([x, y + h, z], [w, 0, 0], [0, 0, d]),
        _rectangle([x, y, z], [w, 0, 0], [0, h, 0]),
        _rectangle([x + w, y, z + d], [-w, 0, 0], [0, h, 0]),
        _rectangle([x, y, z + d], [0, 0, -d], [0, h, 0]),
        _rectangle([x + w, y, z], [0, 0, d], [0, h, 0]),
    ]
