"""What is found of the errors of channels, against truth: `python -m benchmarks video channels`.

A humanoid waves for two seconds. Each draw gives 90 markers on it errors of one kind, or a range sensor's distance
from a post to a wrist white noise, with no marker beyond the elbow; the take is smoothed, the body known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from kinefit import Motion, Recording, load_body, track
from kinefit.bodies import Body, PointSet
from kinefit.geometry.camera import Rig
from kinefit.observations import MarkerFrame
from kinefit.sensors.base import Measurement, RowsOf, Sensor
from kinefit.simulation.movements import movement

RATE, FRAMES, MARKERS = 30.0, amount(60, 20), 90
SET = "dense"
POST = np.array([0.5, 2.2, -0.5])  # [m]
RANGE_SIGMA = 0.05  # [m]
WRIST = ("r_wrist", "hand_r")


def person() -> Body:
    """A humanoid with 90 markers, each within 8 cm of a landmark's place on its segment."""
    body, random = load_body("humanoid"), np.random.default_rng(0)
    on = np.arange(MARKERS) % len(body.landmarks.names)
    places = body.landmarks.points[on] + random.uniform(-0.08, 0.08, (MARKERS, 3))
    names = tuple(f"m{k:02d}" for k in range(MARKERS))
    return replace(body, marker_sets={SET: PointSet(names, body.landmarks.segments[on], places)})


BODY = person()
TRUTH = movement("wave", BODY, rate=RATE)


@dataclass
class Distance(Measurement):
    """A distance [m] from the post to a wrist."""

    time: float
    value: float
    sensor: str = "range"

    def match(self, scene, reach):
        return RowsOf(self.rows)

    def rows(self, scene):
        away = scene.position(WRIST[0]) - POST
        far = float(np.linalg.norm(away))
        return scene.along(
            scene.body.landmarks.select(WRIST[:1]), away / far, [self.value - far], RANGE_SIGMA, group=np.zeros(1, int)
        )


class Range(Sensor):
    """A range sensor on the post."""

    name = "range"

    def prepare(self, frame, scene):
        return frame


def seen(points: PointSet) -> NDArray:
    """(T, K, 3) [m] true places."""
    return np.array([BODY.positions(TRUTH.state(i), points) for i in range(FRAMES)])


def motion_of(x: NDArray, names: tuple[str, ...], marker_set: str, sigma: float, ranges: NDArray | None) -> Motion:
    """The smoothed motion from markers (T, K, 3) and distances (T,)."""
    steps = [[MarkerFrame("mocap", i / RATE, names, x[i], marker_set)] for i in range(FRAMES)]
    if ranges is not None:
        steps = [[*s, Distance(i / RATE, float(d))] for i, (s, d) in enumerate(zip(steps, ranges))]
    recording = Recording.of_frames(
        steps, Rig(()), rate=RATE, sigma={"mocap": sigma}, up="y", start=(0, TRUTH.state(0)),
        sensors=() if ranges is None else (Range(),),
    )  # fmt: skip
    return track(recording, BODY, size=False)


def scores(motion: Motion) -> tuple[float, float]:
    """RMS of angle errors over their standard deviations, where these are finite; lasting error [mm] of the markers."""
    error, std = motion.angles - TRUTH.angles[:FRAMES], motion.dof_std[:, 6:]
    known = np.isfinite(std) & (std > 0)
    return float(np.sqrt(np.mean(np.square(error[known] / std[known])))), 1e3 * lasting(motion, "mocap")


def lasting(motion: Motion, sensor: str) -> float:
    """[m] standard deviation of what lasts of a sensor's errors, from channel to channel."""
    told = motion.provenance["sensor noise"][sensor]
    return float(np.hypot(told["bias [m]"], told["drift [m]"]))


def markers(draw: int, kind: str) -> tuple[float, float]:
    """`scores` of one draw: "constant" 10 mm, the same with "gaps", white with "outliers" or with "wrong" markers."""
    random = np.random.default_rng([draw, len(kind)])
    x = seen(BODY.markers(SET))
    if kind in ("outliers", "wrong"):
        x = x + 0.003 * random.normal(size=x.shape)
        wrong = random.random(x.shape[:2] if kind == "outliers" else MARKERS) < 0.03
        away = random.normal(size=(*wrong.shape, 3))
        x += np.where(wrong[..., None], 0.05 * away / np.linalg.norm(away, axis=-1, keepdims=True), 0.0)
    else:
        x = x + 0.01 * random.normal(size=x.shape[1:]) + 0.001 * random.normal(size=x.shape)
    if kind == "gaps":
        x[random.random(x.shape[:2]) < 0.2] = np.nan
    return scores(motion_of(x, BODY.markers(SET).names, SET, 0.003, None))


def ranged(draw: int) -> tuple[float, float, float]:
    """Bias that is found of a range [m]; the wrist's bar and its error [m], RMS over what is observed of it."""
    random = np.random.default_rng(draw)
    x, names = seen(BODY.markers(SET)), BODY.markers(SET).names
    beyond = np.isin(BODY.markers(SET).segments, [BODY.tree.segment(n) for n in ("forearm_r", "hand_r")])
    wrist = seen(BODY.landmarks.select(WRIST[:1]))[:, 0]
    far = np.linalg.norm(wrist - POST, axis=1) + RANGE_SIGMA * random.normal(size=FRAMES)
    x = np.where(beyond[:, None], np.nan, x + 0.003 * random.normal(size=x.shape))
    motion = motion_of(x, names, SET, 0.003, far)
    s = BODY.tree.segment(WRIST[1])
    at = np.array([motion.body.positions(motion.state(i), BODY.landmarks.select(WRIST[:1]))[0] for i in range(FRAMES)])
    std, away = motion.joint_std[:, s], at - wrist
    known = np.isfinite(std)  # an infinite bar says that nothing observes the wrist along that axis
    told = motion.provenance["sensor noise"]["range"]
    return told["bias [m]"], float(np.sqrt(np.mean(std[known] ** 2))), float(np.sqrt(np.mean(away[known] ** 2)))


def run() -> None:
    """Print what is found, over all draws."""
    draws = range(amount(100, 1))
    for kind, goal in (("constant", "10 mm constant"), ("gaps", "10 mm constant, 20 % random gaps")):
        z, found = np.array([markers(k, kind) for k in draws]).T
        for what, value in (("lowest", found.min()), ("highest", found.max())):
            figure(f"channels, {goal}: lasting error, {what}", value, "mm", ">= 9" if what == "lowest" else "<= 12")
        figure(f"channels, {goal}: z of angles, median", float(np.median(z)), "", ">= 0.8")
        figure(f"channels, {goal}: z of angles, median (upper)", float(np.median(z)), "", "<= 1.2")
    for kind, what in (("outliers", "3 % outliers"), ("wrong", "3 % of the markers always off")):
        _, found = np.array([markers(k, kind) for k in draws]).T
        share = 100.0 * float(np.mean(found <= 1.0))
        figure(f"channels, white 3 mm, {what} by 50 mm: lasting error at most 1 mm", share, "% of draws", ">= 95")
    bias, bar, error = np.array([ranged(k) for k in draws]).T
    figure("channels, white range of 5 cm: bias of at most 5 cm", 100 * float(np.mean(bias <= 0.05)), "%", ">= 95")
    ratio = float(np.sqrt(np.mean(bar**2) / np.mean(error**2)))
    figure("channels, white range of 5 cm: the wrist's bar over its RMS error", ratio, "", "<= 1.5")
