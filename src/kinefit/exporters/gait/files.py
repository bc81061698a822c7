"""The gait record in files: one table of all strides and steps, and a summary."""

from __future__ import annotations

import json
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from kinefit._files import write_text, writing
from kinefit.bodies.masses import segment_masses
from kinefit.exporters.gait.record import SIDES, WALKS, GaitRecord
from kinefit.exporters.report.strides import QUANTITIES, Quantity
from kinefit.exporters.tables import Table, parquet_writer, quantity_table, to_csv

_DIGITS = 6  # that count, of numbers in the summary


def write_gait(record: GaitRecord, folder: str | PathLike[str]) -> dict[str, Path]:
    """Write gait.csv, gait.json and, where pyarrow is installed, gait.parquet.

    The tables have a row for every stride and single step, with each quantity and its standard deviation, NaN (in CSV
    nothing) where it was not seen. The summary has what `summary` returns.

    Returns
    -------
    {"csv", "parquet", "json": file}

    Raises
    ------
    ExportError
        A file cannot be written.
    """
    folder, table = Path(folder), stride_table(record)
    out = {"csv": folder / "gait.csv"}
    with writing(out["csv"]) as file:
        to_csv([table], file)
    if find_spec("pyarrow"):
        out["parquet"] = folder / "gait.parquet"
        with writing(out["parquet"]) as file:
            parquet_writer(folder, {"trials": ", ".join(walk.name for walk in record.walks)})([table], file)
    out["json"] = folder / "gait.json"
    write_text(out["json"], json.dumps(summary(record), indent=1, ensure_ascii=False) + "\n")
    return out


def stride_table(record: GaitRecord) -> Table:
    """Columns (rows,): trial, kind, side, walk, start and stop [s], each quantity with its standard deviation."""
    return quantity_table(record.stretches, ("trial", "kind", "side", "walk", "start", "stop"), QUANTITIES)


def summary(record: GaitRecord) -> dict[str, Any]:
    """The record as JSON has it.

    Returns
    -------
    {"trials": names, "notes": sentences, "stature_m", "mass_kg", "mass_std_kg": of the person, "straight", "turning":
    {"strides", "steps": {side: number}, "quantities": {quantity: {"left", "right", "both": {"mean", "std": of the
    mean's error, "sd": of strides, "cv_percent", "n"}, "symmetry_percent": {"value", "std"}}}}}
    """
    body = record.walks[0].motion.body
    masses = segment_masses(body)
    out: dict[str, Any] = {
        "trials": [walk.name for walk in record.walks], "notes": list(record.notes),
        "stature_m": _rounded(body.stature) if body.stature else None,
        "mass_kg": _rounded(float(masses.masses.sum())), "mass_std_kg": _rounded(masses.std),
    }  # fmt: skip
    for walk in WALKS:
        counts = {f"{kind}s": {side: record.count(kind, side, walk) for side in SIDES} for kind in ("stride", "step")}
        both, quantities = record.quantities("both", walk), {}
        for name, left, right, (share, std) in record.compared(walk):
            entry = {side: _entry(q) for side, q in zip((*SIDES, "both"), (left, right, both[name])) if len(q.values)}
            if np.isfinite(share):
                entry["symmetry_percent"] = {"value": _rounded(share), "std": _rounded(std)}
            quantities[name] = entry
        out[walk] = {**counts, "quantities": quantities}
    return out


def _entry(of: Quantity) -> dict[str, Any]:
    variation = 100.0 * of.spread / abs(of.mean or np.nan)
    numbers = {"mean": of.mean, "std": of.std, "sd": of.spread, "cv_percent": variation}
    return {name: _rounded(value) for name, value in numbers.items()} | {"n": len(of.values)}


def _rounded(value: float) -> float | None:
    return float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None
