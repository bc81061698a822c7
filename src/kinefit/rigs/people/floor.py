"""Which way is up and where the floor is, from a person who stands and walks on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import rotation_between_up
from kinefit.fitting.smoothing.foot_contacts import fit_plane, upward
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig

_MAX_FOOT_HEIGHT_M = 0.12  # [m] points this little above the soles are the foot's
_FLAT = 0.02  # [m] how well a foot on the floor tells its height
_STEPS = 20.0  # looks at the floor that are news, over a take
_MAX_SUPPORT_DIFFERENCE_M = 0.03  # [m] the lower foot bears more than one this much higher
_STANCE_PERCENT = 20  # per cent of frames in which the lower foot surely stands


def settled(
    rig: Rig, x_world: NDArray, rest_height: NDArray, *, balance: NDArray | None = None, up: str = "z"
) -> Rig:
    """The rig in a world that stands on the floor: origin below the person's mean place, height zero on the floor.

    Up is the mean direction from the standing foot to the centre of mass: who does not fall keeps one above the other.
    Then the floor under the feet corrects it where they walked about. For z up, x points to the first camera.

    Parameters
    ----------
    x_world : (F, K, 3) [m] points of the person, NaN where unknown.
    rest_height : (K,) [m] height of each point above the soles when standing.
    balance : (F, 3) [m] centre of mass; default: unknown, and up is how the whole body stands.
    up : str, vertical axis of the result.
    """
    R = _upright(upward(x_world, rest_height))
    for _ in range(3 if balance is not None else 0):
        R = _upright(R.T @ np.nanmean(balance @ R.T - _stand(x_world @ R.T, rest_height), axis=0))
    for _ in range(3):
        low, height = _soles(x_world @ R.T, rest_height)
        if len(low) >= 3:
            fit, _ = fit_plane(low, height, np.full(len(low), _STEPS / len(low) / _FLAT**2))
            R = _upright(R.T @ np.append(-fit[:2], 1.0))
    x = x_world @ R.T
    _, height = _soles(x, rest_height)
    ground = float(np.percentile(height, _STANCE_PERCENT)) if len(height) else float(np.nanmin(x[..., 2]))
    middle = np.nanmedian(x.reshape(-1, 3), axis=0)
    towards = R @ rig.cameras[0].centre_world - middle
    turn = se3.exp_so3(np.array([0.0, 0.0, -np.arctan2(towards[1], towards[0])]))
    T = se3.transform(turn @ R, turn @ -np.array([middle[0], middle[1], ground]))
    return rig.moved(se3.transform(rotation_between_up("z", up), np.zeros(3)) @ T)


def _upright(up: NDArray) -> NDArray:
    """(3, 3) smallest rotation that takes a direction to z."""
    return se3.shortest_turn(up, np.array([0.0, 0.0, 1.0]))


def _stand(x: NDArray, rest_height: NDArray) -> NDArray:
    """(F, 3) where the person stands: the feet's points, the lower ones more; NaN where none is known."""
    feet = np.flatnonzero(rest_height < _MAX_FOOT_HEIGHT_M)
    height = x[:, feet, 2] - rest_height[feet]
    low = np.min(np.where(np.isfinite(height), height, np.inf), axis=1, keepdims=True, initial=np.inf)
    above = np.where(np.isfinite(height), height - low, 0.0)
    weight = np.where(np.isfinite(height), np.exp(-above / _MAX_SUPPORT_DIFFERENCE_M), 0.0)
    total = weight.sum(axis=1, keepdims=True)
    mean = np.einsum("fk,fkd->fd", weight, np.nan_to_num(x[:, feet])) / np.where(total > 0, total, 1.0)
    return np.where(total > 0, mean, np.nan)


def _soles(x: NDArray, rest_height: NDArray) -> tuple[NDArray, NDArray]:
    """Horizontal place (M, 2) and height (M,) of the lower foot's sole in every frame in which it hardly moves."""
    feet = np.flatnonzero(rest_height < _MAX_FOOT_HEIGHT_M)
    at = x[:, feet] - np.array([0.0, 0.0, 1.0]) * rest_height[feet, None]
    known = np.isfinite(at).all(axis=(1, 2)) if len(feet) else np.zeros(len(x), bool)
    at = at[known]
    if len(at) < 2:
        return np.zeros((0, 2)), np.zeros(0)
    lowest = np.argmin(at[..., 2], axis=1)
    point = at[np.arange(len(at)), lowest]
    move = np.linalg.norm(np.gradient(at, axis=0), axis=-1)[np.arange(len(at)), lowest]
    still = move <= np.median(move)
    return point[still, :2], point[still, 2]
