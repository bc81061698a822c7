"""Columns of a motion's tables, each (F,), by names that tell their units: angles, joint centres, places."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3

if TYPE_CHECKING:
    from kinefit.motion import Motion

Columns = dict[str, NDArray]


def angle_columns(motion: Motion, factor: float = 1.0, unit: str = "m") -> Columns:
    """Every coordinate [deg] (sliding ones: length) with its standard deviation, and the root: place, unit quaternion.

    Parameters
    ----------
    factor, unit : of lengths, units in a metre and their name.
    """
    body = motion.body
    units = [unit] * 3 + ["deg"] * 3 + [unit if slides else "deg" for slides in body.tree.prismatic]
    factors = np.array([np.degrees(1.0) if u == "deg" else factor for u in units])
    stds, angles = motion.dof_std * factors, motion.angles * factors[6:]
    quaternions = continuous_quaternions(motion.Ts_world_root[:, :3, :3])
    out = {f"root_t{axis} [{unit}]": factor * motion.Ts_world_root[:, i, 3] for i, axis in enumerate("xyz")}
    out |= {f"root_q{part}": quaternions[:, i] for i, part in enumerate("wxyz")}
    out |= {f"{name} [{unit}]": angles[:, d] for d, (name, unit) in enumerate(zip(body.tree.coordinates, units[6:]))}
    return out | {f"{name} std [{unit}]": stds[:, d] for d, (name, unit) in enumerate(zip(body.dof_names, units))}


def joint_columns(
    motion: Motion, names: Sequence[str] | None = None, factor: float = 1.0, unit: str = "m"
) -> Columns:
    """Joint centres and their standard deviations along the world's axes; `names` default to the body's joints."""
    names = names or motion.body.joints
    centres = place_columns(names, factor * motion.joint_centres, unit)
    return centres | place_columns(names, factor * motion.joint_std, unit, " std")


def place_columns(names: Sequence[str], positions: NDArray, unit: str, suffix: str = "") -> Columns:
    """Places (F, K, 3) of K names."""
    axes = list(enumerate("xyz"))
    return {f"{n} {axis}{suffix} [{unit}]": positions[:, k, i] for k, n in enumerate(names) for i, axis in axes}


def continuous_quaternions(rotations: NDArray, before: NDArray | None = None) -> NDArray:
    """Quaternions (F, ..., 4) as (w, x, y, z) of rotations (F, ..., 3, 3).

    Of the two signs the nearer to the frame before is taken; `before` (..., 4) is that of the frame before the first.
    """
    q = se3.quaternion(rotations)
    last = q[:1] if before is None else before[None]
    flips = np.sum(q * np.concatenate([last, q])[:-1], axis=-1) < 0
    q *= np.where(np.cumsum(flips, axis=0) % 2, -1.0, 1.0)[..., None]
    return q
