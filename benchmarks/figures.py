"""One figure a line, with a verdict that is computed from its value and nothing else."""

from __future__ import annotations

import math
import operator
import os
import shlex
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from datetime import date
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from benchmarks.areas import AREAS

ROOT = Path(__file__).resolve().parents[1]
Amount = TypeVar("Amount")

_RELATIONS = {"<=": operator.le, ">=": operator.ge, ">": operator.gt, "==": operator.eq}


def figure(name: str, value: float | None, unit: str, goal: str, reason: str = "", *, whole: bool = True) -> bool:
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
    if whole and not quick() and (command := os.environ.get(COMMAND)):
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


COMMAND = "KINEFIT_BENCHMARKS_COMMAND"
"""Set in the environment while a whole run goes on whose figures are logged, so that processes that a part starts log
theirs, too: the command of the area and the part."""


def log_as(*words: str) -> None:
    """Log what is printed from now on as printed by `python -m benchmarks WORDS`."""
    from benchmarks.ledger import commit

    os.environ[COMMAND] = shlex.join(["python", "-m", "benchmarks", *words])
    commit()  # that of the code which is imported now, whatever is edited while the parts run


def data(name: str) -> Path | None:
    """Folder of a recording: below `KINEFIT_DATA`, else `../shared/data` beside the checkout; None where absent."""
    root = Path(os.environ.get("KINEFIT_DATA") or ROOT.parent / "shared" / "data")
    return root / name if (root / name).exists() else None


class NotMeasured(Exception):
    """Why a part, or a step of it, prints no figures: no recording, no program, or the quick form."""


def recording(name: str) -> Path:
    """Folder of a recording.

    Raises
    ------
    NotMeasured
        Where it is absent.
    """
    folder = data(name)
    if folder is None:
        raise NotMeasured(f"no recording {name}")
    return folder


def whole_recording(name: str) -> Path:
    """As `recording`, of what the quick form leaves out."""
    if quick():
        raise NotMeasured(LEFT_OUT)
    return recording(name)


def each(*steps: Callable[[], object]) -> None:
    """Run steps one after the other; one that cannot be measured says why, and the others go on."""
    for step in steps:
        try:
            step()
        except Exception as error:
            from kinefit.errors import AssetError

            if not isinstance(error, NotMeasured | AssetError):
                raise
            print(f"# not measured: {getattr(error, 'problem', error)}", flush=True)


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

BRIEF_DAYS = 5
"""Days in which the parts of an area all run with `--brief`, another share each day, at least one part."""


FAILED: list[str] = []
"""Processes of kinefit's own that a part started and that broke off: their figures are not measured, and `run_parts`
ends with an error."""


def of_today(parts: Sequence[str]) -> Sequence[str]:
    """The share of the parts that `--brief` runs today."""
    day = date.today().toordinal()
    return parts[day % BRIEF_DAYS :: BRIEF_DAYS] or [parts[day % len(parts)]]


def module_of(name: str) -> ModuleType:
    """The module of that name, in whatever folder of benchmarks: names are there once."""
    (path,) = (ROOT / "benchmarks").rglob(f"{name}.py")
    return import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))


def run_parts(area: str, words: Sequence[str]) -> None:
    """Print the figures of the parts of an area that the words name; of all, where they name none.

    A part that does not end is told with its traceback, and the others go on; the process then ends with an error.
    """
    parts = AREAS[area]
    options = {word for word in words if word.startswith("--")}
    chosen = [word for word in words if word not in options]
    unknown = [name for name in chosen if name not in parts] + sorted(options - {*OPTIONS})
    if unknown:
        sys.exit(f"no part {', '.join(unknown)}; there are: {', '.join(parts)}, and {', '.join(OPTIONS)}")
    if "--quick" in options:
        os.environ[QUICK] = "1"
    find_benchmarks()
    broken = []
    for name in chosen or (of_today(list(parts)) if "--brief" in options else parts):
        print(f"\n# {name}: {parts[name]}", flush=True)
        began = time.monotonic()
        if not options & {"--quick", "--no-log"}:
            log_as(area, name)
        try:
            each(module_of(name).run)
        except Exception:
            traceback.print_exc(file=sys.stdout)
            broken.append(name)
        print(f"# {name}: {time.monotonic() - began:.0f} s", flush=True)
    broken += FAILED
    if broken:
        sys.exit(f"did not end: {', '.join(broken)}")


def find_benchmarks() -> None:
    """Processes that are started from now on find this package, and log nothing but what `log_as` asks for."""
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    os.environ.pop(COMMAND, None)


def peers() -> bool:
    """Whether other programs run side by side: not in the quick form, which makes no environments."""
    return not quick() and "--no-peers" not in sys.argv
