"""Figures and where they stand: sensors placed before a motion, and drawn bodies.

Replay a motion on a slope, moved along it, and film it with a virtual camera (P3 4, fig. 13).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, MeshSurface
from kinefit.bodies.motion import UP_AXES, Motion, turned_std
from kinefit.bodies.rendering.looks import side_colour
from kinefit.bodies.surfaces import Surface
from kinefit.errors import BodyError, ExportError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.readers.videos.video import Video
from kinefit.simulation.retarget import known_motion
from kinefit.solving.mobility import closed_poses

_MARGIN_SHARE = 0.04  # of the image, free around the landmarks
_MIN_DISTANCE = 1.0  # [m]
_MAX_DISTANCE = 20.0  # [m]
_SURFACE_MARGIN = 0.1  # [m] between landmarks and the body's surface


@checked
def in_front(
    motion: Motion, camera: Camera, *, distance: float | None = None, azimuth: float = 0.0, height: float = 1.2,
    near: float = 0.0, far: float = np.inf,
) -> Camera:
    """The camera placed in front of a person, looking at the middle of the motion.

    Parameters
    ----------
    motion : Motion
    camera : Camera
        Its intrinsics are kept, its pose is replaced.
    distance : float [m], optional
        From the middle of the motion, along the floor; default: the shortest from which all landmarks are in the image
        and within the range.
    azimuth : float [rad]
        Counter-clockwise seen from above, from the person's forward direction (mean of the root's x axis).
    height : float [m] above the lowest landmark
    near, far : float [m]
        Range of the sensor.

    Raises
    ------
    ObservationError
        There is no distance from which all of the motion is in view and within the range.
    """
    up = np.array(UP_AXES[motion.up])
    points = places(motion)
    along = points @ up
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    forward = motion.Ts_world_root[:, :3, 0].mean(axis=0)
    forward -= (forward @ up) * up
    if np.linalg.norm(forward) < 0.1:  # all directions occur, or the x axis is vertical
        forward = np.roll(up, 1)
    forward /= np.linalg.norm(forward)
    ahead = np.cos(azimuth) * forward + np.sin(azimuth) * np.cross(up, forward)
    eye = middle + (along.min() + height - middle @ up) * up
    for trial in (distance,) if distance is not None else np.arange(_MIN_DISTANCE, _MAX_DISTANCE, 0.05):
        placed = camera.with_pose(look_at(eye + trial * ahead, middle, up))
        if distance is not None or sees(placed, points, near, far):
            return placed
    depth = float(np.ptp(points @ ahead))
    raise ObservationError(
        f"no place of {camera.name} has the whole motion ({depth:.1f} m deep) in view from {near:g} to {far:g} m",
        remedy="Choose frames in which the person moves less, or give a distance.",
    )


def places(motion: Motion) -> NDArray:
    """(N, 3) [m] all landmarks in all frames, in the world; joint centres for a body without landmarks."""
    if len(motion.body.landmarks):
        return motion.positions().reshape(-1, 3)
    return motion.segment_poses()[..., :3, 3].reshape(-1, 3)


def look_at(eye: NDArray, target: NDArray, up: NDArray) -> NDArray:
    """T_camera_world (4, 4) of a camera at `eye` (3,) [m] that looks at `target` (3,) [m], with `up` (3,) upwards."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    T[:3, 3] = -T[:3, :3] @ eye
    return T


def shifted_camera(camera: Camera, name: str, baseline: float) -> Camera:
    """The same camera, `baseline` [m] to its right: the second of a stereo head."""
    T = np.eye(4)
    T[0, 3] = -baseline
    return Camera(name, camera.size, camera.matrix, camera.distortion, camera.model, T @ camera.T_camera_world)


def sees(camera: Camera, x_world: NDArray, near: float, far: float) -> bool:
    """Whether a camera sees all points (N, 3) [m] between two depths [m], with a margin."""
    uv = camera.project(x_world) / camera.size
    z = x_world @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    inside = np.all((uv > _MARGIN_SHARE) & (uv < 1 - _MARGIN_SHARE), axis=1)  # False for NaN
    return bool(inside.all() and z.min() > near + _SURFACE_MARGIN and z.max() < far)


_GREY = (128, 128, 128)
_END_CORNERS = 32  # of the polygon of a round end
_SUBPIXEL_BITS = 4  # of corners in drawing functions


@checked
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
    state = closed_poses(body, most=1)[0] if body.closures else body.default_state()
    motion = known_motion(body, 1.0, state.T_world_root[None], state.angles[None])
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


def write_video(
    path: Path, images: Iterable[NDArray], rate: float, size: tuple[int, int], *, lossless: bool = False
) -> None:
    """Write images (H, W, 3) BGR, or (H, W) grey without loss, of a size (width, height) [px] as a video."""
    lossy = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1" if lossless else lossy, rate=Fraction(rate).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = *size, "gray" if lossless else "yuv420p"
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format="gray" if lossless else "bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


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
        motion, Ts_world_root=carried @ T @ motion.Ts_world_root, joint_std=turned_std(motion.joint_std, T[:3, :3]),
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
