"""Replay a motion on a slope, moved along it, and film it with a virtual camera (P3 4, fig. 13)."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import UP_AXES, Motion
from kinefit.errors import ExportError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.readers.videos.video import Video
from kinefit.simulation.figures import draw_figure, look_at, places, write_video

_SLOPE_COLOUR = (240, 232, 226)  # BGR
_GRID_COLOUR = (214, 202, 192)  # BGR
_SKY_COLOUR = (225, 190, 150)  # BGR
_GRID_SPACING = 1.0  # [m]
_GRID_LINES = 30  # to either side
_MIN_LINE_DEPTH = 0.3  # [m] in front of a camera


def replayed(
    motion: Motion, *, slope: float = 30.0, heading: float = 0.0, speed: float = 0.0, gain: float = 0.0
) -> Motion:
    """Put a motion on an inclined floor, moving down the fall line by s(t) = v t + a t² / 2.

    Parameters
    ----------
    slope : [deg] of the floor, below 90
    heading : [deg] of the fall line about the vertical axis
    speed, gain : v [m/s] and a [m/s²]

    Raises
    ------
    ObservationError
        A number is not finite; the slope is 90 degrees or more.
    """
    if not np.isfinite([slope, heading, speed, gain]).all() or abs(slope) >= 90.0:
        problem = f"slope is {slope:g} degrees, speed {speed:g} m/s, gain {gain:g} m/s²"
        raise ObservationError(problem, remedy="Give a slope below 90 degrees, and finite numbers.")
    down, T = _ground(motion, slope, heading)
    t = motion.times - motion.times[0]
    carried = np.tile(np.eye(4), (len(motion), 1, 1))
    carried[:, :3, 3] = (speed * t + 0.5 * gain * t**2)[:, None] * down
    return replace(
        motion, Ts_world_root=carried @ T @ motion.Ts_world_root, joint_std=_turned(motion.joint_std, T[:3, :3]),
        residuals={}, plates=(), name=f"{motion.name} replayed",
        provenance={**motion.provenance, "replay": {"slope": slope, "heading": heading, "speed": speed, "gain": gain}},
    )  # fmt: skip


def _ground(motion: Motion, slope: float, heading: float) -> tuple[NDArray, NDArray]:
    """Fall line (3,), and T (4, 4) from a level floor to the inclined one, about the person's first place."""
    up, down, R = _inclined(motion, slope, heading)
    x = places(motion).reshape(len(motion), -1, 3)
    foot = x[0].mean(axis=0)
    foot = foot + (float((x @ up).min()) - foot @ up) * up
    return down, se3.transform(R, foot - R @ foot)


def _inclined(motion: Motion, slope: float, heading: float) -> tuple[NDArray, NDArray, NDArray]:
    """Vertical (3,), fall line (3,), and R (3, 3) that inclines the floor."""
    up = np.array(UP_AXES[motion.up])
    level = se3.exp_so3(np.radians(heading) * up) @ np.roll(up, 1)
    R = se3.exp_so3(np.radians(slope) * np.cross(level, -up))
    return up, R @ level, R


def _turned(std: NDArray, R: NDArray) -> NDArray:
    """(F, S, 3) standard deviations along rotated axes, for independent errors along the old ones."""
    known = np.isfinite(std).all(axis=-1, keepdims=True)
    return np.where(known, np.sqrt(np.square(np.where(known, std, 0.0)) @ np.square(R).T), np.inf)


