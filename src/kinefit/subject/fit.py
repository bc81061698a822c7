"""Whatever is unknown of a person, cameras and sensors, from all sensors of a take together.

Some frames, the same in every sensor, and their poses; parameters of any kinds (`kinefit.subject.parameters`). Frames
are matched, poses and parameters solved together, and matched again where the solution now is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.losses import SQUARED, Loss
from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched, Measurement, check_rows
from kinefit.sensors.scene import Scene
from kinefit.solvers.border import POSTURE, Bordered, Part, Prior, solve
from kinefit.solvers.equations import inverse
from kinefit.subject.lasting import excess
from kinefit.subject.parameters import Parameters, World, stacked

REACH = (0.08, 0.05, 0.03)
"""[m] of correspondences that are sought anew, coarse to fine; the last for all further rounds."""

TOLD = 0.1
"""Share of the prior's variance that data must explain for a direction to count as measured."""

_ITERATIONS = 15  # of the solver, a round of settled correspondences
_ANEW = 3  # of one where some are sought anew
_DONE = 0.01  # posterior standard deviations of a change between rounds that is none
_KEPT = 64  # worlds and rows that are remembered


@dataclass(frozen=True, eq=False)
class Unmeasured:
    """A combination of parameters that the prior alone holds.

    Parameters
    ----------
    direction : (p,) in prior standard deviations, of length 1.
    share : of the prior's variance in it that data explain, below `TOLD`.
    names : of the parameters that make up most of it, the largest first.
    """

    direction: NDArray
    share: float
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Subject:
    """A person, cameras and sensors as a fit found them.

    Parameters
    ----------
    body, rig, values : the world that was found; see `World`.
    names, mean : (p,) of the parameters.
    covariance : (p, p) posterior, with the poses unknown and lasting errors counted.
    states : K poses, refined along.
    information : (p, p) what the sensors tell, without the prior, lasting errors counted.
    prior : Prior
    excess : {sensor: factor} by which what its frames tell together is less certain than its rows say.
    unmeasured : directions that the prior alone holds, the least measured first.
    cost : float
    rounds : of match and solve
    """

    body: Body
    rig: Rig
    values: Mapping[str, Mapping[str, float]]
    names: tuple[str, ...]
    mean: NDArray
    covariance: NDArray
    states: tuple[BodyState, ...]
    information: NDArray
    prior: Prior
    excess: Mapping[str, float]
    unmeasured: tuple[Unmeasured, ...]
    cost: float
    rounds: int

    @property
    def std(self) -> NDArray:
        """(p,) posterior standard deviation of each parameter."""
        return np.sqrt(np.diag(self.covariance))

    def value(self, name: str) -> tuple[float, float]:
        """A parameter by name: its estimate and standard deviation.

        Raises
        ------
        ObservationError
            No such parameter.
        """
        if name not in self.names:
            raise ObservationError(f"no parameter '{name}' was fitted", remedy=f"Fitted are: {', '.join(self.names)}.")
        k = self.names.index(name)
        return float(self.mean[k]), float(self.std[k])


