"""The experiment of P2 (Knoop, Vacek, Dillmann 2006) on simulated sequences, graded by the truth.

    python -m benchmarks.depth_voodoo

A hundred sequences: ten movements by ten people of 1.50 to 2.00 m, a time-of-flight camera at 10 Hz and the face and
hands in a colour camera. The method as printed, and the fusion tracker, each with depth alone, the features alone, and
both. Published: 5 lost, 32 acceptable, 63 good, mean 1.58, graded by eye. The Kinect-like sensor: twenty sequences.
"""

from __future__ import annotations

import time

from benchmarks.figures import amount, figure
from kinefit.evaluation.sequences import sequences
from kinefit.evaluation.voodoo import METHODS, conclusions, evaluate
from kinefit.simulation.sensors import KINECT

KINECT_COUNT = amount(20, 1)  # each movement and each person twice: images of 640 x 480 take long to simulate


def run() -> None:
    """Print the figures."""
    runs = list(sequences(amount(100, 1)))
    for name, method in METHODS.items():
        began = time.process_time()
        found = evaluate(runs, method)
        spent = (time.process_time() - began) / 60.0
        for inputs, summary in found.items():
            lost, some, good = summary.counts
            print(f"{name} {inputs}: {lost} lost, {some} acceptable, {good} good, mean {summary.mean_grade:.2f}, "
                  f"joints {1e3 * summary.error:.0f} mm")  # fmt: skip
        both, holds = found["fusion"], conclusions(found)
        for text, true in holds.items():
            print(f"{name}: {text}: {'yes' if true else 'no'}")
        published = name == "voodoo"  # its own figures are the goal of the method as printed
        figure(f"{name}_lost", both.counts[0], "of the sequences", "<= 5" if published else "== 0")
        figure(f"{name}_grade", both.mean_grade, "of 2", ">= 1.58" if published else ">= 1.95")
        figure(f"{name}_conclusions", float(sum(holds.values())), "of 3", "== 3")
        figure(f"{name}_minutes", spent, "min CPU for all three choices of sensors", "<= 10")
        if not published:
            figure("fusion_tof_mm", 1e3 * both.error, "mm, mean of all joints", "<= 25")
    near = evaluate(sequences(KINECT_COUNT, sensor=KINECT), METHODS["fusion"], inputs=("fusion",))["fusion"]
    figure("fusion_kinect_mm", 1e3 * near.error, "mm, mean of all joints", "<= 12")


if __name__ == "__main__":
    run()
