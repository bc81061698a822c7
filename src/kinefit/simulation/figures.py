"""Figures and where they stand: sensors placed before a motion, and drawn bodies."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, MeshSurface
from kinefit.bodies.motion import UP_AXES, Motion
from kinefit.bodies.rendering.looks import side_colour
from kinefit.bodies.surfaces import Surface
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry.camera import Camera
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
