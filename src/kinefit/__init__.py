"""kinefit fits one articulated body to whatever the sensors saw.

The public names are loaded when they are first used, so that `import kinefit` and the command line start at once.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "Body": "kinefit.bodies",
    "BodyState": "kinefit.bodies",
    "Camera": "kinefit.geometry.camera",
    "FusionResult": "kinefit.tracking.fusion",
    "FusionSettings": "kinefit.tracking.fusion_settings",
    "FusionTracker": "kinefit.tracking.fusion",
    "ImageFrame": "kinefit.geometry.camera",
    "KinefitError": "kinefit.errors",
    "Keypoints": "kinefit.observations",
    "Markers": "kinefit.observations",
    "Motion": "kinefit.motion",
    "Rig": "kinefit.geometry.camera",
    "calibrate_board": "kinefit.calibration.board",
    "calibrate_people": "kinefit.calibration.people",
    "catalogue": "kinefit.bodies",
    "check_take": "kinefit.calibration.check",
    "fit_markers": "kinefit.tracking.markers",
    "gauss_newton": "kinefit.solvers.least_squares",
    "levenberg_marquardt": "kinefit.solvers.least_squares",
    "load_body": "kinefit.bodies",
    "load_observations": "kinefit.readers.load",
    "read_amc": "kinefit.readers.amc",
    "read_bvh": "kinefit.readers.bvh",
    "read_caliscope_csv": "kinefit.readers.keypoints",
    "read_calibration": "kinefit.readers.calibration",
    "read_clouds": "kinefit.readers.depth",
    "read_depth": "kinefit.readers.depth",
    "read_detections": "kinefit.readers.detections",
    "read_keypoints": "kinefit.readers.keypoints",
    "read_markers": "kinefit.readers.markers",
    "read_motion": "kinefit.readers.motion",
    "read_take": "kinefit.readers.take",
    "refine": "kinefit.calibration.refine",
    "retarget": "kinefit.simulation.retarget",
    "track": "kinefit.tracking.video",
    "track_take": "kinefit.tracking.take",
    "write_calibration_like": "kinefit.readers.calibration_write",
}
__all__ = [*_HOMES, "__version__"]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'kinefit' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
