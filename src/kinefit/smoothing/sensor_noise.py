"""Errors of all sensors but the keypoints: variance components, and the effect of systematic errors on the pose."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import room
from kinefit.bodies import Body, BodyState
from kinefit.correspondences.closures import every_closure
from kinefit.frame.fit import ignores_surface_offsets, rows_of_points
from kinefit.frame.results import ROOT_PRIOR_STD
from kinefit.frame.skin import skin_of
from kinefit.rows import DofRows, Rows, weaker
from kinefit.sensors.base import Matched, rows_at
from kinefit.sensors.channels import ChannelResiduals
from kinefit.sensors.points.markers import MarkerMatched
from kinefit.sensors.points.packed_markers import PackedMarkers
from kinefit.smoothing.process_noise import SmoothTake
from kinefit.smoothing.spool import MATRIX_FRAMES, Spool, stretches
from kinefit.smoothing.tracked_frames import TrackedFrames, squares_of
from kinefit.solvers.bundle.border_frames import gram
from kinefit.solvers.equations import block_diagonal, design, inverse, normal_equations, point_derivatives, product
from kinefit.solvers.trajectory.seen_points import SeenPoints
from kinefit.solvers.trajectory.smoothing import unpacked
from kinefit.solvers.trajectory.variance_components import VarianceComponents, variance_components

_RIGID_SURFACE_STDS = 1e-6, 1e-6  # [m], [rad] of surface offsets of a body without joints: it is its surface
_MIN_SURFACE_STD = 1e-4  # [m] of a surface offset, in place of 0
_LEVERAGE_FRAMES = 40  # of a take, in which the leverage of each channel is computed
_STATED_CHANNELS = 5.0  # channels along one axis, without leverage, that a stated systematic error counts as


_Push = tuple[str, NDArray, NDArray, NDArray]
"""Rows of one sensor in one frame: its name; channels and axes (2, R), Σ w J (R, n) and Σ w (R,) of each."""


class Pushes(NamedTuple):
    """Gradients Jᵀ W e of the pose by systematic errors e of one standard deviation, in one frame.

    Parameters
    ----------
    constant, drift : (k, n) of errors that last for the whole take, and of those that drift
    rest : (n, n) Σ s sᵀ of the gradients s of errors that are others in every frame
    surplus : (n, n) Σ s sᵀ of what the fit assumes beyond the jitter, see `LastingPushes`
    """

    constant: NDArray
    drift: NDArray
    rest: NDArray
    surplus: NDArray

    @classmethod
    def none(cls, n: int) -> Pushes:
        """Of no sensor."""
        return cls(np.zeros((0, n)), np.zeros((0, n)), *np.zeros((2, n, n)))


@dataclass(frozen=True, eq=False)
class LastingPushes:
    """Gradients by the systematic errors of sensors of one kind, in some frames.

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
class OtherNoise:
    """Information and systematic errors of all sensors but the keypoints.

    Parameters
    ----------
    information : (T, n (n + 1) / 2) of every frame's rows, the upper triangle of each
    rest : (T, n (n + 1) / 2) as in `Pushes`
    lasting : of each kind of sensor
    frames : (K,) int, increasing, those of `lasting`
    components : {sensor: VarianceComponents [m]}
    """

    information: NDArray
    rest: NDArray
    lasting: tuple[LastingPushes, ...]
    frames: NDArray
    components: dict[str, VarianceComponents]

    def pooled(self, f: int, half: int) -> NDArray:
        """(n, n) information, averaged over `half` (int) frames to either side."""
        return _square(self.information[max(f - half, 0) : f + half + 1].mean(axis=0))

    def pushes(self, f: int) -> Pushes:
        """Of one of `frames`."""
        k, rest = int(np.searchsorted(self.frames, f)), _square(self.rest[f])
        per_unit = [one.per_unit[k] for one in self.lasting]
        none, pushes = np.zeros((0, len(rest))), list(zip((one.stds for one in self.lasting), per_unit))
        constant, drift, surplus = (
            np.concatenate([none, *(stds[part][:, None] * push for stds, push in pushes)]) for part in range(3)
        )
        return Pushes(constant, drift, rest, gram(surplus, surplus))

    @property
    def drift_times(self) -> list[float]:
        """[s] of each kind of sensor that drifts."""
        return [one.drift_time for one in self.lasting if np.any(one.stds[1] > 0.0)]

    def __add__(self, other: OtherNoise) -> OtherNoise:
        """The noise of both, of different sensors."""
        return OtherNoise(
            self.information + other.information, self.rest + other.rest, self.lasting + other.lasting, self.frames,
            {**self.components, **other.components},
        )  # fmt: skip

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
        information = information + normal_equations(body, state, every_closure(body, state)).matrix
    free = slice(0 if tree.root_free else 6, tree.n_dofs)
    prior = block_diagonal(np.eye(6) / ROOT_PRIOR_STD**2, tree.posture_precision)
    out = np.zeros_like(information)
    out[free, free] = inverse((information + prior)[free, free])
    return out


