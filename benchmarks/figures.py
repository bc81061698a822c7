"""One figure a line, with a verdict that is computed from its value and nothing else."""

from __future__ import annotations

import math
import operator
import os
import sys
import time
import traceback
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TypeVar

Amount = TypeVar("Amount")


_RELATIONS = {"<=": operator.le, ">=": operator.ge, ">": operator.gt, "==": operator.eq}


def figure(name: str, value: float | None, unit: str, goal: str, reason: str = "") -> bool:
    """Print `figure NAME = VALUE UNIT (goal GOAL): met|missed|not measured (reason)`.

    Parameters
    ----------
    goal : str such as "<= 9", ">= 2.5", "> 0" or "== 500".
    reason : str, why there is no value.
    """
    relation, bound = goal.split()
    if value is None or not math.isfinite(value):
        print(f"figure {name} = - {unit} (goal {goal}): not measured ({reason or 'no value'})", flush=True)
        return False
    met = _RELATIONS[relation](value, float(bound))
    print(f"figure {name} = {value:.4g} {unit} (goal {goal}): {'met' if met else 'missed'}", flush=True)
    return met


def data(name: str) -> Path | None:
    """Folder of a recording: below `KINEFIT_DATA`, else `../shared/data` beside the checkout; None where absent."""
    root = Path(os.environ.get("KINEFIT_DATA") or Path(__file__).parents[1].parent / "shared" / "data")
    return root / name if (root / name).exists() else None


QUICK = "KINEFIT_BENCHMARKS_QUICK"
"""Set in the environment where `--quick` was asked for, so that processes that a part starts know it, too."""

LEFT_OUT = "left out of the quick form"


def quick() -> bool:
    """Whether figures are to be told from few frames: whether all parts run to their end, not how good they are."""
    return bool(os.environ.get(QUICK))


def amount(whole: Amount, few: Amount) -> Amount:
    """How much of something: all of it, or little in the quick form."""
    return few if quick() else whole


FAILED: list[str] = []
"""Processes of kinefit's own that a part started and that broke off: their figures are not measured, and `run_parts`
ends with an error."""


def run_parts(parts: Mapping[str, str]) -> None:
    """Print the figures of the parts that the command line names; of all, where it names none.

    A part that does not end is told with its traceback, and the others go on; the process then ends with an error.

    Parameters
    ----------
    parts : {module of this package with a function `run`: what it is about}
    """
    options = {word for word in sys.argv[1:] if word.startswith("--")}
    chosen = [word for word in sys.argv[1:] if word not in options]
    unknown = [name for name in chosen if name not in parts] + sorted(options - {"--quick", "--no-peers"})
    if unknown:
        sys.exit(f"no part {', '.join(unknown)}; there are: {', '.join(parts)}, and --quick, --no-peers")
    if "--quick" in options:
        os.environ[QUICK] = "1"
    broken = []
    for name in chosen or parts:
        print(f"\n# {name}: {parts[name]}", flush=True)
        began = time.monotonic()
        try:
            import_module(f"benchmarks.{name}").run()
        except Exception:
            traceback.print_exc(file=sys.stdout)
            broken.append(name)
        print(f"# {name}: {time.monotonic() - began:.0f} s", flush=True)
    broken += FAILED
    if broken:
        sys.exit(f"did not end: {', '.join(broken)}")


def peers() -> bool:
    """Whether other programs run side by side: not in the quick form, which makes no environments."""
    return not quick() and "--no-peers" not in sys.argv
