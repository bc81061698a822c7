"""Who is seen: bone lengths, and where on the body the detectors' points sit, from frames spread over a take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import TrackingError
from kinefit.initialization.from_points import first_scales, pose_from_points
from kinefit.sensors.channels import Channels, fitted_pixels
from kinefit.sensors.left_right import find_swaps, limb_groups
from kinefit.sensors.triangulation import triangulated
from kinefit.solvers.equations import inverse
from kinefit.solvers.shape import PixelFrames, Shape, fit_shape

Progress = Callable[[str, int, int], None]

_SHIFT = 0.01  # [m] how far a detector's points stand from the anatomical ones, before a take is seen
_BELIEF = 5.0  # axes of points that this counts for
_UNTOLD = 1.35  # variance of shapes found, over what they state: limits, weights and priors are taken for known there.
# Measured on twenty known people with BODY_25B (`benchmarks.error_bars`); MEDIAPIPE_33 is the check.
_MOST_HIDDEN = 0.75  # share of all errors that a fit may be thought to follow
_ROUNDS = 3  # of fits with a better prior standard deviation; it changes by less than a tenth from then on
_PLAUSIBLE = 0.15  # [m] median distance from triangulated points beyond which a pose is not one


@dataclass(frozen=True, eq=False)
class Subject:
    """A body fitted to a person: lengths (G,) as `scales` of the generic one, and the detectors' points on it.

    `shape` says from which frames it came, `covariance` (p, p) how sure each of its parameters is; both None for a
    body that was given. `length_share` (G,) is each scale's standard deviation over it, where other sensors gave it.
    `sets` are the detectors' keypoint sets that it was found from.
    """

    body: Body
    scales: NDArray
    shape: Shape | None = None
    covariance: NDArray | None = None
    length_share: NDArray | None = None
    sets: tuple[str, ...] = ()

    @property
    def length_std(self) -> dict[str, float]:
        """[m] standard deviation of each length, from one segment's joint to the next's: "thigh_l-shank_l"."""
        share = self.length_share
        if self.covariance is not None:
            share = np.sqrt(np.diag(self.covariance)[: len(self.scales)]) / self.scales
        if share is None:
            return {}
        tree = self.body.tree
        lengths = np.linalg.norm(tree.offsets, axis=1)
        return {
            f"{tree.segments[p]}-{tree.segments[s]}": float(lengths[s] * share[self.body.segment_scale[p]])
            for s, p in enumerate(tree.parents) if p >= 0
        }  # fmt: skip


def fit_subject(
    body: Body,
    channels: Channels,
    *,
    frames: int = 25,
    height: float | None = None,
    trial: Subject | None = None,
    progress: Progress | None = None,
) -> Subject:
    """Bone lengths and the places of the detectors' points on a body, with no pose given.

    Parameters
    ----------
    body : Body, generic.
    frames : int, how many frames spread over the take are used.
    height : float [m] of the person: lengths that no two points measure follow it.
    trial : what another trial of the same person gave: lengths start from there, and stay as near as it was sure.

    Raises
    ------
    TrackingError
        No frame shows enough of the person in two cameras.
    """
    chosen = np.unique(np.linspace(0, len(channels.uv) - 1, min(max(frames, 1), len(channels.uv))).astype(int))
    if progress:
        progress("bone lengths", 0, 1)
    x = triangulated(channels, chosen)
    scales = first_scales(body, channels.points, x, height=height) if trial is None else trial.scales
    sized = channels.with_points(body.scaled(scales))
    states: dict[int, BodyState] = {}
    for i, f in enumerate(chosen):
        state = _pose(body.scaled(scales), sized, x[i], next(reversed(states.values()), None))
        if state is not None:
            states[int(f)] = state
        if progress:
            progress("bone lengths", i + 1, len(chosen) + 1)
    if not states:
        raise TrackingError(
            "no frame shows enough of the person in two cameras to start from",
            remedy="Check the calibration and that the cameras are in step (kinefit track -v).",
        )
    weight = _weights(body.scaled(scales), sized, states)
    pixels = PixelFrames(channels.points, channels.camera, channels.column, channels.uv[list(states)], weight)
    whole = height / body.stature if height and body.stature else None
    shape, covariance = _shape(body, channels, pixels, list(states.values()), scales, whole, trial)
    fitted = body.scaled(shape.scales)
    for name, span in channels.sets.items():
        points = fitted.keypoints(name)
        moved = np.array(points.points)
        moved[[points.index(n) for n in channels.points.names[span]]] += shape.shifts[span]
        fitted = fitted.with_keypoints(name, moved)
    if progress:
        progress("bone lengths", len(chosen) + 1, len(chosen) + 1)
    return Subject(fitted, shape.scales, shape, covariance, sets=tuple(name for name in channels.sets if name))


def _shape(
    body: Body, channels: Channels, pixels: PixelFrames, states: list[BodyState], scales: NDArray, whole: float | None,
    trial: Subject | None,
) -> tuple[Shape, NDArray]:
    """Shape, with as much freedom for a detector's points as this take asks for; and its covariance (p, p).

    How far points stand from where the body has them is found as MacKay (1992) finds a prior's width, beginning with
    one centimetre, which counts as much as `_BELIEF` points seen along one axis.
    """
    spread, known, lengths, start = _SHIFT, 0.0, None, None
    if trial is not None and trial.covariance is not None:
        lengths = trial.scales, trial.covariance[: len(scales), : len(scales)]
    for last in [False] * (_ROUNDS - 1) + [True]:
        shape = fit_shape(
            body, channels.rig, pixels, states, scales, shift_sigma=spread, whole=whole, lengths=lengths, start=start,
            tolerance=1e-3 if last else 1e-2,
        )  # fmt: skip
        states, start = list(shape.states), shape.theta
        covariance = inverse(shape.prior + shape.information / _excess(shape, channels, pixels, known))
        moved = shape.theta - shape.parameters.mean
        open_to = np.isclose(np.diag(shape.prior), spread**-2)
        told = 1.0 - np.diag(covariance)[open_to] / spread**2
        known = len(moved) - float(np.sum(shape.prior * covariance))  # how many parameters the pixels observe
        told = float(np.sum(np.maximum(told, 0.0)))
        spread = float(np.sqrt((np.sum(moved[open_to] ** 2) + _BELIEF * _SHIFT**2) / (told + _BELIEF)))
    return shape, _UNTOLD * covariance


def _excess(shape: Shape, channels: Channels, pixels: PixelFrames, known: float) -> float:
    """How many times larger than assumed a channel's variance is once all frames are averaged.

    A detector's errors last: the mean over F frames varies by more than 1/F of the variance of one. Both are taken from
    the residuals that are no outliers, F times the first and the second, and the larger counts. Of 2 N means of N
    channels the poses hide as many as they have degrees of freedom, and the shape its `known` ones.
    """
    fitted = np.stack([
        shape.parameters.pixels(shape.theta, s, channels.rig, pixels.camera, pixels.column) for s in shape.states
    ])  # fmt: skip
    r = (pixels.uv - fitted) / channels.sigma[:, None]
    r = np.where((pixels.weight > 0)[..., None], r, np.nan)
    seen = np.isfinite(r)
    if seen.sum() < 10:
        return 1.0
    size = np.median(np.abs(r[seen])) / 0.6745  # of a normal variable
    r = np.where(np.abs(r) < 3.0 * size, r, np.nan)
    counts = np.isfinite(r).sum(axis=0)
    means = np.nansum(r, axis=0) / np.maximum(counts, 1)
    hidden = (shape.parameters.body.tree.n_dofs + known) / max(int(np.sum(counts > 0)), 1)
    lasting = float(np.sum(counts**2 * means**2) / max(counts.sum(), 1)) / (1.0 - min(hidden, _MOST_HIDDEN))
    return max(lasting, float(size**2), 1e-3)


def _pose(body: Body, channels: Channels, x_world: NDArray, near: BodyState | None) -> BodyState | None:
    """State from triangulated points: from a neighbouring frame's if that leads there, else from nowhere."""
    for start in (near, None) if near else (None,):
        try:
            state, left = pose_from_points(body, channels.points, x_world, near=start)
        except TrackingError:
            return None
        if left < (0.5 * _PLAUSIBLE if start else _PLAUSIBLE):
            return state
    return None


def _weights(body: Body, channels: Channels, states: dict[int, BodyState]) -> NDArray:
    """(F, N) weights without the channels whose left and right look exchanged."""
    groups = limb_groups(body, channels)
    weight = channels.weight[list(states)]
    for row, (f, state) in zip(weight, states.items(), strict=True):
        row[find_swaps(channels, groups, channels.uv[f], row, fitted_pixels(body, channels, state))] = 0.0
    return weight
