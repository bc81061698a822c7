"""Simulate 2D keypoints of a known motion, with the errors of a detector."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import Keypoints
from kinefit.observations.recordings import mirror_name
from kinefit.readers.landmarks.keypoint_sets import keypoint_names
from kinefit.simulation.figures import look_at, sees

_DISTORTION = np.array([-0.06, 0.03, 0.0004, -0.0003])
_MIN_DISTANCE, _MAX_DISTANCE = 3.0, 60.0  # [m]
_MEAN_SWAP_FRAMES = 8  # length of a left-right swap
_DEFAULT_VOLUME = np.array([[-0.8, 0.0, -0.8], [0.8, 2.0, 0.8]])  # [m], y up


def studio_rig(
    motion: Motion | None = None,
    *,
    cameras: int = 4,
    up: str | None = None,
    size: tuple[int, int] = (1088, 1920),
    focal: float | None = None,
) -> Rig:
    """Rig of cameras around a motion, each at the shortest distance from which all of it is in view.

    Parameters
    ----------
    motion : Motion, optional
        Default: a volume of 1.6 x 1.6 m and 2 m height at the origin.
    cameras : int
        One or more; at heights of tripods, around the motion, no two opposite each other.
    up : str, optional
        Vertical axis of the world; default: the motion's, or "y".
    size : (width, height) [px]
    focal : float [px], optional
        Default: 1675 px for images 1920 px high, in proportion for others.

    Returns
    -------
    Rig
        Cameras cam01, cam02, ... with a mild lens distortion.

    Raises
    ------
    ObservationError
        `cameras` is below 1; a camera sees all of the motion from no place within 60 m.
    """
    if cameras < 1:
        raise ObservationError(f"cameras is {cameras}", remedy="Give one or more.")
    up = up or (motion.up if motion is not None else "y")
    R_world = rotation_between_up("y", up)  # built y up, then turned
    if motion is None:
        corners = np.array(np.meshgrid(*_DEFAULT_VOLUME.T)).reshape(3, -1).T
    else:
        corners = motion.positions().reshape(-1, 3) @ rotation_between_up(motion.up, "y").T
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre = np.array([0.5 * (low + high)[0], min(low[1] + 0.9, 0.5 * (low + high)[1]), 0.5 * (low + high)[2]])
    focal = focal or 1675.0 * size[1] / 1920.0
    matrix = np.array([[focal, 0, 0.5 * (size[0] - 1)], [0, focal, 0.5 * (size[1] - 1)], [0, 0, 1]])
    placed = []
    for k in range(cameras):
        azimuth = 2 * np.pi * (k + 0.5) / cameras + (0.22 if k % 2 else -0.12)
        height = low[1] + (1.3, 1.9, 1.5, 2.2)[k % 4]
        for distance in np.arange(_MIN_DISTANCE, _MAX_DISTANCE, 0.1):
            place = centre + distance * np.array([np.cos(azimuth), 0.0, np.sin(azimuth)])
            place[1] = height
            T_camera_world = look_at(place, centre, np.array([0.0, 1.0, 0.0]))
            camera = Camera(f"cam{k + 1:02d}", size, matrix, _DISTORTION, "radtan", T_camera_world)
            if sees(camera, corners, -np.inf, np.inf):
                break
        else:
            extent = " x ".join(f"{size:.1f}" for size in high - low)
            raise ObservationError(
                f"no place within {_MAX_DISTANCE:.0f} m from which camera {k + 1} sees all of the motion ({extent} m)",
                remedy="Give a shorter focal length, or a part of the motion.",
            )
        placed.append(camera.with_pose(camera.T_camera_world @ se3.transform(R_world.T, np.zeros(3))))
    return Rig(tuple(placed))


@checked
def simulate_keypoints(
    motion: Motion,
    rig: Rig,
    keypoint_set: str = "BODY_25B",
    *,
    noise_px: float = 3.0,
    outliers: float = 0.1,
    missing: float = 0.1,
    swaps: float = 0.0,
    drift_px: float = 0.0,
    drift_time: float = 0.5,
    bystander: Motion | None = None,
    seed: int = 0,
) -> list[Keypoints]:
    """Simulate a detector's keypoints of a motion in every camera of a rig.

    Parameters
    ----------
    motion : Motion
        In the rig's world.
    keypoint_set : str
        Points that the body lacks are never detected.
    noise_px : float [px]
        Standard deviation of the jitter along u and v.
    outliers : share of the detected points
        One half is anywhere in the person's box, the other 20 to 200 px off.
    missing : share of the points
        NaN with confidence 0, like points outside the image.
    swaps : share of each camera's frames
        Left and right of the whole person are swapped, for about eight frames each time.
    drift_px : float [px]
        Standard deviation of the drift along u and v, an error correlated in time.
    drift_time : float [s]
        Time constant of the drift.
    bystander : Motion, optional
        A second person, in as many frames as its motion has, with the same errors.
    seed : int
        The same seed gives the same keypoints.

    Returns
    -------
    list of Keypoints, one for each camera
        Confidences of outliers are lower on average only.

    Raises
    ------
    ObservationError
        A share is not in 0..1; a standard deviation is negative; `drift_time` is not positive; the keypoint set is
        unknown.
    """
    for name, share in (("outliers", outliers), ("missing", missing), ("swaps", swaps)):
        if not 0.0 <= share <= 1.0:
            raise ObservationError(f"{name} is {share}", remedy="Give a share between 0 and 1.")
    for name, size in (("noise_px", noise_px), ("drift_px", drift_px)):
        if not 0.0 <= size < np.inf:
            raise ObservationError(f"{name} is {size}", remedy="Give a standard deviation in pixels, 0 or more.")
    if not 0.0 < drift_time < np.inf:
        raise ObservationError(f"drift_time is {drift_time}", remedy="Give a time in seconds, above 0.")
    keep = float(np.exp(-1.0 / (motion.rate * drift_time)))
    names = keypoint_names(keypoint_set)
    random = np.random.default_rng(seed)
    people = [motion] if bystander is None else [motion, bystander]
    out = []
    for camera in rig:
        points = np.full((len(motion), len(people), len(names), 2), np.nan)
        confidence = np.zeros(points.shape[:3])
        for p, person in enumerate(people):
            frames = min(len(motion), len(person))
            uv = _project(person, camera, keypoint_set, names)[:frames]
            if drift_px:
                uv = uv + drift_px * drift(uv.shape, keep, random)
            found = _detect(uv, camera, names, random, noise_px, outliers, missing, swaps)
            points[:frames, p], confidence[:frames, p] = found
        if len(people) > 1:  # a detector's order of people is arbitrary
            order = random.permuted(np.tile(np.arange(len(people)), (len(motion), 1)), axis=1)
            points = np.take_along_axis(points, order[:, :, None, None], axis=1)
            confidence = np.take_along_axis(confidence, order[:, :, None], axis=1)
        out.append(Keypoints(camera.name, keypoint_set, names, motion.rate, points, confidence, source="simulation"))
    return out


def _project(motion: Motion, camera: Camera, keypoint_set: str, names: tuple[str, ...]) -> NDArray:
    """(F, K, 2) [px] projections, NaN for points that the body lacks and points outside the image."""
    points = motion.body.keypoints(keypoint_set)
    columns = [names.index(name) for name in points.names]
    uv = np.full((len(motion), len(names), 2), np.nan)
    uv[:, columns] = camera.project(motion.positions(points))
    inside = np.all((uv >= -0.5) & (uv < np.array(camera.size) - 0.5), axis=-1)
    uv[~inside] = np.nan
    return uv


def drift(shape: tuple[int, ...], keep: float, random: np.random.Generator) -> NDArray:
    """Random values (F, ...) of unit variance, correlated by `keep` (a number in 0..1) from frame to frame.

    Parameters
    ----------
    shape : (F, K, 2) or any other
    """
    out = random.standard_normal(shape)
    for f in range(1, len(out)):
        out[f] = keep * out[f - 1] + np.sqrt(1.0 - keep**2) * out[f]
    return out


def _detect(
    uv: NDArray, camera: Camera, names: tuple[str, ...], random: np.random.Generator,
    noise_px: float, outliers: float, missing: float, swaps: float,
) -> tuple[NDArray, NDArray]:
    """Points (F, K, 2) [px] with a detector's errors, and confidences (F, K)."""
    frames, count = uv.shape[:2]
    found = uv + noise_px * random.standard_normal(uv.shape)
    wrong = random.random((frames, count)) < outliers
    box = np.ma.masked_invalid(uv)
    low, high = box.min(axis=1, keepdims=True).filled(0.0), box.max(axis=1, keepdims=True).filled(0.0)
    anywhere = low + random.random(uv.shape) * (high - low)
    angle, reach = random.uniform(0, 2 * np.pi, (frames, count)), random.uniform(20.0, 200.0, (frames, count))
    jump = uv + reach[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    stray = np.where(random.random((frames, count, 1)) < 0.5, anywhere, jump)
    found = np.where(wrong[..., None], np.clip(stray, 0.0, np.array(camera.size) - 1.0), found)
    confidence = np.where(wrong, random.beta(4, 3, (frames, count)), random.beta(8, 2, (frames, count)))
    lost = (random.random((frames, count)) < missing) | np.isnan(uv).any(axis=-1)
    found[lost], confidence[lost] = np.nan, 0.0
    swapped = _bursts(frames, swaps, random)
    mirror = [names.index(other if (other := mirror_name(name)) in names else name) for name in names]
    found[swapped], confidence[swapped] = found[swapped][:, mirror], confidence[swapped][:, mirror]
    return found, confidence


def _bursts(frames: int, share: float, random: np.random.Generator) -> NDArray:
    """(F,) bool: random bursts of frames that make up a share of all frames."""
    out = np.zeros(frames, bool)
    while out.sum() < round(share * frames):
        start, length = random.integers(frames), 1 + random.poisson(_MEAN_SWAP_FRAMES - 1)
        out[start : min(start + length, start + round(share * frames) - int(out.sum()))] = True
    return out
