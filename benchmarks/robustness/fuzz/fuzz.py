"""Damaged files for every reader: how many crash it, keep it busy, or take its memory.

A reader answers a file with a `KinefitError` or with a result. Each reads copies of a small valid file, damaged by
`fuzz_mutations`, in a process of its own whose memory is limited; the same copies in every run. `KINEFIT_FUZZ` sets how
many, `KINEFIT_FUZZ_READERS` (names, by commas) for which readers. What goes wrong is told with the number of the copy.
"""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
from collections import Counter

from benchmarks.figures import amount, figure
from benchmarks.robustness.fuzz.fuzz_readers import READERS

SLOW, MEMORY = 5.0, 500
"""[s] of the processor and [MB] that a file may take."""
WHOLE = 10_000
"""Damaged files of every reader in a whole run, whose figures are logged."""
_PATIENCE = 60.0  # [s] after which a process is stopped: of the clock, other programs may run
_START = 600.0  # [s] for imports, kernels and the seed, which are no damaged file
_TOLD = 8  # faults of a reader that are printed


def run() -> None:
    """Print the counts over all readers."""
    count = int(os.environ.get("KINEFIT_FUZZ") or amount(WHOLE, 8))
    chosen = os.environ.get("KINEFIT_FUZZ_READERS")
    totals: Counter[str] = Counter()
    names = [name.strip() for name in chosen.split(",")] if chosen else list(READERS)[:: amount(1, 5)]
    if unknown := set(names) - set(READERS):
        raise SystemExit(f"no reader {', '.join(sorted(unknown))}; there are: {', '.join(READERS)}")
    for name in names:
        found = fuzz(name, count)
        totals += found
        told = ", ".join(f"{kind} {found[kind]}" for kind in ("read", "typed", *FAULTS) if found[kind])
        print(f"# {name}: {told}", flush=True)
    whole = not chosen and count >= WHOLE
    figure("damaged files", totals.total(), "files", ">= 1", whole=whole)
    for kind, text in FAULTS.items():
        figure(text, totals[kind], "files", "== 0", whole=whole)


FAULTS = {
    "untyped": "damaged files with an untyped error",
    "crash": "damaged files that end the process",
    "slow": f"damaged files that take more than {SLOW:.0f} s",
    "memory": f"damaged files that take more than {MEMORY} MB",
    "long": "damaged files with a message of more than 600 characters",
}
"""Kinds of faults, and the names of their figures."""


def fuzz(name: str, count: int) -> Counter[str]:
    """How `count` damaged files of one reader came out: "read", "typed" or one of `FAULTS`."""
    found: Counter[str] = Counter()
    first = 0
    while first < count:
        first = _some(name, first, count - first, found)
    return found


def _some(name: str, first: int, count: int, found: Counter[str]) -> int:
    """Read files in one process until it is done, ends or is stopped; the number of the next file."""
    words = [sys.executable, "-m", "benchmarks.robustness.fuzz.fuzz_worker", name, *map(str, (first, count, MEMORY))]
    worker = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace",
        env=os.environ | {"MALLOC_ARENA_MAX": "1"},  # threads of FFmpeg would reserve memory that they never use
    )  # fmt: skip
    lines: queue.Queue[str | None] = queue.Queue()
    errors: list[str] = []
    threads = [
        threading.Thread(target=_pass_on, args=(worker, lines), daemon=True),
        threading.Thread(target=lambda: errors.extend(worker.stderr or ()), daemon=True),
    ]
    for thread in threads:
        thread.start()
    at, patience = -1, _START
    try:
        while True:
            try:
                line = lines.get(timeout=patience)
            except queue.Empty:
                if at < 0:
                    raise RuntimeError(f"{name}: no file was begun within {patience:.0f} s") from None
                _count(found, "slow", name, at, f"stopped after {patience:.0f} s")
                return at + 1
            if line is None:
                break
            words = line.rstrip("\n").split(" ", 4)
            if not line.endswith("\n") or len(words) < 2:  # the process ended within a line
                continue
            if words[0] == "at":
                at, patience = int(words[1]), _PATIENCE
            else:
                number, kind, seconds, megabytes = int(words[0]), words[1], float(words[2]), float(words[3])
                kind = "slow" if seconds > SLOW else "memory" if megabytes > MEMORY else kind
                _count(found, kind, name, number, f"{seconds:.1f} s, {megabytes:.0f} MB {' '.join(words[4:])}")
                at, first = -1, number + 1
    finally:
        worker.kill()
        worker.wait()
        for thread in threads:
            thread.join()
        for stream in (worker.stdout, worker.stderr):
            stream.close()  # type: ignore[union-attr]
    if at >= 0:
        _count(found, "crash", name, at, " | ".join(line.strip() for line in errors[-6:]))
        return at + 1
    if worker.returncode and not found:
        raise RuntimeError(f"{name}: the seed cannot be read: {''.join(errors[-12:])}")
    return first


def _pass_on(worker: subprocess.Popen, lines: queue.Queue[str | None]) -> None:
    for line in worker.stdout or ():
        lines.put(line)
    lines.put(None)


def _count(found: Counter[str], kind: str, name: str, number: int, text: str) -> None:
    found[kind] += 1
    if kind in FAULTS and found[kind] <= _TOLD:
        print(f"#   {name} {number}: {kind} {text[:600]}", flush=True)
