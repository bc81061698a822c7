"""All areas one after the other, each in a process of its own: `python -m benchmarks [AREA ...] [--quick]`.

The exit code is 0 where every area ran to its end; figures that are missed or not measured do not change it.
"""

from __future__ import annotations

import subprocess
import sys
import time

from benchmarks import AREAS

LIMIT = 600.0
"""[s] for the quick form of an area; about a minute on two free cores."""


def main(words: list[str]) -> None:
    """Run the areas named, or all; the other words are options of each."""
    options = [word for word in words if word.startswith("--")]
    chosen = [word for word in words if word not in options]
    unknown = [name for name in chosen if name not in AREAS]
    if unknown:
        sys.exit(f"no area {', '.join(unknown)}; there are: {', '.join(AREAS)}")
    told = {name: run(name, options) for name in chosen or AREAS}
    print("\n" + "\n".join(f"# {name}: {text}" for name, text in told.items()))
    broken = [name for name, text in told.items() if not text.startswith("ended")]
    if broken:
        sys.exit(f"did not end: {', '.join(broken)}")


def run(area: str, options: list[str]) -> str:
    """How an area came out."""
    began = time.monotonic()
    print(f"\n## {area}", flush=True)
    limit = LIMIT if "--quick" in options else None
    try:
        code = subprocess.run([sys.executable, "-m", f"benchmarks.{area}", *options], timeout=limit).returncode
    except subprocess.TimeoutExpired:
        return f"not ended after {limit:.0f} s"
    spent = time.monotonic() - began
    return f"ended in {spent:.0f} s" if code == 0 else f"broke off with code {code} after {spent:.0f} s"


if __name__ == "__main__":
    main(sys.argv[1:])
