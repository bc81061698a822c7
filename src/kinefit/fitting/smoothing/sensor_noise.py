"""Errors of all sensors but the keypoints: variance components, and the effect of systematic errors on the pose."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import room
from kinefit.bodies import Body, BodyState
from kinefit.fitting.frame.fit import ignores_surface_offsets, rows_of_points
from kinefit.fitting.frame.results import ROOT_PRIOR_STD
from kinefit.fitting.frame.skin import has_surface_offset, skin_of
from kinefit.fitting.smoothing.process_noise import SmoothTake
from kinefit.fitting.smoothing.spool import MATRIX_FRAMES, Spool, stretches
from kinefit.fitting.smoothing.tracked_frames import TrackedFrames
from kinefit.sensors.base import Matched, rows_at
from kinefit.sensors.channels import ChannelResiduals
from kinefit.sensors.points.markers import MarkerMatched
from kinefit.solving import equations
from kinefit.solving.bundle.border_frames import gram
from kinefit.solving.correspondences.closures import every_closure
from kinefit.solving.rows import DofRows, Rows, weaker
from kinefit.solving.trajectory.variance_components import VarianceComponents, variance_components

_RIGID_SURFACE_STDS = 1e-6, 1e-6  # [m], [rad] of surface offsets of a body without joints: it is its surface
_MIN_SURFACE_STD = 1e-4  # [m] of a surface offset, in place of 0
_LEVERAGE_FRAMES = 40  # of a take, in which the leverage of each channel is computed
_STATED_CHANNELS = 5.0  # channels along one axis, without leverage, that a stated systematic error counts as


_Push = tuple[NDArray, NDArray, NDArray]
"""Rows of one sensor in one frame: channels and axes (2, R), Σ w J (R, n) and Σ w (R,) of each."""


class Pushes(NamedTuple):
    """Gradients Jᵀ W e of the pose by systematic errors e of one standard deviation of some sensors, in one frame.

    Parameters
    ----------
    information : (n, n) of these sensors
    constant, drift : (k, n) of errors that last for the whole take, and of those that drift
    rest : (n, n) Σ s sᵀ of the gradients s of errors that are others in every frame
    surplus : (n, n) Σ s sᵀ of what the fit assumes beyond white errors, see `LastingPushes`
    """

    information: NDArray
    constant: NDArray
    drift: NDArray
    rest: NDArray
    surplus: NDArray


@dataclass(frozen=True, eq=False)
class LastingPushes:
    """Gradients by the systematic errors of one sensor, in some frames.

    Parameters
    ----------
    per_unit : of each of these frames (k, n) gradients by a unit of each error, averaged over the frames within the
        correlation time of the motion
    stds : (3, k) standard deviations of constant errors, of those that drift, and of the surplus: what the fit assumes
        to be white beyond the errors that are
    drift_time : [s] in which the correlation of the drift falls to 1/e
    """

    per_unit: Sequence[NDArray]
    stds: NDArray
    drift_time: float


@dataclass(frozen=True, eq=False)
class _SensorErrors:
    """What shows the errors of one sensor of C channels along A axes.

    Parameters
    ----------
    residuals : (T, C, A) [m], NaN where unobserved
    assumed, stated : (C, A) [m²] variance that the fit assumes, and what is stated to last of it
    independent : whether channels err independently
    pushes : frame -> its rows
    """

    residuals: NDArray
    assumed: NDArray
    stated: NDArray
    independent: bool
    pushes: Callable[[int], Sequence[_Push]]


@dataclass(frozen=True, eq=False)
class OtherNoise:
    """Information and systematic errors of all sensors but the keypoints.

    Parameters
    ----------
    information : (T, n (n + 1) / 2) of every frame's rows, the upper triangle of each
    rest : (T, n (n + 1) / 2) as in `Pushes`, of every frame alone
    half : frames to either side within the correlation time of the motion, over which both are averaged
    lasting : of each sensor
    frames : (K,) int, increasing, those of `lasting`
    components : {sensor: VarianceComponents [m]}
    """

    information: NDArray
    rest: NDArray
    half: int
    lasting: tuple[LastingPushes, ...]
    frames: NDArray
    components: dict[str, VarianceComponents]

    def near(self, f: int) -> slice:
        """The frames within the correlation time of frame `f`."""
        return slice(max(f - self.half, 0), f + self.half + 1)

    def pooled(self, f: int) -> NDArray:
        """(n, n) information near frame `f`."""
        return square(self.information[self.near(f)].mean(axis=0))

    def pushes(self, f: int) -> Pushes:
        """Of one of `frames`."""
        k, rest = int(np.searchsorted(self.frames, f)), square(self.rest[self.near(f)].mean(axis=0))
        none, pushes = np.zeros((0, len(rest))), [(one.stds, one.per_unit[k]) for one in self.lasting]
        constant, drift, surplus = (
            np.concatenate([none, *(stds[part][:, None] * push for stds, push in pushes)]) for part in range(3)
        )
        return Pushes(self.pooled(f), constant, drift, rest, gram(surplus, surplus))

    @property
    def drift_times(self) -> list[float]:
        """[s] of each sensor that drifts."""
        return [one.drift_time for one in self.lasting if np.any(one.stds[1] > 0.0)]

    def summary(self) -> dict[str, Any]:
        """The variance components in a few numbers, by sensor."""
        return {name: found.summary("m", 4) for name, found in self.components.items()}


def covariance_alone(body: Body, state: BodyState, information: NDArray) -> NDArray:
    """(n, n) covariance of one frame on its own, closures and prior included; 0 for a fixed root.

    Parameters
    ----------
    information : (n, n) of the frame's measurements
    """
    tree = body.tree
    if body.closures:
        information = information + equations.normal_equations(body, state, every_closure(body, state)).matrix
    free = slice(0 if tree.root_free else 6, tree.n_dofs)
    prior = equations.block_diagonal(np.eye(6) / ROOT_PRIOR_STD**2, tree.posture_precision)
    out = np.zeros_like(information)
    out[free, free] = equations.inverse((information + prior)[free, free])
    return out


def leverages(J: NDArray, pushed: NDArray, alone: NDArray) -> NDArray:
    """(R,) leverages: share of the variance of each row's error that the fit absorbs.

    Errors e of equal variance leave residuals r = (I − J P Jᵀ W) e. The errors of other rows add a negative share.

    Parameters
    ----------
    J, pushed : (R, n) derivatives by the pose, and W J
    alone : (n, n) covariance P of the frame on its own
    """
    residual = np.eye(len(J)) - equations.product(equations.product(J, alone), pushed.T)
    return np.asarray(1.0 - np.sum(residual**2, axis=1))


def noise_of_sensors(
    take: SmoothTake, matched: Sequence[tuple[Matched, ...]] | None, *, half: int = 0, surfaces: bool = True,
    frames: NDArray | None = None,
) -> OtherNoise:  # fmt: skip
    """Estimate the noise of all sensors but the keypoints from their residuals at the states of a take.

    Parameters
    ----------
    matched : T lists of matches of `take.others`; None without them
    half : frames to either side within the correlation time of the motion
    surfaces : whether surface offsets count as systematic errors
    frames : (K,) int, increasing, in which systematic errors are asked for; default: all
    """
    body, T, n = take.body, len(take.roots), take.body.tree.n_dofs
    shape, upper, errors = (T, n * (n + 1) // 2), np.triu_indices(n), dict[str, _SensorErrors]()
    information = rest = np.broadcast_to(0.0, shape)
    if take.markers.sensors:
        information = room(shape)
        errors |= _of_markers(take, information)
        # Neighbouring frames repeat the same error of the prior, which counts where the cost is flat.
        rest = np.broadcast_to(equations.block_diagonal(np.zeros((6, 6)), body.tree.posture_precision)[upper], shape)
    if take.others is not None and matched is not None:
        information, rest = (np.add(values, 0.0, out=room(shape)) for values in (information, rest))
        errors |= _of_rows(take, take.others, matched, information, rest, surfaces=surfaces)
    absorbed = defaultdict[str, list[NDArray]](list)
    for f in np.linspace(0, T - 1, min(_LEVERAGE_FRAMES, T)).astype(int) if errors else ():
        one, state = slice(f, f + 1), BodyState(take.roots[f], take.angles[f])
        whole = take.pixels.part(one).information(body, take.roots[one], take.angles[one])[0]
        alone = covariance_alone(body, state, whole + square(information[f]))
        for sensor, of in errors.items():
            for at, push, weight in of.pushes(f):
                absorbed[sensor].append(np.vstack([at, leverages(push / weight[:, None], push, alone)]))
    lasting, found = list[LastingPushes](), dict[str, VarianceComponents]()
    asked = np.arange(T) if frames is None else frames
    for sensor, of in errors.items():
        leverage = _means(absorbed[sensor], of.residuals.shape[1:]).mean(axis=1)
        noise = variance_components(of.residuals, take.markers.times, leverage=leverage, window=2 * half + 1)
        stds = _lasting(noise, leverage, of)
        per_unit = Spool(_with_shared(mean).astype(np.float32) for mean in _window_means(of, half, asked, n))
        lasting.append(LastingPushes(per_unit, stds.reshape(3, -1), noise.drift_time))
        found[sensor] = noise
    return OtherNoise(information, rest, half, tuple(lasting), asked, found)


def _of_rows(
    take: SmoothTake, others: TrackedFrames, matched: Sequence[tuple[Matched, ...]], information: NDArray,
    rest: NDArray, *, surfaces: bool,
) -> dict[str, _SensorErrors]:  # fmt: skip
    """Errors of all sensors of which there are rows; adds to `information` and `rest`, see `OtherNoise`."""
    body, upper = take.body, np.triu_indices(take.body.tree.n_dofs)
    residuals, pushes = ChannelResiduals(), Spool[list[tuple[str, _Push]]]()
    variance, independent = defaultdict[str, list[NDArray]](list), set[str]()
    for f in range(len(take.roots)):
        scene, surface = others.scene(f, take.roots, take.angles), list[Rows | DofRows]()
        pushed = list[tuple[str, _Push]]()
        for m in matched[f]:
            scale = others.scale.get(m.sensor, 1.0)
            made = [r for r in rows_at(m, scene) if r.weight.ndim == 1 and len(r)]
            points = [r for r in made if not has_surface_offset(r, m)]
            surface += [weaker(r, scale) for r in made if has_surface_offset(r, m)]
            weights = [r.weight * equations.robust_factors(r)[0] / scale**2 for r in points]
            for rows, w, at in zip(points, weights, residuals.add(f, m, points, [r.residual for r in points], weights)):
                used = w > 0.0
                J, w, at = equations.design(body, scene.state, rows)[used], w[used], at[:, used]
                information[f] += gram(J, w[:, None] * J)[upper]
                pushed.append((m.sensor, _summed(at, w[:, None] * J, w)))
                assumed = scale**2 / rows.weight[used]
                variance[m.sensor].append(np.vstack([at, assumed, m.lasts / rows.weight[used]]))
                independent |= {m.sensor} if m.independent else set()
        if surface:
            settings = others.tracker.settings
            offset_stds = max(settings.skin_shift, _MIN_SURFACE_STD), settings.skin_turn
            skin = skin_of(scene, surface, *(offset_stds if body.tree.coordinates else _RIGID_SURFACE_STDS), matched[f])
            exact = ignores_surface_offsets(scene, settings, int(others.points[f]) + rows_of_points(scene, matched[f]))
            information[f] += (skin.exact_information if exact else skin.information)[upper]
            if surfaces:
                pushed_by_skin = skin.exact_pushes if exact else skin.pushes
                rest[f] += gram(pushed_by_skin, pushed_by_skin)[upper]
        pushes.append(pushed)

    def pushes_of(f: int, sensor: str) -> list[_Push]:
        return [push for name, push in pushes[f] if name == sensor]

    out = dict[str, _SensorErrors]()
    for sensor, (values, _) in residuals.arrays(len(take.roots)).items():
        assumed, stated = (_means([one[[0, 1, k]] for one in variance[sensor]], values.shape[1:]) for k in (2, 3))
        of_sensor = partial(pushes_of, sensor=sensor)
        out[sensor] = _SensorErrors(values, assumed, stated, sensor in independent, of_sensor)
    return out


def _of_markers(take: SmoothTake, information: NDArray) -> dict[str, _SensorErrors]:
    """Errors of packed markers by sensor; fills in `information`, see `OtherNoise`."""
    body, markers, n = take.body, take.markers, take.body.tree.n_dofs
    upper, gaps, weight = np.triu_indices(n), room(markers.values.shape), room(markers.stated.shape)
    for some in stretches(len(gaps), MATRIX_FRAMES):
        part, at = markers.part(some), (take.roots[some], take.angles[some])
        information[some] = part.information(body, *at)[:, upper[0], upper[1]]
    for some, part, of_part in markers.stretched(body, take.roots, take.angles):
        gaps[some], weight[some] = of_part, part.factors(of_part) * part.weight

    def pushes(f: int, own: NDArray) -> list[_Push]:
        seen = np.flatnonzero(weight[f, own] > 0.0)
        state = BodyState(take.roots[f], take.angles[f])
        J = equations.point_derivatives(body, state, markers.points)[own[seen]].reshape(-1, n)
        w = np.repeat(weight[f, own[seen]], 3)
        return [(np.stack([np.repeat(seen, 3), np.tile(np.arange(3), len(seen))]), w[:, None] * J, w)]

    out = dict[str, _SensorErrors]()
    for sensor in markers.sensors:
        own = markers.columns(sensor)
        used = weight[:, own] > 0.0
        variance = np.where(used, 1.0 / np.where(used, markers.stated[:, own], 1.0), 0.0)
        assumed = np.repeat(filled(variance.sum(axis=0), np.count_nonzero(used, axis=0))[:, None], 3, axis=1)
        out[sensor] = _SensorErrors(
            gaps[:, own], assumed, MarkerMatched.lasts * assumed, MarkerMatched.independent, partial(pushes, own=own)
        )  # fmt: skip
    return out


def filled(total: NDArray, count: NDArray) -> NDArray:
    """Means (C,) of totals (C,) over counts (C,); the overall mean where the count is 0."""
    return np.where(count > 0, total / np.maximum(count, 1), total.sum() / max(float(count.sum()), 1.0))


def _lasting(found: VarianceComponents, leverage: NDArray, of: _SensorErrors) -> NDArray:
    """(3, C + 1, A) standard deviations of constant errors and of those that drift, and the surplus of `LastingPushes`.

    The last of C + 1 is what channels share. What is stated beyond the estimate drifts: at least for as long as a
    posture lasts. A share of it counts, which falls with the number of independent channels, each counted by
    1 − leverage (C,): their residuals would show a larger error. The statement itself counts as `_STATED_CHANNELS`
    channels. If channels are not independent, the fit absorbs their common error, and the share is 1.
    """
    axes = of.stated.shape[1]
    channels = axes * float(np.sum(np.clip(1.0 - leverage, 0.0, 1.0))) if of.independent else 0.0
    share = _STATED_CHANNELS / (_STATED_CHANNELS + channels)
    excess = share * np.maximum(of.stated - found.systematic[:, None] ** 2, 0.0)
    constant = np.broadcast_to(np.hypot(found.bias, found.bias_error)[:, None], of.stated.shape)
    drift = np.sqrt(found.smoothed_drift[:, None] ** 2 + excess)
    surplus = np.sqrt(np.maximum(of.assumed - found.white[:, None] ** 2, 0.0))
    shared = found.shared[0], np.zeros(axes), np.zeros(axes)
    return np.stack([np.vstack(one) for one in zip((constant, drift, surplus), shared)])


def _with_shared(pushes: NDArray) -> NDArray:
    """(C A + A, n) gradients by the errors of channels (C, A, n), and by an error that all share."""
    return np.concatenate([pushes, pushes.sum(axis=0)[None]]).reshape(-1, pushes.shape[2])


def _summed(at: NDArray, push: NDArray, weight: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Unique channels and axes (2, R) of N rows, with the sums of the rows' w J (R, n) and weights (R,)."""
    at, index = np.unique(at, axis=1, return_inverse=True)
    index, out = index.ravel(), np.zeros((at.shape[1], push.shape[1]))
    np.add.at(out, index, push)
    return at, out, np.bincount(index, weight, at.shape[1])


