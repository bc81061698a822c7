"""The loop over frames: predict, put left and right right, fit, judge, recover."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.charts import off_the_limits
from kinefit.correspondences import _kernels, prior_rows, targets
from kinefit.errors import TrackingError
from kinefit.initialization.from_points import pose_from_points, triangulated_frame
from kinefit.losses import Loss, geman_mcclure
from kinefit.multiview.left_right import find_swaps, limb_groups
from kinefit.rows import AnyRows, ParameterRows
from kinefit.sensors.channels import Channels, fitted_pixels
from kinefit.solvers.equations import Covariance, covariance, inverse, joint_std, normal_equations
from kinefit.solvers.least_squares import Fit, levenberg_marquardt
from kinefit.tracking.prediction import Prediction, belief

_LIGHT = 1e-3  # first damping where a prediction holds every degree of freedom already


@dataclass(frozen=True)
class Settings:
    """How a track runs.

    Parameters
    ----------
    loss : Loss of a keypoint, in its standard deviations.
    angle_acceleration, root_acceleration : float [rad/s²], [m/s²]
        How abruptly a person moves: one standard deviation.
    velocity_memory : float [s]
        How long a velocity lasts that nothing confirms.
    poor : float in 0..1
        Support below which a frame is started anew from its own keypoints.
    smooth_memory : float [s]
        The same as velocity_memory, where a whole take is smoothed.
    acceleration_memory : float [s]
        How long an acceleration lasts, where a whole take is smoothed.
    smooth_rounds : int
        How often the strength of the motion prior and the pixels' noise are estimated anew, at most.
    """

    loss: Loss = field(default_factory=geman_mcclure)
    angle_acceleration: float = 150.0
    root_acceleration: float = 15.0
    velocity_memory: float = 0.1
    poor: float = 0.5
    smooth_memory: float = 1.0
    acceleration_memory: float = 0.2
    smooth_rounds: int = 8


@dataclass(frozen=True, eq=False)
class FrameResult:
    """One tracked frame.

    Parameters
    ----------
    state : BodyState
    dof_std : (6 + D,) [m, rad]
    joint_std : (S, 3) [m]
    factor : (N,) robust factor of every channel, 0 where unseen.
    weight : (N,) [1/px²] with which every channel took part, that factor included.
    uv, fitted : (N, 2) [px] measurements as used, and where the body is seen.
    swapped : (N,) bool, channels exchanged with their partner.
    quality : float, and segment_quality (S,), in 0..1.
    support : float in 0..1, mean robust factor of what was seen: low where the body is not where the pixels are.
    """

    state: BodyState
    dof_std: NDArray
    joint_std: NDArray
    factor: NDArray
    weight: NDArray
    uv: NDArray
    fitted: NDArray
    swapped: NDArray
    quality: float
    segment_quality: NDArray
    support: float


class Tracker:
    """Follows one body from frame to frame.

    Parameters
    ----------
    body : Body, fitted to the person.
    channels : Channels
        Layout of the measurements (`uv` and `confidence` of it are not used).
    rate : float [Hz]
    """

    def __init__(self, body: Body, channels: Channels, rate: float, settings: Settings | None = None) -> None:
        self.body, self.channels = body, channels
        self.settings = settings or Settings()
        names = tuple(channels.points.names[c] for c in channels.column)
        place = channels.points.points[channels.column]
        self._points = PointSet(names, channels.points.segments[channels.column], place)  # one for every channel
        self._groups = limb_groups(body, channels)
        self._informs = informing(body, channels)
        self._angles = np.arange(6, body.tree.n_dofs)
        self._posture = np.square(1.0 / body.tree.spread)
        self._prediction = Prediction(
            body,
            1.0 / rate,
            angle_acceleration=self.settings.angle_acceleration,
            root_acceleration=self.settings.root_acceleration,
            memory=self.settings.velocity_memory,
        )

    def start_at(self, state: BodyState) -> None:
        """Take a state as that of the last frame; its velocity is unknown."""
        self._prediction.start(state)

    def update(self, uv: NDArray, confidence: NDArray) -> FrameResult | None:
        """Track a frame: uv (N, 2) [px], NaN where unseen; confidence (N,). None until there is a start."""
        seen = np.isfinite(uv).all(axis=1)
        weight = np.where(seen, confidence / np.square(self.channels.sigma), 0.0)
        uv = np.where(seen[:, None], uv, np.nan)
        result = None
        if self._prediction.state is not None:
            if not weight.any():
                self._prediction.halt()
            predicted, information = self._prediction.ahead()
            fit, result = self._fit(predicted, (predicted, information), uv, weight)
            self._prediction.correct(result.state, inverse(fit.equations.matrix))
            chart = off_the_limits(self.body.tree, result.state.angles)
            if chart is not None:
                self._prediction.change_chart(*chart)
        if result is None or result.support < self.settings.poor:
            again = self._start(uv, weight, confidence)
            if again is not None and (result is None or again.support > result.support + 0.1):
                result = again
                self._prediction.start(result.state, result.dof_std)
        return result

    def _start(self, uv: NDArray, weight: NDArray, confidence: NDArray) -> FrameResult | None:
        x, _ = triangulated_frame(self.channels, uv, confidence)
        try:
            state, _ = pose_from_points(self.body, self.channels.points, x)
        except TrackingError:
            return None
        return self._fit(state, None, uv, weight)[1]

    def _fit(
        self, start: BodyState, predicted: tuple[BodyState, NDArray] | None, uv: NDArray, weight: NDArray
    ) -> tuple[Fit, FrameResult]:
        swapped = find_swaps(self.channels, self._groups, uv, weight, fitted_pixels(self.body, self.channels, start))
        partner = np.arange(len(swapped))
        for _ in range(3):
            order = np.where(swapped, self.channels.partner, partner)
            used, used_weight = np.ascontiguousarray(uv[order]), np.ascontiguousarray(weight[order])
            fit = levenberg_marquardt(
                self.body, start, lambda s: self._rows(s, predicted, used, used_weight),  # noqa: B023
                loss=self.settings.loss, max_iterations=40, tolerance=1e-4,
                damping=None if predicted is None else _LIGHT,
            )  # fmt: skip
            fitted = fitted_pixels(self.body, self.channels, fit.state)
            again = find_swaps(self.channels, self._groups, uv, weight, fitted)
            if np.array_equal(again, swapped):
                break
            swapped, start = again, fit.state
        return fit, self._judge(fit, used, used_weight, fitted, swapped)

    def _rows(
        self, state: BodyState, predicted: tuple[BodyState, NDArray] | None, uv: NDArray, weight: NDArray
    ) -> list[AnyRows]:
        cameras, camera = self.channels.rig.packed, self.channels.camera
        rows = targets.fill(_kernels.pixel_rows, 2, self.body, state, self._points, cameras, camera, uv, weight)
        tree = self.body.tree
        parts: list[AnyRows] = [rows, ParameterRows(self._angles, tree.usual - state.angles, self._posture)]
        if predicted is not None:
            parts.append(belief(state, *predicted))
        return parts

    def _judge(self, fit: Fit, uv: NDArray, weight: NDArray, fitted: NDArray, swapped: NDArray) -> FrameResult:
        factor = np.zeros(len(weight))
        factor[fit.equations.rows.group] = fit.equations.factor
        own = normal_equations(
            self.body, fit.state, [fit.equations.rows, prior_rows(self.body, fit.state)], loss=self.settings.loss
        )
        cov = covariance(own)
        blind = 6 + np.flatnonzero(prior_alone(self.body, cov.std))
        if blind.size:
            cov = Covariance(cov.observed, np.concatenate([cov.free, np.eye(len(cov.observed))[:, blind]], axis=1))
        std = cov.std, joint_std(self.body, fit.state, cov)
        return judged(self.channels, self._informs, fit.state, std, uv, weight, factor, fitted, swapped)


def prior_alone(body: Body, dof_std: NDArray) -> NDArray:
    """(..., D) bool: coordinates that are known from the prior alone, by standard deviations (..., 6 + D)."""
    return np.asarray(dof_std[..., 6:] > 0.95 * body.tree.spread)


def judged(
    channels: Channels, informs: NDArray, state: BodyState, std: tuple[NDArray, NDArray],
    uv: NDArray, weight: NDArray, factor: NDArray, fitted: NDArray, swapped: NDArray,
) -> FrameResult:  # fmt: skip
    """A fitted frame with its quality.

    Parameters
    ----------
    informs : (S, N) from `informing`.
    std : (n,) of the degrees of freedom and (S, 3) [m] of the joint centres.
    uv, fitted : (N, 2) [px] measured as used, and where the body is seen.
    weight, factor : (N,) [1/px²] and in 0..1, of every measurement, 0 where unseen; swapped (N,).
    """
    seen = weight > 0
    support = informs @ factor
    cameras = np.stack(
        [informs[:, channels.camera == c] @ (factor > 0.3)[channels.camera == c] > 0 for c in range(len(channels.rig))]
    ).sum(axis=0)
    share = support / np.maximum(informs @ seen, 1.0)
    quality = share * np.minimum(cameras, 2) / 2.0
    return FrameResult(
        state, *std, factor, weight * factor, uv, fitted, swapped, float(np.mean(quality)), quality,
        float(factor.sum() / max(int(seen.sum()), 1)),
    )  # fmt: skip


def informing(body: Body, channels: Channels) -> NDArray:
    """(S, N) 0 or 1: channels that tell where a segment is: those on it and those at its children's joints.

    A segment without any is known through its children.
    """
    tree = body.tree
    owner, place = channels.points.segments[channels.column], channels.points.points[channels.column]
    near = np.linalg.norm(place, axis=1) < 0.05
    out = np.zeros((len(tree.segments), len(owner)))
    for s in range(len(tree.segments)):
        out[s] = (owner == s) | (near & (tree.parents[owner] == s))
    for s in range(len(tree.segments) - 1, 0, -1):
        if not out[s].any():
            children = [c for c in range(len(tree.segments)) if tree.parents[c] == s]
            out[s] = np.max([out[c] for c in children], axis=0) if children else 0.0
    return out
