"""A figure of tapered limbs, drawn as a camera would see it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import MeshSurface
from kinefit.bodies.surfaces import Surface
from kinefit.geometry.camera import Camera
from kinefit.motion import Motion

_GREY = (128, 128, 128)
_COLOURS = {"_l": (196, 120, 60), "_r": (60, 110, 200), "": (150, 175, 110)}  # BGR: left, right, middle
_RIM = 32  # corners of a round end
_FINE = 4  # binary digits after the point of a pixel


def draw_figure(motion: Motion, frame: int, camera: Camera, image: NDArray | None = None) -> NDArray:
    """Picture (H, W, 3) of the body's surfaces, BGR 8 bit: the far ones first, the near ones over them.

    Parameters
    ----------
    frame : int
    camera : Camera in the motion's world.
    image : (H, W, 3), optional
        Drawn upon, of the camera's size; default: plain grey.
    """
    image = np.full((camera.size[1], camera.size[0], 3), _GREY, np.uint8) if image is None else image.copy()
    R_camera_world, far = camera.T_camera_world[:3, :3], []
    frames, _ = motion.body.tree.forward(motion.state(frame).T_world_root, motion.state(frame).angles)
    for limb in motion.body.surfaces:
        R, t = frames[limb.segment, :9].reshape(3, 3), frames[limb.segment, 9:]
        x = _rim(limb, R_camera_world @ R) @ R.T + R @ motion.body.tree.rest[limb.segment] + t
        far.append((float((x @ R_camera_world[2]).mean() + camera.T_camera_world[2, 3]), x, limb.segment))
    nearest, farthest = min(item[0] for item in far), max(item[0] for item in far)
    for depth, x, segment in sorted(far, key=lambda item: -item[0]):
        outline = camera.project(x)
        if not np.isfinite(outline).all():
            continue
        hull = cv2.convexHull(outline.astype(np.float32))[:, 0]
        corners = np.round(hull * 2**_FINE).astype(np.int32)
        name = motion.body.tree.segments[segment]
        colour = np.array(_COLOURS[name[-2:] if name[-2:] in _COLOURS else ""])
        shade = 1.0 - 0.35 * (depth - nearest) / max(farthest - nearest, 1e-9)
        cv2.fillPoly(image, [corners], (colour * shade).tolist(), cv2.LINE_AA, _FINE)
        cv2.polylines(image, [corners], True, (colour * shade * 0.6).tolist(), 1, cv2.LINE_AA, _FINE)
    return image


def _rim(limb: Surface, R_camera_segment: NDArray) -> NDArray:
    """(K, 3) [m] points in the segment's frame about which the limb's outline runs: of its two rounded ends."""
    if isinstance(limb, MeshSurface):
        return limb.vertices
    angle = np.linspace(0, 2 * np.pi, _RIM, endpoint=False)
    outward = np.outer(np.cos(angle), R_camera_segment[0]) + np.outer(np.sin(angle), R_camera_segment[1])
    rims = []
    for end, (a, b) in zip((limb.start, limb.end), limb.radii):
        M = limb.axes.T @ np.diag([a, b, np.sqrt(a * b)]) ** 2 @ limb.axes  # ellipsoid; its farthest point outward
        rims.append(end + (outward @ M) / np.sqrt(np.sum(outward @ M * outward, axis=1))[:, None])
    return np.concatenate(rims)
