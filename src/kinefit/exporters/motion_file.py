"""Writing the files of kinefit's own, which `readers.motion` and `readers.landmarks.detections` read."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_lines, writing
from kinefit._mapped import release
from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.bodies.serial import arrays_of, body_to_arrays
from kinefit.errors import ExportError
from kinefit.exporters.skeletons.common import turned
from kinefit.geometry import se3
from kinefit.observations import MEDIAPIPE_33, Detections
from kinefit.readers import motion as motion_format
from kinefit.readers.landmarks import detections as detections_format


@checked
def write_motion(motion: Motion, path: str | PathLike[str]) -> None:
    """Write everything of a motion into one `.npz`; `read_motion` gives it back exactly.

    Raises
    ------
    ExportError
        The name does not end in .npz, or the file cannot be written.
    """
    form = motion_format
    arrays = {"provenance": np.array(_json(motion.provenance)), **arrays_of(motion, form.SHAPES)}
    arrays |= {f"body/{key}": array for key, array in body_to_arrays(motion.body).items()}
    if motion.lasting is not None:
        arrays |= arrays_of(motion.lasting, form.LASTING_SHAPES, "lasting/")
        if motion.lasting.parameters is not None:
            arrays |= arrays_of(motion.lasting.parameters, form.PARAMETER_SHAPES, "lasting/parameters/")
    for sensor, residuals in motion.residuals.items():
        shapes = form.RESIDUAL_SHAPES | form.SURFACE_SHAPES
        arrays |= arrays_of(residuals, shapes, f"residuals/{quote(sensor, safe='')}/")
    for plate in motion.plates:
        arrays |= arrays_of(plate, form.PLATE_SHAPES, f"plates/{quote(plate.name, safe='')}/")
    if motion.events:
        columns = {name: [getattr(event, name) for event in motion.events] for name in form.EVENT_SHAPES}
        arrays |= {f"events/{name}": np.array(values) for name, values in columns.items()}
    _write(path, "a motion file", form, arrays)


def _json(provenance: Mapping[str, Any]) -> str:
    try:
        return json.dumps(dict(provenance), allow_nan=False)
    except (TypeError, ValueError) as error:
        remedy = "Give numbers, texts, lists and mappings of them."
        raise ExportError(f"a provenance that JSON cannot hold ({error})", remedy=remedy) from error


def write_detections(detections: Detections, path: str | PathLike[str], *, key: str = "") -> None:
    """Write a file that `read_detections` reads, whole or not at all.

    Raises
    ------
    ExportError
        The name does not end in .npz, or the file cannot be written.
    """
    arrays: dict[str, Any] = {
        name: array.astype(np.float32)
        for name in ("points", "confidence", "lifted", "hands", "hand_confidence", "face", "face_confidence")
        if (array := getattr(detections, name)) is not None
    }  # fmt: skip
    keys = ["camera", "rate", "size", "mask_runs", "mask_starts"]
    keys += [name for name in ("times", "looked") if getattr(detections, name) is not None]
    if detections.network or detections.names != MEDIAPIPE_33:
        keys += ["names", "keypoint_set", "network"]
    arrays |= {"key": key, **{name: getattr(detections, name) for name in keys}}
    _write(path, "a file of detections", detections_format, arrays)


def _write(path: str | PathLike[str], kind: str, form: Any, arrays: Mapping[str, Any]) -> None:
    if Path(path).suffix != ".npz":
        raise ExportError(f"{kind} ends in .npz", file=path, remedy=f"Call it {Path(path).stem}.npz.")
    whole = {"format": form.FORMAT, "version": form.VERSION, **arrays}
    with writing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as file:
        for key, value in whole.items():  # as numpy.savez_compressed, which would have all in memory at once
            array = np.asarray(value)
            with file.open(f"{key}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array)
            release(array)


FORMAT, VERSION = "kinefit live", 1
_DIGITS = 6  # decimals of lengths and angles


def hello(body: Body, *, name: str, rate: float, up: str, sensors: Sequence[str] = ()) -> bytes:
    """What a reader must know before the first pose, and again where the body changes."""
    tree = body.tree
    return msgspec.json.encode({
        "type": "hello", "format": FORMAT, "version": VERSION, "name": name, "rate": rate, "up": up,
        "body": body.name, "segments": list(tree.segments), "parents": tree.parents.tolist(),
        "offsets": _rounded(tree.offsets), "coordinates": list(tree.coordinates),
        "units": ["m" if slides else "rad" for slides in tree.prismatic], "sensors": list(sensors),
    })  # fmt: skip


def pose(
    Ts_world_segment: NDArray, angles: NDArray, dof_std: NDArray, joint_std: NDArray, segment_quality: NDArray, *,
    quality: float, lost: NDArray,
) -> dict[str, Any]:  # fmt: skip
    """What a packet says of one pose.

    Parameters
    ----------
    Ts_world_segment : (S, 4, 4) [m]
    angles : (D,) [rad, m]
    dof_std : (6 + D,), joint_std : (S, 3), inf where nothing observes
    segment_quality : (S,); quality : float
    lost : (S,) bool
    """
    T = Ts_world_segment
    places = np.concatenate([T[:, :3, 3], se3.quaternion(T[:, :3, :3])], axis=1)
    return {
        "segments": _rounded(places), "joint_std": _finite(joint_std), "angles": _rounded(angles),
        "root_std": _finite(dof_std[:6]), "angle_std": _finite(dof_std[6:]), "quality": round(float(quality), 3),
        "segment_quality": np.round(segment_quality, 3).tolist(), "lost": np.flatnonzero(lost).tolist(),
    }  # fmt: skip


@checked
def write_jsonl(motion: Motion, path: str | PathLike[str], *, up: str | None = None) -> None:
    """Write a motion as JSON lines: `hello`, then a `pose` for each frame.

    Raises
    ------
    ExportError
        An unknown vertical axis, or the file cannot be written.
    """
    motion = motion if up is None else turned(motion, up, path)
    write_lines(path, _lines(motion))


def _lines(motion: Motion) -> Iterator[str]:
    yield hello(motion.body, name=motion.name, rate=motion.rate, up=motion.up).decode()
    number = 0
    for part in motion.parts():
        poses, lost = part.segment_poses(), part.lost
        for f in range(len(part)):
            entries = pose(
                poses[f], part.angles[f], part.dof_std[f], part.joint_std[f], part.segment_quality[f],
                quality=part.quality[f], lost=lost[f],
            )  # fmt: skip
            packet = {"type": "pose", "number": number, "time": round(float(part.times[f]), 6), **entries}
            yield msgspec.json.encode(packet).decode()
            number += 1


def _rounded(values: NDArray) -> Any:
    return np.round(values, _DIGITS).tolist()


def _finite(std: NDArray) -> Any:
    """Standard deviations as JSON has them."""
    finite = np.isfinite(std)
    if finite.all():
        return _rounded(std)
    out = np.round(std, _DIGITS).astype(object)
    out[~finite] = None
    return out.tolist()
