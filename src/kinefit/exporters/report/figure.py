"""The moving 3D figure of a page: capsules over time, a floor and cameras, drawn on a canvas by `player.js`."""

from __future__ import annotations

import base64
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, MeshSurface, PointSet
from kinefit.bodies.surfaces import Surface
from kinefit.exporters.pictures.drawing import bones
from kinefit.exporters.report.page import Html, to_json
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.motion import Motion, rotation_between_up
from kinefit.rendering.colours import LEFT_COLOUR, LOST_COLOUR, RIGHT_COLOUR, side_colour, to_hex
from kinefit.rendering.tubes import is_last

RATE = 15.0  # [Hz] of the figure: enough for the eye to follow, the player goes smoothly between
MAX_FIGURE_FRAMES = 3000  # frames: longer takes are shown at a lower rate
_BONE = 0.02  # [m] radius of a bone that has no surface
_PYRAMID_DEPTH_M = 0.35  # [m] how far a camera's pyramid reaches


class Capsules(NamedTuple):
    """C capsules: points (2 C) on the body, their ends two by two; radii (C, 2) [m] of both; colours (C) "#0072b2"."""

    points: PointSet
    radii: NDArray
    colours: list[str]


def figure(motion: Motion, rig: Rig | None = None) -> Html:
    """The body as it moves, with the cameras of a rig; the floor lies under the lowest foot."""
    R = rotation_between_up(motion.up, "z")
    capsules = _capsules(motion.body)
    step = max(1, round(motion.rate / RATE), -(-len(motion) // MAX_FIGURE_FRAMES))
    frames = np.arange(0, len(motion), step)
    T = se3.transform(R, np.zeros(3))
    x = motion.body.trajectories(T @ motion.Ts_world_root[frames], motion.angles[frames], capsules.points)
    floor = float(np.percentile((x[..., 2] - capsules.radii.ravel()).min(axis=1), 5))
    cameras = [] if rig is None else [_pyramid(camera.name, camera, R) for camera in rig]
    lost = motion.lost[frames][:, capsules.points.segments[::2]]
    return player(
        x, capsules, rate=motion.rate / step, start=float(motion.times[0]), floor=floor, cameras=cameras, dimmed=lost
    )  # fmt: skip


def live_figure(body: Body) -> tuple[Html, PointSet]:
    """A figure that a page moves by `move(points, lost)`, at rest; and its capsules' ends on the body, two by two."""
    capsules = _capsules(body)
    T = se3.transform(rotation_between_up("y", "z"), np.zeros(3))
    x = body.trajectories(T[None], body.rest_state().angles[None], capsules.points)
    floor = float((x[0, :, 2] - capsules.radii.ravel()).min())
    return player(x, capsules, rate=1.0, floor=floor), capsules.points


def player(
    x: NDArray,
    capsules: Capsules,
    *,
    rate: float,
    start: float = 0.0,
    floor: float = 0.0,
    cameras: list[dict[str, Any]] | None = None,
    dimmed: NDArray | None = None,
) -> Html:
    """A moving figure of capsules, z up.

    Parameters
    ----------
    x : (F, 2 C, 3) [m] ends of the capsules over time.
    capsules : Capsules
    rate : float [Hz]
    start : float [s] time of the first frame.
    floor : float [m] height of the floor's grid.
    cameras : list of {"name", "points": (5, 3) centre and corners}, optional
    dimmed : (F, C) bool, optional
        Capsules that are shown as lost.
    """
    low, high = x.min(axis=(0, 1)), x.max(axis=(0, 1))
    quantum = max(float((high - low).max()) / 60000.0, 1e-4)
    whole = np.round((x - 0.5 * (low + high)) / quantum).astype("<i2")
    data = {
        "rate": rate, "start": start, "frames": len(x), "points": x.shape[1], "quantum": quantum,
        "middle": 0.5 * (low + high), "low": low, "high": high, "floor": floor, "radii": capsules.radii,
        "ends": np.arange(x.shape[1]).reshape(-1, 2), "colours": capsules.colours,
        "sides": [(c == to_hex(RIGHT_COLOUR)) - (c == to_hex(LEFT_COLOUR)) for c in capsules.colours],
        "lost": to_hex(LOST_COLOUR),
        "cameras": cameras or [], "x": _packed(whole),
        "dimmed": _packed(np.packbits(dimmed)) if dimmed is not None and dimmed.any() else "",
    }  # fmt: skip
    return Html(f'<div class="player" id="figure"><script type="application/json">{to_json(data)}</script></div>')


def _packed(array: NDArray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _capsules(body: Body) -> Capsules:
    """Those of a body's surfaces, or of its bones."""
    tree = body.tree
    limbs = [limb for c in body.surfaces for limb in _limbs(c, body)]
    if limbs:
        segments = np.repeat([segment for segment, _, _ in limbs], 2)
        tips = np.concatenate([both for _, both, _ in limbs])
        radii = np.array([r for _, _, r in limbs])
        points = PointSet(tuple(f"{k}" for k in range(len(tips))), segments, tips)
    else:
        points = bones(body)[0]
        radii = np.full((len(points) // 2, 2), _BONE)
    colours = [to_hex(side_colour(tree.segments[s])) for s in points.segments[::2]]
    return Capsules(points, radii, colours)


def _limbs(c: Surface, body: Body) -> list[tuple[int, NDArray, NDArray]]:
    """Segment, both ends (2, 3) [m] and radii (2,) [m] of the capsules that stand for a surface.

    An ellipse is filled by three circles side by side. The last of a limb is, with its rounded end, as long as its
    surface; a mesh is as long as its longest direction and as thick as the rest of it.
    """
    if isinstance(c, MeshSurface):
        middle = c.vertices.mean(axis=0)
        _, _, axes = np.linalg.svd(c.vertices - middle, full_matrices=False)
        half = 0.5 * np.ptp((c.vertices - middle) @ axes.T, axis=0)
        radius = float(np.sqrt(half[1] * half[2]))
        return [(c.segment, middle + np.outer([-1, 1], max(half[0] - radius, 1e-3) * axes[0]), np.full(2, radius))]
    start, end, radii = np.array(c.start), np.array(c.end), np.array(c.radii)
    thin, wide = np.argmin(radii.sum(0)), np.argmax(radii.sum(0))
    if is_last(body, c):
        end = start + (end - start) * max(0.2, 1 - c.mean_radii[1] / c.length)
    if c.is_round:
        return [(c.segment, np.stack([start, end]), radii[:, 0])]
    beside = (radii[:, wide] - radii[:, thin]).clip(0)[:, None] * c.axes[wide]
    return [(c.segment, np.stack([start, end]) + k * beside, radii.min(axis=1)) for k in (-1, 0, 1)]


def _pyramid(name: str, camera: Any, R: NDArray) -> dict[str, Any]:
    """A camera's centre and the corners of its view, turned by R."""
    width, height = camera.size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(camera.matrix).T
    x = np.vstack([np.zeros(3), _PYRAMID_DEPTH_M * rays])
    T = camera.T_world_camera
    return {"name": name, "points": (x @ T[:3, :3].T + T[:3, 3]) @ R.T}
