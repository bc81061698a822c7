"""From how far off a pose is found by silhouettes: with and without coarse to fine, and by levels of Fourier series.

Each trial begins with every joint off by the same angle, this way or that, from a random posture that four cameras see
rendered. It counts as a success where landmarks end within four centimetres of the truth on average.
"""

from __future__ import annotations

import os

import numpy as np

from benchmarks.figures import ROOT, amount, figure, quick
from benchmarks.scenes.curves import COLOURS, curves
from benchmarks.scenes.silhouettes_scene import ring, standing
from kinefit.bodies import load_body
from kinefit.bodies.rendering import render_body
from kinefit.fitting.initialization.candidates import LEVELS, coarse_to_fine
from kinefit.observations import SilhouetteFrame

OFF = amount((0, 5, 10, 15, 20, 25, 30, 35, 40), (0, 10, 20, 30))  # [deg]
TRIALS = int(os.environ.get("KINEFIT_TRIALS", amount("12", "1")))
WITHIN = 0.04  # [m]
PICTURE = ROOT / "docs" / "images" / "silhouettes_basin.svg"


def run() -> None:
    """Print the shares of success and draw their curve."""
    body, rig = load_body("humanoid10"), ring(4, size=(320, 240), focal=262.0)
    spread = np.minimum(np.where(np.isfinite(body.tree.spread), body.tree.spread, 0.5), 0.6)
    accuracy = {f"silhouette {name}": 1.0 for name in rig.names}
    kinds = {"finest level alone": LEVELS[-1:], "coarse to fine": LEVELS}
    share = {kind: np.zeros(len(OFF)) for kind in kinds}
    for k, off in enumerate(OFF):
        rng = np.random.default_rng(k)
        for _ in range(TRIALS):
            usual = body.tree.usual
            truth = standing(body, usual + 0.4 * spread * rng.normal(size=len(usual)))
            seen = [SilhouetteFrame(c.name, 0.0, render_body(body, truth, c).seen) for c in rig]
            start = standing(body, truth.angles + np.radians(off) * rng.choice([-1, 1], len(usual)))
            for kind, levels in kinds.items():
                found = coarse_to_fine(body, rig, seen, start, sigma=accuracy, levels=levels).result.state
                away = body.positions(found, body.landmarks) - body.positions(truth, body.landmarks)
                share[kind][k] += (np.linalg.norm(away, axis=1).mean() < WITHIN) / TRIALS
        print(f"# {off:2d} degrees off: " + ", ".join(f"{kind} {100 * s[k]:.0f} %" for kind, s in share.items()))
    alone, both = share.values()
    added = 100 * float((both - alone)[np.array(OFF) >= 20].mean())
    figure("basin: successes that coarse to fine adds from 20 to 40 degrees", added, "%", ">= 15")
    if quick():
        return
    lines = [(OFF, 100 * s, colour, "") for s, colour in zip(share.values(), COLOURS)]
    legend = dict(zip(share, COLOURS))
    curves(PICTURE, [(f"{TRIALS} postures at each angle", lines)], x="every joint off by [deg]", y="found [%]",
           legend=legend)  # fmt: skip
    print(f"# drawn: {PICTURE}")
