"""A figure of tapered limbs, drawn as a camera would see it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
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
    for limb in motion.body.surfaces:
        ends = _ends(motion.state(frame), motion, limb.segment, limb.end)
        depth = (ends @ R_camera_world.T + camera.T_camera_world[:3, 3])[:, 2]
        far.append((float(depth.mean()), ends, limb))
    nearest, farthest = min(item[0] for item in far), max(item[0] for item in far)
    circle = np.linspace(0, 2 * np.pi, _RIM, endpoint=False)
    for depth, ends, limb in sorted(far, key=lambda item: -item[0]):
        rims = [
            x + r * (np.outer(np.cos(circle), R_camera_world[0]) + np.outer(np.sin(circle), R_camera_world[1]))
            for x, r in zip(ends, limb.radii)
        ]
        outline = camera.project(np.concatenate(rims))
        if not np.isfinite(outline).all():
            continue
        hull = cv2.convexHull(outline.astype(np.float32))[:, 0]
        corners = np.round(hull * 2**_FINE).astype(np.int32)
        name = motion.body.tree.segments[limb.segment]
        colour = np.array(_COLOURS[name[-2:] if name[-2:] in _COLOURS else ""])
        shade = 1.0 - 0.35 * (depth - nearest) / max(farthest - nearest, 1e-9)
        cv2.fillPoly(image, [corners], (colour * shade).tolist(), cv2.LINE_AA, _FINE)
        cv2.polylines(image, [corners], True, (colour * shade * 0.6).tolist(), 1, cv2.LINE_AA, _FINE)
    return image


def _ends(state: BodyState, motion: Motion, segment: int, end: tuple[float, float, float]) -> NDArray:
    """(2, 3) [m] both ends of a limb's axis in the world."""
    frames, _ = motion.body.tree.forward(state.T_world_root, state.angles)
    points = motion.body.tree.rest[segment] + np.array([np.zeros(3), end])
    return points @ frames[segment, :9].reshape(3, 3).T + frames[segment, 9:]
