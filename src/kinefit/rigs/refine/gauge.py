"""The gauge of a calibration, which images do not determine: position, rotation and scale of the world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.solving.bundle.cameras import COLUMNS, POSE, departure

_PLACE_SIGMA = 0.05  # [m] of a camera's centre, that weighs as much as
_TURN_SIGMA = np.radians(1.0)  # of its rotation: at a distance of 3 m


def resized(rig: Rig, factor: float) -> Rig:
    """The rig with all lengths of its world multiplied by a number."""
    cameras = []
    for camera in rig:
        T = np.array(camera.T_camera_world)
        T[:3, 3] *= factor
        cameras.append(camera.with_pose(T))
    return Rig(tuple(cameras))


def generators(rig: Rig) -> NDArray:
    """(C · 16, 7) derivatives of the cameras' parameters by a twist (v, ω) and the scale of the world, images fixed."""
    out = np.zeros((len(rig), COLUMNS, 7))
    for block, camera in zip(out, rig, strict=True):
        block[POSE, :6] = -se3.adjoint(camera.T_camera_world)
        block[:3, 6] = camera.T_camera_world[:3, 3]
    return out.reshape(-1, 7)


def _gauge_weight(cameras: int) -> NDArray:
    weight = np.zeros((cameras, COLUMNS))
    weight[:, :3], weight[:, 3:6] = _PLACE_SIGMA**-2, _TURN_SIGMA**-2
    return weight.ravel()


def aligned(rig: Rig, old: Rig, *, scale: bool = True) -> tuple[Rig, NDArray, float]:
    """Align a rig with an old one by the similarity that moves all cameras nearest to their old poses.

    Least squares over the cameras' centres and rotations, 5 cm counting as 1°. Returns the rig, T_old_new (4, 4), and
    the scale factor (1 if `scale` is False): x_old = T_old_new (factor · x_new).
    """
    T, factor = _by_centres(rig, old)
    factor = factor if scale else 1.0
    weight = _gauge_weight(len(rig))
    for _ in range(20):
        now = resized(rig, factor).moved(T)
        G, away = generators(now)[:, : 7 if scale else 6], departure(old, now).ravel()
        step = np.linalg.lstsq(np.sqrt(weight)[:, None] * G, np.sqrt(weight) * away, rcond=1e-12)[0]
        grow = float(np.exp(step[6])) if scale else 1.0
        T[:3, 3] *= grow
        T, factor = se3.exp(step[:6]) @ T, factor * grow
        if np.abs(step).max() < 1e-12:
            break
    return resized(rig, factor).moved(T), T, factor


def _by_centres(rig: Rig, old: Rig) -> tuple[NDArray, float]:
    """Initial T_old_new (4, 4) and factor: mean rotation, then centres."""
    turns = [b.T_world_camera[:3, :3] @ a.T_camera_world[:3, :3] for a, b in zip(rig, old)]
    R = se3.nearest_rotation(np.sum(turns, axis=0))
    a, b = (np.stack([c.centre_world for c in r]) for r in (rig, old))
    a_in, b_in = (a - a.mean(axis=0)) @ R.T, b - b.mean(axis=0)
    spread = float(np.sum(a_in * a_in))
    factor = float(np.sum(a_in * b_in)) / spread if spread > 0 else 1.0
    factor = factor if factor > 0 else float(np.sqrt(np.sum(b_in * b_in) / max(spread, 1e-12)))
    return se3.transform(R, b.mean(axis=0) - factor * (R @ a.mean(axis=0))), factor


def covariance_in_gauge(rig: Rig, S: NDArray, free: NDArray) -> NDArray:
    """(C · 16, C · 16) covariance of the cameras' parameters in the gauge of `aligned`, from their information S.

    free (C · 16,) bool: estimated parameters; all others have zero. Undetermined directions are large, not infinite.
    """
    G, W = generators(rig), _gauge_weight(len(rig))
    G = G * free[:, None]
    unit = np.where(free, 1.0, 0.0)
    scale = np.sqrt(np.where(np.diag(S) > 0, np.diag(S), 1.0))
    normal = S / np.outer(scale, scale)
    pinned = (scale[:, None] * G) / np.linalg.norm(scale[:, None] * G, axis=0)
    regular = normal + pinned @ pinned.T + 1e-12 * np.eye(len(S)) + np.diag(1.0 - unit)
    C = np.linalg.inv(regular) / np.outer(scale, scale)
    P = np.eye(len(S)) - G @ np.linalg.solve(G.T @ (W[:, None] * G), G.T * W)
    P = P * unit[:, None]
    return P @ C @ P.T
