"""Feet that leave the ground and come back: a person who crouches, jumps and lands, twice, seen by cameras.

`kinefit track --contacts` holds the soles where they rest. Told: in how many frames a foot is rightly held, or rightly
free; how often that changes, of the 2 landings and 2 take-offs of each foot; and how far soles slip while they stand.
Thresholds are those of `smoothing.foot_contacts`, chosen on seeds 0 to 2; seeds 11 to 13 are printed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.closures.closures_takes import RATE, Take, from_drive, towards
from benchmarks.figures import amount, figure
from kinefit.bodies import Body, load_body
from kinefit.bodies.motion import Motion
from kinefit.bodies.tree import Closure
from kinefit.fitting.smoothing.foot_contacts import find_contacts
from kinefit.fitting.tracking.video import track
from kinefit.solving.rows import ParameterRows

SEEDS = (11, 12, 13)
SECONDS = 3.2  # of a take, with two jumps in it
STANDS = 0.005
"""[m] above the ground to which a foot counts as standing."""


def jumper(seed: int) -> Take:
    """Somebody who jumps on the spot twice, by about 30 cm."""
    random = np.random.default_rng(seed)
    generic = load_body("humanoid")
    person = generic.scaled(np.full(len(generic.scale_groups), random.normal(1.0, 0.04)))
    names, starts = person.tree.coordinates, (random.uniform(0.7, 0.9), random.uniform(1.9, 2.1))
    flight = random.uniform(0.4, 0.5)

    def drive(t: float) -> tuple[Body, ParameterRows, dict[int, float]]:
        air, crouch = 0.0, 0.0
        for start in starts:
            s = t - start
            air += 0.5 * 9.81 * s * (flight - s) if 0.0 < s < flight else 0.0
            crouch += np.exp(-0.5 * ((s + 0.2) / 0.1) ** 2) + 0.7 * np.exp(-0.5 * ((s - flight - 0.15) / 0.1) ** 2)
        feet = tuple(
            Closure(f"foot {side}", "rigid", f"{side}_heel", place=(0.0, air, 0.12 * sign), hard=True)
            for side, sign in (("r", 1.0), ("l", -1.0))
        )
        posture = np.array(person.tree.usual)
        for side in "lr":
            posture[names.index(f"hip_flexion_{side}")] += 0.9 * crouch
            posture[names.index(f"knee_angle_{side}")] += 1.1 * crouch
            posture[names.index(f"arm_flex_{side}")] += 0.5 * np.sin(4.0 * t)
        return replace(person, closures=feet), towards(person, posture), {}

    return from_drive(generic, drive, SECONDS, 4, seed, of=person)


def run() -> None:
    """Print the figures."""
    right, changes, slips = [], [], {"held": [], "free": []}
    for seed in amount(SEEDS, SEEDS[:1]):
        take = jumper(seed)
        free, held = track(take.recording, take.generic), track(take.recording, take.generic, contacts=True)
        stands = standing(take.truth)
        on = contacts(free)
        right.append(np.mean(on == stands))
        changes.append(switches(on) - switches(stands))
        for name, motion in (("free", free), ("held", held)):
            slips[name].append(slip(motion, stands))
    figure("jumps: frames in which a foot is rightly held or free", 100.0 * float(np.mean(right)), "%", ">= 97")
    worst = float(np.abs(np.concatenate(changes)).max())
    figure("jumps: take-offs and landings too many or too few, worst foot", worst, "", "== 0")
    mean = {name: float(np.mean(values)) for name, values in slips.items()}
    print(f"  soles that stand: {mean['held']:.1f} mm/s with contacts, {mean['free']:.1f} mm/s without")


def switches(on: NDArray) -> NDArray:
    """(2,) how often each foot begins or ceases to stand."""
    return np.abs(np.diff(on.astype(int), axis=0)).sum(axis=0)


def standing(truth: Motion) -> NDArray:
    """(F, 2) bool of the right and the left foot."""
    x = truth.positions(truth.body.landmarks.select(("r_heel", "l_heel")))
    return x[..., 1] < x[..., 1].min() + STANDS


def contacts(motion: Motion) -> NDArray:
    """(F, 2) bool: feet of which a sole's points are held."""
    found = find_contacts(motion.body, motion.Ts_world_root, motion.angles, RATE, "y")
    side = np.array([name[0] for name in found.points.names])
    return np.stack([(found.weight[:, side == s] > 0).any(axis=1) for s in "rl"], axis=1)


def slip(motion: Motion, stands: NDArray) -> float:
    """[mm/s] mean speed of the heels while they stand."""
    x = motion.positions(motion.body.landmarks.select(("r_heel", "l_heel")))
    speed = 1e3 * RATE * np.linalg.norm(np.diff(x, axis=0), axis=2)
    return float(speed[stands[1:] & stands[:-1]].mean())
