"""Every figure of takes of telephones: `python -m benchmarks.phones`; some parts: `... phones phones_time`."""

from __future__ import annotations

from benchmarks.figures import run_parts

PARTS = {
    "phones_time": "videos that dropped frames, and cameras of unequal rates",
    "phones_rooms": "simulated rooms of which nothing is known: cameras, clocks and motion from the people in view",
    "phones_speed": "from a folder with four videos of ten seconds to the report: time and memory",
    "phones_floor": "the floor under one walker, rooms and a balancing trial: tilt, height, feet that slide",
    "phones_real": "real recordings without their calibrations, from the videos to the motion",
}

if __name__ == "__main__":
    run_parts(PARTS)
