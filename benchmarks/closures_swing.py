"""A real golf swing by markers: how far down the club the hands hold it, and how, estimated in the take (P3 5).

c3d.org's sample 13: 514 frames at 107.5 Hz, 29 channels, of a golfer of the right hand. Six markers are on the club,
three of them sampled four times a frame, one twice; the first sample of each is used, and 13 markers on the person.
The world's x is up. The device low-passes: at impact all lengths of the club are 17 % short, until 1.6 % away from it
in the backswing. So the take is its address, backswing and turn at the top: the first 300 frames, every second.

Nobody measured this club. Priors 10 cm shorter and longer show whether the data decide.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figures import amount, data, figure
from kinefit.bodies.motion import Motion
from kinefit.exporters.c3d_file import write_markers
from kinefit.readers.markers import read_markers
from kinefit.takes.track import track_take

FILE = "markers/btkdata/Input__C3DSamples__c3d.org__sample13__golfswing.c3d"
HERE = Path(__file__).parent / "golf_swing"
FRAMES = slice(0, 300)
PRIORS = {  # [m, rad] standard deviations of body.toml
    "club length": 0.10, "hand distance": 0.03, "shaft angle": np.radians(15.0), "shaft sideways": np.radians(15.0),
    "face angle": np.radians(25.0),
}  # fmt: skip
OBSERVED = "club length", "hand distance"  # the shaft's angles in the hand look like a bent wrist
_OTHER_MEANS = 0.80, 1.00  # [m] of the club's length


def run() -> None:
    """Print the figures."""
    if (file := data(FILE)) is None:
        figure("golf swing: club length, standard deviation over its prior's", None, "of it", "<= 0.7", f"no {FILE}")
        return
    step = amount(2, 8)
    with tempfile.TemporaryDirectory() as folder:
        motion = swing(file, Path(folder), step)
        found = gear_of(motion)
        for name, (value, std) in found.items():
            scale, unit = (1e3, "mm") if PRIORS[name] < 0.2 else (180.0 / np.pi, "deg")
            print(f"  {name}: {scale * value:.0f} ± {scale * std:.0f} {unit} (prior ± {scale * PRIORS[name]:.0f})")
        for name in PRIORS:
            share = found[name][1] / PRIORS[name]
            goal = "<= 0.7" if name in OBSERVED else "<= 1"
            figure(f"golf swing: {name}, standard deviation over its prior's", share, "of it", goal)
        figure("golf swing: markers, RMS residual", 1e3 * motion.provenance["markers"]["rms_m"], "mm", "<= 12")
        others = [gear_of(swing(file, Path(folder), 2 * step, mean=m))["club length"] for m in amount(_OTHER_MEANS, ())]
        if others:
            told = ", ".join(f"{1e3 * v:.0f} ± {1e3 * s:.0f} mm" for v, s in others)
            print(f"  club length by priors 10 cm off: {told}")
            apart = 1e3 * float(np.ptp([v for v, _ in others]))
            figure("golf swing: club length, by priors 20 cm apart", apart, "mm apart", "<= 30")


def swing(file: Path, folder: Path, step: int, mean: float | None = None) -> Motion:
    """The take tracked as `kinefit track` does, every so many frames, with another prior mean [m] of the length."""
    whole, known = read_markers(file), (HERE / "markers.toml").read_text()
    here = [k for k, name in enumerate(whole.names) if f"{name} =" in known]
    seen = replace(
        whole, positions=whole.positions[FRAMES][::step, here], names=tuple(whole.names[k] for k in here),
        residual=None, rate=whole.rate / step,
    )  # fmt: skip
    write_markers(seen, folder / "swing.c3d")
    body = (HERE / "body.toml").read_text()
    if mean is not None:
        body = body.replace("\nmean = 0.90\n", f"\nmean = {mean}\n")
    (folder / "body.toml").write_text(body)
    (folder / "markers.toml").write_text(known)
    take = folder / "take.toml"
    take.write_text('[take]\nup = "x"\nbody = "body.toml"\n[[markers]]\nfile = "swing.c3d"\nset = "markers.toml"\n')
    return track_take(take)[0]


def gear_of(motion: Motion) -> Mapping[str, tuple[float, float]]:
    """{dimension: (estimate, standard deviation)} [m, rad]."""
    return {name: tuple(motion.provenance["shape"][f"gear {name}"]) for name in PRIORS}
