"""NWB (Neurodata Without Borders) with ndx-pose: joint centres with confidence, for neuroscience."""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Mapping
from os import PathLike
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from numpy.typing import NDArray

from kinefit._files import writing
from kinefit.errors import ExportError, extra
from kinefit.exporters.skeletons.common import bone_names, convention, plain_names, turned
from kinefit.motion import Motion

CONFIDENCE_RADIUS_M = 0.02
"""[m] within which `confidence` has the true joint centre."""


def write_nwb(motion: Motion, path: str | PathLike[str], *, up: str | None = None, names: str = "kinefit") -> None:
    """Write joint centres as NWB: a PoseEstimation of ndx-pose in the processing module "behavior".

    Every joint has a PoseEstimationSeries in metres, whose confidence is the probability that the true centre lies
    within 2 cm, by the error bars (`joint_std`, taken as equal in all directions); 0 where nothing observed it.
    The module holds TimeSeries of all joint coordinates (`angles`, radians, metres where they slide) and of the
    standard deviations (`joint_std`, `angles_std`), too. The session starts on the date that the take states, else on
    1970-01-01, and the file says so.

    Parameters
    ----------
    motion : Motion
    path : path
    up : str, optional
        Vertical axis of the file's world. Default: the motion's own.
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim" or "bvh"
        Names of the joints; ":" becomes "_": mixamorig_Hips.

    Raises
    ------
    ExportError
        The extra "nwb" is not installed, no frame, unknown axis or names, or the file cannot be written.
    """
    needed = "NWB needs the packages pynwb and ndx-pose"
    with extra("nwb", needed, ExportError, file=path), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import ndx_pose
        import pynwb
    if not len(motion):
        raise ExportError("a motion without frames has nothing to write", file=path, remedy="Track the take first.")
    bones = list(motion.body.joints) if convention(names) == "kinefit" else bone_names(motion.body, names, path)
    world = turned(motion, up or motion.up, path)
    with writing(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of packages about each other
        file = _file(pynwb, world)
        behavior = file.create_processing_module("behavior", "motion of a body, fitted by kinefit")
        for thing in _pose(ndx_pose, pynwb, world, plain_names(bone.replace(":", "_") for bone in bones)):
            behavior.add(thing)
        with pynwb.NWBHDF5IO(str(temporary), "w") as out:
            out.write(file)


def confidence(std: NDArray) -> NDArray:
    """(...) probability that a point with standard deviations (..., 3) [m] lies within `CONFIDENCE_RADIUS_M`.

    Of a normal distribution equal in all directions, with the mean variance (Maxwell's distribution).
    """
    from scipy.special import gammainc

    sigma = np.nan_to_num(np.sqrt(np.mean(np.square(std), axis=-1)), nan=np.inf, posinf=np.inf)
    with np.errstate(divide="ignore"):
        return np.asarray(gammainc(1.5, 0.5 * np.square(CONFIDENCE_RADIUS_M / sigma)))


def _file(pynwb: Any, motion: Motion) -> Any:
    stated = motion.provenance.get("session")
    session = stated if isinstance(stated, Mapping) else {}
    start, said = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC), " The date of the recording is not known."
    try:
        start = datetime.datetime.fromisoformat(str(session["date"])).replace(tzinfo=datetime.UTC)
        said = ""
    except (KeyError, ValueError):
        pass
    file = pynwb.NWBFile(
        session_description=f"{motion.name}: motion of a body, {motion.up} up.{said}", session_start_time=start,
        identifier=str(uuid5(NAMESPACE_URL, f"kinefit:{motion.name}:{len(motion)}:{motion.rate}:{start}")),
    )  # fmt: skip
    if session.get("subject"):
        file.subject = pynwb.file.Subject(subject_id=str(session["subject"]), species="Homo sapiens")
    return file


def _pose(ndx_pose: Any, pynwb: Any, motion: Motion, bones: list[str]) -> list[Any]:
    """Skeleton and pose estimation, and time series beside them."""
    tree, sure = motion.body.tree, confidence(motion.joint_std)
    centres = motion.joint_centres
    skeleton = ndx_pose.Skeleton(
        name="skeleton", nodes=bones,
        edges=np.array([(p, s) for s, p in enumerate(tree.parents) if p >= 0], dtype="uint8"),
    )  # fmt: skip
    series: list[Any] = []
    for s, name in enumerate(bones):
        series.append(ndx_pose.PoseEstimationSeries(
            name=name, description=f"joint centre, segment {tree.segments[s]}", data=centres[:, s], unit="meters",
            reference_frame=f"right-handed world, {motion.up} up, of the calibration", confidence=sure[:, s],
            confidence_definition=f"probability that the true centre is within {CONFIDENCE_RADIUS_M:g} m, by its sigma",
            timestamps=series[0] if series else np.array(motion.times),
        ))  # fmt: skip
    pose = ndx_pose.PoseEstimation(
        name="PoseEstimation", pose_estimation_series=series, skeleton=skeleton, source_software="kinefit",
        description="joint centres of the fitted body",
    )  # fmt: skip
    coordinates = ", ".join(tree.coordinates)
    beside = (
        ("joint_std", motion.joint_std, "meters", f"standard deviations along x, y, z; joints: {', '.join(bones)}"),
        ("angles", motion.angles, "radians", f"joint coordinates (metres where they slide): {coordinates}"),
        ("angles_std", motion.dof_std[:, 6:], "radians",
         f"their standard deviations; inf: not observed; {coordinates}"),
    )  # fmt: skip
    times = {"timestamps": series[0]}
    return [
        ndx_pose.Skeletons(skeletons=[skeleton]), pose,
        *(pynwb.TimeSeries(name=n, data=np.array(d), unit=u, description=t, **times) for n, d, u, t in beside),
    ]  # fmt: skip
