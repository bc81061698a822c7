"""Nominal lenses of depth cameras, by the names of folders and the size of the image."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from kinefit.readers.guess.draft import Value


@dataclass(frozen=True)
class DepthCamera:
    """Focal lengths {(width, height) [px] of the depth image: [px]} of one kind of camera, and words that name it.

    They are nominal, to 1 to 3 %: single cameras differ, and state their own to their maker's programs.
    """

    name: str
    words: str
    focal: dict[tuple[int, int], float]


DEPTH_CAMERAS = (
    DepthCamera("Azure Kinect or Orbbec Femto", r"azure|k4a|femto",
                {(640, 576): 504.0, (320, 288): 252.0, (512, 512): 252.0, (1024, 1024): 504.0}),
    DepthCamera("second Kinect", r"kinect.?(v2|2|one)|k4w", {(512, 424): 365.0}),
    DepthCamera("first Kinect", r"kinect|xtion|primesense", {(640, 480): 577.0, (320, 240): 288.5}),
    DepthCamera("Orbbec Astra", r"astra|orbbec", {(640, 480): 570.0, (320, 240): 285.0}),
    DepthCamera("RealSense D415", r"d415", {(1280, 720): 920.0, (848, 480): 612.0, (640, 480): 612.0}),
    DepthCamera("RealSense SR300", r"sr30\d", {(640, 480): 476.0}),
    DepthCamera("RealSense L515", r"l515", {(1024, 768): 735.0, (640, 480): 460.0}),
    DepthCamera("RealSense D435 or D455", r"realsense|d43\d|d45\d",
                {(1280, 720): 640.0, (848, 480): 425.0, (640, 480): 385.0}),
)  # fmt: skip


def guessed_intrinsics(path: Path, size: tuple[int, int]) -> Value:
    """[fx, fy, cx, cy] [px] of a depth image: by a name in the path and the size, by a size of one kind; else open."""
    fitting = [camera for camera in DEPTH_CAMERAS if size in camera.focal]
    named = [camera for camera in fitting if re.search(camera.words, str(path), re.IGNORECASE)]
    chosen = named or fitting
    each = [f"{camera.focal[size]:g} ({camera.name})" for camera in chosen]
    if not (named or len(chosen) == 1):
        likely = f": fx = fy = {', '.join(each)}" if each else ""
        return Value(None, "open", f"[fx, fy, cx, cy] in pixels of the depth image{likely}")
    focal = chosen[0].focal[size]
    values = [focal, focal, (size[0] - 1) / 2.0, (size[1] - 1) / 2.0]
    why = f"nominal, {each[0]}, by its {'name' if named else 'image size'}; the camera's own are better"
    return Value(values, "likely" if named else "guess", why)