def leverages(J: NDArray, pushed: NDArray, alone: NDArray) -> NDArray:
    """(R,) leverages: share of the variance of each row's error that the fit absorbs.

    Errors e of equal variance leave residuals r = (I − J P Jᵀ W) e. The errors of other rows add a negative share.

    Parameters
    ----------
    J, pushed : (R, n) derivatives by the pose, and W J
    alone : (n, n) covariance P of the frame on its own
    """
    residual = np.eye(len(J)) - product(product(J, alone), pushed.T)
    return np.asarray(1.0 - np.sum(residual**2, axis=1))


def other_noise(
    body: Body, others: TrackedFrames, matched: Sequence[tuple[Matched, ...]], roots: NDArray, angles: NDArray,
    pixels: Callable[[int], NDArray], *, half: int = 0, surfaces: bool = True, frames: NDArray | None = None,
) -> OtherNoise:  # fmt: skip
    """Estimate the noise of all sensors but the keypoints from their residuals at fitted states.

    Parameters
    ----------
    matched : T lists of matches
    roots, angles : (T, 4, 4), (T, D) fitted
    pixels : frame -> (n, n) information of its keypoints
    half : frames to either side within the correlation time of the motion
    surfaces : whether surface offsets count as systematic errors
    frames : (K,) int, increasing, in which systematic errors are asked for; default: all
    """
    T = len(roots)
    upper, frames = np.triu_indices(body.tree.n_dofs), np.arange(T) if frames is None else frames
    information, skins, rest = np.zeros((3, T, len(upper[0])))
    residuals, pushes = ChannelResiduals(), Spool[list[_Push]]()
    absorbed, stated, assumed = (defaultdict[str, list[NDArray]](list) for _ in range(3))
    independent = set[str]()
    leverage_frames = set(np.linspace(0, T - 1, min(_LEVERAGE_FRAMES, T)).astype(int).tolist())
    for f in range(T):
        scene, surface, pushed = others.scene(f, roots, angles), list[Rows](), list[_Push]()
        for m in matched[f]:
            scale = others.scale.get(m.sensor, 1.0)
            made = [r for r in rows_at(m, scene) if isinstance(r, Rows | DofRows) and len(r)]
            points = [r for r in made if m.of_points or isinstance(r, DofRows)]
            surface += [weaker(r, scale) for r in made if isinstance(r, Rows) and not m.of_points]
            weights = [r.weight * squares_of(r)[1] / scale**2 for r in points]
            for rows, w, at in zip(points, weights, residuals.add(f, m, points, [r.residual for r in points], weights)):
                used = w > 0.0
                J, w, at = design(body, scene.state, rows)[used], w[used], at[:, used]
                information[f] += gram(J, w[:, None] * J)[upper]
                pushed.append((m.sensor, *_summed(at, w[:, None] * J, w)))
                stated[m.sensor].append(np.vstack([at, m.lasts / rows.weight[used]]))
                assumed[m.sensor].append(np.vstack([at, scale**2 / rows.weight[used]]))
                independent |= {m.sensor} if m.independent else set()
        if surface:
            settings = others.tracker.settings
            offset_stds = max(settings.skin_shift, _MIN_SURFACE_STD), settings.skin_turn
            skin = skin_of(scene, surface, *(offset_stds if body.tree.coordinates else _RIGID_SURFACE_STDS), matched[f])
            exact = ignores_surface_offsets(scene, settings, int(others.points[f]) + rows_of_points(scene, matched[f]))
            information[f] += (skin.exact_information if exact else skin.information)[upper]
            if surfaces:
                pushed_by_skin = skin.exact_pushes if exact else skin.pushes
                skins[f] += gram(pushed_by_skin, pushed_by_skin)[upper]
        if f in leverage_frames:
            alone = covariance_alone(body, scene.state, _square(information[f]) + pixels(f))
            for sensor, at, push, weight in pushed:
                absorbed[sensor].append(np.vstack([at, leverages(push / weight[:, None], push, alone)]))
        pushes.append(pushed)
    found, stds = {}, {}
    for sensor, (values, _) in residuals.arrays(T).items():
        leverage = _means(absorbed[sensor], values.shape[1:]).mean(axis=1)
        noise = variance_components(values, others.times, leverage=leverage, window=2 * half + 1)
        found[sensor] = noise
        systematic, white = (_means(of[sensor], values.shape[1:]) for of in (stated, assumed))
        stds[sensor] = _lasting(noise, leverage, systematic, white, sensor in independent)
    per_unit, asked = {sensor: Spool[NDArray]() for sensor in found}, set(frames.tolist())
    for f, (near, sums) in enumerate(_window_means(pushes, half, stds, body.tree.n_dofs)):
        rest[f] = skins[near].mean(axis=0)
        for sensor, mean in sums.items() if f in asked else ():
            per_unit[sensor].append(_with_shared(mean).astype(np.float32))
    lasting = tuple(
        LastingPushes(per_unit[sensor], of.reshape(3, -1), found[sensor].drift_time) for sensor, of in stds.items()
    )  # fmt: skip
    return OtherNoise(information, rest, lasting, frames, found)


