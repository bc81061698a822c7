"""Fit a person, cameras and sensors jointly to all sensors of a take.

The unknowns are the poses of some frames and parameters of any kinds (`kinefit.fitting.subject.parameters`). Each round
matches the frames at the current solution, then solves for poses and parameters jointly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape, checked
from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.fitting.subject.gear import excess
from kinefit.fitting.subject.matched_frames import MatchedFrames, Worlds
from kinefit.fitting.subject.parameters import Parameters, World, stacked
from kinefit.fitting.subject.subject import Progress, SubjectFit
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.sensors.base import Measurement
from kinefit.solving.bundle.border import Bordered, Prior, solve
from kinefit.solving.bundle.border_frames import MAX_POSE_STEPS, POSTURE_SHARE, Weighing
from kinefit.solving.equations import inverse

REACH = (0.08, 0.05, 0.03)
"""[m] correspondence distance of each round, coarse to fine; the last for all further rounds."""

COARSE_ITERATIONS = 4, MAX_POSE_STEPS
"""Iterations of an early round, whose correspondences still change, and steps of the poses alone in each iteration."""

_FINE_ITERATIONS = 15  # of the solver, in the last rounds
_MAX_CHANGE_SIGMAS = 0.01  # posterior standard deviations of a change between rounds that counts as converged
_MAX_REMATCH_SIGMAS = 2.0  # the same of nearest points: new pairs alone move all parameters together by 1.3 to 1.9


@checked
def fit_subject(
    body: Body,
    rig: Rig,
    steps: Sequence[Sequence[Measurement]],
    states: Sequence[BodyState],
    parameters: Sequence[Parameters],
    *,
    times: Sequence[float] | None = None,
    velocities: Sequence[NDArray] | None = None,
    start: NDArray | None = None,
    reach: Sequence[float] = REACH,
    rounds: int = 5,
    looks: float | None = None,
    loss: Loss = SQUARED,
    posture: float = POSTURE_SHARE,
    coarse: tuple[int, int] = COARSE_ITERATIONS,
    progress: Progress | None = None,
) -> SubjectFit:
    """Fit parameters and poses jointly to the measurements of K frames.

    Parameters
    ----------
    body, rig : at the means of the parameters' priors
    steps : K lists of measurements, one list for each frame
    states : K poses near the truth
    parameters : kinds of parameters, applied in this order
    times : (K,) [s] of the states; default: time of the first measurement of each frame
    velocities : K of (6 + D,) [m/s, rad/s], optional; for measurements at other times than their state's
    start : (p,) parameters to start from; default: the priors' means
    reach : [m] correspondence distance of each round; the last for all further rounds
    rounds : of match and solve, at most; fewer if correspondences no longer change
    looks : float, optional
        Number of frames with independent errors that all frames together count as; default: estimated for each sensor
        from the bias of its residuals (see `excess.excess`).
    loss : Loss of rows that have none of their own
    posture : share of the body's posture prior that constrains the poses
    coarse : iterations of a round whose correspondences still change, and steps of the poses alone in each. Few
        iterations keep poses from following wrong lengths along the nearest points of a surface.
    progress : called with ("body fit", rounds done, rounds at most)

    Raises
    ------
    ObservationError
        No frames, other numbers of frames than of poses; rows of a sensor that cannot be used.
    """
    if not steps or len(steps) != len(states) or not all(len(several) for several in steps):
        problem = f"{len(steps)} frames of measurements but {len(states)} states, or a frame without measurements"
        raise ObservationError(problem, remedy="Give one state for each frame, and measurements in each.")
    given = {"times": times, "velocities": velocities}
    wrong = [name for name, values in given.items() if values is not None and len(values) != len(steps)]
    if wrong:
        raise ObservationError(f"{wrong[0]} and frames differ in number", remedy=f"Give {len(steps)} {wrong[0]}.")
    if rounds < 1 or not reach or (looks is not None and not looks > 0):
        problem = f"rounds = {rounds}, {len(reach)} values of reach, looks = {looks}: too few"
        raise ObservationError(problem, remedy="Give at least one round and one value of reach, and looks above 0.")
    names, mean, information, step = stacked(parameters)
    worlds, prior = Worlds(World(body, rig), parameters), Prior(mean, information)
    theta = np.array(mean if start is None else start, float)
    check_shape(theta, mean.shape, f"the start for {', '.join(names)}")
    sensors = tuple({m.sensor: None for several in steps for m in several})
    rematched = not all(m.settled for several in steps for m in several)
    shares = {} if looks is None else dict.fromkeys(sensors, min(looks / len(steps), 1.0))
    excess_of = {sensor: 1.0 / share for sensor, share in shares.items()}
    for used in range(1, rounds + 1):
        if progress:
            progress("body fit", used - 1, rounds)
        frames = MatchedFrames(worlds, steps, times, velocities, theta, states, reach[min(used, len(reach)) - 1])
        early, before = rematched or used < min(len(reach), rounds), theta
        solved = solve(
            frames, theta, states, prior, step, weighing=Weighing(shares, loss, posture),
            iterations=coarse if early else (_FINE_ITERATIONS, MAX_POSE_STEPS),
        )  # fmt: skip
        theta, states, moved = solved.theta, solved.states, solved.theta - before
        squared_change = moved @ (prior.information + solved.information) @ moved
        converged = used >= len(reach) if rematched else not early and solved.converged
        if converged and squared_change < (_MAX_REMATCH_SIGMAS if rematched else _MAX_CHANGE_SIGMAS) ** 2:
            break
    if looks is None:
        excess_of = excess(frames.rows_of_frames(theta, states), _effective_parameters(body, solved))
        shares = {sensor: 1.0 / max(excess_of.get(sensor, 1.0), 1.0) for sensor in sensors}
        if min(shares.values()) < 1.0:
            weighing, fine = Weighing(shares, loss, posture), (_FINE_ITERATIONS, MAX_POSE_STEPS)
            solved = solve(frames, theta, states, prior, step, weighing=weighing, iterations=fine)
    if progress:
        progress("body fit", rounds, rounds)
    world = worlds.at(solved.theta)
    return SubjectFit(
        world.body, world.rig, world.values, names, solved.theta, inverse(prior.information + solved.information),
        solved.states, solved.information, prior, excess_of, solved.cost, used,
        tuple(parameters), World(body, rig),
    )  # fmt: skip


def _effective_parameters(body: Body, solved: Bordered) -> float:
    """Number of mean residuals that a fit can make zero: degrees of freedom, and parameters that data determine."""
    posterior = inverse(solved.prior.information + solved.information)
    return body.tree.n_dofs + len(solved.theta) - float(np.sum(solved.prior.information * posterior))
