"""One figure a line, with a verdict that is computed from its value and nothing else."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path


def figure(name: str, value: float | None, unit: str, goal: str, reason: str = "") -> bool:
    """Print `figure NAME = VALUE UNIT (goal GOAL): met|missed|not measured (reason)`.

    Parameters
    ----------
    goal : str such as "<= 9", ">= 2.5" or "== 500".
    reason : str, why there is no value.
    """
    relation, bound = goal.split()
    if value is None or not math.isfinite(value):
        print(f"figure {name} = - {unit} (goal {goal}): not measured ({reason or 'no value'})", flush=True)
        return False
    met = {"<=": value <= float(bound), ">=": value >= float(bound), "==": value == float(bound)}[relation]
    print(f"figure {name} = {value:.4g} {unit} (goal {goal}): {'met' if met else 'missed'}", flush=True)
    return met


def data(name: str) -> Path | None:
    """Folder of a recording: below `KINEFIT_DATA`, else `../shared/data` beside the checkout; None where absent."""
    root = Path(os.environ.get("KINEFIT_DATA") or Path(__file__).parents[1].parent / "shared" / "data")
    return root / name if (root / name).exists() else None


def run_parts(parts: Mapping[str, str]) -> None:
    """Print the figures of the parts that the command line names; of all, where it names none.

    Parameters
    ----------
    parts : {module of this package with a function `run`: what it is about}
    """
    chosen = sys.argv[1:]
    unknown = [name for name in chosen if name not in parts]
    if unknown:
        sys.exit(f"no part {', '.join(unknown)}; there are: {', '.join(parts)}")
    for name in chosen or parts:
        print(f"\n# {name}: {parts[name]}", flush=True)
        import_module(f"benchmarks.{name}").run()
