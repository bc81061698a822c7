"""Hips, spine and pelvis seen by keypoints alone: `python -m benchmarks video posture`.

Keypoints of a hip lie on the axis about which the pelvis tilts, so that how much of the bend between trunk and thighs
is the hips' and how much the spine's is not seen: the posture prior tells. Recorded people, with markers and as
skeletons, are shown to four cameras as in `error_bars` and tracked twice: with angles that are independent
of each other beforehand, and with the spine bending as the hips do, learnt from all other people. Each person counts
alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.uncertainty.error_bars import ACCURACY
from benchmarks.accuracy.video.posture_takes import Take, learnt, shown, takes, uncoupled
from benchmarks.figures import figure
from benchmarks.scenes.simulated import somebody, with_points_off
from kinefit import Body, Motion, Recording, load_body, track
from kinefit.simulation import simulate_keypoints, studio_rig
from kinefit.simulation.evaluation import angle_errors

SET = "BODY_25B"
ANGLES = {"hip flexion": ("hip_flexion_r", "hip_flexion_l"), "lumbar extension": ("lumbar_extension",)}


@dataclass(frozen=True, eq=False)
class Told:
    """What came out of a take.

    Parameters
    ----------
    errors, sigmas : {angle: (F, k)} [deg]
    """

    errors: dict[str, NDArray]
    sigmas: dict[str, NDArray]


def seen_by_detector(take: Take, number: int) -> Motion:
    """The take of a person whose detector points stand beside the anatomical ones."""
    random, truth = np.random.default_rng(number), shown(take)
    if not take.marked:
        return somebody(truth, SET, random)
    off = random.normal(0.0, 0.008, (len(truth.body.keypoints(SET)), 3))  # lengths are the person's own
    return replace(truth, body=with_points_off(truth.body, SET, off))


def told(truth: Motion, number: int, body: Body) -> Told:
    """Track a take with a body, and compare."""
    rig = studio_rig(truth)
    seen = simulate_keypoints(
        truth, rig, SET, noise_px=3.0, drift_px=2.0, drift_time=0.5, outliers=0.1, missing=0.1, seed=number
    )
    motion = track(Recording.of_keypoints(rig, seen, sigma=ACCURACY, up=truth.up), body)
    errors, std = angle_errors(truth, motion), np.degrees(motion.dof_std[:, 6:])
    at = {what: [body.tree.coordinate(c) for c in names] for what, names in ANGLES.items()}
    return Told({w: errors[:, d] for w, d in at.items()}, {w: std[:, d] for w, d in at.items()})


def over_people(
    results: dict[str, Told], known: dict[str, Take], marked: bool, what: str
) -> tuple[float, float, float]:
    """Mean error [deg], median standard deviation [deg] and coverage [%] of an angle, each person counting alike."""
    of: dict[str, list[tuple[float, float, float]]] = {}
    for name, t in results.items():
        if known[name].marked == marked:
            e, s = np.abs(t.errors[what]), t.sigmas[what]
            finite = np.isfinite(s)
            inside = 100.0 * float(np.mean(e[finite] <= 1.96 * s[finite])) if finite.any() else np.nan
            of.setdefault(known[name].person, []).append((float(e.mean()), float(np.median(s)), inside))
    return tuple(np.nanmean([np.nanmean(v, axis=0) for v in of.values()], axis=0))  # type: ignore[return-value]


def run() -> None:
    """Print every figure before and after."""
    known = takes()
    absent = "the recordings are absent"
    several = len({t.person for t in known.values()}) > 3
    before, after, plain = {}, {}, uncoupled(load_body("humanoid"))
    for number, (name, take) in enumerate(known.items()):
        truth = seen_by_detector(take, number)
        before[name] = told(truth, number, plain)
        taught = learnt(known, take.person).body() if several else load_body("humanoid")  # in the quick form
        after[name] = told(truth, number, taught)
        hips = [np.mean(t.errors["hip flexion"]) for t in (before[name], after[name])]
        print(f"# {name} ({take.person}): hip flexion off by {hips[0]:.0f} deg, now {hips[1]:.0f} deg", flush=True)
    for marked, group in ((False, "motions"), (True, "markers")):
        there = any(t.marked == marked for t in known.values())
        for what in ANGLES:
            was, now = ((over_people(r, known, marked, what) if there else (np.nan,) * 3) for r in (before, after))
            tag = f"posture_{what.replace(' ', '_')}_{group}"
            print(f"# {group}, {what}: error {was[0]:.1f} deg, now {now[0]:.1f}; standard deviation {was[1]:.1f}, "
                  f"now {now[1]:.1f}; coverage {was[2]:.0f} %, now {now[2]:.0f} %", flush=True)  # fmt: skip
            figure(f"{tag}_error", now[0] / was[0], "of before", "<= 0.5", absent)
            if what == "hip flexion":
                figure(f"{tag}_sigma", now[1], "deg", "<= 8", absent)
                figure(f"{tag}_coverage_lowest", now[2], "%", ">= 90", absent)
                figure(f"{tag}_coverage_highest", now[2], "%", "<= 98", absent)
