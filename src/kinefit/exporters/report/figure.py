"""The moving 3D figure of a page: skin or cylinders over time, a floor and cameras, drawn by `player.js`."""

from __future__ import annotations

import base64
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, MeshSurface, PointSet
from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.bodies.rendering import looks
from kinefit.bodies.surfaces import Surface
from kinefit.exporters.pictures.drawing import bones
from kinefit.exporters.report.page import Html, to_json
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig

RATE = 15.0  # [Hz] of the figure: enough for the eye to follow, the player goes smoothly between
MAX_FIGURE_FRAMES = 3000  # frames: longer takes are shown at a lower rate
_MAX_VERTICES, _MAX_SEGMENTS = 65535, 256  # of a skin: a page stays small; larger ones are drawn as cylinders
_BONE = 0.02  # [m] radius of a bone that has no surface
_PYRAMID_DEPTH_M = 0.35  # [m] how far a camera's pyramid reaches


class Capsules(NamedTuple):
    """C capsules: points (2 C) on the body, their ends two by two; radii (C, 2) [m] of both."""

    points: PointSet
    radii: NDArray


def figure(motion: Motion, rig: Rig | None = None) -> Html:
    """The body as it moves, with the cameras of a rig; the floor lies under the lowest foot."""
    R = rotation_between_up(motion.up, "z")
    step = max(1, round(motion.rate / RATE), -(-len(motion) // MAX_FIGURE_FRAMES))
    frames = np.arange(0, len(motion), step)
    T = se3.transform(R, np.zeros(3))
    Ts = motion.body.tree.segment_poses(T @ motion.Ts_world_root[frames], motion.angles[frames])
    cameras = [] if rig is None else [_pyramid(camera.name, camera, R) for camera in rig]
    hints = {"lost": motion.lost[frames], "uncertain": looks.uncertain_segments(motion.body, motion.joint_std[frames])}
    return _player(
        motion.body, Ts, rate=motion.rate / step, start=float(motion.times[0]), cameras=cameras,
        **{look: _packed(np.packbits(segments)) if segments.any() else "" for look, segments in hints.items()},
    )  # fmt: skip


def live_figure(body: Body, up: str = "y") -> Html:
    """A figure at rest that a page moves by `move(poses, lost, uncertain)`, in a world with the vertical axis `up`."""
    rest = se3.transform(rotation_between_up("y", "z"), np.zeros(3))
    Ts = body.tree.segment_poses(rest[None], body.rest_state().angles[None])
    return _player(body, Ts, rate=1.0, turn=rotation_between_up(up, "z"))


def _player(body: Body, Ts: NDArray, **more: Any) -> Html:
    """The figure that `player.js` draws: segments' poses (F, S, 4, 4), z up, and more entries as it reads them."""
    capsules, names = _capsules(body), body.tree.segments
    owners = capsules.points.segments
    x = np.einsum("fkij,kj->fki", Ts[:, owners, :3], np.insert(capsules.points.points, 3, 1.0, axis=1))
    low, high = x.min(axis=(0, 1)), x.max(axis=(0, 1))
    floor = float(np.percentile((x[..., 2] - capsules.radii.ravel()).min(axis=1), 5))
    at = Ts[..., :3, 3]
    quantum = max(float((np.maximum(high, at.max((0, 1))) - np.minimum(low, at.min((0, 1)))).max()) / 30000.0, 1e-4)
    turns = np.rint(32767 * se3.quaternion(Ts[..., :3, :3])[..., 1:])  # the first, w, is the root of the rest
    poses = np.concatenate([np.rint((at - 0.5 * (low + high)) / quantum), turns], axis=-1).astype("<i2")
    data = {
        "frames": len(Ts), "segments": len(names), "poses": _packed(poses), "quantum": quantum,
        "middle": 0.5 * (low + high), "low": low, "high": high, "floor": floor, "rest": body.tree.rest,
        "ends": capsules.points.points, "owners": owners, "radii": capsules.radii, "skin": _skin(body),
        "colours": [looks.to_hex(looks.side_colour(name)) for name in names],
        "sides": [name.endswith("_r") - name.endswith("_l") for name in names],
        "lost_colour": looks.to_hex(looks.LOST_COLOUR), "opacities": [looks.LOST_OPACITY, looks.UNCERTAIN_OPACITY],
        "cameras": [], "start": 0.0, "lost": "", "uncertain": "",
        **more,
    }  # fmt: skip
    return Html(f'<div class="player" id="figure"><script type="application/json">{to_json(data)}</script></div>')


def _skin(body: Body) -> dict[str, Any] | None:
    """The skin as `player.js` reads it, each vertex once for every segment that it shows; None without one."""
    mesh = looks.body_mesh(body)
    V = len(mesh.vertices)
    pairs, faces = np.unique(looks.triangle_segments(mesh)[:, None] * V + mesh.triangles, return_inverse=True)
    if not 0 < len(pairs) <= _MAX_VERTICES or len(body.tree.segments) > _MAX_SEGMENTS:
        return None
    shown, used = np.divmod(pairs, V)
    grain = max(float(np.abs(mesh.vertices).max()) / 32767.0, 1e-6)
    return {
        "grain": grain, "vertices": _packed(np.rint(mesh.vertices[used] / grain).astype("<i2")),
        "normals": _packed(np.rint(127 * mesh.normals[used]).astype("i1")), "faces": _packed(faces.astype("<u2")),
        "shown": _packed(shown.astype("u1")), "owners": _packed(mesh.segments[used].astype("u1")),
        "weights": _packed(np.rint(255 * mesh.weights[used]).astype("u1")),
    }  # fmt: skip


def _packed(array: NDArray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _capsules(body: Body) -> Capsules:
    """Those of a body's surfaces, or of its bones."""
    limbs = [limb for c in body.surfaces for limb in _limbs(c, body)]
    if not limbs:
        points = bones(body)[0]
        return Capsules(points, np.full((len(points) // 2, 2), _BONE))
    segments = np.repeat([segment for segment, _, _ in limbs], 2)
    tips = np.concatenate([both for _, both, _ in limbs])
    return Capsules(PointSet(tuple(f"{k}" for k in range(len(tips))), segments, tips), np.array([r for *_, r in limbs]))


def _limbs(c: Surface, body: Body) -> list[tuple[int, NDArray, NDArray]]:
    """Segment, both ends (2, 3) [m] and radii (2,) [m] of the capsules that stand for a surface.

    An ellipse is filled by three circles side by side. The last of a limb is, with its rounded end, as long as its
    surface; a mesh is as long as its longest direction and as thick as the rest of it.
    """
    if isinstance(c, MeshSurface):
        middle, axes, size = c.box()
        half = 0.5 * size
        radius = float(np.sqrt(half[1] * half[2]))
        return [(c.segment, middle + np.outer([-1, 1], max(half[0] - radius, 1e-3) * axes[0]), np.full(2, radius))]
    start, end, radii = np.array(c.start), np.array(c.end), np.array(c.radii)
    thin, wide = np.argmin(radii.sum(0)), np.argmax(radii.sum(0))
    if looks.is_last(body, c):
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
