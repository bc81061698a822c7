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
    residuals/SENSOR/names (K,)  segments (K,)        points of a sensor, and the segment of each
    residuals/SENSOR/unit ()         "px" or "m"
    residuals/SENSOR/values (F, K, N)                 measured minus fitted, NaN if unobserved; N = 2 or 3
    residuals/SENSOR/measured (F, K, N)  weights (F, K)
    residuals/SENSOR/swapped (F,)    bool, the detector swapped left and right, corrected

Sensor names are percent-encoded in keys.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from urllib.parse import unquote

from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import read_npz, regular
from kinefit.bodies.serial import body_from_arrays
from kinefit.errors import FileError, KinefitError, command
from kinefit.motion import UP_AXES, Motion, Residuals

FORMAT, VERSION = "kinefit motion", 1
ARRAYS = ("times", "Ts_world_root", "angles", "dof_std", "joint_std", "quality", "segment_quality")
SURFACE_ARRAYS = ("rms", "count")
RESIDUAL_ARRAYS = ("names", "segments", "unit", "values", "weights", "measured", "swapped")
_REMEDY = "Write it again with kinefit, or copy it again from its source."


def find_motion(path: str | PathLike[str]) -> Path:
    """The motion file in a folder of results; any other path unchanged."""
    inside = Path(path) / "motion.npz"
    return inside if inside.is_file() else Path(path)


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
    except KeyError as error:
        raise FileError(f"motion file without the array {error}", file=file, remedy=_REMEDY) from error
    except (KinefitError, ValueError, TypeError, IndexError, RecursionError) as error:
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
    body = body_from_arrays(_below(arrays, "body/"))
    F, S, D = len(arrays["times"]), len(body.tree.segments), len(body.tree.coordinates)
    shapes = ((F,), (F, 4, 4), (F, D), (F, 6 + D), (F, S, 3), (F,), (F, S))
    for key, shape in zip(ARRAYS, shapes):
        _check(key, arrays[key], shape)
    up = str(arrays["up"])
    if up not in UP_AXES:
        raise ValueError(f"vertical axis '{up}'")
    sensors = dict.fromkeys(key.split("/")[1] for key in arrays if key.startswith("residuals/"))
    return Motion(
        body=body,
        rate=float(arrays["rate"]),
        **{key: arrays[key] for key in ARRAYS},  # type: ignore[arg-type]
        residuals={unquote(s): _residuals(_below(arrays, f"residuals/{s}/"), s, F, S) for s in sensors},
        up=up,
        name=str(arrays["name"]),
        provenance=json.loads(str(arrays["provenance"])) if "provenance" in arrays else {},
    )


def _residuals(arrays: Mapping[str, NDArray], sensor: str, F: int, S: int) -> Residuals:
    K, N = len(arrays["names"]), {"px": 2, "m": 3}[str(arrays["unit"])]
    surface = "rms" in arrays
    N = 1 if surface else N
    shapes: dict[str, tuple[int, ...]] = {
        "segments": (K,), "values": (F, K, N), "measured": (F, K, N), "weights": (F, K), "swapped": (F,),
        **({"rms": (F, K), "count": (F, K)} if surface else {}),
    }  # fmt: skip
    for key, shape in shapes.items():
        _check(f"residuals/{sensor}/{key}", arrays[key], shape)
        arrays[key].flags.writeable = False
    if K and not (0 <= arrays["segments"].min() and arrays["segments"].max() < S):
        raise ValueError(f"residuals/{sensor}/segments names a segment that the body lacks")
    names = tuple(str(name) for name in arrays["names"])
    return Residuals(names=names, unit=str(arrays["unit"]), **{key: arrays[key] for key in shapes})


def _below(arrays: Mapping[str, NDArray], prefix: str) -> dict[str, NDArray]:
    return {key[len(prefix) :]: array for key, array in arrays.items() if key.startswith(prefix)}


def _check(key: str, array: NDArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"array '{key}' has shape {array.shape} instead of {shape}")
