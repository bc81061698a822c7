"""Every figure of markers: `python -m benchmarks.markers`; some parts: `python -m benchmarks.markers markers_fit`."""

from __future__ import annotations

import sys
from importlib import import_module

PARTS = {
    "markers_synthetic": "the paper's synthetic test, for its method and for `identify`",
    "markers_real": "who is who in real takes, frame by frame and whole",
    "markers_audit": "models of subjects, and labels that somebody else gave",
    "markers_fit": "bodies and angles beside Plug-in-Gait's and OpenSim's",
    "markers_speed": "time of large sets, and of a whole take from points to angles",
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
