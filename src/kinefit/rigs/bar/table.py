"""Read the centroids of a bar's targets from a table."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from os import PathLike
from pathlib import Path

import numpy as np

from kinefit._arguments import checked
from kinefit._files import no_column, regular
from kinefit.errors import CalibrationError, FileError
from kinefit.rigs.bar.targets import BarViews

_COLUMNS = ("camera", "frame", "u", "v")


@checked
def read_centroids(
    path: str | PathLike[str], sizes: Mapping[str, tuple[int, int]] | tuple[int, int]
) -> dict[str, BarViews]:
    """Read a CSV file with the columns camera, frame, u, v: one row for each target, two for each image.

    Parameters
    ----------
    path : of the table; u and v [px], (0, 0) being the centre of the first pixel.
    sizes : (width, height) [px] of all cameras' images, or {camera: size}.

    Raises
    ------
    FileError
        No such table, other columns, or a cell that is no number; with the line.
    CalibrationError
        A camera without a size, targets outside of the image, or no image with two targets.
    """
    path = Path(path)
    spots: dict[str, dict[int, list[list[float]]]] = {}
    try:
        with regular(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                problem = no_column(missing, reader.fieldnames)
                raise FileError(problem, file=path, remedy="Write camera,frame,u,v in its first line.")
            for line, row in enumerate(reader, 2):
                try:
                    frame, uv = int(row["frame"]), [float(row["u"]), float(row["v"])]
                except (TypeError, ValueError):
                    raise FileError("a frame, u or v is not a number", file=path, place=f"line {line}",
                                    remedy="Correct it, or remove the row.") from None  # fmt: skip
                if np.isfinite(uv).all():
                    spots.setdefault(str(row["camera"]).strip(), {}).setdefault(frame, []).append(uv)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"cannot be read: {error}", file=path, remedy="Give a CSV file.") from None
    out = {}
    for name, frames in spots.items():
        size = sizes.get(name) if isinstance(sizes, Mapping) else sizes
        if size is None:
            remedy = "Give its width and height."
            raise CalibrationError("no image size", file=path, place=f"camera {name}", remedy=remedy)
        ends = {frame: np.array(uv) for frame, uv in sorted(frames.items()) if len(uv) == 2}
        every = np.concatenate([np.array(uv) for uv in frames.values()])
        if (every < -0.5).any() or (every > np.array(size) - 0.5).any():
            raise CalibrationError(
                f"targets at {every.min():.0f} to {every.max():.0f} px in images of {size[0]}x{size[1]} px", file=path,
                place=f"camera {name}", remedy="Give the size of the images in which they were measured.",
            )  # fmt: skip
        if not ends:
            raise CalibrationError(
                "no image with two targets", file=path, place=f"camera {name}", remedy="Give two rows an image."
            )
        out[name] = BarViews((int(size[0]), int(size[1])), ends, len(frames))
    if not out:
        raise FileError("it holds no targets", file=path, remedy="Write a row for each target: camera,frame,u,v.")
    return out
