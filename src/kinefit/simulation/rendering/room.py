"""Build a room around a motion: floor, walls, ceiling and a table, as triangles that face inwards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera
from kinefit.motion import UP_AXES, Motion
from kinefit.rendering import subdivided
from kinefit.simulation.placing import places

PARTS = ("floor", "wall", "table")
_BACK_WALL_DISTANCE = 1.0  # [m] from the body to the wall behind it
_SIDE_WALL_DISTANCE = 1.3  # [m] from the body to the side walls
_CEILING_HEIGHT = 3.0  # [m]
_SURFACE_MARGIN = 0.1  # [m] between landmarks and the body's surface
_TABLE_SIZE = np.array([0.6, 0.72, 0.8])  # [m] width, height, depth
_TABLE_DISTANCE = 0.25  # [m] from the body to the table
_MAX_EDGE = 0.5  # [m] of a triangle: lens distortion applies to corners only


@dataclass(frozen=True, eq=False)
class Room:
    """Static triangles of a room.

    Parameters
    ----------
    vertices : (V, 3) [m] in the world
    faces : (T, 3) int, counter-clockwise seen from inside the room
    parts : (T,) int, number in `PARTS` of each
    """

    vertices: NDArray
    faces: NDArray
    parts: NDArray


def room(motion: Motion, camera: Camera) -> Room:
    """A room around a motion, with the camera facing a wall behind the body.

    Parameters
    ----------
    motion : Motion
        Its lowest landmark is on the floor; the table is beside the volume of the motion.
    camera : Camera in the motion's world
    """
    up = np.array(UP_AXES[motion.up])
    ahead = camera.T_camera_world[2, :3] - (camera.T_camera_world[2, :3] @ up) * up
    if np.linalg.norm(ahead) < 1e-3:  # looks straight down or up
        ahead = camera.T_camera_world[1, :3] - (camera.T_camera_world[1, :3] @ up) * up
    ahead /= np.linalg.norm(ahead)
    axes = np.stack([np.cross(ahead, up), up, ahead])  # right, up, ahead of the camera
    body = places(motion) @ axes.T
    low = body.min(axis=0) - [_SURFACE_MARGIN, 0.03, _SURFACE_MARGIN]
    high = body.max(axis=0) + _SURFACE_MARGIN
    eye = axes @ camera.centre_world
    left = min(low[0], eye[0]) - _SIDE_WALL_DISTANCE
    right = max(high[0], eye[0]) + _SIDE_WALL_DISTANCE + _TABLE_SIZE[0]
    front, back, floor = min(low[2], eye[2]) - 0.3, high[2] + _BACK_WALL_DISTANCE, low[1]
    top = max(floor + _CEILING_HEIGHT, eye[1] + 0.3)
    table = np.array([high[0] + _TABLE_DISTANCE, floor, 0.5 * (low[2] + high[2])])
    pieces = [
        (0, _rectangle([left, floor, front], [right - left, 0, 0], [0, 0, back - front])),
        (1, _rectangle([left, floor, back], [right - left, 0, 0], [0, top - floor, 0])),
        (1, _rectangle([left, floor, front], [0, 0, back - front], [0, top - floor, 0])),
        (1, _rectangle([right, floor, back], [0, 0, front - back], [0, top - floor, 0])),
        (1, _rectangle([right, floor, front], [left - right, 0, 0], [0, top - floor, 0])),
        (1, _rectangle([right, top, front], [left - right, 0, 0], [0, 0, back - front])),
        *((2, side) for side in _box(table, _TABLE_SIZE)),
    ]
    cut = [subdivided(corners, np.array([[0, 1, 2], [0, 2, 3]]), _MAX_EDGE) for _, corners in pieces]
    starts = np.cumsum([0, *(len(x) for x, _ in cut)])
    return Room(
        np.concatenate([x for x, _ in cut]) @ axes,
        np.concatenate([f + start for (_, f), start in zip(cut, starts)]),
        np.concatenate([np.full(len(f), part) for (_, f), (part, _) in zip(cut, pieces)]),
    )


def _rectangle(corner: list[float], across: list[float], along: list[float]) -> NDArray:
    """(4, 3) corners, counter-clockwise seen from the side opposite to across × along.

    The axes right, up and ahead are left-handed, which reverses the sign of the product.
    """
    a, b, c = (np.array(v, float) for v in (corner, across, along))
    return np.stack([a, a + b, a + b + c, a + c])


def _box(corner: NDArray, size: NDArray) -> list[NDArray]:
    """The five sides of a box that are not on the floor, facing outwards."""
    (x, y, z), (w, h, d) = corner, size
    return [
        _rectangle([x, y + h, z], [w, 0, 0], [0, 0, d]),
        _rectangle([x, y, z], [w, 0, 0], [0, h, 0]),
        _rectangle([x + w, y, z + d], [-w, 0, 0], [0, h, 0]),
        _rectangle([x, y, z + d], [0, 0, -d], [0, h, 0]),
        _rectangle([x + w, y, z], [0, 0, d], [0, h, 0]),
    ]