def film(
    motion: Motion, path: str | os.PathLike[str], *, slope: float = 30.0, heading: float = 0.0, azimuth: float = 100.0,
    size: tuple[int, int] = (960, 720), beside: str | os.PathLike[str] | None = None,
) -> None:  # fmt: skip
    """Write a video (.mp4) of a motion from `replayed` on its slope, with a panning camera.

    Parameters
    ----------
    slope, heading : [deg], see `replayed`
    azimuth : [deg] of the camera about the vertical axis, from the fall line
    size : (width, height) [px] of the scene, even
    beside : video to the left of the scene, whose first image is the motion's first frame, such as an overlay

    Raises
    ------
    ObservationError
        The video beside cannot be read, or is shorter than the motion.
    ExportError
        The suffix is not .mp4; the file cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() != ".mp4":
        raise ExportError("videos are written only as .mp4", file=path, remedy=f"Write to {target.stem}.mp4.")
    lines, (up, _, R) = _lines(motion, slope, heading), _inclined(motion, slope, heading)
    images: Iterator[NDArray] = (
        draw_figure(motion, frame, camera, _backdrop(camera, lines, R @ up))
        for frame, camera in enumerate(_cameras(motion, heading, azimuth, size))
    )
    if beside is not None:
        images, size = _joined(motion, Video(beside, rate=motion.rate), images, size)
    try:
        write_video(target, images, motion.rate, size)
    except OSError as error:
        problem = f"the video cannot be written ({error.strerror or error})"
        raise ExportError(problem, file=path, remedy="Give a writable folder with free space.") from error


def _joined(
    motion: Motion, video: Video, scenes: Iterable[NDArray], size: tuple[int, int]
) -> tuple[Iterator[NDArray], tuple[int, int]]:
    """Images (H, W, 3) BGR of a video and of the scene side by side, and their size (width, height) [px]."""
    shown = [video.frame_at(t) for t in motion.times - motion.times[0]]
    numbers = [k for k in shown if k is not None]
    if len(numbers) < len(shown):
        lasting = motion.times[-1] - motion.times[0]
        problem = f"the video ends at {video.times[-1]:.2f} s, the motion lasts {lasting:.2f} s"
        raise ObservationError(problem, file=video.path, remedy="Give a video of the same time, such as an overlay.")
    width = 2 * round(0.5 * size[1] * video.size[0] / video.size[1])
    scaled = (cv2.resize(video.read(k)[..., ::-1], (width, size[1]), interpolation=cv2.INTER_AREA) for k in numbers)
    return map(np.hstack, zip(scaled, scenes)), (width + size[0], size[1])


def _cameras(motion: Motion, heading: float, azimuth: float, size: tuple[int, int]) -> list[Camera]:
    """The camera of every frame: it stays beside the middle of the path, and pans and zooms with the person."""
    up = np.array(UP_AXES[motion.up])
    x = places(motion).reshape(len(motion), -1, 3).mean(axis=1)
    side = se3.exp_so3(np.radians(heading + azimuth) * up) @ np.roll(up, 1)
    length = float(np.linalg.norm(x[-1] - x[0]))
    eye = x[len(x) // 2] + (4.0 + 0.6 * length) * side + (1.0 + 0.1 * length) * up
    out = []
    for middle in x:
        focal = 0.32 * size[1] * float(np.linalg.norm(middle - eye))
        matrix = np.array([[focal, 0.0, 0.5 * size[0]], [0.0, focal, 0.5 * size[1]], [0.0, 0.0, 1.0]])
        out.append(Camera("replay", size, matrix, np.zeros(0), "radtan", look_at(eye, middle, up)))
    return out


def _lines(motion: Motion, slope: float, heading: float) -> NDArray:
    """(L, 2, 3) [m] lines of a grid on the slope, below the person's path."""
    up, down, R = _inclined(motion, slope, heading)
    across, normal = np.cross(R @ up, down), R @ up
    x = places(motion)
    at = x[: len(x) // len(motion)].mean(axis=0)
    at = at + (float((x @ normal).min()) - at @ normal) * normal
    length = max(float(((x - at) @ down).max()), 0.0)
    steps = np.arange(-_GRID_LINES, _GRID_LINES + 1) * _GRID_SPACING
    along = [(at + s * across - 10.0 * down, at + s * across + (length + 20.0) * down) for s in steps]
    rungs = np.arange(-10.0, length + 20.0, _GRID_SPACING)
    half = _GRID_LINES * across
    return np.array([*along, *((at + r * down - half, at + r * down + half) for r in rungs)])


def _backdrop(camera: Camera, lines: NDArray, normal: NDArray) -> NDArray:
    """Image (H, W, 3) of the slope with its upward normal (3,), its grid and the sky."""
    horizon = np.linalg.inv(camera.matrix).T @ camera.T_camera_world[:3, :3] @ normal  # rays below it meet the slope
    u, v = np.meshgrid(np.arange(camera.size[0]), np.arange(camera.size[1]))
    image = np.full((camera.size[1], camera.size[0], 3), _SLOPE_COLOUR, np.uint8)
    ends = lines @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    for a, b in ends:
        if min(a[2], b[2]) < _MIN_LINE_DEPTH:
            if max(a[2], b[2]) < _MIN_LINE_DEPTH:
                continue
            far, near = (a, b) if a[2] > b[2] else (b, a)
            near = near + (far - near) * (_MIN_LINE_DEPTH - near[2]) / (far[2] - near[2])
            a, b = far, near
        p, q = (camera.matrix @ v for v in (a, b))
        start, end = (np.clip(np.round(v[:2] / v[2]), -20000, 20000).astype(int).tolist() for v in (p, q))
        cv2.line(image, start, end, _GRID_COLOUR, 1, cv2.LINE_AA)
    image[horizon[0] * u + horizon[1] * v + horizon[2] >= 0.0] = _SKY_COLOUR
    return image
