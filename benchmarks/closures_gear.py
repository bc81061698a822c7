"""Dimensions of gear that a take file leaves to be estimated: the distance and the angle of a snowboarder's boots.

The catalogue's snowboarder with `value = "estimate"`; boards of seeds 11 to 16 have other bindings, within the prior's
standard deviations. A detector's points are a centimetre from the body's, alike on both sides, which nothing in a take
tells from boots that are farther apart: hence the error, which the error bars hold.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.closures_takes import snowboarder
from benchmarks.figures import amount, figure
from kinefit.fitting.tracking.video import track

SEEDS = (11, 12, 13, 14, 15, 16)
STD = {"boot distance": 0.06, "boot angle": np.radians(10.0)}


def run() -> None:
    """Print the figures."""
    off, bar = {name: [] for name in STD}, {name: [] for name in STD}
    for seed in amount(SEEDS, SEEDS[:1]):
        random = np.random.default_rng(seed + 100)
        gear = {"boot distance": random.uniform(0.45, 0.58), "boot angle": np.radians(random.uniform(8.0, 30.0))}
        take = snowboarder(seed, gear=gear)
        generic = replace(
            take.generic, dimensions=tuple(replace(d, std=STD[d.name]) for d in take.generic.dimensions)
        )
        shape = track(take.recording, generic).provenance["shape"]
        for name, true in gear.items():
            value, std = shape[f"gear {name}"]
            off[name].append(value - true)
            bar[name].append(std)
    inside = []
    for name, scale, unit in (("boot distance", 1e3, "mm"), ("boot angle", 57.3, "deg")):
        errors, bars = scale * np.array(off[name]), scale * np.array(bar[name])
        inside += (np.abs(errors) <= 1.96 * bars).tolist()
        print(f"  {name}: mean error {np.abs(errors).mean():.1f} {unit}, mean error bar {bars.mean():.1f} {unit}")
        print(f"    errors {np.round(errors, 1).tolist()}, bars {np.round(bars, 1).tolist()}")
    share = 100.0 * float(np.mean(inside))
    figure(f"snowboarder: estimates of {len(inside)} dimensions within 95 % error bars", share, "%", ">= 90")
