"""Sample 14 of the DIC Challenge: displacement and strain against the truth, beside pyvale in the same run.

The images are stretched along x by a sinusoid of 0.1 px whose period shrinks along x. Systematic error: RMS over
columns of the mean along y less the truth; noise: RMS over columns of the standard deviation along y. Both programs
match the same grid of step 10 px from one seed, and are compared where both found a point. Time is the processor's,
one thread, of all from pixels to points, least of three. The strain's window is chosen on L1 and L5, its figures are
L3's.
"""

from __future__ import annotations

import json
import tempfile
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import LEFT_OUT, amount, figure, peers, quick, recording
from benchmarks.peers.environments import run_peer
from benchmarks.timing import fastest
from kinefit.images.photogrammetry.least_squares_matching import Grid, Matches, Seeds, grow
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.strain import Strain, strain

WINDOWS = (13, 21, 35)
STEP, EDGE = 10, 20  # [px] of the grid, and of its first windows' borders from the edges
SEED = [1006, 306]
STRAIN_WINDOWS, STRAIN_STEP = (21, 25, 29, 35), amount(5, 10)


class Sample:
    """The images as arrays, and the truth by column: displacement [px] and strain."""

    def __init__(self, folder: Path) -> None:
        self.files = {name: folder / f"Sample14 {name}.tif" for name in ("Reference",)}
        self.files |= {name: folder / f"Sample14 {name} Amp0.1b.tif" for name in ("L1", "L3", "L5")}
        self.images = {name: cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for name, file in self.files.items()}
        table = np.loadtxt(folder / "command.csv", delimiter=",")
        self.shift = {name: table[:, 1 + 2 * k] for k, name in enumerate(("L1", "L3", "L5"))}
        self.strain = {name: 1e-6 * table[:, 2 + 2 * k] for k, name in enumerate(("L1", "L3", "L5"))}

    def matched(self, name: str, window: int, step: int = STEP) -> tuple[Grid, Matches]:
        """The grid, matched from the pixels on."""
        first, second = SplineImage.of(self.images["Reference"]), SplineImage.of(self.images[name])
        grid = Grid.of(first.size, step, margin=EDGE + window // 2)
        return grid, grow(first, second, grid, Seeds.of([SEED], [SEED]), window=window)


def run() -> None:
    """Print every figure."""
    folder = recording("dic_challenge_14")
    sample = Sample(folder)
    _against_pyvale(sample)
    _strain(sample)


def _against_pyvale(sample: Sample) -> None:
    sample.matched("L3", 13)  # compiles
    with tempfile.TemporaryDirectory() as name:
        told, where = {"reason": LEFT_OUT if quick() else "--no-peers"}, Path(name)
        if peers():
            wanted = {
                "first": str(sample.files["Reference"]), "second": str(sample.files["L3"]), "windows": WINDOWS,
                "step": STEP, "edge": 15, "seed": SEED, "repeats": 3, "shape": sample.images["L3"].shape,
            }  # fmt: skip
            (where / "pair.json").write_text(json.dumps(wanted))
            told = run_peer("pyvale", where)
        for window in WINDOWS:
            (grid, matches), spent = fastest(partial(sample.matched, "L3", window), amount(3, 1))
            rate = matches.found.sum() / spent
            ours = _table(grid.points, matches.uv - grid.points)
            error = (matches.uv - grid.points)[:, 0] - sample.shift["L3"][grid.points[:, 0].astype(int)]
            inside = 100 * np.mean(np.abs(error / matches.std[:, 0])[matches.found] <= 1.96)
            figure(f"dic_intervals_{window}_low", inside, "% in 95 % intervals", ">= 93")
            figure(f"dic_intervals_{window}_high", inside, "% in 95 % intervals", "<= 97")
            goals = {"systematic": "<= 1.02", "noise": "<= 1.02", "times_faster": ">= 5"}
            if str(window) not in told:
                for what, goal in goals.items():
                    figure(f"dic_{what}_{window}_against_pyvale", None, "x", goal, str(told["reason"]))
                continue
            with np.load(where / f"pyvale_{window}.npz") as file:
                theirs = _table(file["points"], file["shift"])
            both = sorted(set(ours) & set(theirs))
            e1 = _errors({k: ours[k] for k in both}, sample.shift["L3"])
            e2 = _errors({k: theirs[k] for k in both}, sample.shift["L3"])
            peer_rate = told[str(window)]["points"] / told[str(window)]["seconds"]
            print(f"#   {len(both)} points: systematic {e1[0]:.4f} / {e2[0]:.4f}, noise {e1[1]:.4f} / {e2[1]:.4f} px, "
                  f"{rate:.0f} / {peer_rate:.0f} points/s (kinefit / pyvale {told['version']})")  # fmt: skip
            figure(f"dic_systematic_{window}_against_pyvale", e1[0] / e2[0], "x", goals["systematic"])
            figure(f"dic_noise_{window}_against_pyvale", e1[1] / e2[1], "x", goals["noise"])
            figure(f"dic_times_faster_{window}_than_pyvale", rate / peer_rate, "x", goals["times_faster"])


def _table(points: NDArray, shift: NDArray) -> dict[tuple[int, int], float]:
    good = np.isfinite(shift).all(axis=1)
    return {(round(u), round(v)): s for (u, v), s in zip(points[good], shift[good, 0])}


def _errors(table: dict[tuple[int, int], float], truth: NDArray) -> tuple[float, float]:
    """Systematic error and noise [px]."""
    at, shift = np.array(list(table)), np.array(list(table.values()))
    off = shift - truth[at[:, 0]]
    columns = [off[at[:, 0] == u] for u in np.unique(at[:, 0])]
    systematic = np.sqrt(np.mean([column.mean() ** 2 for column in columns]))
    return float(systematic), float(np.sqrt(np.mean([column.var() for column in columns])))


def _strain(sample: Sample) -> None:
    for gauge, goal in ((250, "<= 1200e-6"), (80, "<= 300e-6")):
        tried = {}
        for window in amount(STRAIN_WINDOWS, STRAIN_WINDOWS[:1]):
            tried[window] = np.hypot(*(_strain_error(sample, name, window, gauge)[0] for name in ("L1", "L5")))
        window = min(tried, key=lambda w: tried[w])
        error, alone = _strain_error(sample, "L3", window, gauge)
        print(f"# strain over {gauge + 1} px, window {window} (of {list(tried)}, by L1 and L5), step {STRAIN_STEP}: "
              f"linear fit of the truth alone {1e6 * alone:.0f}e-6")  # fmt: skip
        figure(f"dic_strain_L3_gauge_{gauge + 1}", 1e6 * error, "microstrain RMS", goal.replace("e-6", ""))
    shares = []
    for name in ("L1", "L3", "L5"):
        _, flat = strained(sample, name, 21, 80)
        z = [getattr(flat, n) / getattr(flat, f"std_{n}") for n in ("yy", "xy")]  # no strain in these directions
        shares += [100 * float(np.mean(np.abs(one[np.isfinite(one)]) <= 1.96)) for one in z]
    print("#   yy and xy of L1, L3, L5, window 21: " + ", ".join(f"{s:.1f}" for s in shares) + " % within 1.96 std")
    figure("dic_strain_inside_least", min(shares), "% within 1.96 std, directions without strain", ">= 90")
    figure("dic_strain_inside_most", max(shares), "% within 1.96 std, directions without strain", "<= 98")


def strained(sample: Sample, name: str, window: int, gauge: int) -> tuple[Grid, Strain]:
    """Grid and strain of an image."""
    grid, matches = sample.matched(name, window, STRAIN_STEP)
    shift = matches.uv - grid.points
    return grid, strain(grid.points, shift, grid.columns, gauge=gauge, window=window, unit="px")


def _strain_error(sample: Sample, name: str, window: int, gauge: int) -> tuple[float, float]:
    """RMS error, and that of a linear fit of the truth: whole gauges only."""
    grid, found = strained(sample, name, window, gauge)
    half = gauge // 2 + EDGE + window // 2
    u, v = grid.points.T
    whole = (u >= half) & (u < 2048 - half) & (v >= half) & (v < 589 - half) & np.isfinite(found.xx)
    at, along = u[whole].astype(int), np.arange(-(gauge // 2), gauge // 2 + 1, STRAIN_STEP)
    mean = (sample.shift[name][at[:, None] + along] @ along) / (along @ along)
    measured, truth = found.gradient[whole, 0, 0], sample.strain[name][at]
    return float(np.sqrt(np.mean((measured - truth) ** 2))), float(np.sqrt(np.mean((mean - truth) ** 2)))
