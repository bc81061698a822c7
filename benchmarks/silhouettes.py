"""Every figure of silhouettes: `python -m benchmarks.silhouettes`; some parts: `... silhouettes silhouettes_track`."""

from __future__ import annotations

import sys
from importlib import import_module

PARTS = {
    "silhouettes_cga": "conformal geometric algebra",
    "silhouettes_morphing": "a morphing shoulder, rendered",
    "silhouettes_track": "the real trial by silhouettes alone",
    "silhouettes_anny": "the real trial on a realistic skin of the person's shape",
    "silhouettes_speed": "time a frame; the renderer beside others",
    "silhouettes_basin": "from how far off a pose is found, with and without coarse to fine",
    "silhouettes_car": "a car on a turntable",
    "silhouettes_arm": "a real arm in two views",
}


def main(chosen: list[str]) -> None:
    """Print the figures of the chosen parts; of all, where none is named."""
    unknown = [name for name in chosen if name not in PARTS]
    if unknown:
        sys.exit(f"no part {', '.join(unknown)}; there are: {', '.join(PARTS)}")
    for name in chosen or PARTS:
        print(f"\n# {name}: {PARTS[name]}", flush=True)
        import_module(f"benchmarks.{name}").run()


if __name__ == "__main__":
    main(sys.argv[1:])
