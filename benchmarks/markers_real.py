"""Who is who in real takes without labels: single frames and whole takes: `python -m benchmarks.markers_real`.

Labels are removed and the order is shuffled in every frame; what teaches is another take of the subject, or another
part of the take with a tenth of it between. Settings were chosen on the cases marked "chosen"; the figures are those of
the others, the table shows all.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import sys
import time
from dataclasses import dataclass

import numpy as np

from benchmarks.figures import figure
from benchmarks.marker_takes import CASES, Case, broken, load, shuffled, training, truth_of
from kinefit.identification.identify import identify
from kinefit.identification.learn import learn_model
from kinefit.identification.model import MarkerModel
from kinefit.observations import Markers

FRAMES = int(os.environ.get("FRAMES", 60))
VARIANTS = {"all": {}, "10 % removed": {"missing": 0.1}, "ten ghosts": {"ghosts": 10}}


@dataclass(frozen=True)
class Score:
    """Shares of the labels that were seen: right, wrong; of those not seen but named: counted as wrong."""

    right: float
    wrong: float
    median: float = np.nan
    slowest: float = np.nan


def prepare(case: Case) -> tuple[MarkerModel, Markers] | None:
    """The model of a case and its take; None where files are absent."""
    taught, take = training(case), load(case.test)
    return None if taught is None or take is None else (learn_model(taught), take)


def single_frames(
    model: MarkerModel, take: Markers, frames: int = FRAMES, seed: int = 0, *, missing: float = 0.0, ghosts: int = 0
) -> Score:
    """Frames one by one, spread over the take."""
    rng = np.random.default_rng(seed)
    right = wrong = seen = 0
    times = []
    whole = np.flatnonzero(np.isfinite(take.positions[..., 0]).sum(1) >= 0.5 * take.positions.shape[1])
    for f in whole[np.unique(np.linspace(0, len(whole) - 1, frames).round().astype(int))]:
        points, truth = shuffled(take, model.labels, int(f), rng, missing, ghosts)
        start = time.process_time()
        found = identify(model, points).assignment
        times.append(time.process_time() - start)
        right += int(((found == truth) & (truth >= 0)).sum())
        wrong += int(((found != truth) & (found >= 0)).sum())
        seen += int((truth >= 0).sum())
    return Score(right / seen, wrong / seen, float(np.median(times)), float(np.max(times)))


def main(names: list[str]) -> None:
    """A table of single frames."""
    for case in CASES:
        if names and not any(n in case.name for n in names):
            continue
        ready = prepare(case)
        if ready is None:
            print(case.name, "absent")
            continue
        model, take = ready
        line = f"{case.name:28s}{'*' if case.chosen else ' '} {len(model):3d} in {len(model.segments):2d}"
        for options in VARIANTS.values():
            s = single_frames(model, take, **options)
            line += f" | {100 * s.right:6.2f} {100 * s.wrong:5.2f} {1e3 * s.median:4.0f}/{1e3 * s.slowest:5.0f} ms"
        print(line, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
