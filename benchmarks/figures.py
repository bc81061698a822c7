"""One figure a line, with a verdict that is computed from its value and nothing else."""

from __future__ import annotations

import math
import operator
import os
import shlex
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from datetime import date
from importlib import import_module
from pathlib import Path
from typing import TypeVar

Amount = TypeVar("Amount")


_RELATIONS = {"<=": operator.le, ">=": operator.ge, ">": operator.gt, "==": operator.eq}


def figure(
    name: str, value: float | None, unit: str, goal: str, reason: str = "", *, whole: bool = True
) -> bool:
    """Print `figure NAME = VALUE UNIT (goal GOAL): met|missed|not measured (reason)`; log it in a whole run.

    Parameters
    ----------
    goal : str such as "<= 9", ">= 2.5", "> 0" or "== 500".
    reason : str, why there is no value.
    whole : bool, False where less was measured than the figure's name says: it is then not logged.
    """
    known = value is not None and math.isfinite(value)
    text = _printed(value, goal) if known else ""
    verdict = ("met" if holds(value, goal) else "missed") if known else "not measured"
    reason = "" if known else reason or "no value"
    print(f"figure {name} = {text or '-'} {unit} (goal {goal}): {verdict}{f' ({reason})' * (not known)}", flush=True)
    if whole and (command := _command()):
        from benchmarks.ledger import record

        record(name, text, unit, goal, verdict, reason, command=command)
    return verdict == "met"


def holds(value: float, goal: str) -> bool:
    """Whether a value meets a goal such as "<= 9"."""
    relation, bound = goal.split()
    return bool(_RELATIONS[relation](value, float(bound)))


def _printed(value: float, goal: str) -> str:
    """Four digits, all those of a whole number, or as many as the verdict needs: 99.996 is not 100 if the goal is."""
    if value == int(value):
        return str(int(value))
    texts = [f"{value:.{digits}g}" for digits in range(4, 18)]
    return next(text for text in texts if holds(float(text), goal) == holds(value, goal))


_PART: list[str] = []
"""Words of the command that runs one part of an area alone; empty before `run_parts` has begun with it."""


def _command() -> str:
    """The command whose figures are logged; empty in the quick form, with `--no-log`, and in other programs."""
    program = Path(sys.argv[0]).resolve()
    if quick() or {"--quick", "--no-log"} & {*sys.argv} or program.parent != Path(__file__).resolve().parent:
        return ""
    return shlex.join(["python", "-m", f"benchmarks.{program.stem}", *(_PART or sys.argv[1:])])


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


OPTIONS = "--quick", "--brief", "--no-peers", "--no-log"

BRIEF_S = 40.0
"""[s] after which an area begins no further part with `--brief`, which also begins with another part each day."""


FAILED: list[str] = []
"""Processes of kinefit's own that a part started and that broke off: their figures are not measured, and `run_parts`
ends with an error."""


def turned(parts: Sequence[str]) -> Sequence[str]:
    """The parts from another one on each day."""
    first = date.today().toordinal() % len(parts)
    return [*parts[first:], *parts[:first]]


def run_parts(parts: Mapping[str, str]) -> None:
    """Print the figures of the parts that the command line names; of all, where it names none.

    A part that does not end is told with its traceback, and the others go on; the process then ends with an error.

    Parameters
    ----------
    parts : {module of this package with a function `run`: what it is about}
    """
    options = {word for word in sys.argv[1:] if word.startswith("--")}
    chosen = [word for word in sys.argv[1:] if word not in options]
    unknown = [name for name in chosen if name not in parts] + sorted(options - {*OPTIONS})
    if unknown:
        sys.exit(f"no part {', '.join(unknown)}; there are: {', '.join(parts)}, and {', '.join(OPTIONS)}")
    if "--quick" in options:
        os.environ[QUICK] = "1"
    paths = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]  # processes that parts start find this
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))  # package, after a command ran in theirs, too
    if _command():
        from benchmarks.ledger import commit

        commit()  # that of the code which is imported now, whatever is edited while the parts run
    broken, start = [], time.monotonic()
    for name in chosen or (turned(list(parts)) if "--brief" in options else parts):
        if "--brief" in options and time.monotonic() - start > BRIEF_S:
            print(f"\n# {name}: not begun, {LEFT_OUT}", flush=True)
            continue
        print(f"\n# {name}: {parts[name]}", flush=True)
        began, _PART[:] = time.monotonic(), [name]
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