def noise_of_sensors(
    take: SmoothTake, matched: Sequence[tuple[Matched, ...]] | None, pixels: Callable[[int], NDArray], *,
    half: int = 0, surfaces: bool = True, frames: NDArray | None = None,
) -> OtherNoise | None:  # fmt: skip
    """Estimate the noise of all sensors but the keypoints, packed markers too; None without such sensors.

    Parameters
    ----------
    matched : T lists of matches of `take.others`; None without them
    pixels, half, surfaces, frames : see `other_noise`
    """
    body, roots, angles, markers = take.body, take.roots, take.angles, take.markers
    of_markers = None if markers is None else marker_information(body, markers, roots, angles)

    def points(f: int) -> NDArray:
        return pixels(f) if of_markers is None else pixels(f) + _square(of_markers[f])

    others = None
    if take.others is not None and matched is not None:
        others = other_noise(
            body, take.others, matched, roots, angles, points, half=half, surfaces=surfaces, frames=frames
        )
    if markers is None or of_markers is None:
        return others

    def rest(f: int) -> NDArray:
        return pixels(f) if others is None else pixels(f) + _square(others.information[f])

    found = marker_noise(body, markers, of_markers, roots, angles, rest, half=half, frames=frames)
    return found if others is None else found + others


def marker_information(body: Body, markers: PackedMarkers, roots: NDArray, angles: NDArray) -> NDArray:
    """(T, n (n + 1) / 2) information of packed markers at fitted states, the upper triangle of each frame."""
    upper = np.triu_indices(body.tree.n_dofs)
    out = room((len(roots), len(upper[0])))
    for some in stretches(len(roots), MATRIX_FRAMES):
        whole = marker_matrices(body, markers.part(some), roots[some], angles[some])
        out[some] = whole[:, upper[0], upper[1]]
    return out


def marker_matrices(body: Body, markers: PackedMarkers, roots: NDArray, angles: NDArray) -> NDArray:
    """(T, n, n) information of packed markers at fitted states."""
    weight = markers.factors(markers.gaps(body, roots, angles)) * markers.weight
    packed, _, _ = SeenPoints.in_metres(markers.points, markers.places, weight).equations(body)(roots, angles)
    return unpacked(packed, body.tree)


def marker_noise(
    body: Body, markers: PackedMarkers, information: NDArray, roots: NDArray, angles: NDArray,
    rest: Callable[[int], NDArray], *, half: int = 0, frames: NDArray | None = None,
) -> OtherNoise:  # fmt: skip
    """Estimate the noise of packed markers from their residuals at fitted states, as `other_noise` does.

    Parameters
    ----------
    information : of `marker_information`
    roots, angles : (T, 4, 4), (T, D) fitted
    rest : frame -> (n, n) information of all other sensors, keypoints too
    half, frames : see `other_noise`
    """
    T, K = len(roots), len(markers.points)
    frames = np.arange(T) if frames is None else frames
    gaps, weight = room(markers.places.shape), room(markers.stated.shape)
    for some in stretches(T):
        part = markers.part(some)
        gaps[some] = part.gaps(body, roots[some], angles[some])
        weight[some] = part.factors(gaps[some]) * part.weight
    absorbed, count = np.zeros(K), np.zeros(K)
    for f in np.linspace(0, T - 1, min(_LEVERAGE_FRAMES, T)).astype(int):
        state = BodyState(roots[f], angles[f])
        J = point_derivatives(body, state, markers.points)
        alone = covariance_alone(body, state, _square(information[f]) + rest(f))
        for sensor in markers.sensors:
            own = markers.columns(sensor)
            own = own[weight[f, own] > 0.0]
            lines, w = J[own].reshape(-1, body.tree.n_dofs), np.repeat(weight[f, own], 3)[:, None]
            absorbed[own] += leverages(lines, w * lines, alone).reshape(-1, 3).mean(axis=1)
            count[own] += 1
    found, stds, drift_time = {}, {}, np.inf
    for sensor in markers.sensors:
        own = markers.columns(sensor)
        leverage = filled(absorbed[own], count[own])
        noise = variance_components(gaps[:, own], markers.times, leverage=leverage, window=2 * half + 1)
        seen = weight[:, own] > 0.0
        stated = np.where(seen, 1.0 / np.where(seen, markers.stated[:, own], 1.0), 0.0)
        assumed = np.repeat(filled(stated.sum(axis=0), np.count_nonzero(seen, axis=0))[:, None], 3, axis=1)
        found[sensor], drift_time = noise, min(drift_time, noise.drift_time)
        stds[sensor] = _lasting(noise, leverage, MarkerMatched.lasts * assumed, assumed, MarkerMatched.independent)
    per_unit = Spool[NDArray]()
    for some in stretches(T, MATRIX_FRAMES):
        asked = frames[(frames >= some.start) & (frames < some.stop)]
        first, stop = np.maximum(asked - half, 0), np.minimum(asked + half + 1, T)
        if not len(asked):
            continue
        pushes = np.zeros((stop[-1] - first[0] + 1, K, 3, body.tree.n_dofs))
        for f in range(first[0], stop[-1]):
            pushes[f - first[0] + 1] = weight[f, :, None, None] * point_derivatives(
                body, BodyState(roots[f], angles[f]), markers.points
            )
        total = np.cumsum(pushes, axis=0)
        for mean in (total[stop - first[0]] - total[first - first[0]]) / (stop - first)[:, None, None, None]:
            of_sensors = [_with_shared(mean[markers.columns(sensor)]) for sensor in markers.sensors]
            per_unit.append(np.concatenate(of_sensors).astype(np.float32))
    lasting = LastingPushes(per_unit, np.concatenate([of.reshape(3, -1) for of in stds.values()], axis=1), drift_time)
    posture = block_diagonal(np.zeros((6, 6)), body.tree.posture_precision)
    # Neighbouring frames repeat the same error of the prior, which counts where the cost is flat.
    of_prior = np.broadcast_to(posture[np.triu_indices(len(posture))], information.shape)
    return OtherNoise(information, of_prior, (lasting,), frames, found)


