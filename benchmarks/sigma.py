"""Ranges of motion against truth, and how wide their error bars are: `python -m benchmarks.sigma`.

Simulated takes of `benchmarks.setups` (people, motions, detector and calibration errors as told there), through
`kinefit.track_take` with the defaults. Draws from `FIRST` on serve nothing else.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figures import LEFT_OUT, amount, figure, run_parts
from benchmarks.mixed_runs import MIXES
from benchmarks.mixed_takes import record, take_text, write
from benchmarks.setups import around
from kinefit import Motion, track_take
from kinefit.evaluation import angle_errors
from kinefit.exporters.report.angles import ranges_of

PARTS = {
    "sigma": "ranges of motion of five joints, from two and four cameras and from markers",
    "sigma_changes": "changes of ranges between two takes of one person, from the same set-ups",
}
FIRST, DRAWS, FRAMES = 9000, 40, 90
JOINTS = {"hip": "hip_flexion", "knee": "knee_angle", "ankle": "ankle_angle", "shoulder": "arm_flex",
          "elbow": "elbow_flex"}  # fmt: skip
SETUPS = ("2 cameras", "4 cameras", "markers")


def of_draw(draw: int) -> dict[str, list[tuple[str, float, float, float]]]:
    """{set-up: joint, error of the range, its standard deviation, that of independent ends [deg]} of one draw."""
    recording, out = record(draw, amount(FRAMES, 20), depth=False), {}
    with tempfile.TemporaryDirectory() as folder:
        write(recording, Path(folder))
        for setup in amount(SETUPS, SETUPS[:1]):
            count = setup.partition(" ")[0]
            text = (
                around(recording, Path(folder), int(count), draw) if count.isdigit()
                else take_text(Path(folder), MIXES["markers_alone"])
            )  # fmt: skip
            path = Path(folder) / f"{setup.replace(' ', '_')}.toml"
            path.write_text(text)
            out[setup] = errors(recording.truth, track_take(path)[0])
    return out


def errors(truth: Motion, motion: Motion) -> list[tuple[str, float, float, float]]:
    """Joint, error [deg] of its range between the frames of the motion's ends, σ [deg] and σ of independent ends."""
    found, alone, out = ranges_of(motion), ranges_of(replace(motion, lasting=None)), []
    away = angle_errors(truth, motion)
    for joint, stem in JOINTS.items():
        for side, one in found.get(stem, {}).items():
            if one is not None:
                low, high = one.ends
                off = np.subtract(*away[[high, low], one.terms[1] - 6])
                out.append((joint, off, one.span[1] / 2, alone[stem][side].span[1] / 2))
    return out


def run() -> None:
    """Print coverage and width for every set-up and joint."""
    draws = [of_draw(draw) for draw in range(FIRST, FIRST + amount(DRAWS, 1))]
    for setup in SETUPS:
        found = [one for draw in draws for one in draw.get(setup, ())]
        tag, wide = setup.replace(" ", "_"), []
        for joint in JOINTS:
            off, std, alone = (np.array([one[k] for one in found if one[0] == joint]) for k in (1, 2, 3))
            if len(off):
                rms, inside = np.sqrt(np.mean(off**2)), 100 * np.mean(np.abs(off) <= 1.96 * std)
                print(f"# {setup}, {joint}: off by {rms:.1f}, bars {np.mean(std):.1f} deg (independent ends "
                      f"{np.mean(alone):.1f}), inside {inside:.0f} %, {len(off)} ranges", flush=True)  # fmt: skip
                wide.append(float(np.mean(std) / rms))
        off, std = (np.array([one[k] for one in found]) for k in (1, 2))
        inside = 100 * float(np.mean(np.abs(off) <= 1.96 * std)) if len(off) else None
        figure(f"sigma_ranges_{tag}_inside_least", inside, "% in 95 % bars", ">= 90", LEFT_OUT)
        figure(f"sigma_ranges_{tag}_inside_most", inside, "% in 95 % bars", "<= 98", LEFT_OUT)
        figure(f"sigma_ranges_{tag}_width", max(wide, default=None), "mean sigma over RMS error", "<= 1.5", LEFT_OUT)


if __name__ == "__main__":
    run_parts(PARTS)
