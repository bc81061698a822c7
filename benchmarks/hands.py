"""Every figure of hands with fingers, and of heads: `python -m benchmarks.hands`; some parts: `... hands head_turn`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "hands_simulated": "random motions of fingers before four cameras, through the command; speed beside the humanoid",
    "hands_real": "a seated person with both hands before four cameras, each of them held out of the fit",
    "head_turn": "random turns of the head before four cameras and one, through the command; jaw and gaze before four",
}

if __name__ == "__main__":
    run_parts(PARTS)
