"""Writing what the built-in detector saw (`kinefit.readers.detections` tells the format)."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from kinefit.errors import ExportError
from kinefit.exporters.atomic import writing
from kinefit.observations import Detections
from kinefit.readers.detections import FORMAT, VERSION


def write_detections(detections: Detections, path: str | PathLike[str], *, key: str = "") -> None:
    """Write a file that `read_detections` reads, whole or not at all.

    Raises
    ------
    ExportError
        The name does not end in .npz, or the file cannot be written.
    """
    if Path(path).suffix != ".npz":
        raise ExportError("a file of detections ends in .npz", file=path, remedy=f"Call it {Path(path).stem}.npz.")
    extra: dict[str, Any] = {
        name: array.astype(np.float32)
        for name in ("lifted", "hands", "hand_confidence", "face", "face_confidence")
        if (array := getattr(detections, name)) is not None
    }  # fmt: skip
    if detections.times is not None:
        extra["times"] = detections.times
    with writing(path) as temporary:
        np.savez_compressed(
            temporary, format=np.array(FORMAT), version=np.array(VERSION), key=np.array(key),
            camera=np.array(detections.camera), rate=np.array(detections.rate), size=np.array(detections.size),
            points=detections.points.astype(np.float32), confidence=detections.confidence.astype(np.float32),
            mask_runs=detections.mask_runs, mask_starts=detections.mask_starts,
            **extra,
        )
