"""The centre of mass of real walks against the double integral of the forces under both feet.

    python -m benchmarks gait gait_mass

Every walk is fitted by `kinefit markers fit` with its static trial and the person's mass, which is that of the static
trial on a plate. Compared is the time in which both feet are on plates: from the toe-off of the foot that came before
the plates to its next contact off them. Where the person was and how fast at its start, plates do not tell: it is
fitted, for the whole time and for every step by itself.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.gait.gait_events import CHOSEN, PRINTED, file_of, fitted, plates_of
from benchmarks.figures import amount, figure
from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.exporters.report.feet import foot_events

_GRAVITY, _LOADED_N = 9.81, 20.0
_LEAST_S = 0.3  # of the time on plates


def run() -> None:
    """Print how far the centre of mass is from the integral, over the time on plates and over steps."""
    whole, steps = list[float](), list[float]()
    for name in (*PRINTED, *CHOSEN)[: amount(None, 1)]:
        path = file_of(name)
        mass = None if path is None else _mass(path.with_name("static.c3d"))
        if path is None or mass is None:
            continue
        motion = fitted(path, mass)
        found = _compared(motion, path, mass)
        if found is None:
            print(f"# {name}: no time with both feet on plates")
            continue
        each = ", ".join(f"{1e3 * step:.1f}" for step in found[1])
        print(f"# {name}: {mass:.1f} kg, {1e3 * found[0]:.1f} mm over all, steps {each} mm")
        whole.append(found[0])
        steps += found[1]
    reason = "" if whole else "no recording, or the package ezc3d is not installed"
    figure("gait_com_mm", 1e3 * _rms(whole) if whole else None, "mm RMS", "<= 10", reason)
    figure("gait_com_step_mm", 1e3 * _rms(steps) if steps else None, "mm RMS", "<= 5", reason)


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _mass(static: Path) -> float | None:
    """[kg] of a person who stands on a plate; None without one."""
    plates = plates_of(static) if static.exists() else None
    if not plates:
        return None
    return float(np.median(np.sum([force[2] for _, force, _ in plates], axis=0))) / _GRAVITY


def _compared(motion: Motion, path: Path, mass: float) -> tuple[float, list[float]] | None:
    """[m] RMS distance over the time on plates, and over each step in it; None where there is none."""
    plates, feet = plates_of(path), foot_events(motion)
    if not plates or feet is None:
        return None
    times, total = plates[0][0], np.sum([force for _, force, _ in plates], axis=0)
    loaded = [np.flatnonzero(force[2] > _LOADED_N) for _, force, _ in plates]
    if any(not len(at) for at in loaded):
        return None
    onsets = sorted((float(times[at[0]]), float(times[at[-1]])) for at in loaded)
    if onsets[1][0] > onsets[0][1]:  # the second foot lands off the plates in between
        return None
    offs, contacts = (np.sort(np.concatenate(pair)) for pair in (
        (feet.left.offs, feet.right.offs), (feet.left.contacts, feet.right.contacts)
    ))  # fmt: skip
    start = offs[(offs > onsets[0][0] + 0.02) & (offs < onsets[1][0])]
    stop = contacts[(contacts > onsets[1][0] + 0.1)]
    if not len(start) or not len(stop) or stop[0] - start[0] < _LEAST_S:
        return None
    R = rotation_between_up(motion.up, "z")
    centre = motion.centre_of_mass @ R.T
    whole = _apart(motion.times, centre, times, total, mass, start[0], stop[0])
    middle = onsets[1][0]
    ends = [(a, b) for a, b in ((start[0], middle), (middle, stop[0])) if b - a > _LEAST_S]
    return whole, [_apart(motion.times, centre, times, total, mass, a, b) for a, b in ends]


def _apart(
    frames: NDArray, centre: NDArray, times: NDArray, force: NDArray, mass: float, start: float, stop: float
) -> float:
    """[m] RMS distance of the centre (F, 3) from the integral of a force (3, N) [N], z up, between two times [s]."""
    at = (times >= start) & (times <= stop)
    step = float(times[1] - times[0])
    acceleration = force[:, at].T / mass - [0.0, 0.0, _GRAVITY]
    velocity = np.cumsum(acceleration, axis=0) * step
    place = np.cumsum(velocity, axis=0) * step
    inside = (frames >= start) & (frames <= stop)
    t = frames[inside]
    known = np.stack([np.interp(t, times[at], place[:, k]) for k in range(3)], axis=1)
    left = centre[inside] - known
    line = np.stack([np.ones(len(t)), t - t.mean()], axis=1)
    left -= line @ np.linalg.lstsq(line, left, rcond=None)[0]
    return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
