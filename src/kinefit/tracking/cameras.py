"""Where a fit found the cameras, beside where their calibration has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinefit.geometry.camera import Rig
from kinefit.subject.sensor_parameters import CameraExtrinsics, moved_rig
from kinefit.subject.subject import SubjectFit

CAMERAS = "cameras"
"""Key of `Motion.provenance`: {camera: {"moved": (6,), "std": (6,)}} [m, rad] as `CameraExtrinsics` has them."""

_FAR = 3.0  # standard deviations of its calibration: one of 24 numbers is so far off in 6 % of takes


def as_told(found: Sequence[SubjectFit]) -> dict[str, Any]:
    """How far the last of several fits that sought cameras moved them, for `Motion.provenance`."""
    for fit in reversed(found):
        first = 0
        for one in fit.parameters:
            own, first = slice(first, first + len(one.names)), first + len(one.names)
            if isinstance(one, CameraExtrinsics):
                values, std = fit.mean[own].reshape(-1, 6), fit.std[own].reshape(-1, 6)
                return {
                    name: {"moved": value.tolist(), "std": s.round(6).tolist()}
                    for name, value, s in zip(one.free, values, std)
                }
    return {}


def sentences(provenance: Mapping[str, Any], std: tuple[float, float] | None) -> list[str]:
    """What is worth saying of cameras that were found far from where their calibration has them.

    Parameters
    ----------
    std : (2,) [m, rad] of the calibration
    """
    out = []
    for name, one in provenance.get(CAMERAS, {}).items() if std is not None else ():
        moved = np.array(one["moved"])
        if np.any(np.abs(moved) > _FAR * np.repeat(std, 3)):  # type: ignore[arg-type]
            shift, turn = 1e3 * np.linalg.norm(moved[:3]), np.degrees(np.linalg.norm(moved[3:]))
            out.append(
                f"camera {name} was found {shift:.0f} mm and {turn:.2f} degrees from its calibration, more than it may "
                "be off by: `kinefit check` looks closer"
            )
    return out


def as_found(rig: Rig, provenance: Mapping[str, Any]) -> Rig:
    """The cameras of a calibration where a motion's fit found them; as they are where it did not seek them."""
    return moved_rig(rig, {name: one["moved"] for name, one in provenance.get(CAMERAS, {}).items()})
