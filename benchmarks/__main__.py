"""`python -m benchmarks AREA [PART ...] [--quick [--brief]]` runs one area or some of its parts.

Without an area, or with several, each runs in a process of its own, one after the other.
In the quick form, which is no measure of speed, two at a time; what each prints is shown when it has ended. With
`--brief`, too, each area runs a fifth of its parts, another fifth each day. The exit code is 0 where every area ran to
its end; figures that are missed or not measured do not change it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

from benchmarks.areas import AREAS
from benchmarks.figures import module_of, run_parts

LIMIT = 600.0
"""[s] for the quick form of an area; about a minute on two free cores."""

SIDE_BY_SIDE = 2
"""Areas that run at a time in the quick form."""


def main(words: list[str]) -> None:
    """Run some parts of one area in this process, or several areas; the other words are options of each."""
    options = [word for word in words if word.startswith("--")]
    chosen = [word for word in words if word not in options]
    if words and not AREAS.get(words[0], "parts"):
        module_of(words[0]).main(words[1:])
    elif chosen and chosen[0] in AREAS and not (len(chosen) > 1 and AREAS.keys() >= {*chosen}):
        run_parts(chosen[0], [*chosen[1:], *options])
    else:
        run_areas(chosen, options)


def run_areas(chosen: list[str], options: list[str]) -> None:
    """Run areas, each in a process of its own; all where none is named."""
    unknown = [name for name in chosen if name not in AREAS]
    if unknown:
        sys.exit(f"no area {', '.join(unknown)}; there are: {', '.join(AREAS)}")
    areas = chosen or list(AREAS)
    with ThreadPoolExecutor(SIDE_BY_SIDE if "--quick" in options else 1) as pool:
        told = dict(zip(areas, pool.map(lambda name: run(name, options), areas)))
    print("\n" + "\n".join(f"# {name}: {text}" for name, text in told.items()))
    broken = [name for name, text in told.items() if not text.startswith("ended")]
    if broken:
        sys.exit(f"did not end: {', '.join(broken)}")


def run(area: str, options: list[str]) -> str:
    """How an area came out."""
    began, quick = time.monotonic(), "--quick" in options
    command, limit = [sys.executable, "-m", "benchmarks", area, *options], LIMIT if quick else None
    if not quick:
        print(f"\n## {area}", flush=True)
    kept = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT} if quick else {}
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1"} if quick else None  # each area has a core
    try:
        done = subprocess.run(command, timeout=limit, env=env, **kept)
    except subprocess.TimeoutExpired as late:
        _show(area, late.stdout)
        return f"not ended after {limit:.0f} s"
    _show(area, done.stdout)
    code, spent = done.returncode, time.monotonic() - began
    return f"ended in {spent:.0f} s" if code == 0 else f"broke off with code {code} after {spent:.0f} s"


def _show(area: str, printed: bytes | None) -> None:
    """What an area printed, in one piece."""
    if printed is not None:
        print(f"\n## {area}\n{printed.decode(errors='replace')}", end="", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
