"""An unknown of a sensor by `kinefit.track`: the rope of `examples/07_own_sensor.py`, 0.8 m, begun at 1.0 ± 0.3 m."""

from __future__ import annotations

import sys
from importlib import import_module

import numpy as np

from benchmarks.figures import ROOT, figure
from kinefit import Recording, load_body, track
from kinefit.simulation import studio_rig

FIRST, DRAWS, FRAMES = 100, 20, 60


def run(*, quick: bool = False) -> None:
    """Figures of the length over draws from `FIRST` on; 1 px of noise in two cameras, the fixed root given as start."""
    sys.path.insert(0, str(ROOT / "examples"))
    example, arm, rig = import_module("07_own_sensor"), load_body("arm"), studio_rig(cameras=2)
    found = []
    for draw in range(FIRST, FIRST + (2 if quick else DRAWS)):
        states, steps = zip(*example.simulated(arm, rig, FRAMES, 1.0, np.random.default_rng(draw)))
        recording = Recording.of_frames(
            steps, rig, rate=example.RATE, sensors=(example.Rope(),), up="y", sigma=dict.fromkeys(rig.names, 1.0),
            start=(0, states[0]),
        )  # fmt: skip
        found.append(track(recording, arm, settings=example.SETTINGS, size=False).provenance["shape"]["rope length"])
    error, std = np.array(found).T - [[example.LENGTH], [0.0]]
    figure("own_unknown_error", 1000 * np.sqrt(np.mean(error**2)), "mm RMS of a rope's length", "<= 5")
    figure("own_unknown_inside", 100 * np.mean(np.abs(error) < 1.96 * std), "% within 95 % bars", ">= 90")
    figure("own_unknown_std", 1000 * std.mean(), "mm stated", "<= 5")
