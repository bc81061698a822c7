"""Every figure of video: `python -m benchmarks.video`; only some parts: `python -m benchmarks.video detect check`."""

from __future__ import annotations

import sys
from importlib import import_module

PARTS = {
    "tracking": "keypoints of the real trial and of known motions -> motion",
    "check": "what is wrong with a recording",
    "calibrate": "calibration refined with the body's motion, and found from people alone",
    "board": "calibration from boards",
    "detect": "the built-in detector",
    "smoothing": "whole takes at once",
    "error_bars": "truth within the error bars",
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
