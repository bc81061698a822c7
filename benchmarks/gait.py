"""Figures of gait: `python -m benchmarks.gait`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "gait_events": "contacts, toe-offs and steps of laboratory files, against plates and their own events",
    "gait_record": "records of laboratory files by the command",
    "gait_movements": "jumps against force plates; squats and rises from a seat counted",
    "gait_mass": "centre of mass of laboratory files, against the double integral of plates' forces",
}

if __name__ == "__main__":
    run_parts(PARTS)