def _means(entries: Sequence[NDArray], shape: tuple[int, ...]) -> NDArray:
    """(C, A) means of entries (3, R) (channel, axis, value); the overall mean where there are no entries."""
    channel, axis, value = np.concatenate([np.zeros((3, 0)), *entries], axis=1)
    count, total = np.zeros(shape), np.zeros(shape)
    at = channel.astype(np.int64), axis.astype(np.int64)
    np.add.at(count, at, 1.0)
    np.add.at(total, at, value)
    return np.where(count > 0, total / np.maximum(count, 1), np.mean(value) if len(value) else 0.0)


def _window_means(of: _SensorErrors, half: int, frames: NDArray, n: int) -> Iterator[NDArray]:
    """Mean w J (C, A, n) over the window of `half` frames to either side, for each of `frames` (K,)."""
    T = len(of.residuals)
    for some in stretches(T, MATRIX_FRAMES):
        asked = frames[(frames >= some.start) & (frames < some.stop)]
        if not len(asked):
            continue
        first, stop = np.maximum(asked - half, 0), np.minimum(asked + half + 1, T)
        total = np.zeros((stop[-1] - first[0] + 1, *of.residuals.shape[1:], n))
        for f in range(first[0], stop[-1]):
            for at, push, _ in of.pushes(f):
                total[f - first[0] + 1, at[0], at[1]] += push
        np.cumsum(total, axis=0, out=total)
        yield from (total[stop - first[0]] - total[first - first[0]]) / (stop - first)[:, None, None, None]


def square(packed: NDArray) -> NDArray:
    """Symmetric (n, n) from its upper triangle (n (n + 1) / 2,)."""
    out = np.empty((int(np.sqrt(2.0 * len(packed))),) * 2)
    upper = np.triu_indices(len(out))
    out[upper] = out.T[upper] = packed
    return out
