"""Normative values of angles over the cycle, from a table of the user's."""

from __future__ import annotations

import csv
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import FileError

COLUMNS = ("coordinate", "percent", "mean", "sd")

Norms = dict[str, NDArray]
"""{coordinate: (N, 3) percent of the cycle, mean [deg], standard deviation [deg]}, percent ascending."""


def read_norms(path: str | PathLike[str]) -> Norms:
    """Read normative values: a CSV with the columns coordinate, percent, mean and sd.

    A coordinate is named as in the tables of angles, with its side or, for both, without (`knee_angle`).

    Raises
    ------
    FileError
        The file is missing or no such table; the message names the line.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except FileNotFoundError as error:
        raise FileError("no such table of normative values", file=path, remedy="Check the path.") from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"cannot be read ({error})", file=path, remedy="Give a CSV in UTF-8.") from error
    lacking = [name for name in COLUMNS if not rows or name not in rows[0]]
    if lacking:
        remedy = f"Head its columns {', '.join(COLUMNS)}, and give a line below."
        raise FileError(f"has no column '{lacking[0]}'", file=path, remedy=remedy)
    found: dict[str, list[tuple[float, ...]]] = {}
    for number, row in enumerate(rows, 2):
        try:
            percent, mean, sd = (float(row[name]) for name in COLUMNS[1:])
        except (TypeError, ValueError):
            percent = mean = sd = np.nan
        if not (0 <= percent <= 100 and np.isfinite(mean) and 0 <= sd < np.inf):
            remedy = "percent lies within 0 to 100, mean and sd are degrees, and sd is not negative."
            raise FileError("is no normative value", file=path, place=f"line {number}", remedy=remedy)
        found.setdefault((row["coordinate"] or "").strip(), []).append((percent, mean, sd))
    return {name: np.array(sorted(values)) for name, values in found.items()}
