"""The smoother's border: unknowns of sensors, such as a rope's length, that all frames of a take share.

With A the system of the poses at their minimum, B its coupling to the unknowns θ, and S, b the equations of θ alone,
(S − Bᵀ A⁻¹ B) Δθ = b − Bᵀ A⁻¹ g. A is a band, so that A⁻¹ B costs one solution for each unknown.

Solve a long take in overlapping windows, and keep the middle of each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from kinefit._threads import side_by_side
from kinefit.bodies import BodyState
from kinefit.fitting.smoothing.process_noise import DETECTOR_CORRELATION_TIME, SmoothTake
from kinefit.fitting.smoothing.shape_errors import FrameMatches
from kinefit.fitting.smoothing.spool import Spool
from kinefit.fitting.subject.fit import Worlds
from kinefit.fitting.subject.parameters import World
from kinefit.fitting.subject.sensor_parameters import OwnUnknowns
from kinefit.fitting.subject.subject import SubjectFit
from kinefit.sensors.base import Matched
from kinefit.solving.bundle.border_frames import POSTURE_SHARE
from kinefit.solving.equations import inverse
from kinefit.solving.trajectory.smoothing import Posterior, responses

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
