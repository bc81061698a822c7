"""Writing the files of kinefit's own, which `kinefit.readers.motion` and `kinefit.readers.detections` read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from kinefit._arguments import checked
from kinefit._files import writing
from kinefit.bodies.serial import arrays_of, body_to_arrays
from kinefit.errors import ExportError
from kinefit.motion import Motion
from kinefit.observations import Detections
from kinefit.readers import detections as detections_format
from kinefit.readers import motion as motion_format


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
    for sensor, residuals in motion.residuals.items():
        shapes = form.RESIDUAL_SHAPES | form.SURFACE_SHAPES
        arrays |= arrays_of(residuals, shapes, f"residuals/{quote(sensor, safe='')}/")
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
    keys = ("camera", "rate", "size", "mask_runs", "mask_starts", *(() if detections.times is None else ("times",)))
    arrays |= {"key": key, **{name: getattr(detections, name) for name in keys}}
    _write(path, "a file of detections", detections_format, arrays)


def _write(path: str | PathLike[str], kind: str, form: Any, arrays: Mapping[str, Any]) -> None:
    if Path(path).suffix != ".npz":
        raise ExportError(f"{kind} ends in .npz", file=path, remedy=f"Call it {Path(path).stem}.npz.")
    whole = {"format": form.FORMAT, "version": form.VERSION, **arrays}
    with writing(path) as temporary:
        np.savez_compressed(temporary, **{key: np.asarray(value) for key, value in whole.items()})  # type: ignore[arg-type]
