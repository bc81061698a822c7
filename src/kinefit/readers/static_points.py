"""Static points for a calibration: pixels of objects that did not move.

A TOML file with one table a point, and in it the pixel of each camera that sees it, in the calibration's image:

    [beam_end]
    cam01 = [512.3, 1204.0]
    cam03 = [430.1, 1311.8]
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from kinefit._files import parse_toml, read_text
from kinefit.errors import ObservationError, check_choice


def read_static_points(
    path: str | PathLike[str], cameras: Sequence[str]
) -> dict[str, dict[str, tuple[float, float]]]:
    """Read {point: {camera: (u, v)}} [px] of points that two or more cameras see.

    Raises
    ------
    FileError
        No such file, or not TOML.
    ObservationError
        An unknown camera, a pixel that is not two finite numbers, a point in fewer than two cameras, no points.
    """
    file = Path(path)
    raw = parse_toml(read_text(file, "the static points", remedy="Give the path of a TOML file in UTF-8."), file)
    form = "Write [name] and below it camera = [u, v] for two or more cameras."
    out: dict[str, dict[str, tuple[float, float]]] = {}
    for name, views in raw.items():
        if not isinstance(views, dict) or len(views) < 2:
            raise ObservationError("a point needs two or more cameras", file=file, place=f"[{name}]", remedy=form)
        out[name] = {}
        for camera, pixel in views.items():
            place = f"[{name}] {camera}"
            check_choice("camera", camera, cameras, ObservationError, file=file, place=place)
            if not _is_pixel(pixel):
                raise ObservationError(f"{pixel} is not a pixel position", file=file, place=place, remedy=form)
            out[name][camera] = (float(pixel[0]), float(pixel[1]))
    if not out:
        raise ObservationError("there are no points", file=file, remedy=form)
    return out


def _is_pixel(value: object) -> bool:
    return (
        isinstance(value, list) and len(value) == 2
        and all(isinstance(v, int | float) and not isinstance(v, bool) and -1e9 < v < 1e9 for v in value)
    )  # fmt: skip
