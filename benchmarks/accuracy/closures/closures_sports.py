"""A rower, a weight lifter and a golfer, tracked with a dimension of the gear that is estimated along the way (P3 5).

The catalogue's bodies, whose gear has another dimension than the file's, drawn within its prior, with `value =
"estimate"`: inboard length of the oar, grip width on the bar, distance of the hands on the club. Simulated keypoints of
four cameras as of `closures_takes`, no start from truth; seeds 11 and 12. One stroke lasts two seconds, a squat
and a swing likewise. Gear is not seen: hands, feet and closures show it, so points are those of the built-in detector,
which has the knuckles. Points that end at the wrists leave the palm's direction to the prior, and a grip 9 cm beyond
the wrist with it: what they say of the same gear is printed, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.accuracy.closures.closures_people import off
from benchmarks.accuracy.closures.closures_takes import (
    PLACED,
    SET,
    Take,
    another_person,
    from_drive,
    posture_of,
    towards,
    wandering,
    waves,
)
from benchmarks.figures import amount, figure, quick
from kinefit.bodies import Body, load_body
from kinefit.bodies.parts import with_dimensions
from kinefit.bodies.tree import Closure
from kinefit.fitting.subject.keypoints import fit_subject
from kinefit.fitting.tracking.sizing import channels_of
from kinefit.fitting.tracking.video import track
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.rows import ParameterRows

SEEDS = (11, 12)
POINTS = "MEDIAPIPE_33"
PERIOD = 2.0  # [s]


@dataclass(frozen=True)
class Sport:
    """What is done with which gear.

    Parameters
    ----------
    dimension : of the gear, that is estimated
    std : [m] of its prior, within which it is drawn
    swing : {coordinate without side: (middle, amplitude) [deg]} of a posture that swings once a period
    driven : {coordinate: (middle, amplitude) [m]} that are set
    held : landmarks that stay where they are, and where [m]
    """

    dimension: str
    std: float
    swing: dict[str, tuple[float, float]]
    driven: dict[str, tuple[float, float]]
    held: tuple[tuple[str, tuple[float, float, float]], ...]


FEET = (("r_heel", (0.0, 0.0, 0.15)), ("l_heel", (0.0, 0.0, -0.15)))
SPORTS = {
    "rower": Sport(
        "inboard length", 0.05,
        {"lumbar_extension": (-15, 12), "elbow_flex": (40, -30), "arm_flex": (60, 15)}, {"seat_slide": (0.45, 0.2)},
        (("left_shoe", (0.0, 0.3, 0.0)),),
    ),
    "weight_lifter": Sport(
        "grip width", 0.08, {"hip_flexion": (45, 35), "knee_angle": (55, 40), "lumbar_extension": (-15, 10)}, {}, FEET,
    ),
    "golfer": Sport(
        "hand distance", 0.02, {"lumbar_rotation": (0, 20), "thorax_rotation": (0, 20), "arm_flex": (35, 12)}, {}, FEET,
    ),
}  # fmt: skip


def run() -> None:
    """Print the figures."""
    for name, sport in SPORTS.items():
        if quick() and name != "golfer":
            continue
        errors, gear, bars, whole = list[float](), list[float](), list[float](), list[float]()
        for seed in amount(SEEDS, SEEDS[:1]):
            take, true = made(name, seed)
            motion = track(take.recording, take.generic)
            value, std = motion.provenance["shape"][f"gear {sport.dimension}"]
            errors.append(float(off(take, motion).mean()))
            gear.append(1e3 * (value - true))
            bars.append(1e3 * std)
            person = ~motion.body.gear_scale[motion.body.segment_scale]
            whole.append(float(np.mean(~motion.lost[:, person].any(axis=1))))
            print(f"  {name}, seed {seed}: joints {errors[-1]:.1f} mm; {sport.dimension} {100 * value:.1f} ± "
                  f"{100 * std:.1f} cm, true {100 * true:.1f}", flush=True)  # fmt: skip
        share = float(np.max(bars)) / (1e3 * sport.std)
        figure(f"{name}: {sport.dimension}, standard deviation over its prior's", share, "of it", "<= 0.7")
        ends = by_wrists(name)
        figure(f"{name}: {sport.dimension}, likewise of points that end at the wrists", ends, "of it", "<= 1")
        figure(f"{name}: mean joint error", float(np.mean(errors)), "mm", "<= 20")
        figure(f"{name}: frames in which no segment of the person is lost", 100 * float(np.mean(whole)), "%", ">= 95")
        figure(f"{name}: {sport.dimension}, worst error", float(np.abs(gear).max()), "mm", f"<= {500 * sport.std:.0f}")
        inside = 100 * float(np.mean(np.abs(gear) <= 1.96 * np.array(bars)))
        figure(f"{name}: {sport.dimension} within 95 % error bars", inside, "% of the takes", ">= 100")


def by_wrists(name: str) -> float:
    """Standard deviation of the dimension over its prior's, of the first take in points without hands."""
    sport, take, settings = SPORTS[name], made(name, SEEDS[0], points=SET)[0], TrackSettings()
    channels = channels_of(take.recording, take.generic, settings)
    found = fit_subject(take.generic, channels, cameras=settings.camera_errors)
    k = found.fit.names.index(f"gear {sport.dimension}")
    return float(np.sqrt(found.covariance[k, k])) / sport.std


def made(name: str, seed: int, seconds: float = 3.0, points: str = POINTS) -> tuple[Take, float]:
    """A take of a sport, whose generic body has the dimension to estimate, and its true value [m]."""
    sport, random = SPORTS[name], np.random.default_rng(seed)
    catalogue = load_body(name)
    drawn = next(d.value for d in catalogue.dimensions if d.name == sport.dimension)
    true = drawn + sport.std * random.uniform(-1.0, 1.0)
    stated = [replace(d, std=sport.std) if d.name == sport.dimension else d for d in catalogue.dimensions]
    generic = replace(catalogue, dimensions=tuple(stated))
    person = with_dimensions(another_person(catalogue, random, points), {sport.dimension: true})
    return from_drive(generic, _drive(person, sport, random), seconds, 4, seed, of=person, points=points), true


def _drive(
    person: Body, sport: Sport, random: np.random.Generator
) -> Callable[[float], tuple[Body, ParameterRows, dict[int, float]]]:
    names, wave = person.tree.coordinates, waves(random, len(person.tree.coordinates))
    held = tuple(
        Closure(f"{PLACED} {mark}", "rigid" if len(sport.held) == 1 else "point", mark, place=place, hard=True)
        for mark, place in sport.held
    )
    body = replace(person, closures=(*person.closures, *held))
    usual, start = posture_of(person, {}), random.uniform(0.0, 2.0 * np.pi)

    def drive(t: float) -> tuple[Body, ParameterRows, dict[int, float]]:
        phase = float(np.sin(start + 2.0 * np.pi * t / PERIOD))
        posture = usual + wave(t) * wandering(person)
        for name, (middle, amplitude) in sport.swing.items():
            for k, coordinate in enumerate(names):
                if coordinate in (name, f"{name}_r", f"{name}_l"):
                    posture[k] = np.radians(middle + amplitude * phase)
        driven = {6 + names.index(n): middle + amplitude * phase for n, (middle, amplitude) in sport.driven.items()}
        return body, towards(person, posture), driven

    return drive
