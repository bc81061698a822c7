"""kinefit fits one articulated body to whatever the sensors saw.

The public names are loaded when they are first used, so that `import kinefit` and the command line start at once.
"""

from importlib import import_module
from typing import Any

__version__ = "0.2.0"

_HOMES = {
    "Body": "kinefit.bodies",
    "BodyState": "kinefit.bodies",
    "Camera": "kinefit.geometry.camera",
    "FixedLag": "kinefit.smoothing.online.fixed_lag",
    "FrameResult": "kinefit.frame.results",
    "ImageFrame": "kinefit.geometry.camera",
    "Keypoints": "kinefit.observations",
    "KinefitError": "kinefit.errors",
    "KnownNoise": "kinefit.smoothing.online.known_noise",
    "Markers": "kinefit.observations",
    "Motion": "kinefit.motion",
    "Recording": "kinefit.tracking.recording",
    "Rig": "kinefit.geometry.camera",
    "TrackSettings": "kinefit.sensors.settings",
    "Tracker": "kinefit.tracking.tracker",
    "audit_take": "kinefit.identification.audit.audit",
    "calibrate_board": "kinefit.calibration.board.calibrate",
    "calibrate_people": "kinefit.calibration.people.calibrate",
    "catalogue": "kinefit.bodies",
    "check_take": "kinefit.calibration.check.check",
    "fit_marker_subject": "kinefit.markers.subject",
    "fit_markers": "kinefit.markers.fit",
    "functional_axis": "kinefit.solvers.functional_joints",
    "functional_centre": "kinefit.solvers.functional_joints",
    "gauss_newton": "kinefit.solvers.least_squares",
    "identify": "kinefit.identification.frame.identify",
    "identify_people": "kinefit.identification.take.people",
    "identify_take": "kinefit.identification.take.takes",
    "learn_model": "kinefit.identification.model.learn",
    "levenberg_marquardt": "kinefit.solvers.least_squares",
    "load_body": "kinefit.bodies",
    "load_observations": "kinefit.readers.take.load",
    "model_from_frame": "kinefit.identification.model.from_frame",
    "read_amc": "kinefit.readers.skeletons.amc",
    "read_bvh": "kinefit.readers.skeletons.bvh",
    "read_calibration": "kinefit.readers.calibration.read",
    "read_caliscope_csv": "kinefit.readers.keypoints",
    "read_clouds": "kinefit.readers.depth.recordings",
    "read_depth": "kinefit.readers.depth.recordings",
    "read_detections": "kinefit.readers.detections",
    "read_keypoints": "kinefit.readers.keypoints",
    "read_markers": "kinefit.readers.markers",
    "read_motion": "kinefit.readers.motion",
    "read_take": "kinefit.readers.take.file",
    "refine": "kinefit.calibration.refine.refine",
    "retarget": "kinefit.simulation.retarget",
    "split_people": "kinefit.markers.people",
    "track": "kinefit.tracking.video",
    "track_take": "kinefit.tracking.takes.take",
    "track_takes": "kinefit.batch.many",
    "training_gate": "kinefit.identification.model.gate",
    "write_calibration_like": "kinefit.readers.calibration.write",
}
__all__ = [*_HOMES, "__version__"]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'kinefit' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