def fit_subject(
    body: Body,
    rig: Rig,
    steps: Sequence[Sequence[Measurement]],
    states: Sequence[BodyState],
    parameters: Sequence[Parameters],
    *,
    velocities: Sequence[NDArray] | None = None,
    start: NDArray | None = None,
    reach: Sequence[float] = REACH,
    rounds: int = 5,
    looks: float | None = None,
    loss: Loss = SQUARED,
    posture: float = POSTURE,
) -> Subject:
    """Parameters and poses that explain what all sensors saw in K frames.

    Parameters
    ----------
    body, rig : as the parameters' priors have them.
    steps : K lists, what each sensor measured in a frame.
    states : K poses near the truth.
    parameters : kinds of them, applied in this order.
    velocities : K of (6 + D,) [m/s, rad/s], optional; for measurements of other times than their frame's first.
    start : (p,) to start from, default the priors' means.
    reach : [m] of correspondences, round by round; the last for all further rounds.
    rounds : of match and solve, at most; correspondences that settle end it earlier.
    looks : float, optional
        How many frames of independent errors all frames together count as; default: estimated, sensor by sensor, from
        how much residuals last (see `lasting.excess`).
    loss : Loss of rows that have none of their own.
    posture : share of the body's posture prior that holds the poses.

    Raises
    ------
    ObservationError
        No frames, other numbers of frames than of poses; rows of a sensor that cannot be used.
    """
    if not steps or len(steps) != len(states) or not all(len(several) for several in steps):
        problem = f"{len(steps)} frames of measurements with {len(states)} states"
        raise ObservationError(problem, remedy="Give one state for each frame, and measurements in each.")
    if rounds < 1 or not reach or (looks is not None and not looks > 0):
        problem = f"{rounds} rounds, {len(reach)} reaches, {looks} looks"
        raise ObservationError(problem, remedy="Give one round and one reach at least, and looks above 0.")
    names, mean, information, step = stacked(parameters)
    worlds, prior = _Worlds(World(body, rig), parameters), Prior(mean, information)
    theta = np.array(mean if start is None else start, float)
    if theta.shape != mean.shape:
        raise ObservationError(f"a start of shape {theta.shape}", remedy=f"Give ({len(mean)},): {', '.join(names)}.")
    settled = {m.sensor: m.settled for several in steps for m in several}
    iterations = _ITERATIONS if all(settled.values()) else _ANEW
    sensors, solved, shares, used = tuple(settled), None, {}, 0
    fit = lambda problem, theta, states, shares, iterations: solve(
        problem, theta, states, prior, step, shares=shares, loss=loss, posture=posture, max_iterations=iterations
    )
    if looks is not None:
        shares = dict.fromkeys(sensors, min(looks / len(steps), 1.0))
    for used in range(1, rounds + 1):
        problem = _Frames(worlds, steps, velocities, theta, states, reach[min(used, len(reach)) - 1])
        before = theta
        solved = fit(problem, theta, states, shares, iterations)
        theta, states = solved.theta, solved.states
        moved = float((theta - before) @ (prior.information + solved.information) @ (theta - before))
        if used > 1 and all(settled.values()) and solved.converged and moved < _DONE**2:
            break
    told = dict.fromkeys(sensors, 1.0 / shares[sensors[0]]) if shares else {}
    if looks is None:
        told = excess(problem.all_parts(theta, states), settled, _followed(body, solved))
        shares = {sensor: 1.0 / told.get(sensor, 1.0) for sensor in sensors}
        solved = fit(problem, theta, states, shares, _ITERATIONS)
    world = worlds.at(solved.theta)
    return Subject(
        world.body, world.rig, world.values, names, solved.theta, inverse(prior.information + solved.information),
        solved.states, solved.information, prior, told, unmeasured(names, prior, solved.information), solved.cost, used,
    )  # fmt: skip


def unmeasured(names: Sequence[str], prior: Prior, information: NDArray) -> tuple[Unmeasured, ...]:
    """Directions of which data explain less than a tenth of the prior's variance."""
    root = np.linalg.cholesky(inverse(prior.information))
    values, vectors = np.linalg.eigh(root.T @ information @ root)
    out = []
    for value, vector in zip(values, vectors.T):
        share = max(float(value), 0.0) / (1.0 + max(float(value), 0.0))
        if share < TOLD:
            moved = np.abs(root @ vector) / np.sqrt(np.diag(root @ root.T))
            largest = [k for k in np.argsort(-moved) if moved[k] > 0.3 * moved.max()]
            out.append(Unmeasured(vector, share, tuple(names[k] for k in largest)))
    return tuple(out)


def _followed(body: Body, solved: Bordered) -> float:
    """How many mean residuals a fit can make zero."""
    posterior = inverse(solved.prior.information + solved.information)
    return body.tree.n_dofs + len(solved.theta) - float(np.sum(solved.prior.information * posterior))


