"""Fit a person, cameras and sensors jointly to all sensors of a take.

The unknowns are the poses of some frames and parameters of any kinds (`kinefit.fitting.subject.parameters`). Each round
matches the frames at the current solution, then solves for poses and parameters jointly.

Frames with fixed correspondences, as a function of parameters: the problem that a subject fit solves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape, checked
from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.fitting.subject.parameters import FrameRows, Parameters, World, excess, stacked, with_slices
from kinefit.fitting.subject.point_moves import ClosureMoves, PointMoves, closing_rows
from kinefit.fitting.subject.subject import CameraExtrinsics, Progress, SubjectFit
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.sensors.base import Matched, Measurement, matched_by, packed, rows_at
from kinefit.sensors.scene import Scene
from kinefit.solving.bundle.border import Bordered, Prior, solve
from kinefit.solving.bundle.border_frames import MAX_POSE_STEPS, POSTURE_SHARE, Part, Weighing, apart
from kinefit.solving.equations import inverse
from kinefit.solving.least_squares import PixelPoints
from kinefit.solving.rows import AnyRows, Rows

CLOSURES = "closures"
"""Name of a body's closures among the sensors."""

_MAX_CACHED_WORLDS = 64
_CLOSURE_ATTRIBUTES = ("tree", "landmarks", "closures")  # of a body, on which its closures depend
_SURFACE_ATTRIBUTES = ("tree", "surfaces", "skin", "morphs")  # of a body, on which a surface's rows depend


class Worlds:
    """Makes worlds from values of parameters, and caches the latest: unchanged parts are the same objects.

    Parameters
    ----------
    world : to which the parameters apply
    parameters : kinds of parameters, p in all
    """

    def __init__(self, world: World, parameters: Sequence[Parameters]) -> None:
        self._first = world
        self._parameters = with_slices(parameters)
        # Cameras do not depend on bodies: applied first, they are not applied again for every body.
        self._applied = sorted(self._parameters, key=lambda each: not isinstance(each[0], CameraExtrinsics))
        self._cache: dict[tuple[int, bytes], tuple[World, World]] = {}
        self._bare: Worlds | None = None
        self._scenes: dict[int, tuple[Body, Scene]] = {}

    def at(self, theta: NDArray) -> World:
        """The world with parameters (p,)."""
        return self._chain(theta)[-1] if self._applied else self._first

    def _chain(self, theta: NDArray) -> list[World]:
        """The worlds after each kind of parameters has been applied in turn."""
        world, out = self._first, []
        for kind, own in self._applied:
            values = theta[own]
            key = id(world), values.tobytes()
            cached = self._cache.pop(key, None)
            if cached is None:
                if len(self._cache) >= _MAX_CACHED_WORLDS:
                    self._cache.pop(next(iter(self._cache)))
                cached = world, kind.apply(world, values)
            self._cache[key] = cached  # the latest last
            world = cached[1]
            out.append(world)
        return out

    @property
    def touches(self) -> tuple[frozenset[int] | None, ...]:
        """(p,) for each parameter the only segments whose rows depend on it; None for any."""
        out: list[frozenset[int] | None] = []
        for kind, own in self._parameters:
            out += getattr(kind, "touches", (None,) * (own.stop - own.start))
        return tuple(out)

    @property
    def of_points(self) -> NDArray:
        """(p,) bool: parameters that move nothing but points and joints of the body."""
        flags = [np.full(own.stop - own.start, getattr(kind, "of_points", False)) for kind, own in self._parameters]
        return np.concatenate(flags)

    @property
    def cameras(self) -> list[tuple[CameraExtrinsics, slice]]:
        """Parameters of cameras, and their slice of all parameters."""
        return [(kind, own) for kind, own in self._parameters if isinstance(kind, CameraExtrinsics)]

    def moves(self, theta: NDArray, steps: NDArray, some: NDArray) -> PointMoves:
        """Derivatives of points by parameters that move nothing else; by differences if a kind has no slopes.

        Parameters
        ----------
        theta, steps : (p,) values and steps of finite differences
        some : (q,) int, the parameters to derive by
        """
        chain = self._chain(theta)
        moving = [
            (kind, own, after.body) for (kind, own), before, after in zip(self._applied, [self._first, *chain], chain)
            if after.body is not before.body
        ]  # fmt: skip
        slopes: list[Any] = [getattr(kind, "slopes", None) for kind, _, _ in moving]
        if all(slopes):
            made = [(add_slopes, theta[own], own, body) for add_slopes, (_, own, body) in zip(slopes, moving)]
            return PointMoves.from_slopes(chain[-1].body, made, some, len(theta))
        worlds = self
        of_bodies = [kind for kind, _ in self._parameters if not isinstance(kind, CameraExtrinsics)]
        if all(getattr(kind, "of_points", False) for kind in of_bodies):  # saves scaling surfaces that are not used
            if self._bare is None:
                bare = replace(self._first.body, surfaces=(), morphs=(), skin=None)
                self._bare = Worlds(replace(self._first, body=bare), [kind for kind, _ in self._parameters])
            worlds = self._bare
        pairs = []
        for together in apart(self.touches, some):
            change = np.zeros(len(theta))
            change[together] = steps[together]
            pairs.append((together, worlds.at(theta - change).body, worlds.at(theta + change).body))
        return PointMoves.from_differences(pairs, some, steps, self.touches)

    def closing(self, theta: NDArray, steps: NDArray) -> ClosureMoves | None:
        """Derivatives of the body's closures by the parameters; None for a body without closures.

        Parameters
        ----------
        theta, steps : (p,) values and steps of finite differences
        """
        if not self._first.body.closures:
            return None
        pairs, body = [], self.at(theta).body
        for k, step in enumerate(steps):
            ends = []
            for sign in (-1.0, 1.0):
                change = np.zeros(len(theta))
                change[k] = sign * step
                ends.append(self.at(theta + change).body)
            same = all(getattr(ends[0], part) is getattr(body, part) for part in _CLOSURE_ATTRIBUTES)
            pairs.append(None if same else (ends[0], ends[1]))
        return ClosureMoves(body, pairs, steps)

    def scene(self, world: World, state: BodyState) -> Scene:
        """A scene of a world; scenes of one body share its cached geometry."""
        key = id(world.body)
        if key not in self._scenes:
            if len(self._scenes) >= 4:
                self._scenes.pop(next(iter(self._scenes)))
            self._scenes[key] = world.body, Scene(world.body, state, world.rig)
        return self._scenes[key][1].at(state, rig=world.rig, values=world.values)


