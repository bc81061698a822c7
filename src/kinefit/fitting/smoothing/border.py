"""The smoother's border: unknowns of sensors, such as a rope's length, that all frames of a take share.

With A the system of the poses at their minimum, B its coupling to the unknowns θ, and S, b the equations of θ alone,
(S − Bᵀ A⁻¹ B) Δθ = b − Bᵀ A⁻¹ g. A is a band, so that A⁻¹ B costs one solution for each unknown.

Solve a long take in overlapping windows, and keep the middle of each.

Propagate the uncertainty of a shape to poses: D Σ Dᵀ, with D the response of the fitted pose to the shape.

This holds for any sensors and parameters. At the fitted pose the gradient g = Jᵀ W r vanishes. If the shape is θ + δ,
it does not, and the pose responds by P ∂g/∂θ δ. Derivatives by θ are differences between worlds, as in the subject fit.

Parameters of surfaces alone (girths) are excluded: `frame.skin` accounts for surface offsets.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from kinefit._threads import side_by_side
from kinefit.bodies import Body, BodyState
from kinefit.bodies.lasting_errors import ParameterErrors, between
from kinefit.fitting.frame.fit import rows_of, rows_of_points
from kinefit.fitting.smoothing.process_noise import DETECTOR_CORRELATION_TIME, SmoothTake
from kinefit.fitting.smoothing.spool import Spool
from kinefit.fitting.subject.fit import CLOSURES, Worlds
from kinefit.fitting.subject.parameters import PointOffsets, World, stacked
from kinefit.fitting.subject.subject import OwnUnknowns, SubjectFit
from kinefit.fitting.subject.surfaces import CylinderShape, Girths
from kinefit.geometry.camera import Rig
from kinefit.sensors.base import Matched, rows_at
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.bundle.border_frames import POSTURE_SHARE, Part, Weighing, differences, frame_at, gram
from kinefit.solving.correspondences.closures import every_closure
from kinefit.solving.equations import inverse, joint_moves, normal_equations, square_root
from kinefit.solving.rows import weaker
from kinefit.solving.trajectory.smoothing import Posterior, responses

SAMPLED_FRAMES = 16
"""Frames in which responses are computed; variances are interpolated between them. On three simulated takes of 60
frames the mean standard deviation of joint centres differs by less than 1 % from that with responses in every frame,
single ones by 60 %."""


@dataclass(frozen=True, eq=False)
class ShapeErrors:
    """Variances that the uncertainty of the shape adds to some frames.

    Parameters
    ----------
    frames : (K,) int
    joints : (K, S, 3) [m²] of the joint centres along the world's axes
    factors : (K, n, q) [m, rad] of the degrees of freedom's covariance
    parameters : the q parameters, with `directions` (q, q) to the columns of `factors`
    """

    frames: NDArray
    joints: NDArray
    factors: NDArray
    parameters: ParameterErrors | None = None

    @cached_property
    def dofs(self) -> NDArray:
        """(K, n) [m², rad²] of the degrees of freedom."""
        return np.asarray(np.square(self.factors).sum(axis=2))

    def at(self, frame: int) -> tuple[NDArray, NDArray]:
        """(n,) [m², rad²] and (S, 3) [m²] variances of any frame, interpolated."""
        return self._between(self.dofs, frame), self._between(self.joints, frame)

    def factor_at(self, frame: int) -> NDArray:
        """(n, q) [m, rad] factor of the covariance of any frame, interpolated."""
        return self._between(self.factors, frame)

    def _between(self, values: NDArray, frame: int) -> NDArray:
        before, after, share = between(self.frames, np.asarray(frame))
        return np.asarray(values[before] * (1.0 - share) + values[after] * share)


def shape_errors(
    found: SubjectFit, settings: TrackSettings, frame_data: Callable[[int], tuple[Scene, Sequence[Matched]]],
    frames: Sequence[int], alone: Sequence[NDArray], scale: Mapping[str, float] | None = None,
) -> ShapeErrors:  # fmt: skip
    """Variances that the uncertainty of the shape adds to some frames.

    Parameters
    ----------
    found : subject fit with parameters and covariance
    settings : of the fit
    frame_data : frame -> its scene and all its matches, keypoints with the weights of the covariances
    frames : K numbers of frames
    alone : K (n, n) covariances of each frame on its own, prior included
    scale : {sensor: factor} on the standard deviations of other sensors' rows in these covariances
    """
    used = np.concatenate([
        np.full(len(p.names), not isinstance(p, CylinderShape | Girths)) for p in found.parameters
    ])  # fmt: skip
    wide = np.concatenate([np.full(len(p.names), not isinstance(p, PointOffsets)) for p in found.parameters])
    step, worlds = stacked(found.parameters)[3], Worlds(found.prior_world, found.parameters)
    Sigma = found.covariance[np.ix_(used, used)]
    root, joints, factors = square_root(Sigma), [], []
    for frame, P in zip(frames, alone):
        scene, matched = frame_data(frame)
        matches = FrameMatches(worlds, scene, matched, found.mean, used, np.flatnonzero(wide[used]), scale or {})
        gradients = matches.surfaces(step, settings) - matches.border(step)[2]
        response = P @ gradients
        moves = joint_moves(scene.body, scene.state)
        whole = moves @ response + matches.stretch(step)
        factors.append(response @ root)
        joints.append(np.einsum("sap,pq,saq->sa", whole, Sigma, whole, optimize=True))
    known = parameter_errors(found, root, np.flatnonzero(used))
    return ShapeErrors(np.asarray(frames), np.maximum(joints, 0.0), np.array(factors), known)


def parameter_errors(found: SubjectFit, root: NDArray, used: NDArray) -> ParameterErrors:
    """Some parameters (q,) int of a fit, with their errors `root` (q, m), of which root rootᵀ is the covariance."""
    names, cameras = list(found.names), found.cameras
    if cameras is not None:
        calibration = cameras.rig if cameras.calibrated is None else cameras.calibrated
        first = len(names) - len(cameras.names)
        for k, name in enumerate(names[first:]):
            pose = calibration[cameras.free[k // 6]].T_camera_world
            names[first + k] = f"{name} {hashlib.sha256(pose.tobytes()).hexdigest()[:8]}"
    information = found.prior.information[np.ix_(used, used)]
    return ParameterErrors(tuple(names[k] for k in used), found.mean[used], root @ root.T, information, root.T)


@dataclass(frozen=True, eq=False)
class FrameMatches:
    """One frame's matches as a function of q of p parameters: a `BorderedProblem` of one frame.

    Parameters
    ----------
    theta : (p,) parameters
    used : (p,) bool, the q parameters
    wide : int, numbers among the q of those that move more than landmark offsets
    scale : {sensor: factor} on standard deviations
    """

    worlds: Worlds
    scene: Scene
    matched: Sequence[Matched]
    theta: NDArray
    used: NDArray
    wide: NDArray
    scale: Mapping[str, float]

    @property
    def touches(self) -> tuple[frozenset[int] | None, ...]:
        """(q,) for each parameter the only segments whose rows depend on it; None for any."""
        return tuple(t for t, used in zip(self.worlds.touches, self.used) if used)

    def body(self, values: NDArray) -> Body:
        """The body with parameters (q,)."""
        return self.worlds.at(self._all(values)).body

    def parts(self, values: NDArray, frame: int, state: BodyState) -> list[Part]:
        """Rows of points and of closures, with parameters (q,)."""
        scene = self._scene(values)
        points = [
            (m.sensor, weaker(rows, self.scale.get(m.sensor, 1.0)))
            for m in self.matched if m.of_points for rows in rows_at(m, scene)
        ]  # fmt: skip
        return [*points, *((CLOSURES, rows) for rows in every_closure(scene.body, scene.state))]

    def border(self, step: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Equations (q, q), (q,) of the parameters by all points, and their coupling (n, q) to the pose.

        Parameters
        ----------
        step : (p,) of finite differences
        """
        mean, state = self.theta[self.used], self.scene.state
        frame = frame_at(self, mean, 0, state, Weighing())
        moved = frame.factor[:, None] * differences(self, mean, step[self.used], [state])[0]
        return gram(moved, moved), frame.residual @ moved, gram(frame.J, moved)

    def surfaces(self, step: NDArray, settings: TrackSettings) -> NDArray:
        """(n, q) ∂g/∂θ of all surfaces, by the `wide` parameters; step (p,) of finite differences."""
        n, mean = self.scene.body.tree.n_dofs, self.theta[self.used]
        out = np.zeros((n, len(mean)))
        surfaces = [m for m in self.matched if not m.of_points]
        if not surfaces or not len(self.wide):
            return out
        point_rows = rows_of_points(self.scene, self.matched)

        def gradient(values: NDArray) -> NDArray:
            scene = self._scene(values)
            rows = [r for r in rows_of(scene, surfaces, settings, self.scale, points=point_rows) if len(r)]
            return normal_equations(scene.body, scene.state, rows).gradient if rows else np.zeros(n)

        for k in self.wide:
            change = np.zeros(len(mean))
            change[k] = step[self.used][k]
            out[:, k] = (gradient(mean + change) - gradient(mean - change)) / (2.0 * change[k])
        return out

    def stretch(self, step: NDArray) -> NDArray:
        """(S, 3, q) derivatives of joint centres for a fixed pose; step (p,) of finite differences."""
        mean, state = self.theta[self.used], self.scene.state
        out = np.zeros((len(self.scene.body.tree.segments), 3, len(mean)))
        for k in self.wide:
            change = np.zeros(len(mean))
            change[k] = step[self.used][k]
            a, b = (_centres(self.body(mean + sign * change), state) for sign in (1.0, -1.0))
            out[:, :, k] = (a - b) / (2.0 * change[k])
        return out

    def _all(self, values: NDArray) -> NDArray:
        theta = self.theta.copy()
        theta[self.used] = values
        return theta

    def _scene(self, values: NDArray) -> Scene:
        s, world = self.scene, self.worlds.at(self._all(values))
        scene = self.worlds.scene(world, s.state)
        rig = _moved(s.rig, world.rig)
        return scene.at(s.state, rig=rig, time=s.time, velocity=s.velocity, measurements=s.measurements)


