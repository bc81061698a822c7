"""Manual annotations: joints that a user clicked in images, as JSON, and pixels of static objects, as TOML."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._files import parse_toml, read_bytes, read_text, repeated
from kinefit.errors import FileError, ObservationError, check_choice, located

_MAX_NUMBER = 1e9  # of a frame or a pixel; no recording has as many
_FORM = 'Write {"step": 0, "points": {"CAMERA": {"r_knee": [812.0, 401.5], ...}, ...}}, or a list of these.'


@dataclass(frozen=True)
class Clicks:
    """Manually annotated points of one step.

    Parameters
    ----------
    step : int, of the take's common time
    points : {camera: {landmark: (u, v)}} [px] of the camera's own image
    """

    step: int
    points: Mapping[str, Mapping[str, tuple[float, float]]]

    @property
    def names(self) -> tuple[str, ...]:
        """Landmarks clicked in two or more images, in the order of the first clicks."""
        return tuple(repeated(name for points in self.points.values() for name in points))

    def places(self, camera: str) -> NDArray:
        """(N, 2) [px] of `names` in a camera's image; NaN if not clicked."""
        points = self.points.get(camera, {})
        return np.array([points.get(name, (np.nan, np.nan)) for name in self.names], float).reshape(-1, 2)


def clicks_text(steps: Sequence[Clicks]) -> str:
    """Clicks of one or several steps as JSON, the format of `read_clicks`."""
    content = [{"step": of.step, "points": {c: dict(points) for c, points in of.points.items()}} for of in steps]
    return json.dumps(content if len(content) > 1 else content[0], indent=1) + "\n"


def read_clicks(path: str | PathLike[str]) -> tuple[Clicks, ...]:
    """Read the clicked points of every step in a JSON file, at least one, in the order of the steps.

    Raises
    ------
    FileError
        Not readable, not JSON, of another form, or a step twice.
    """
    try:
        content = json.loads(read_bytes(Path(path)))
    except (ValueError, RecursionError) as error:
        raise FileError(f"is not JSON ({error})", file=path, remedy=_FORM) from error
    with located(path):
        several = content if isinstance(content, list) and content else [content]
        steps = sorted(map(clicks_of, several), key=lambda of: of.step)
    if twice := repeated(str(of.step) for of in steps):
        raise FileError(f"step {', '.join(twice)} appears twice", file=path, remedy="Put a step into one entry.")
    return tuple(steps)


def clicks_of(value: Any) -> Clicks:
    """Clicked points of a JSON value; raises FileError if it has another form."""
    if not isinstance(value, dict) or not isinstance(value.get("points"), dict):
        raise FileError("holds no points", remedy=_FORM)
    step = value.get("step", 0)
    if not isinstance(step, int) or isinstance(step, bool) or not 0 <= step < _MAX_NUMBER:
        raise FileError(f"step {step!r} is not a frame number", remedy=_FORM)
    points: dict[str, dict[str, tuple[float, float]]] = {}
    for camera, of in value["points"].items():
        if not isinstance(of, dict):
            raise FileError("holds no points", place=f"camera {camera}", remedy=_FORM)
        points[camera] = {}
        for name, place in of.items():
            if not _is_pixel(place):
                raise FileError(f"{place!r} is not a pixel position", place=f"camera {camera}, {name}", remedy=_FORM)
            points[camera][name] = (float(place[0]), float(place[1]))
    return Clicks(step, points)


def read_static_points(
    path: str | PathLike[str], cameras: Sequence[str]
) -> dict[str, dict[str, tuple[float, float]]]:
    """Read {point: {camera: (u, v)}} [px] of points that two or more cameras see.

    A TOML file with one table a point, and in it the pixel of each camera that sees it, in the calibration's image:

        [beam_end]
        cam01 = [512.3, 1204.0]
        cam03 = [430.1, 1311.8]

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
        and all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < _MAX_NUMBER for v in value)
    )  # fmt: skip