class MatchedFrames:
    """Frames with fixed correspondences: a `BorderedProblem`.

    Parameters
    ----------
    worlds : Worlds
    steps : F lists of measurements, one list for each frame
    times : (F,) [s] of the states; default: time of the first measurement of each frame
    velocities : F of (6 + D,) [m/s, rad/s], optional
    theta : (p,) parameters at which the measurements are matched
    states : F poses at which they are matched
    reach : [m] correspondence distance
    """

    def __init__(
        self, worlds: Worlds, steps: Sequence[Sequence[Measurement]], times: Sequence[float] | None,
        velocities: Sequence[NDArray] | None, theta: NDArray, states: Sequence[BodyState], reach: float,
    ) -> None:  # fmt: skip
        self._worlds, self._steps, self._times, self._velocities = worlds, steps, times, velocities
        self._matched: list[list[Matched]] = []
        self._latest: dict[tuple[int, int], tuple[BodyState, World, Sequence[AnyRows]]] = {}
        world = worlds.at(theta)
        for f, state in enumerate(states):
            scene = self._scene(world, f, state)
            self._matched.append([matched_by(m, scene, reach) for m in steps[f]])

    @property
    def touches(self) -> tuple[frozenset[int] | None, ...]:
        """(p,) for each parameter the only segments whose rows depend on it; None for any."""
        return self._worlds.touches

    def body(self, theta: NDArray) -> Body:
        """The body with parameters (p,)."""
        return self._worlds.at(theta).body

    def parts(self, theta: NDArray, frame: int, state: BodyState) -> list[Part]:
        """Rows of one frame's sensors and closures, with parameters (p,)."""
        world = self._worlds.at(theta)
        scene = self._scene(world, frame, state)
        out: list[Part] = []
        for i, (measurement, matched) in enumerate(zip(self._steps[frame], self._matched[frame], strict=True)):
            rows = self._rows((frame, i), measurement.sensor, matched, scene, world)
            out += [(measurement.sensor, part) for part in rows]
        return [*out, *((CLOSURES, rows) for rows in closing_rows(world.body, state))]

    def packed(self, theta: NDArray, frame: int, state: BodyState) -> tuple[Rig, PixelPoints] | None:
        """A frame's cameras and keypoints, with parameters (p,); None if it has other measurements."""
        scene = self._scene(self._worlds.at(theta), frame, state)
        pixels = packed(self._matched[frame], scene)
        return None if pixels is None else (scene.rig, pixels)

    def columns(self, theta: NDArray, steps: NDArray, states: Sequence[BodyState]) -> list[NDArray]:
        """(N, p) derivatives of every frame's rows by points and cameras, NaN elsewhere.

        See `border_frames.differences`; `theta` and `steps` (p,) are values and steps of finite differences.
        """
        world, moving = self._worlds.at(theta), np.flatnonzero(self._worlds.of_points)
        some = len(moving) and any(m.places is not None for several in self._matched for m in several)
        moves = self._worlds.moves(theta, steps, moving) if some else None
        closing, out = self._worlds.closing(theta, steps), []
        for f, state in enumerate(states):
            scene, blocks = self._scene(world, f, state), [np.empty((0, len(theta)))]
            for i, matched in enumerate(self._matched[f]):
                for rows in self._rows((f, i), matched.sensor, matched, scene, world):
                    blocks.append(np.full((len(rows), len(theta)), np.nan))
                    if matched.cameras is not None and isinstance(rows, Rows):
                        seen_by = matched.cameras[rows.group] if len(matched.cameras) else matched.cameras
                        for kind, own in self._worlds.cameras:
                            blocks[-1][:, own] = kind.columns(rows, world.rig, seen_by)
                    if moves is None or matched.places is None or not isinstance(rows, Rows) or scene.morphing:
                        continue
                    there = scene.at_time(matched.time)
                    by_points = moves.columns(matched.places, rows, there.body.tree, there.frames)
                    if by_points is not None:
                        blocks[-1][:, moving] = by_points
            if closing is not None:
                blocks.append(closing.whitened(state))
            out.append(np.concatenate(blocks))
        return out

    def rows_of_frames(self, theta: NDArray, states: Sequence[BodyState]) -> list[list[FrameRows]]:
        """Rows of every frame's measurements, with parameters (p,)."""
        world = self._worlds.at(theta)
        return [
            [
                (matched, self._rows((f, i), matched.sensor, matched, self._scene(world, f, state), world))
                for i, matched in enumerate(self._matched[f])
            ]
            for f, state in enumerate(states)
        ]

    def _rows(
        self, key: tuple[int, int], sensor: str, matched: Matched, scene: Scene, world: World
    ) -> Sequence[AnyRows]:
        """Rows of one measurement; cached rows if the world differs only in parts on which they do not depend."""
        cached = self._latest.get(key)
        same = cached is not None and cached[0] is scene.state
        if same and cached is not None and _same_for(cached[1], world, sensor, matched.shows_surface):
            return cached[2]
        rows = rows_at(matched, scene)
        if not same:
            self._latest[key] = scene.state, world, rows
        return rows

    def _scene(self, world: World, frame: int, state: BodyState) -> Scene:
        measurements = self._steps[frame]
        velocity = None if self._velocities is None else self._velocities[frame]
        time = measurements[0].time if self._times is None else self._times[frame]
        scene = self._worlds.scene(world, state)
        return scene.at(state, time=time, velocity=velocity, measurements=measurements)


def point_moves(found: SubjectFit) -> PointMoves:
    """Derivatives of points and joints by those parameters of a fit that move nothing else."""
    worlds, step = Worlds(found.prior_world, found.parameters), stacked(found.parameters)[3]
    return worlds.moves(found.mean, step, np.flatnonzero(worlds.of_points))


def closing_moves(found: SubjectFit, body: Body) -> ClosureMoves | None:
    """Derivatives of a body's closures by the parameters of a fit; None for a body without closures.

    The fitted body may have had fewer closures.
    """
    if not body.closures:
        return None
    world = replace(found.prior_world, body=replace(found.prior_world.body, closures=body.closures))
    return Worlds(world, found.parameters).closing(found.mean, stacked(found.parameters)[3])


def _same_for(a: World, b: World, sensor: str, of_surface: bool) -> bool:
    """Whether a sensor's rows are the same in two worlds; rows of a surface do not depend on the body's points."""
    same = a.body is b.body or (
        of_surface and all(getattr(a.body, name) is getattr(b.body, name) for name in _SURFACE_ATTRIBUTES)
    )
    return same and a.rig is b.rig and a.values.get(sensor) == b.values.get(sensor)


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
        from the bias of its residuals (see `parameters.excess`).
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
