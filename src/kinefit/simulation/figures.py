"""Draw a body as a figure of tapered limbs in a camera's image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, MeshSurface
from kinefit.bodies.surfaces import Surface
from kinefit.errors import BodyError
from kinefit.geometry.camera import Camera
from kinefit.motion import Motion
from kinefit.rendering.looks import side_colour
from kinefit.simulation.placing import look_at
from kinefit.solvers.mobility import closed_poses

_GREY = (128, 128, 128)
_END_CORNERS = 32  # of the polygon of a round end
_SUBPIXEL_BITS = 4  # of corners in drawing functions


def draw_figure(motion: Motion, frame: int, camera: Camera, image: NDArray | None = None) -> NDArray:
    """Image (H, W, 3) of the body's surfaces, BGR 8 bit, drawn from far to near.

    Parameters
    ----------
    frame : int
    camera : Camera in the motion's world
    image : (H, W, 3), optional
        Background of the camera's size; default: plain grey.
    """
    image = np.full((camera.size[1], camera.size[0], 3), _GREY, np.uint8) if image is None else image.copy()
    R_camera_world, far = camera.T_camera_world[:3, :3], []
    frames, _ = motion.body.tree.forward(motion.state(frame).T_world_root, motion.state(frame).angles)
    for limb in motion.body.surfaces:
        R, t = frames[limb.segment, :9].reshape(3, 3), frames[limb.segment, 9:]
        x = _contour_points(limb, R_camera_world @ R) @ R.T + R @ motion.body.tree.rest[limb.segment] + t
        far.append((float((x @ R_camera_world[2]).mean() + camera.T_camera_world[2, 3]), x, limb.segment))
    nearest, farthest = min(item[0] for item in far), max(item[0] for item in far)
    for depth, x, segment in sorted(far, key=lambda item: -item[0]):
        contour = camera.project(x)
        if not np.isfinite(contour).all():
            continue
        hull = cv2.convexHull(contour.astype(np.float32))[:, 0]
        corners = np.round(hull * 2**_SUBPIXEL_BITS).astype(np.int32)
        colour = np.array(side_colour(motion.body.tree.segments[segment])[::-1])
        shade = 1.0 - 0.35 * (depth - nearest) / max(farthest - nearest, 1e-9)
        cv2.fillPoly(image, [corners], (colour * shade).tolist(), cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.polylines(image, [corners], True, (colour * shade * 0.6).tolist(), 1, cv2.LINE_AA, _SUBPIXEL_BITS)
    return image


def portrait(body: Body, azimuth: float = 40.0, size: tuple[int, int] = (900, 900)) -> NDArray:
    """Image (H, W, 3) of a body in its default pose, BGR 8 bit; with closures in a closed pose near it.

    Parameters
    ----------
    azimuth : [deg] of the camera about the vertical, 0 in front of the body
    size : (width, height) [px]

    Raises
    ------
    BodyError
        Closures contradict each other; the body has no surfaces.
    """
    if not body.surfaces:
        raise BodyError(f"body '{body.name}' has no surfaces to render", remedy="Add a surface to its segments.")
    state = closed_poses(body, most=1)[0] if body.closures else body.usual_state()
    count = len(body.tree.segments)
    motion = Motion(
        body, 1.0, np.zeros(1), state.T_world_root[None], state.angles[None], np.zeros((1, body.tree.n_dofs)),
        np.zeros((1, count, 3)), np.ones(1), np.ones((1, count)),
    )  # fmt: skip
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    points_of_limbs = [
        limb.vertices if isinstance(limb, MeshSurface) else np.array([limb.start, limb.end]) for limb in body.surfaces
    ]
    x = np.concatenate([
        (points + body.tree.rest[limb.segment]) @ frames[limb.segment, :9].reshape(3, 3).T + frames[limb.segment, 9:]
        for points, limb in zip(points_of_limbs, body.surfaces)
    ])  # fmt: skip
    centre, extent = 0.5 * (x.min(axis=0) + x.max(axis=0)), float(np.linalg.norm(np.ptp(x, axis=0)))
    a, distance = np.radians(azimuth), 2.2 * extent
    eye = centre + distance * np.array([np.cos(a) * 0.97, 0.25, np.sin(a) * 0.97])
    T = look_at(eye, centre, np.array([0.0, 1.0, 0.0]))
    focal = 0.85 * min(size) * distance / extent
    matrix = np.array([[focal, 0.0, 0.5 * size[0]], [0.0, focal, 0.5 * size[1]], [0.0, 0.0, 1.0]])
    return draw_figure(motion, 0, Camera("portrait", size, matrix, np.zeros(0), "radtan", T))


def _contour_points(limb: Surface, R_camera_segment: NDArray) -> NDArray:
    """(K, 3) [m] points in the segment's frame whose convex hull in the image is the limb: of its two round ends."""
    if isinstance(limb, MeshSurface):
        return limb.vertices
    angle = np.linspace(0, 2 * np.pi, _END_CORNERS, endpoint=False)
    outward = np.outer(np.cos(angle), R_camera_segment[0]) + np.outer(np.sin(angle), R_camera_segment[1])
    ends = []
    for end, (a, b) in zip((limb.start, limb.end), limb.radii):
        M = limb.axes.T @ np.diag([a, b, np.sqrt(a * b)]) ** 2 @ limb.axes  # ellipsoid; its farthest point outward
        ends.append(end + (outward @ M) / np.sqrt(np.sum(outward @ M * outward, axis=1))[:, None])
    return np.concatenate(ends)
