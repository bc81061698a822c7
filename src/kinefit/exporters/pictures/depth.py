"""Depth images as pictures with the body's outlines drawn on them: what a person can judge."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from os import PathLike

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.exporters.pictures.drawing import WHITE, draw_line, segment_contours, write_lines
from kinefit.exporters.pictures.overlay import frames_of, write_pictures
from kinefit.geometry.camera import Camera
from kinefit.motion import Motion
from kinefit.observations import DepthVideo
from kinefit.rendering import render_body, scaled
from kinefit.rendering.colours import LOST_COLOUR

_COLOUR_RANGE_M = 0.6  # [m] in front of and behind the body that the colours are spread over
_DASH_PX = 6.0  # of a lost segment's outline
_WIDTH = 640  # [px] of a picture, at least: small sensors are enlarged


def depth_picture(
    depth: NDArray, motion: Motion, frame: int | None, camera: Camera, *, label: str = ""
) -> NDArray[np.uint8]:
    """One depth image, near red and far blue, with the outlines of all segments; holes are black.

    Outlines of lost segments are dashed and grey.

    Parameters
    ----------
    depth : (H, W) [m], 0 where nothing was measured
    frame : int or None, of the motion
    camera : Camera of the depth images

    Returns
    -------
    (H, W, 3) uint8 RGB, enlarged by a whole factor to 640 pixels of width where the image is smaller
    """
    depth = np.asarray(depth, np.float32)
    times = max(-(-_WIDTH // depth.shape[1]), 1)
    large = scaled(camera, float(times))
    middle = float(np.median(depth[depth > 0])) if (depth > 0).any() else 2.0
    raster = None
    if frame is not None:
        raster = render_body(motion.body, motion.state(frame), large)
        middle = float(np.median(raster.depth[raster.seen])) if raster.seen.any() else middle
    shade = np.clip((middle + _COLOUR_RANGE_M - depth) / (2.0 * _COLOUR_RANGE_M), 0.0, 1.0)
    picture = cv2.applyColorMap((255 * shade).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    picture = np.where((depth > 0)[..., None], picture, 0).astype(np.uint8)
    out = np.ascontiguousarray(np.repeat(np.repeat(picture, times, axis=0), times, axis=1))
    if raster is not None and frame is not None:
        part, lost = raster.segment, np.append(motion.lost[frame], False)  # -1, the background, is not lost
        for a, b, there in ((part[1:], part[:-1], out[1:]), (part[:, 1:], part[:, :-1], out[:, 1:])):
            there[(a != b) & ~lost[a] & ~lost[b]] = WHITE
        for s in np.flatnonzero(lost).tolist():
            for rim in segment_contours(part, s):
                draw_line(out, rim, LOST_COLOUR, 1, _DASH_PX)
    if label:
        write_lines(out, [(label, WHITE)])
    return out


def write_depth_overlay(
    motion: Motion, camera: Camera, depth: DepthVideo, path: str | PathLike[str], *,
    progress: Callable[[int], None] | None = None,
) -> None:  # fmt: skip
    """Write a video of the depth images of a motion with the fitted body's outlines.

    Raises
    ------
    ExportError
        The file cannot be written.
    """
    height, width = (n - n % 2 for n in depth_picture(depth.frame(0).depth, motion, None, camera).shape[:2])

    def drawn() -> Iterator[NDArray[np.uint8]]:
        for i in frames_of(motion, depth.times):
            at = motion.frame_at(float(depth.times[i]))
            label = f"{camera.name}   frame {i}" + ("" if at is not None else "   no motion here")
            yield depth_picture(depth.frame(i).depth, motion, at, camera, label=label)[:height, :width]

    write_pictures(drawn(), path, depth.rate, (width, height), progress)
