"""Who is who in real takes without labels: single frames and whole takes: `python -m benchmarks markers markers_real`.

Labels are removed and the order is shuffled in every frame; what teaches is another take of the subject, or another
part of the take with a tenth of it between. Settings were chosen on the cases marked "chosen"; the figures are those of
the others, the table shows all. Many were looked at while the search was made; four takes (a plus) were held back from
all choices, and have figures of their own. FRAMES frames a case (60).
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.scenes.marker_takes import CASES, HELD, Case, broken, counts, load, shares, shuffled, training
from benchmarks.timing import timed
from kinefit.errors import ObservationError
from kinefit.markers.frame.identify import identify
from kinefit.markers.model.learn import learn_model
from kinefit.markers.model.model import MarkerModel
from kinefit.markers.take.takes import identify_take
from kinefit.observations import Markers

FRAMES = int(os.environ.get("FRAMES", amount(60, 2)))
QUICK = tuple(case for case in CASES if case.name in ("run", "clusters 61"))
VARIANTS: dict[str, dict[str, Any]] = {"all": {}, "10 % removed": {"missing": 0.1}, "ten ghosts": {"ghosts": 10}}


@dataclass(frozen=True)
class Score:
    """Shares of the labels that were seen: right, wrong; of those not seen but named: counted as wrong.

    `names` (N, 3): of every guess its probability, whether it is right, and how many points its segment has.
    """

    right: float
    wrong: float
    median: float = np.nan
    slowest: float = np.nan
    names: NDArray | None = None


def prepare(case: Case) -> tuple[MarkerModel, Markers] | None:
    """The model of a case and its take; None where files are absent."""
    taught, take = training(case), load(case.test)
    return None if taught is None or take is None else (learn_model(taught), take)


def single_frames(
    model: MarkerModel, take: Markers, frames: int = FRAMES, seed: int = 0, *, missing: float = 0.0, ghosts: int = 0
) -> Score:
    """Frames one by one, spread over the take."""
    rng = np.random.default_rng(seed)
    counted, times, names = np.zeros(3, int), [], []
    whole = np.flatnonzero(np.isfinite(take.positions[..., 0]).sum(1) >= 0.5 * take.positions.shape[1])
    for f in whole[np.unique(np.linspace(0, len(whole) - 1, frames).round().astype(int))]:
        points, truth = shuffled(take, model.labels, int(f), rng, missing, ghosts)
        with timed(times):
            told = identify(model, points)
        found, guess = told.assignment, told.assignment if told.guess is None else told.guess
        held = [max(int((guess[list(s)] >= 0).sum()) for s in model.segments if m in s) for m in range(len(model))]
        names.append(np.stack([told.confidence, guess == truth, held], axis=1)[guess >= 0])
        counted += counts(found, truth)
    right, wrong, seen = counted.tolist()
    return Score(right / seen, wrong / seen, float(np.median(times)), float(np.max(times)), np.concatenate(names))


def whole_take(model: MarkerModel, take: Markers, seed: int = 0, **breaking: float) -> Score:
    """A take whose trajectories are broken; its time is that of one frame."""
    cut = broken(take, seed, **breaking)
    start = time.process_time()
    try:
        found = identify_take(model, cut.markers)
    except ObservationError as error:
        print(f"refused after {time.process_time() - start:.1f} s: {error.problem}")
        return Score(np.nan, np.nan)
    spent = (time.process_time() - start) / len(take)
    return Score(*shares(found.column, cut, take, model.labels), spent, spent)


def table(names: list[str]) -> dict[str, tuple[Case, dict[str, Score]]]:
    """Print and return all scores: right, wrong [%], median and slowest time of a frame [ms]."""
    out = {}
    print(f"{'':28s}  labels in segments | " + " | ".join([*VARIANTS, "whole take, broken"]))
    for case in (*amount(CASES, QUICK), *amount(HELD, ())):
        ready = prepare(case) if not names or any(n in case.name for n in names) else None
        if ready is None:
            continue
        model, take = ready
        whole = whole_take(model, take)
        asked = VARIANTS if np.isfinite(whole.right) else {}  # a take that is refused has no names
        scores = {name: single_frames(model, take, **VARIANTS[name]) if asked else whole for name in VARIANTS}
        scores["whole"] = whole
        sign = "*" if case.chosen else "+" if case.held else " "
        line = f"{case.name:28s}{sign} {len(model):3d} in {len(model.segments):2d}"
        for s in scores.values():
            line += f" | {100 * s.right:6.2f} {100 * s.wrong:5.2f} {1e3 * s.median:4.0f}/{1e3 * s.slowest:5.0f}"
        print(line, flush=True)
        out[case.name] = case, scores
    return out


def run(names: list[str] | None = None) -> None:
    """Print every figure of real takes; settings were chosen on the cases with a star, which do not count."""
    found = table(names or [])
    told([row for row in found.values() if row[0].full and not row[0].chosen and not row[0].held], "markers_real")
    told([row for row in found.values() if row[0].held], "markers_held")
    calibration([s for case, s in found.values() if not case.chosen])
    large = [s["all"].slowest for case, s in found.values() if case.name == "clusters 61"]
    reason = "" if large else "no recordings"
    figure("markers_real_clusters61", 1e3 * large[0] if large else None, "ms a frame, slowest", "<= 200", reason)


def calibration(rows: list[dict[str, Score]]) -> None:
    """How many names given at about 0.9 are right, in single frames of all kinds; and in segments of two points."""
    kept = [s[kind].names for s in rows for kind in VARIANTS]
    names = np.concatenate([n for n in kept if n is not None] or [np.empty((0, 3))])
    near = names[(names[:, 0] >= 0.85) & (names[:, 0] < 0.95)]
    value = 100 * float(near[:, 1].mean()) if len(near) else None
    figure("markers_real_calibration", value, f"% right of {len(near)} names given at 0.9", ">= 90", "no such names")
    two = near[near[:, 2] <= 2]
    value = 100 * float(two[:, 1].mean()) if len(two) else None
    figure("markers_real_calibration_two_points", value, f"% right of {len(two)}", ">= 90", "no such names")


def told(rows: list[tuple[Case, dict[str, Score]]], area: str) -> None:
    """The figures of some cases."""
    reason = "" if rows else "no recordings"

    def least(kind: str) -> float | None:
        return min((100 * s[kind].right for _, s in rows if np.isfinite(s[kind].right)), default=None)

    def most_wrong(kind: str) -> float | None:
        return max((100 * s[kind].wrong for _, s in rows if np.isfinite(s[kind].wrong)), default=None)

    moved = [100 * s["all"].right for case, s in rows if case.exercised]
    mean = float(np.nanmean(moved)) if moved else None
    figure(f"{area}_single_least", least("all"), "% right", ">= 98.5", reason)
    figure(f"{area}_single_mean", mean, "% right", ">= 99.5", reason)
    figure(f"{area}_single_wrong", most_wrong("all"), "%", "<= 0.2", reason)
    figure(f"{area}_removed_least", least("10 % removed"), "% right", ">= 97", reason)
    figure(f"{area}_ghosts_least", least("ten ghosts"), "% right", ">= 98", reason)
    figure(f"{area}_whole_least", least("whole"), "% right", ">= 99.9", reason)
    figure(f"{area}_whole_wrong", most_wrong("whole"), "%", "<= 0.2", reason)
    slowest = max((s[kind].slowest for _, s in rows for kind in VARIANTS if np.isfinite(s[kind].slowest)), default=None)
    figure(f"{area}_slowest", slowest, "s a frame", "<= 1", reason)
