"""Nominal lenses of depth cameras, by the names of folders and the size of the image."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from kinefit.readers.guess.draft import Value

_LENSES = Path(__file__).with_name("depth_cameras.toml")


def guessed_intrinsics(path: Path, size: tuple[int, int]) -> Value:
    """[fx, fy, cx, cy] [px] of a depth image: by a name in the path and the size, by a size of one kind; else open.

    Parameters
    ----------
    path : of the images, from the recording's folder on
    size : (width, height) [px]
    """
    shape = f"{size[0]}x{size[1]}"
    fitting = [one for one in tomllib.loads(_LENSES.read_text("utf-8"))["camera"] if shape in one["focal"]]
    named = [one for one in fitting if re.search(one["words"], str(path), re.IGNORECASE)]
    chosen = named or fitting
    each = [f"{one['focal'][shape]:g} ({one['name']})" for one in chosen]
    if not (named or len(chosen) == 1):
        likely = f": fx = fy = {', '.join(each)}" if each else ""
        return Value(None, "open", f"[fx, fy, cx, cy] in pixels of the depth image{likely}")
    focal = chosen[0]["focal"][shape]
    why = f"nominal, {each[0]}, by its {'name' if named else 'image size'}; the camera's own are better"
    values = [focal, focal, (size[0] - 1) / 2.0, (size[1] - 1) / 2.0]
    return Value(values, "likely" if named else "guess", why)
