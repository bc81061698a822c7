"""A table that grows while a take is tracked: `so-far.csv`, one row a frame, which may be read at any time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from kinefit.bodies import Body
from kinefit.errors import ExportError
from kinefit.frame.results import FrameResult

BEGIN = b"frame,time [s],quality,"
"""What such a file begins with."""


def append_rows(file: Path, body: Body, results: Iterable[tuple[int, FrameResult]]) -> None:
    """Add frames as the tracker left them, not smoothed: time, quality, the root's place, every coordinate.

    Parameters
    ----------
    file : begins with a header where it is not there yet
    results : step and result of each frame

    Raises
    ------
    ExportError
        It cannot be written.
    """
    units = ["m" if slides else "deg" for slides in body.tree.prismatic]
    factors = np.where(body.tree.prismatic, 1.0, np.degrees(1.0))
    names = [f"{name} [{unit}]" for name, unit in zip(body.tree.coordinates, units)]
    header = ["frame", "time [s]", "quality", *(f"root_t{axis} [m]" for axis in "xyz"), *names]
    try:
        with open(file, "a", encoding="utf-8") as out:
            if not out.tell():
                out.write(",".join(header) + "\n")
            for step, r in results:
                values = [r.time, r.quality, *r.state.T_world_root[:3, 3], *(factors * r.state.angles)]
                out.write(",".join([str(step), *(f"{value:.5f}" for value in values)]) + "\n")
    except OSError as error:
        remedy = "Free some space, or give another folder with --out."
        raise ExportError(f"cannot be written ({error.strerror})", file=file, remedy=remedy) from error