def filled(total: NDArray, count: NDArray) -> NDArray:
    """Means (C,) of totals (C,) over counts (C,); the overall mean where the count is 0."""
    return np.where(count > 0, total / np.maximum(count, 1), total.sum() / max(float(count.sum()), 1.0))


def _lasting(
    found: VarianceComponents, leverage: NDArray, stated: NDArray, assumed: NDArray, independent: bool
) -> NDArray:
    """(3, C + 1, A) standard deviations of constant errors and of those that drift, and the surplus of `LastingPushes`.

    The last of C + 1 is what channels share. The surplus is what `assumed` (C, A), a variance, exceeds white errors by.
    What `stated` (C, A), a variance, exceeds the estimate by, drifts: at least for as long as a posture lasts. A share
    of it counts, which falls with the number of independent channels, each counted by 1 − leverage (C,): their
    residuals would show a larger error. `stated` itself counts as `_STATED_CHANNELS` channels. If channels are not
    independent, the fit absorbs their common error, and the share is 1.
    """
    channels = stated.shape[1] * float(np.sum(np.clip(1.0 - leverage, 0.0, 1.0))) if independent else 0.0
    share = _STATED_CHANNELS / (_STATED_CHANNELS + channels)
    excess = share * np.maximum(stated - found.systematic[:, None] ** 2, 0.0)
    constant = np.broadcast_to(np.hypot(found.bias, found.bias_error)[:, None], stated.shape)
    drift = np.sqrt(found.smoothed_drift[:, None] ** 2 + excess)
    surplus, none = np.sqrt(np.maximum(assumed - found.white[:, None] ** 2, 0.0)), np.zeros(stated.shape[1])
    return np.stack([np.vstack(one) for one in ((constant, found.shared[0]), (drift, none), (surplus, none))])


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


def _window_means(
    pushes: Spool[list[_Push]], half: int, stds: Mapping[str, NDArray], n: int
) -> Iterator[tuple[slice, dict[str, NDArray]]]:
    """For every frame the window of `half` frames to either side, and each sensor's mean w J (C, A, n) over it."""
    T, sums = len(pushes), {sensor: np.zeros((std.shape[1] - 1, std.shape[2], n)) for sensor, std in stds.items()}
    for last in range(T + half):
        for f, sign in ((last, 1.0), (last - 2 * half - 1, -1.0)):
            for sensor, at, push, _ in pushes[f] if 0 <= f < T else ():
                sums[sensor][at[0], at[1]] += sign * push
        if last >= half:
            near = slice(max(last - 2 * half, 0), min(last + 1, T))
            yield near, {sensor: total / (near.stop - near.start) for sensor, total in sums.items()}


def _square(packed: NDArray) -> NDArray:
    """Symmetric (n, n) from its upper triangle (n (n + 1) / 2,)."""
    out = np.empty((int(np.sqrt(2.0 * len(packed))),) * 2)
    upper = np.triu_indices(len(out))
    out[upper] = out.T[upper] = packed
    return out