def _moved(rig: Rig, known: Rig) -> Rig:
    """A scene's cameras with the poses of `known`, for those that it contains; a fit to points alone contains none."""
    if known.names == rig.names:
        return known
    return Rig(tuple(known[c.name] if c.name in known else c for c in rig.cameras))


def _centres(body: Body, state: BodyState) -> NDArray:
    """(S, 3) [m] joint centres."""
    return body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, 3]


_PASS_TOLERANCES = 1e-3, 1e-5  # of two passes, each of matching all other sensors and solving, at known process noise


def parts(frames: int, window: int, overlap: int) -> list[tuple[slice, slice]]:
    """Overlapping windows of equal length: for each the frames to solve, and the frames to keep of them.

    Parameters
    ----------
    frames, window, overlap : numbers of frames
    """
    if frames <= window:
        return [(slice(0, frames), slice(0, frames))]
    count = int(np.ceil((frames - overlap) / (window - overlap)))
    window = int(np.ceil((frames + (count - 1) * overlap) / count))  # no longer than needed: each frame costs
    starts = np.round(np.linspace(0, frames - window, count)).astype(int)
    cuts = [0, *((starts[1:] + starts[:-1] + window) // 2).tolist(), frames]
    return [(slice(int(a), int(a) + window), slice(cuts[i], cuts[i + 1])) for i, a in enumerate(starts)]


def solved(
    take: SmoothTake, window: int, overlap: int, tolerances: Sequence[float] = _PASS_TOLERANCES
) -> tuple[SmoothTake, Spool[tuple[Matched, ...]] | None]:
    """Solve a take in windows; returns it at its minimum, and the matches of all sensors but the keypoints.

    Parameters
    ----------
    window, overlap : numbers of frames
    tolerances : unitless, of each pass of matching and solving; without other sensors the last one alone is used
    """
    matched, windows = None, parts(len(take.roots), window, overlap)
    for tolerance in tolerances[-1:] if take.others is None else tolerances:
        fit = partial(SmoothTake.solved, tolerance=tolerance)
        roots, angles = np.array(take.roots), np.array(take.angles)
        matched = None if take.others is None else Spool[tuple[Matched, ...]]()
        fits = side_by_side(fit, linear_parts(take, windows, matched))
        for (whole, kept), found in zip(windows, fits, strict=True):
            inside = slice(kept.start - whole.start, kept.stop - whole.start)
            roots[kept], angles[kept] = found.roots[inside], found.angles[inside]
            take.pixels.release()
        take = replace(take, roots=roots, angles=angles)
    return take, matched


def solved_with_covariances(
    take: SmoothTake, window: int, overlap: int
) -> tuple[SmoothTake, Spool[NDArray], Spool[tuple[Matched, ...]] | None]:
    """As `solved`, with covariances: the upper triangle (n (n + 1) / 2,) of each frame's (n, n).

    The returned take also has the standard deviations of speeds.
    """
    if take.others is not None:
        take, _ = solved(take, window, overlap, _PASS_TOLERANCES[:-1])
    packed, windows = np.triu_indices(take.body.tree.n_dofs), parts(len(take.roots), window, overlap)
    roots, angles = np.array(take.roots), np.array(take.angles)
    covariances, speeds = Spool[NDArray](), []
    matched = None if take.others is None else Spool[tuple[Matched, ...]]()
    fits = side_by_side(SmoothTake.fit, linear_parts(take, windows, matched, judge=True))
    for whole, kept in windows:
        fit, post = next(fits)
        inside = slice(kept.start - whole.start, kept.stop - whole.start)
        roots[kept], angles[kept] = fit.roots[inside], fit.angles[inside]
        take.pixels.release()
        speeds.append(_speed_std(post, take.dt)[max(inside.start - 1, 0) : inside.stop - 1])
        for covariance in post.frames[inside]:
            covariances.append(covariance[packed])
        del fit, post  # large, while the next parts are fitted
    moving = np.concatenate(speeds)
    speed_std = np.percentile(moving, 90.0, axis=0) if len(moving) else None
    return replace(take, roots=roots, angles=angles, speed_std=speed_std), covariances, matched


def linear_parts(
    take: SmoothTake, windows: Sequence[tuple[slice, slice]], matched: Spool[tuple[Matched, ...]] | None, *,
    judge: bool = False,
) -> Iterator[SmoothTake]:  # fmt: skip
    """Windows of a take, with other sensors matched and linearised at its states; matches are added to `matched`."""
    spans, linear = [whole for whole, _ in windows], None
    if take.others is not None:
        linear = take.others.windows(take.roots, take.angles, spans, matched, judge=judge)
    for whole in spans:
        part = take.part(whole)
        yield part if linear is None else replace(part, linear=next(linear))


def _speed_std(post: Posterior, dt: float) -> NDArray:
    """(T - 1, n) [m/s, rad/s] standard deviation of each change to the next frame, without systematic errors."""
    own = np.einsum("tii->ti", post.frames)
    return np.sqrt(np.maximum(own[1:] + own[:-1] - 2.0 * np.einsum("tii->ti", post.following), 0.0)) / dt


_ROUNDS = 5  # of smoothing at some values and a step of these; each step of a rope's is a twentieth of that before
_MAX_CHANGE_SIGMAS = 0.1  # of a step that counts as converged


@dataclass(frozen=True, eq=False)
class Border:
    """Unknowns of sensors as a whole take tells them.

    Parameters
    ----------
    unknowns : OwnUnknowns
    theta : (p,) values
    covariance : (p, p); the frames of a quarter of a second count as one
    """

    unknowns: OwnUnknowns
    theta: NDArray
    covariance: NDArray

    @classmethod
    def of(cls, found: SubjectFit) -> Border | None:
        """The unknowns of sensors in a subject fit; None without any."""
        for kind, own in found.kinds:
            if isinstance(kind, OwnUnknowns):
                return cls(kind, found.mean[own], found.covariance[own, own])
        return None

    @property
    def values(self) -> Mapping[str, Mapping[str, float]]:
        """{sensor: {name: value}} of all unknowns."""
        return self.unknowns.values(self.theta)

    def applied(self, found: SubjectFit) -> SubjectFit:
        """A subject fit with these unknowns in place of its own, their errors apart from those of the rest."""
        mean, covariance = found.mean.copy(), found.covariance.copy()
        for kind, own in found.kinds:
            if kind is self.unknowns:
                covariance[own] = covariance[:, own] = 0.0
                mean[own], covariance[own, own] = self.theta, self.covariance
        return replace(found, mean=mean, covariance=covariance)


def with_border(
    take: SmoothTake, border: Border, window: int, overlap: int
) -> tuple[SmoothTake, Border]:
    """A take at the minimum over its poses and unknowns, and these; of sensors whose rows are points.

    Parameters
    ----------
    border : to start from
    window, overlap : numbers of frames
    """
    others, prior = take.others, border.unknowns.information
    assert others is not None
    for _ in range(_ROUNDS):
        take = replace(take, others=replace(others, values=border.values))
        take, S, b = _reduced(take, border, window, overlap)
        informed = np.flatnonzero(np.diag(S) > 0.0)  # of surfaces and of what no row moves, the subject fit knows more
        if not len(informed):
            return take, border
        own = np.ix_(informed, informed)
        alike = max(DETECTOR_CORRELATION_TIME / take.dt, 1.0)
        information, theta, covariance = (S / alike + prior)[own], border.theta.copy(), border.covariance.copy()
        step = np.linalg.solve((S + prior)[own], (b + prior @ (border.unknowns.mean - theta))[informed])
        theta[informed] += step
        covariance[informed] = covariance[:, informed] = 0.0
        covariance[own] = inverse(information)
        border = replace(border, theta=theta, covariance=covariance)
        if step @ information @ step < _MAX_CHANGE_SIGMAS**2 * len(step):
            break
    return replace(take, others=replace(others, values=border.values)), border


def _reduced(
    take: SmoothTake, border: Border, window: int, overlap: int
) -> tuple[SmoothTake, NDArray, NDArray]:
    """The take smoothed at its values, and the equations S (p, p), b (p,) of their step, all poses eliminated."""
    p = len(border.theta)
    S, b, step = np.zeros((p, p)), np.zeros(p), border.unknowns.step
    world, matched = World(take.body, take.pixels.channels.rig), Spool[tuple[Matched, ...]]()
    worlds, windows = Worlds(world, (border.unknowns,)), parts(len(take.roots), window, overlap)
    roots, angles, every = np.array(take.roots), np.array(take.angles), np.ones(p, bool)
    for (whole, kept), part in zip(windows, linear_parts(take, windows, matched)):
        fit = part.solved(posture=POSTURE_SHARE)
        inside = slice(kept.start - whole.start, kept.stop - whole.start)
        roots[kept], angles[kept] = fit.roots[inside], fit.angles[inside]
        B = np.zeros((*fit.system.g.shape, p))
        for k in range(inside.start, inside.stop):
            own = [m for m in matched[whole.start + k] if m.sensor in border.unknowns.unknowns]
            if own and part.others is not None:  # where A has their rows: at the states of the matches
                scene = part.others.scene(k, part.roots, part.angles)
                at = FrameMatches(worlds, scene, own, border.theta, every, np.arange(0), part.others.scale)
                of_values, pull, B[k] = at.border(step)
                moved = scene.state.difference(BodyState(fit.roots[k], fit.angles[k]))
                S, b = S + of_values, b + pull - moved @ B[k]
        X = responses(take.body, fit, B)
        S, b = S - np.einsum("tnp,tnq->pq", B, X), b - np.einsum("tnp,tn->p", X, fit.system.g)
    return replace(take, roots=roots, angles=angles), 0.5 * (S + S.T), b
