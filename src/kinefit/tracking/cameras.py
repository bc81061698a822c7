"""Where a fit found the cameras, beside where their calibration has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.sensors.settings import CameraErrors
from kinefit.subject.sensor_parameters import OUTLIER_SIGMAS, CameraExtrinsics, moved_rig
from kinefit.subject.subject import SubjectFit

CAMERAS = "cameras"
"""Key of `Motion.provenance`: {camera: {"moved": (6,), "std": (6,)}} [m, rad] as `CameraExtrinsics` has them."""

LEFT_OUT = "cameras left out"
"""Key of `Motion.provenance`: {depth camera: [m, rad] by which it would have to be moved and turned}."""

_MIN_MOTION = 1e-9  # [m, rad] below which a camera stayed where it was


def as_record(found: Sequence[SubjectFit]) -> dict[str, Any]:
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


def between(rig: Rig, other: Rig) -> dict[str, Any]:
    """How the cameras of a rig that stand elsewhere in another one were moved there, as `as_record` has it."""
    moved = {c.name: se3.log(other[c.name].T_camera_world @ se3.inverse(c.T_camera_world)) for c in rig}
    return {name: {"moved": twist.tolist()} for name, twist in moved.items() if np.any(np.abs(twist) > _MIN_MOTION)}


def composed(first: Mapping[str, Any], then: Mapping[str, Any]) -> dict[str, Any]:
    """What two moves in turn amount to, each as `as_record` has it."""
    out = {**first, **then}
    for name in first.keys() & then.keys():
        T = se3.exp(np.array(then[name]["moved"])) @ se3.exp(np.array(first[name]["moved"]))
        out[name] = {**then[name], "moved": se3.log(T).tolist()}
    return out


def sentences(provenance: Mapping[str, Any], errors: CameraErrors | None) -> list[str]:
    """What is worth saying of cameras that were found far from where their calibration has them.

    Parameters
    ----------
    errors : of the calibration
    """
    out = []
    most = np.inf if errors is None else OUTLIER_SIGMAS * np.repeat([errors.position, errors.direction], 3)
    for name, one in provenance.get(CAMERAS, {}).items():
        moved = np.array(one["moved"])
        if np.any(np.abs(moved) > most):
            shift, turn = 1e3 * np.linalg.norm(moved[:3]), np.degrees(np.linalg.norm(moved[3:]))
            out.append(
                f"camera {name} was found {shift:.0f} mm and {turn:.2f} degrees from its calibration, more than the "
                "calibration's error allows: run kinefit check"
            )
    for name, (shift, turn) in provenance.get(LEFT_OUT, {}).items():
        out.append(
            f"depth camera {name} was excluded: its images fit the person only after a rotation by "
            f"{np.degrees(turn):.0f} degrees and a shift by {1e3 * shift:.0f} mm. Correct its pose in the calibration"
        )
    return out


def as_found(rig: Rig, provenance: Mapping[str, Any]) -> Rig:
    """The cameras of a calibration where a motion's fit found them; as they are where it did not seek them."""
    return moved_rig(rig, {name: one["moved"] for name, one in provenance.get(CAMERAS, {}).items()})
