"""P2's experiment, graded by ground truth instead of by eye: 3D alone, 2D alone, and both (P2 5, table I)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.motion import Motion
from kinefit.bodies.parts import free_parts, parts_state
from kinefit.errors import ObservationError
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.papers.voodoo import Settings, voodoo
from kinefit.simulation.evaluation.sequences import FEATURES, INPUTS, Inputs, TruthSequence
from kinefit.simulation.retarget import known_motion

Method = Callable[[TruthSequence, Inputs, BodyState], Motion]
"""Tracks a sequence with some of its sensors from a given pose; its body has the true one's landmarks."""

GOOD_MEAN = 0.060  # [m] half the width of a thigh: limbs overlap the true ones in the image
GOOD_POINT = 0.150  # [m] width of a thigh: beyond it, limbs lie next to the true ones in the image
GOOD_SHARE = 0.05  # of the frames, in which a point may be worse: less than a fifth of a second is not visible
LOST_POINT = 0.250  # [m] length of a forearm: the limb is somewhere else
LOST_SHARE = 0.5  # of the frames: a point lost for longer counts as lost, not as recovered
_END_INTERVAL = 0.2  # [s] a point lost throughout it was not recovered
_PAPER_MOVEMENTS = ("point", "walk", "wave", "shake_hands", "bow", "clap")
_FLOOR_PLANE = (0.0, 1.0, 0.0, 0.0)  # of the simulated room
_MAX_ARM_ANGLE = np.radians(25.0)  # between an arm and the direction to the sensor

POINTS = (
    "neck", "skull_vertex", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist", "l_hip", "r_hip",
    "l_knee", "r_knee", "l_ankle", "r_ankle",
)  # fmt: skip
"""Graded landmarks: joint centres, and the top of the head."""


class Grade(NamedTuple):
    """2 good congruence, 1 acceptable deviations, 0 lost (P2 5); `mean` and `worst` error of the points [m]."""

    grade: int
    mean: float
    worst: float


class Graded(NamedTuple):
    """One sequence: its movement, its grade, the errors of face and hands, and of stretched arms.

    `parts` [m]: mean error of face and hands across the colour camera's line of sight, NaN without detections.
    `stretched`: share of the frames with an arm stretched towards the sensor in which it is tracked, NaN without such.
    """

    movement: str
    grade: Grade
    parts: float
    stretched: float


@dataclass(frozen=True)
class Summary:
    """All sequences tracked with one choice of sensors.

    Parameters
    ----------
    inputs : "3d", "2d" or "fusion"
    graded : of every sequence, in order.
    """

    inputs: Inputs
    graded: tuple[Graded, ...]

    @property
    def counts(self) -> tuple[int, int, int]:
        """Sequences of grade 0, 1 and 2."""
        grades = [g.grade.grade for g in self.graded]
        return grades.count(0), grades.count(1), grades.count(2)

    @property
    def mean_grade(self) -> float:
        """Mean grade, P2's φ: a number from 0 to 2."""
        return float(np.mean([g.grade.grade for g in self.graded]))

    def of(self, *movements: str) -> Summary:
        """The sequences of some movements."""
        return Summary(self.inputs, tuple(g for g in self.graded if g.movement in movements))

    @property
    def named(self) -> Summary:
        """The sequences of the six movements that the paper names; the other four are ours."""
        return self.of(*_PAPER_MOVEMENTS)

    @property
    def parts(self) -> float:
        """Mean error [m] of face and hands across the line of sight."""
        errors = [g.parts for g in self.graded if np.isfinite(g.parts)]
        return float(np.mean(errors)) if errors else float("nan")

    @property
    def error(self) -> float:
        """Mean error [m] of all points in all sequences."""
        return float(np.mean([g.grade.mean for g in self.graded]))


