"""Errors of all sensors but the keypoints: their variance components, and how what lasts of them pushes the pose."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences.closures import every_closure
from kinefit.frame.results import ANYWHERE
from kinefit.frame.skin import skin_of
from kinefit.rows import DofRows, Rows
from kinefit.sensors.base import Matched, rows_at
from kinefit.sensors.channel_residuals import ChannelResiduals
from kinefit.smoothing.linearised import OtherSensors, squares_of
from kinefit.smoothing.spool import Spool
from kinefit.solvers import _kernels_border
from kinefit.solvers.bundle.border_frames import gram
from kinefit.solvers.equations import block_diagonal, design, inverse, normal_equations, product
from kinefit.solvers.trajectory.variance_components import VarianceComponents, variance_components

_RIGID = 1e-6, 1e-6  # [m], [rad] of a body without joints: it is its surface, and no bone lies below
_EXACT = 1e-4  # [m] as good as 0
_LEVERAGE_FRAMES = 40  # of a take, in which the leverage of each channel is computed
_STRETCH_FRAMES = 100  # whose rows are summed at once

_Felt = tuple[NDArray, NDArray, NDArray, NDArray]
"""N rows of a match: frame, channel and axis (3, N), weight w (N,), derivatives J (N, n), lasting variance (N,)."""


@dataclass(frozen=True, eq=False)
class OtherNoise:
    """What lasts of the errors of all sensors but the keypoints.

    Parameters
    ----------
    information : (T, n (n + 1) / 2) of every frame's rows, the upper triangle of each
    lasting : the same of Σ s sᵀ of the pushes s = Jᵀ W e of every lasting error e, with s the mean over the frames
        that motion ties to each frame
    components : {sensor: VarianceComponents [m]}
    """

    information: NDArray
    lasting: NDArray
    components: dict[str, VarianceComponents]

    def pooled(self, f: int, half: int) -> tuple[NDArray, NDArray]:
        """(n, n) information, the mean over so many frames to either side, and lasting."""
        return _square(self.information[max(f - half, 0) : f + half + 1].mean(axis=0)), _square(self.lasting[f])

    def as_told(self) -> dict[str, Any]:
        """The same in a few numbers, by sensor."""
        return {name: found.summary("m", 4) for name, found in self.components.items()}


def covariance_alone(body: Body, state: BodyState, information: NDArray) -> NDArray:
    """(n, n) covariance of one frame on its own, closures and prior included; zero for a root that is fixed."""
    tree = body.tree
    if body.closures:
        information = information + normal_equations(body, state, every_closure(body, state)).matrix
    free = slice(0 if tree.root_free else 6, tree.n_dofs)
    prior = block_diagonal(np.eye(6) / ANYWHERE**2, tree.posture_precision)
    out = np.zeros_like(information)
    out[free, free] = inverse((information + prior)[free, free])
    return out


def leverages(J: NDArray, pushed: NDArray, alone: NDArray) -> NDArray:
    """(R,) share of the variance of each row's error that a fit takes from its residual.

    Of errors e of equal variance the fit leaves r = (I − J P Jᵀ W) e; what others' errors add is negative.

    Parameters
    ----------
    J, pushed : (R, n) derivatives by the pose, and W J
    alone : (n, n) covariance P of the frame on its own
    """
    left = np.eye(len(J)) - product(product(J, alone), pushed.T)
    return np.asarray(1.0 - np.sum(left**2, axis=1))


def other_noise(
    body: Body, others: OtherSensors, matched: Sequence[tuple[Matched, ...]], roots: NDArray, angles: NDArray,
    pixels: Callable[[int], NDArray], *, half: int = 0, surfaces: bool = True,
) -> OtherNoise:  # fmt: skip
    """Noise of all sensors but the keypoints, from their residuals at fitted states.

    Parameters
    ----------
    matched : T lists of matches
    roots, angles : (T, 4, 4), (T, D) fitted
    pixels : frame -> (n, n) information of its keypoints
    half : frames to either side that motion ties to a frame
    surfaces : whether errors of surfaces as wholes count
    """
    T, n = len(roots), body.tree.n_dofs
    upper = np.triu_indices(n)
    information, skins, lasting = np.zeros((3, T, len(upper[0])))
    residuals, pushes = ChannelResiduals(), Spool[dict[str, NDArray]]()
    hidden, stated = defaultdict[str, list[NDArray]](list), defaultdict[str, list[NDArray]](list)
    looked_at = set(np.linspace(0, T - 1, min(_LEVERAGE_FRAMES, T)).astype(int).tolist())
    length = max(_STRETCH_FRAMES, half)
    spans = [slice(start, min(start + length, T)) for start in range(0, T, length)]
    for span in spans:
        felt = defaultdict[str, list[_Felt]](list)
        for f in range(span.start, span.stop):
            scene, surface = others.scene(f, roots, angles), list[Rows]()
            for m in matched[f]:
                scale = others.scale.get(m.sensor, 1.0)
                made = [r for r in rows_at(m, scene) if isinstance(r, Rows | DofRows) and len(r)]
                points = [r for r in made if m.of_points or isinstance(r, DofRows)]
                surface += [r.weaker(scale) for r in made if isinstance(r, Rows) and not m.of_points]
                weights = [r.weight * squares_of(r)[1] / scale**2 for r in points]
                places = residuals.add(f, m, points, [r.residual for r in points], weights)
                for rows, w, at in zip(points, weights, places):
                    counts, index = w > 0.0, np.vstack([np.full(len(w), f - span.start), at])
                    J = design(body, scene.state, rows)[counts]
                    felt[m.sensor].append((index[:, counts], w[counts], J, m.lasts / rows.weight[counts]))
            if surface:
                settings = others.settings  # also where the fit takes surfaces for exact
                beside = max(settings.skin_shift, _EXACT), settings.skin_turn
                skin = skin_of(scene, surface, *(beside if body.tree.coordinates else _RIGID), matched[f])
                information[f] += skin.information[upper]
                if surfaces:
                    skins[f] += gram(skin.pushes, skin.pushes)[upper]
        sums = {}
        for sensor, parts in felt.items():
            sums[sensor] = _summed(parts, information[span])
            stated[sensor] += [np.vstack([at[1:], lasts]) for at, _, _, lasts in parts]
        for f in looked_at.intersection(range(span.start, span.stop)):
            alone = covariance_alone(body, BodyState(roots[f], angles[f]), _square(information[f]) + pixels(f))
            for sensor, (push, weight) in sums.items():
                seen = weight[f - span.start] > 0.0
                of_frame, w = push[f - span.start][seen], weight[f - span.start][seen]
                hidden[sensor].append(np.vstack([*np.nonzero(seen), leverages(of_frame / w[:, None], of_frame, alone)]))
        pushes.append({sensor: push for sensor, (push, _) in sums.items()})
    found, variance = {}, {}
    for sensor, (values, _) in residuals.arrays(T).items():
        leverage = _means(hidden[sensor], values.shape[1:]).mean(axis=1)
        one = variance_components(values, others.times, leverage=leverage, jitter_leverage=leverage / (2 * half + 1))
        stated_here = _means(stated[sensor], values.shape[1:])
        found[sensor], variance[sensor] = one, np.maximum(one.lasting[:, None] ** 2, stated_here)
    held = dict[int, dict[str, NDArray]]()
    for k, span in enumerate(spans):
        lasting[span] = _window_means([skins], [slice(0, T)], span, half)
        near = range(max(k - 1, 0), min(k + 2, len(spans)))
        held = {j: held[j] if j in held else pushes[j] for j in near}
        for sensor, of in variance.items():
            pushed = [_padded(held[j].get(sensor), (spans[j].stop - spans[j].start, *of.shape, n)) for j in near]
            mean = _window_means(pushed, [spans[j] for j in near], span, half)
            shared = found[sensor].shared[0][:, None] * mean.sum(axis=1)
            own = (np.sqrt(of)[..., None] * mean).reshape(len(mean), -1, n)
            both = np.concatenate([own, shared], axis=1)
            _kernels_border.packed_grams(both.reshape(-1, n), np.arange(len(both) + 1) * both.shape[1], lasting[span])
    return OtherNoise(information, lasting, found)


def _summed(parts: Sequence[_Felt], information: NDArray) -> tuple[NDArray, NDArray]:
    """Σ w J (F, C, A, n) and Σ w (F, C, A) of each channel and axis; `information` (F, n (n + 1) / 2) is added to."""
    at, w, J = (np.concatenate([p[i] for p in parts], axis=-1 if i < 2 else 0) for i in range(3))
    whitened = np.sqrt(w)[:, None] * J
    _kernels_border.packed_grams(whitened, np.searchsorted(at[0], np.arange(len(information) + 1)), information)
    shape = len(information), *(at[1:].max(axis=1, initial=0) + 1)
    index, push = np.ravel_multi_index(tuple(at), shape), np.zeros((int(np.prod(shape)), J.shape[1]))
    _kernels_border.add_weighted(J, w, index, push)
    return push.reshape(*shape, -1), np.bincount(index, w, len(push)).reshape(shape)


def _padded(values: NDArray | None, shape: tuple[int, ...]) -> NDArray:
    """Values in the first places of a larger array of zeros."""
    out = np.zeros(shape)
    if values is not None:
        out[tuple(slice(0, size) for size in values.shape)] = values
    return out


def _window_means(parts: Sequence[NDArray], spans: Sequence[slice], span: slice, half: int) -> NDArray:
    """Means over so many frames to either side of each frame of a span, of values that are given in spans."""
    first, last = spans[0].start, spans[-1].stop
    frames = np.arange(span.start, span.stop)
    low, high = np.maximum(frames - half, first) - first, np.minimum(frames + half + 1, last) - first
    values = np.concatenate(parts)[low[0] : high[-1]]
    sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    count = (high - low).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray((sums[high - low[0]] - sums[low - low[0]]) / count)


def _means(entries: Sequence[NDArray], shape: tuple[int, ...]) -> NDArray:
    """(C, A) means of entries (3, R), channel, axis and value; the mean of all where there are none."""
    channel, axis, value = np.concatenate([np.zeros((3, 0)), *entries], axis=1)
    count, total = np.zeros(shape), np.zeros(shape)
    at = channel.astype(np.int64), axis.astype(np.int64)
    np.add.at(count, at, 1.0)
    np.add.at(total, at, value)
    return np.where(count > 0, total / np.maximum(count, 1), np.mean(value) if len(value) else 0.0)


def _square(packed: NDArray) -> NDArray:
    """(n, n) of its upper triangle."""
    out = np.empty((int(np.sqrt(2.0 * len(packed))),) * 2)
    upper = np.triu_indices(len(out))
    out[upper] = out.T[upper] = packed
    return out
