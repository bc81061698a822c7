"""The motion file of kinefit, `*.npz`, version 1: all of a `Motion`, its fitted body and its residuals, exactly.

An uncompressed or compressed archive of numpy arrays (`numpy.load(path, allow_pickle=False)` reads it); no pickle.
F frames, S segments, D coordinates; metres, radians, seconds, pixels; float64 unless stated otherwise:

    format ()                        text "kinefit motion"
    version ()                       1
    name ()  up ()                   text; up is "x", "y", "z", "-x", "-y" or "-z", the world's vertical axis
    rate ()  times (F,)              [Hz], [s]
    provenance ()                    JSON text: processing steps and settings; optional
    Ts_world_root (F, 4, 4)          pose of the root
    angles (F, D)                    joint coordinates, named in body/coordinates
    dof_std (F, 6 + D)               standard deviation of the root's twist (v, ω), then the angles; inf: unobserved
    joint_std (F, S, 3)              of every joint centre along the world's axes
    quality (F,)  segment_quality (F, S)              0..1
    body/...                         the fitted body, in the format of `kinefit.bodies.serial`
    lasting/frames (K,)              int, key frames of the errors that frames have in common; all of lasting/ optional
    lasting/constant (K, 6 + D, k)  drift (K, 6 + D, m)  drift_time ()   float16, `bodies.lasting_errors`; [s]
    lasting/parameters/names (p,)  values (p,)  covariance (p, p)  information (p, p)  directions (k, p)     optional
    residuals/SENSOR/names (K,)  segments (K,)        points of a sensor, and the segment of each
    residuals/SENSOR/unit ()         "px" or "m"
    residuals/SENSOR/values (F, K, N)                 measured minus fitted, NaN if unobserved; N = 2 or 3
    residuals/SENSOR/measured (F, K, N)  weights (F, K)
    plates/NAME/corners (4, 3)  rate ()  first_time ()  force (n, 3)  moment (n, 3)     [m, Hz, s, N, N m]
    events/label (e,)  context (e,)  subject (e,)  description (e,)  source (e,)        text; all of events/ optional
    events/time (e,)  icon (e,)  flag (e,)            [s], int, int
    residuals/SENSOR/swapped (F,)    bool, the detector swapped left and right, corrected

Sensor names are percent-encoded in keys.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import read_npz, regular
from kinefit.bodies.lasting_errors import LastingErrors, ParameterErrors
from kinefit.bodies.motion import MarkerEvent, Motion, Residuals
from kinefit.bodies.serial import below, body_from_arrays, fields_of, prefixes
from kinefit.errors import FileError, KinefitError, command
from kinefit.geometry.force_plates import ForcePlate

FORMAT, VERSION = "kinefit motion", 1
SHAPES = {
    "name": "$", "up": "$", "rate": "", "times": "F", "Ts_world_root": "F 4 4", "angles": "F D", "dof_std": "F N",
    "joint_std": "F S 3", "quality": "F", "segment_quality": "F S",
}  # fmt: skip
RESIDUAL_SHAPES = {
    "names": "k$", "segments": "k<S", "unit": "$", "values": "F k n", "weights": "F k", "measured": "F k n",
    "swapped": "F",
}  # fmt: skip
LASTING_SHAPES = {"frames": "K<F", "constant": "K N C!", "drift": "K N d!", "drift_time": ""}
PARAMETER_SHAPES = {
    "names": "P$", "values": "P!", "covariance": "P P!", "information": "P P!", "directions": "C P!",
}  # fmt: skip
EVENT_SHAPES = {f.name: {"str": "e$", "float": "e!", "int": "e"}[str(f.type)] for f in fields(MarkerEvent)}
PLATE_SHAPES = {"corners": "4 3!", "rate": "", "first_time": "", "force": "n 3", "moment": "n 3"}
SURFACE_SHAPES = {"rms": "F k", "count": "F k"}
_REMEDY = "Write it again with kinefit, or copy it again from its source."


def find_motion(path: str | PathLike[str]) -> Path:
    """The motion file in a folder of results; any other path unchanged.

    Raises
    ------
    FileError
        A folder without one, with the folders in it that have one.
    """
    path = Path(path)
    inside = path / "motion.npz"
    if path.is_dir() and not inside.is_file():
        below = ", ".join(file.parent.name for file in sorted(path.glob("*/motion.npz"))[:10])
        remedy = f"Name a folder in it: {below}." if below else "Give a folder that `kinefit track` wrote."
        raise FileError("this folder has no motion.npz", file=path, remedy=remedy)
    return inside if inside.is_file() else path


@checked
def read_motion(path: str | PathLike[str]) -> Motion:
    """Read a motion file, or the one in a folder of results.

    Raises
    ------
    FileError
        No such file, not a motion file, truncated, or of a later version.
    """
    file = find_motion(path)
    arrays = _load(file)
    if "format" not in arrays or str(arrays["format"]) != FORMAT:
        remedy = "Give a file that `kinefit track` wrote."
        raise FileError("this is not a motion file of kinefit", file=file, remedy=remedy)
    try:
        if int(arrays["version"]) != VERSION:
            raise FileError(
                f"motion file of version {int(arrays['version'])}; this kinefit reads version {VERSION}",
                file=file,
                remedy="Use the kinefit that wrote it, or a newer one.",
            )
        return _motion(arrays)
    except FileError:
        raise
    except (KinefitError, KeyError, ValueError, TypeError, IndexError, RecursionError) as error:
        problem = f"motion file whose contents do not fit together ({error})"
        raise FileError(problem, file=file, remedy=_REMEDY) from error


def _load(file: Path) -> dict[str, NDArray]:
    if not regular(file).is_file():
        raise FileError("no such motion file", file=file, remedy="Check the path.")
    with file.open("rb") as stream:
        packed = stream.read(2) == b"PK"
    if not packed:
        ways = {".toml": ("track",), ".bvh": ("retarget",), ".amc": ("retarget",), ".c3d": ("markers", "fit"),
                ".trc": ("markers", "fit")}  # fmt: skip
        way = ways.get(file.suffix.lower())
        remedy = f"Convert it: {command(*way, file)}" if way else "Give a file that `kinefit track` wrote."
        raise FileError("this is not a motion file of kinefit", file=file, remedy=remedy)
    try:
        return read_npz(file, remedy=_REMEDY)
    except FileError as error:
        problem = f"this is not a motion file of kinefit, or only a part of one: {error.problem}"
        raise FileError(problem, file=file, remedy=_REMEDY) from error


def _motion(arrays: Mapping[str, NDArray]) -> Motion:
    for array in arrays.values():
        array.flags.writeable = False
    body = body_from_arrays(below(arrays, "body/"))
    D = len(body.tree.coordinates)
    sizes = {"S": len(body.tree.segments), "D": D, "N": 6 + D}
    own = fields_of(arrays, SHAPES, sizes)
    provenance = json.loads(str(arrays["provenance"])) if "provenance" in arrays else {}
    sensors = prefixes(arrays, "residuals")
    residuals = {sensor: _residuals(arrays, prefix, sizes) for sensor, prefix in sensors.items()}
    lasting = None
    if "lasting/frames" in arrays:
        lasting = LastingErrors(**fields_of(arrays, LASTING_SHAPES, sizes, "lasting/"))
    if lasting is not None and "lasting/parameters/names" in arrays:
        known = ParameterErrors(**fields_of(arrays, PARAMETER_SHAPES, sizes, "lasting/parameters/"))
        lasting = replace(lasting, parameters=known)
    found = prefixes(arrays, "plates").items()
    plates = tuple(ForcePlate(name, **fields_of(arrays, PLATE_SHAPES, sizes, prefix)) for name, prefix in found)
    marked = fields_of(arrays, EVENT_SHAPES, sizes, "events/") if "events/time" in arrays else {}
    events = tuple(MarkerEvent(*one) for one in zip(*(np.asarray(values).tolist() for values in marked.values())))
    return Motion(
        body=body, **own, residuals=residuals, provenance=provenance, lasting=lasting, plates=plates, events=events
    )  # fmt: skip


def _residuals(arrays: Mapping[str, NDArray], prefix: str, sizes: dict[str, int]) -> Residuals:
    shapes = RESIDUAL_SHAPES | (SURFACE_SHAPES if f"{prefix}rms" in arrays else {})
    out = Residuals(**fields_of(arrays, shapes, sizes, prefix))
    axes = {"px": 2, "m": 3}.get(out.unit)
    if axes is None or out.values.shape[2] != (axes if out.of_points else 1):
        raise ValueError(f"{prefix}values in {out.unit} of shape {out.values.shape}")
    return out