def point_errors(truth: Motion, fitted: Motion) -> NDArray:
    """Distances (F, K) [m] of the points in `POINTS` that both bodies have.

    Raises
    ------
    ObservationError
        Motions of different lengths, or bodies without such points in common.
    """
    if len(truth) != len(fitted):
        problem = f"{len(fitted)} of {len(truth)} frames have a pose"
        raise ObservationError(problem, remedy="Give a pose for every frame; for lost frames, the previous pose.")
    names = tuple(n for n in POINTS if n in truth.body.landmarks.names and n in fitted.body.landmarks.names)
    if not names:
        raise ObservationError("the bodies share no landmark", remedy=f"Add landmarks named {', '.join(POINTS)}.")
    a, b = (m.positions(m.body.landmarks.select(names)) for m in (truth, fitted))
    return np.asarray(np.linalg.norm(b - a, axis=-1))


def grade(truth: Motion, fitted: Motion) -> Grade:
    """Grade a tracked motion as P2 does by eye (table I).

    2, good: mean error of all joints up to 60 mm, and none over 150 mm in more than 5 % of the frames.
    0, lost and not recovered: a joint over 250 mm throughout the last fifth of a second, or in most of the frames.
    1, acceptable: anything between, such as a forearm that was lost for a while and found again.
    """
    errors = point_errors(truth, fitted)
    last = max(int(np.ceil(_END_INTERVAL * truth.rate)), 1)
    mean, worst = float(errors.mean()), float(errors.max())
    far = errors > LOST_POINT
    if (far.mean(axis=0) > LOST_SHARE).any() or far[-last:].all(axis=0).any():
        return Grade(0, mean, worst)
    good = mean <= GOOD_MEAN and ((errors > GOOD_POINT).mean(axis=0) <= GOOD_SHARE).all()
    return Grade(2 if good else 1, mean, worst)


def evaluate(
    runs: Iterable[TruthSequence],
    method: Method,
    *,
    inputs: Iterable[Inputs] = INPUTS,
    start: Callable[[TruthSequence], BodyState] | None = None,
    step: Callable[[int], None] | None = None,
) -> dict[Inputs, Summary]:
    """Track every sequence with every choice of sensors, and grade it.

    Parameters
    ----------
    runs : see `evaluation.sequences.sequences`
    method : `voodoo_method`, `fusion_method` or another.
    inputs : choices of sensors.
    start : gives the initial pose; default: the first true one.
    step : called with the number of sequences done.
    """
    chosen = tuple(inputs)
    graded: dict[Inputs, list[Graded]] = {i: [] for i in chosen}
    for done, run in enumerate(runs, 1):
        state = run.truth.state(0) if start is None else start(run)
        for i in chosen:
            fitted = method(run, i, state)
            parts, stretched = parts_error(run, fitted), stretched_share(run, fitted)
            graded[i].append(Graded(run.truth.name, grade(run.truth, fitted), parts, stretched))
        if step is not None:
            step(done)
    return {i: Summary(i, tuple(g)) for i, g in graded.items()}


def stretched_share(run: TruthSequence, fitted: Motion) -> float:
    """Share 0..1 of the frames with an arm stretched towards the sensor in which such hands are tracked to 150 mm.

    An arm is stretched if it points to the sensor within 25 degrees, with the elbow bent by no more than that. NaN
    without such a frame.
    """
    eye = run.rig["depth"].centre_world
    names = tuple(f"{side}_{joint}" for side in "lr" for joint in ("shoulder", "elbow", "wrist"))
    x, y = (m.positions(m.body.landmarks.select(names)).reshape(len(m), 2, 3, 3) for m in (run.truth, fitted))
    to_sensor = _unit(eye - x[:, :, 0])
    arm = np.cos(_MAX_ARM_ANGLE) < np.sum(_unit(x[:, :, 2] - x[:, :, 0]) * to_sensor, axis=-1)
    straight = np.cos(_MAX_ARM_ANGLE) < np.sum(_unit(x[:, :, 1] - x[:, :, 0]) * _unit(x[:, :, 2] - x[:, :, 1]), axis=-1)
    stretched = arm & straight
    found = np.linalg.norm(y[:, :, 2] - x[:, :, 2], axis=-1) <= GOOD_POINT
    frames = stretched.any(axis=1)
    if not frames.any():
        return float("nan")
    return float(np.mean((found | ~stretched).all(axis=1)[frames]))