class _Worlds:
    """The worlds of parameters' values; those asked for lately are kept, so that what did not change is the same."""

    def __init__(self, world: World, parameters: Sequence[Parameters]) -> None:
        self._first = world
        ends = np.cumsum([0, *(len(one.names) for one in parameters)])
        self._parameters = [(one, slice(int(a), int(b))) for one, a, b in zip(parameters, ends, ends[1:])]
        self._kept: dict[tuple[int, bytes], tuple[World, World]] = {}
        self._scenes: dict[tuple[int, int], tuple[World, Scene]] = {}

    def at(self, theta: NDArray) -> World:
        """The world with parameters (p,)."""
        world = self._first
        for one, own in self._parameters:
            values = theta[own]
            key = id(world), values.tobytes()
            if key not in self._kept:
                if len(self._kept) >= _KEPT:
                    self._kept.pop(next(iter(self._kept)))
                self._kept[key] = world, one.apply(world, values)
            self._kept[key] = self._kept.pop(key)  # the latest last
            world = self._kept[key][1]
        return world

    def scene(self, world: World, state: BodyState) -> Scene:
        """A scene of a world; those of one body and rig share what was made for them."""
        key = id(world.body), id(world.rig)
        if key not in self._scenes:
            if len(self._scenes) >= 4:
                self._scenes.pop(next(iter(self._scenes)))
            self._scenes[key] = world, Scene(world.body, state, world.rig)
        return self._scenes[key][1].at(state, values=world.values)


class _Frames:
    """Frames with their correspondences: the problem that the solver sees."""

    def __init__(
        self, worlds: _Worlds, steps: Sequence[Sequence[Measurement]], velocities: Sequence[NDArray] | None,
        theta: NDArray, states: Sequence[BodyState], reach: float,
    ) -> None:  # fmt: skip
        self._worlds, self._steps, self._velocities = worlds, steps, velocities
        self._matched: list[list[Matched]] = []
        self._latest: dict[tuple[int, int], tuple[BodyState, World, list[AnyRows]]] = {}
        world = worlds.at(theta)
        for f, state in enumerate(states):
            scene = self._scene(world, f, state)
            self._matched.append([m.match(scene, reach) for m in steps[f]])

    def body(self, theta: NDArray) -> Body:
        """The body with parameters (p,)."""
        return self._worlds.at(theta).body

    def parts(self, theta: NDArray, frame: int, state: BodyState) -> list[Part]:
        """Rows of one frame's sensors."""
        world = self._worlds.at(theta)
        scene = self._scene(world, frame, state)
        out: list[Part] = []
        for i, (measurement, matched) in enumerate(zip(self._steps[frame], self._matched[frame], strict=True)):
            out += [(measurement.sensor, rows) for rows in self._rows((frame, i), measurement.sensor, matched, scene, world)]
        return out

    def all_parts(self, theta: NDArray, states: Sequence[BodyState]) -> list[list[Part]]:
        """Rows of all frames."""
        return [self.parts(theta, f, state) for f, state in enumerate(states)]

    def _rows(
        self, key: tuple[int, int], sensor: str, matched: Matched, scene: Scene, world: World
    ) -> list[AnyRows]:
        """Rows of one measurement; those of a world that differs in nothing that it can know of are not made again."""
        kept = self._latest.get(key)
        same = kept is not None and kept[0] is scene.state
        if same and kept is not None and _alike(kept[1], world, sensor):
            return kept[2]
        rows = check_rows(matched.rows(scene), sensor, world.body)
        if not same:
            self._latest[key] = scene.state, world, rows
        return rows

    def _scene(self, world: World, frame: int, state: BodyState) -> Scene:
        several = self._steps[frame]
        velocity = None if self._velocities is None else self._velocities[frame]
        scene = self._worlds.scene(world, state)
        return scene.at(state, time=several[0].time, velocity=velocity, measurements=several)


def _alike(a: World, b: World, sensor: str) -> bool:
    """Whether a sensor's rows are the same in two worlds."""
    return a.body is b.body and a.rig is b.rig and a.values.get(sensor) == b.values.get(sensor)
