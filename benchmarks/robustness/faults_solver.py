"""The marker solver on a long take with limits active: a second call on its own result must win nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure, recording
from kinefit import fit_marker_subject, fit_markers, load_body, read_markers
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.fitting.markers.subject import columns, sequence_both_ways
from kinefit.geometry.losses import SQUARED
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.solving.trajectory.sequence import fit_sequence

SETTINGS: dict[str, dict[str, Any]] = {"squared": {"loss": SQUARED}, "robust": {"loss": MARKER_LOSS, "posture": 1.0}}
"""Losses; the second is what `fit_markers` takes."""

MAX_GAIN = 1e-4
"""Share of a frame's cost that a second call may win: a hundred times the tolerance at which a frame ends."""

MAX_RESIDUAL = 0.01
"""[m] mean over a frame's markers; the whole take has 5 mm."""

GRAVITY = 9.81
"""[m/s²]"""


def run() -> None:
    """Print the figures of 1,346 frames of squats without gaps.

    The subject is fitted to this trial and a static one, as `kinefit markers fit` does.
    """
    folder = recording("forces_nimblephysics")
    static, take = (read_markers(folder / "subject4" / f"{name}.trc") for name in ("static1", "squats1"))
    subject = fit_marker_subject(load_body("humanoid"), [static, take])
    x = columns(take, subject.points.names)[: amount(None, 300)]
    roots, angles = sequence_both_ways(subject.body, subject.points, x, subject.sigma)
    gain = second_call(subject.body, subject.points, x, roots, angles, sigma=subject.sigma, **SETTINGS["robust"])
    figure("faults_solver_squats_second_call", int(np.sum(gain > MAX_GAIN)), "frames", "== 0")
    motion = fit_markers(subject, take)
    left = np.nanmean(motion.residuals["markers"].norms, axis=1)
    print(f"# squats: residual {1e3 * left.mean():.2f} mm on average, {1e3 * left.max():.1f} mm in the worst frame")
    figure("faults_solver_squats_over_10mm", int(np.sum(left > MAX_RESIDUAL)), "frames", "== 0")
    acceleration = np.diff(motion.centre_of_mass, 2, axis=0) * motion.rate**2
    figure("faults_solver_squats_jump", float(np.linalg.norm(acceleration, axis=1).max()) / GRAVITY, "g", "<= 6")


def beyond_limits(frames: int, seed: int = 0) -> tuple[Body, PointSet, NDArray]:
    """A humanoid whose angles swing beyond both ends of their ranges, and its markers (F, K, 3) [m] with 3 mm noise."""
    body, random = load_body("humanoid"), np.random.default_rng(seed)
    tree = body.tree
    middle = np.clip(tree.usual, tree.lower, tree.upper)
    swing = 1.1 * np.minimum(0.5 * (tree.upper - tree.lower), 0.6) * ~tree.prismatic  # [rad]
    phase, pace = random.uniform(0.0, 2.0 * np.pi, len(middle)), random.uniform(0.5, 1.5, len(middle))
    turns = np.linspace(0.0, 8.0 * np.pi, frames)[:, None]
    angles, points = middle + swing * np.sin(pace * turns + phase), body.markers("HANIM_45")
    x = body.trajectories(np.broadcast_to(np.eye(4), (frames, 4, 4)), angles, points)
    return body, points, x + random.normal(0.0, 0.003, x.shape)


def second_call(body: Body, points: PointSet, x: NDArray, roots: NDArray, angles: NDArray, **settings: Any) -> NDArray:
    """(F,) share of each frame's cost that the solver wins when it starts from its own result."""

    def cost(frame: int, state: BodyState) -> float:  # a fit's own figure is a prediction after the last step
        there = fit_sequence(body, state, points, x[frame : frame + 1], max_iterations=0, **settings)
        return float(there.costs[0])

    gain = np.empty(len(x))
    for f in range(len(x)):
        first = BodyState(roots[f], angles[f])
        again = fit_sequence(body, first, points, x[f : f + 1], **settings)
        before = cost(f, first)
        gain[f] = (before - cost(f, BodyState(again.Ts_world_root[0], again.angles[0]))) / before
    return gain
