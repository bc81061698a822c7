"""Writing the motion file; `kinefit.readers.motion` tells what is in it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from kinefit._arguments import checked
from kinefit.bodies.serial import arrays_of, body_to_arrays
from kinefit.errors import ExportError
from kinefit.exporters.atomic import writing
from kinefit.motion import Motion
from kinefit.readers.motion import FORMAT, RESIDUAL_SHAPES, SHAPES, SURFACE_SHAPES, VERSION


@checked
def write_motion(motion: Motion, path: str | PathLike[str]) -> None:
    """Write everything of a motion into one `.npz`; `read_motion` gives it back exactly.

    Raises
    ------
    ExportError
        The name does not end in .npz, or the file cannot be written.
    """
    if Path(path).suffix != ".npz":
        raise ExportError("a motion file ends in .npz", file=path, remedy=f"Call it {Path(path).stem}.npz.")
    head = {"format": FORMAT, "version": VERSION, "provenance": _json(motion.provenance)}
    arrays = {key: np.array(value) for key, value in head.items()} | arrays_of(motion, SHAPES)
    arrays |= {f"body/{key}": array for key, array in body_to_arrays(motion.body).items()}
    for sensor, residuals in motion.residuals.items():
        arrays |= arrays_of(residuals, RESIDUAL_SHAPES | SURFACE_SHAPES, f"residuals/{quote(sensor, safe='')}/")
    with writing(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]


def _json(provenance: Mapping[str, Any]) -> str:
    try:
        return json.dumps(dict(provenance), allow_nan=False)
    except (TypeError, ValueError) as error:
        remedy = "Give numbers, texts, lists and mappings of them."
        raise ExportError(f"a provenance that JSON cannot hold ({error})", remedy=remedy) from error
