"""Figures of simulated takes for `mixed`: each sensor helps, error bars hold, smoothing helps.

All compare like with like: the same draws, frames and joints. A mix that failed in some draws is told with their number
and the first reason, and is not measured: what is left would not be the same draws.

Each sensor helps: over joints and frames with a finite sigma in both takes, the mean distance from the truth (and the
mean of sigma) with the sensor is divided by that without; both are means of draws. What is printed is the upper end of
the one-sided 95 % interval of this ratio, from 2000 bootstrap samples of the draws: at or below 1.02, a rise by more
than 2 % is refuted.

Error bars: shares of |estimate - truth| <= 1.96 sigma over what has a finite sigma; per cell (mix, condition, group of
joints, joints or angles) and pooled over all cells of a group. Cells with fewer than 200 values are left out. With
`--each K` every draw has K of the runs alone, in turn: as many draws in a fraction of the time; intervals are by draw.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.mixed.mixed_runs import CONDITIONS, MIXES, Outcome, Run, Told
from benchmarks.figures import figure
from kinefit import load_body

PAIRS = (
    ("cameras", "cameras_silhouettes"), ("cameras", "cameras_depth"), ("cameras", "cameras_markers"),
    ("cameras_silhouettes", "all"), ("cameras_depth", "all"), ("cameras_markers", "all"),
)  # fmt: skip
ALONE = ("markers_alone", "markers_sparse", "silhouettes_alone")
QUICK = ("cameras", "markers_alone")  # mixes of which a take needs a second
SAMPLES, FEWEST, SIGMAS = 2000, 200, 1.96
NOISE = 0.3  # [m/s²] that no smoothing need improve


def sensors(told: Told) -> None:
    """Print what each sensor adds."""
    for less, more in PAIRS:
        a, b, reason = _both(told, (less, "smoothed"), (more, "smoothed"))
        for what, value_of in (("error", lambda o: o.distance), ("sigma", lambda o: o.sigma.mean(axis=-1))):
            pairs = np.array([_means(x, y, value_of) for x, y in zip(a, b)]).reshape(-1, 2)
            low, ratio, high = _interval(lambda rows: rows[:, 1].mean() / rows[:, 0].mean(), pairs)
            if len(pairs):
                means = 1e3 * pairs.mean(axis=0)
                print(
                    f"# {less} {means[0]:.1f} mm, {more} {means[1]:.1f} mm: ratio {ratio:.3f} ({low:.3f} to {high:.3f})"
                )
            figure(f"sensor_{what}_{less}_to_{more}", high if len(pairs) else None, "x", "<= 1.02", reason)
    outcomes, reason = _of(told, ("all", "smoothed"))
    distance = [1e3 * o.distance.mean() for o in outcomes]
    sure = [_mean(np.degrees(np.abs(o.turn[o.turn_sigma < np.radians(10.0)]))) for o in outcomes]
    figure("all_joints", _mean(distance), "mm", "<= 8", reason)
    figure("all_sure_angles", _mean(sure), "deg", "<= 2", reason)


def intervals(told: Told) -> None:
    """Print how often the truth lies inside the stated 95 % interval."""
    cells: dict[tuple[str, str], dict[Run, NDArray]] = {}  # (group, what): run: (draws, 2) inside, all
    missing = [run for run in told if _of(told, run)[1]]
    for run in told:
        for key, counts in _counts(told[run] if _of(told, run)[0] else []).items():
            cells.setdefault(key, {})[run] = counts
    share = lambda rows: rows[:, 0].sum() / max(rows[:, 1].sum(), 1.0)
    whole = f"{len(missing)} runs failed, first {' '.join(missing[0])}: {_of(told, missing[0])[1]}" if missing else ""
    for what in ("joints", "angles"):
        for (group, kind), runs in cells.items():
            if kind == what and runs:
                low, value, high = _interval(share, _added(runs.values()), sides=2)
                print(f"# {group} {what}: {100 * value:.1f} % ({100 * low:.1f} to {100 * high:.1f})")
                figure(f"inside_{what}_{group}_least", 100 * value, "%", ">= 90", whole)
                figure(f"inside_{what}_{group}_most", 100 * value, "%", "<= 98", whole)
        single = [
            100 * share(counts) for (_, kind), runs in cells.items() if kind == what
            for counts in runs.values() if counts[:, 1].sum() >= FEWEST
        ]  # fmt: skip
        figure(f"inside_{what}_lowest_cell", min(single, default=None), "%", ">= 85", whole)
        figure(f"inside_{what}_highest_cell", max(single, default=None), "%", "<= 99.5", whole)
    figure("runs_that_failed", float(len(missing)), "runs", "== 0")
    if missing:
        print(f"# {whole}")


def alone(told: Told) -> None:
    """Print how often the truth lies inside the stated 95 % interval of takes of one kind of sensor, by group."""
    for mix, draws in ((mix, told[mix, "smoothed"]) for mix in ALONE if (mix, "smoothed") in told):
        outcomes, reason = _of(told, (mix, "smoothed"))
        shares: dict[str, list[float]] = {"joints": [], "angles": []}
        for (group, what), counts in _counts(draws if outcomes else []).items():
            low, value, high = _interval(lambda rows: rows[:, 0].sum() / max(rows[:, 1].sum(), 1.0), counts, sides=2)
            print(f"# {mix} {group} {what}: {100 * value:.1f} % ({100 * low:.1f} to {100 * high:.1f})")
            shares[what].append(100 * value)
        print(f"# {mix}: {len(outcomes)} draws", flush=True)
        for what, values in shares.items():
            name = f"{mix}_{what}_inside"
            figure(f"{name}_lowest_group", min(values, default=None), "%", ">= 90", reason)
            figure(f"{name}_highest_group", max(values, default=None), "%", "<= 98", reason)


def smoothing(told: Told) -> None:
    """Print what the whole take's smoothing changes."""
    for mix in MIXES:
        one, each, reason = _both(told, (mix, "smoothed"), (mix, "frames"))
        noise = [_mean([o.noise for o in several]) for several in (one, each)]
        error = [_mean([o.distance.mean() for o in several]) for several in (one, each)]
        if one:
            print(f"# {mix}: above 10 Hz {noise[0]:.2f} m/s² smoothed, {noise[1]:.2f} frame by frame; "
                  f"{1e3 * error[0]:.1f} and {1e3 * error[1]:.1f} mm")  # fmt: skip
        worth = min(3.0 * noise[0] / noise[1], noise[0] / NOISE) if one else None
        figure(f"smoothing_noise_{mix}", worth, "of what is allowed", "<= 1", reason)
        figure(f"smoothing_error_{mix}", error[0] / error[1] if one else None, "x", "<= 1", reason)
        peak = _mean([o.peak for o in one])
        figure(f"smoothing_peak_speed_{mix}", peak, "x", ">= 0.95", reason)
        whole, behind, reason = _both(told, (mix, "smoothed"), (mix, "lag"))
        ratio = [b.passing / a.passing for a, b in zip(whole, behind)]
        figure(f"fixed_lag_error_{mix}", _mean(ratio) if ratio else None, "x", "<= 1.15", reason)


