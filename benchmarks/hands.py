"""Every figure of hands with fingers: `python -m benchmarks.hands`; some parts: `... hands hands_simulated`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "hands_simulated": "random motions of fingers before four cameras, through the command; speed beside the humanoid",
    "hands_real": "a seated person with both hands before four cameras, each of them held out of the fit",
}

if __name__ == "__main__":
    run_parts(PARTS)