def parts_error(run: TruthSequence, fitted: Motion) -> float:
    """Mean error [m] of face and hands across the line of sight, over the frames in which they were detected."""
    x, y = (m.positions(m.body.landmarks.select(FEATURES)) for m in (run.truth, fitted))
    ray = _unit(x - run.rig["colour"].centre_world)
    error = y - x
    across = np.linalg.norm(error - np.sum(error * ray, axis=-1, keepdims=True) * ray, axis=-1)
    detected = np.array([np.isfinite(f.uv[:, 0]) for f in run.features])
    return float(across[detected].mean()) if detected.any() else float("nan")


def conclusions(summaries: Mapping[Inputs, Summary]) -> dict[str, bool]:
    """P2's three conclusions (P2 5), and whether each one holds here.

    Tracked well means a mean grade of 1.5 or more without a lost sequence. Face and hands are tracked if their error is
    below half the width of a thigh. A conclusion without sequences does not hold.
    """
    alone, features, both = (summaries[i] for i in INPUTS)

    def well(s: Summary) -> bool:
        return bool(s.graded) and s.counts[0] == 0 and s.mean_grade >= 1.5

    wave, waved = alone.of("wave"), both.of("wave")
    in_2d = features.parts <= GOOD_MEAN and features.mean_grade < 1.0
    waves = bool(waved.graded) and wave.mean_grade < waved.mean_grade
    return {
        "3D alone: bowing is tracked well, waving worse than with face and hands": well(alone.of("bow")) and waves,
        "2D alone: face and hands are tracked, the body is not": in_2d,
        "fusion: bowing and waving are both tracked well": well(both.of("bow")) and well(both.of("wave")),
    }


def voodoo_method(
    run: TruthSequence, inputs: Inputs, start: BodyState, settings: Settings | None = None, model: Body | None = None
) -> Motion:
    """P2's method: parts that move freely, connected by bands; `model` has the true body's tree, default: that body.

    The default settings have three extensions of P2: the room's floor is given, points in the boxes of several limbs
    are assigned to the nearest surface, and ICP's stop rule is off.
    """
    parts = free_parts(run.truth.body)
    fits = voodoo(run.seen(inputs), model or run.truth.body, start, run.rig, settings or Settings(floor=_FLOOR_PLANE))
    return _motion(run, parts, [parts_state(parts, fit.frames) for fit in fits])


def fusion_method(run: TruthSequence, inputs: Inputs, start: BodyState) -> Motion:
    """The fusion tracker: a tree of hard joints, limits, robust weights, visibility; smoothed as in `kinefit track`."""
    return _tracked(run, inputs, start).motion(name=run.truth.name)


def live_method(run: TruthSequence, inputs: Inputs, start: BodyState) -> Motion:
    """The fusion tracker without smoothing: each frame is estimated from the observations until then."""
    return _tracked(run, inputs, start).motion(smooth=False, name=run.truth.name)


def _tracked(run: TruthSequence, inputs: Inputs, start: BodyState) -> Tracker:
    tracker = Tracker(run.truth.body, run.rig, rate=run.truth.rate, sigma=run.sigma, keep=True, up="y")
    tracker.start_at(start)
    for seen in run.seen(inputs):
        tracker.update(seen)
    return tracker


METHODS: Mapping[str, Method] = {"voodoo": voodoo_method, "fusion": fusion_method, "live": live_method}


def found_start(run: TruthSequence) -> BodyState:
    """Estimate the initial pose from the first depth image."""
    from kinefit.fitting.initialization.from_depth import start_from_points

    depth = np.asarray(run.depth[0].depth)
    return start_from_points(run.truth.body, None, run.rig["depth"], depth, up=(0.0, 1.0, 0.0))[0].state


def _motion(run: TruthSequence, body: Body, states: list[BodyState]) -> Motion:
    roots, angles = np.array([s.T_world_root for s in states]), np.array([s.angles for s in states])
    return known_motion(body, run.truth.rate, roots, angles, up=run.truth.up, name=run.truth.name)


def _unit(v: NDArray) -> NDArray:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))