def _counts(outcomes: Sequence[Outcome | str | None]) -> dict[tuple[str, str], NDArray]:
    """(group, "joints" or "angles"): (draws, 2) how many are inside, and how many there are; 0 where it was not run."""
    body, out = load_body("humanoid"), {}
    for g, group in enumerate(body.scale_groups):
        segments = body.segment_scale == g
        for what, error_of, sigma_of, chosen in (
            ("joints", lambda o: o.shift, lambda o: o.sigma, segments),
            ("angles", lambda o: o.turn, lambda o: o.turn_sigma, segments[body.tree.owners]),
        ):
            rows = []
            for o in outcomes:
                if not isinstance(o, Outcome):
                    rows.append([0, 0])
                    continue
                error, sigma = np.abs(error_of(o)[:, chosen]), sigma_of(o)[:, chosen]
                finite = np.isfinite(sigma)
                rows.append([(error[finite] <= SIGMAS * sigma[finite]).sum(), finite.sum()])
            if rows and np.sum(rows, axis=0)[1]:
                out[group, what] = np.array(rows, float)
    return out


def _added(runs: Iterable[NDArray]) -> NDArray:
    """(draws, 2) of several runs of the same draws together."""
    return np.sum(list(runs), axis=0)


def _of(told: Told, run: Run) -> tuple[list[Outcome], str]:
    """Outcomes of a run, and why it is not measured; "" where all draws are."""
    if run not in told:
        return [], "not among the takes that the command line asks for"
    failed = [one for one in told[run] if isinstance(one, str)]
    reason = f"{len(failed)} of {sum(one is not None for one in told[run])} draws: {failed[0]}" if failed else ""
    return [] if failed else [one for one in told[run] if isinstance(one, Outcome)], reason


def _both(told: Told, a: Run, b: Run) -> tuple[list[Outcome], list[Outcome], str]:
    (one, why), (two, other) = _of(told, a), _of(told, b)
    reason = why or other
    return ([], [], reason) if reason else (one, two, "")


def _means(a: Outcome, b: Outcome, value_of: Callable[[Outcome], NDArray]) -> tuple[float, float]:
    """Means of both over joints and frames with a finite sigma in both."""
    known = np.isfinite(a.sigma).all(axis=-1) & np.isfinite(b.sigma).all(axis=-1)
    return _mean(value_of(a)[known]), _mean(value_of(b)[known])


def _interval(value: Callable[[NDArray], float], rows: NDArray, sides: int = 1) -> tuple[float, float, float]:
    """Lower end, value and upper end of a function of draws (rows); one-sided 95 % each, or 95 % between them."""
    if not len(rows):
        return np.nan, np.nan, np.nan
    random = np.random.default_rng(0)
    samples = [value(rows[random.integers(len(rows), size=len(rows))]) for _ in range(SAMPLES)]
    tail = 0.05 / sides
    return float(np.quantile(samples, tail)), float(value(rows)), float(np.quantile(samples, 1.0 - tail))


def _mean(values: Sequence[float] | NDArray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def runs_of(groups: Sequence[str], quick: bool) -> list[Run]:
    """Runs that some groups of figures need; quickly, all sensors beside two, and all conditions of two fast mixes."""
    mixes = [mix for mix in MIXES if not quick or mix in QUICK]
    out: list[Run] = [(mix, "smoothed") for mix in ALONE if "alone" in groups]
    if "sensors" in groups:
        pairs = PAIRS[-1:] if quick else PAIRS
        out += [(mix, "smoothed") for mix in dict.fromkeys(name for pair in pairs for name in pair)]
    if "smoothing" in groups:
        out += [(mix, "lag") for mix in mixes]
    if {"smoothing", "intervals", "doubt"} & {*groups}:
        out += [(mix, condition) for mix in mixes for condition in CONDITIONS[:2]]
    if {"intervals", "doubt"} & {*groups}:
        out += [(m, c) for m in mixes for c in CONDITIONS[2:]]
    return list(dict.fromkeys(out))
