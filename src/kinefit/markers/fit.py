"""Fit a body of the subject's size to labelled markers: joint angles of every frame. For its size see `subject`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit._mapped import room
from kinefit.bodies import Body, BodyState
from kinefit.bodies.marker_sets import find_placement
from kinefit.errors import TrackingError
from kinefit.findings import runs_of
from kinefit.frame.results import UNOBSERVED_STD_RATIO
from kinefit.losses import Loss
from kinefit.markers.poses import columns, sequence_both_ways
from kinefit.markers.valleys import PointTake, profile_frames, resolve_by_motion
from kinefit.motion import UP_AXES, Motion, Residuals
from kinefit.observations import Markers
from kinefit.sensors.points.markers import of_points
from kinefit.sensors.points.packed_markers import PackedMarkers
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.smoothing.smoother import bridged
from kinefit.smoothing.spool import stretches
from kinefit.smoothing.unwrap import unwrap
from kinefit.solvers.sequence import Certainty, fit_sequence

_MAX_ANGLE_STD = 0.35  # [rad] an angle with a larger sigma is interpolated from adjacent frames
_MAX_ROOT_STD = 0.1  # [m] likewise for the root's position
_VELOCITY_MEMORY_S = 0.3  # time constant of the velocity of an unobserved root
_MAX_MISFIT_INCREASE = 0.3  # standard deviations by which interpolation may worsen a frame's fit
_OUTLIER_MISFIT_RATIO = 4.0  # times the take's median misfit: such frames are fitted again without initial pose
_MAX_REFIT_RUNS = 50  # runs of such frames


@checked
def fit_markers(
    body: Body,
    markers: Markers,
    marker_set: str | PathLike[str] | None = None,
    *,
    sigma: ArrayLike = 0.005,
    loss: Loss = MARKER_LOSS,
    limits: bool = True,
    up: str | None = None,
) -> Motion:
    """Fit a body's motion to labelled markers, frame by frame, without an initial pose.

    Angles that a frame does not observe (a limb with occluded markers) are interpolated from adjacent frames. Angles
    that no frame observes stay at the body's prior mean. Standard deviations and quality show both.

    Parameters
    ----------
    body : Body of the subject's size with its marker offsets, from `fit_marker_subject`
    markers : Markers
        (F, N, 3) [m]. Labels outside of the set are excluded; prefix ("Anna:LASI"), case and punctuation are ignored.
    marker_set : str
        Default: the set that shares most labels, the body's own sets first.
    sigma : scalar or (K,) [m], standard deviation of each marker of the set along each axis
    loss : Loss of a marker, robust to wrong labels and ghosts
    limits : whether joint limits hold
    up : vertical axis of the world; default: the file's, or else the axis along which the body stands

    Raises
    ------
    ObservationError
        The body knows fewer than four of the labels.
    TrackingError
        No frame shows enough markers to start from.
    """
    placement = find_placement(body, markers.names, marker_set)
    points = placement.points
    if np.ndim(sigma) and marker_set is not None and len(np.asarray(sigma)) != len(points):
        labels = body.marker_sets.get(str(marker_set), points)
        sigma = np.asarray(sigma, float)[[labels.index(n) for n in points.names]]
    x = columns(markers, points.names)
    sigma = np.broadcast_to(np.asarray(sigma, float), len(points))
    data = MarkerTake(body, points, x, sigma, loss, limits)
    roots, angles = refit_outliers(data, *data.poses(slice(None)))
    roots, angles, local, widened, flat = profile_frames(data, roots, angles, markers.rate)
    roots, angles = resolve_by_motion(data, roots, unwrap(body.tree, angles), flat, markers.rate)
    roots, angles = _interpolate_unobserved(data, roots, angles, local, markers.rate)
    return _motion(data, roots, angles, widened, markers, up)


@dataclass(frozen=True, eq=False)
class MarkerTake(PointTake):
    """Markers measured on a body."""

    @classmethod
    def of(cls, body: Body, markers: PackedMarkers) -> MarkerTake:
        """Packed markers of a body, within its limits."""
        x = room(markers.places.shape)
        for some in stretches(len(x)):
            x[some] = np.where(markers.stated[some, :, None] > 0.0, markers.places[some], np.nan)
        return cls(body, markers.points, x, 1.0 / np.sqrt(markers.stated.max(axis=0)), markers.loss, True)

    def part(self, frames: slice) -> MarkerTake:
        """The markers of some frames."""
        return replace(self, x=self.x[frames])

    def poses_after(self, last: BodyState) -> tuple[NDArray, NDArray]:
        """Roots (F, 4, 4) and angles (F, D) [rad], fitted forwards from the state before the first frame."""
        fit = fit_sequence(
            self.body, last, self.points, self.x, sigma=self.sigma, loss=self.loss, limits=self.limits, posture=1.0
        )
        return fit.Ts_world_root, fit.angles

    def poses(self, frames: slice) -> tuple[NDArray, NDArray]:
        """Roots (F, 4, 4) and angles (F, D) [rad] of some frames, fitted without initial pose."""
        return sequence_both_ways(
            self.body, self.points, self.x[frames], self.sigma, loss=self.loss, limits=self.limits
        )  # fmt: skip

    def misfit(self, roots: NDArray, angles: NDArray, frames: slice = slice(None)) -> NDArray:
        """(F,) mean misfit of the markers in each frame, in standard deviations, each clipped at ten."""
        off = np.linalg.norm(self.x[frames] - self.body.trajectories(roots, angles, self.points), axis=2) / self.sigma
        seen = np.isfinite(off)
        return np.where(seen, np.minimum(np.nan_to_num(off), 10.0), 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)


def refit_outliers(data: MarkerTake, roots: NDArray, angles: NDArray) -> tuple[NDArray, NDArray]:
    """Fit frames with an outlying misfit again without initial pose; keep the better fit."""
    roots, angles = roots.copy(), angles.copy()
    misfit = data.misfit(roots, angles)
    is_outlier = misfit > max(_OUTLIER_MISFIT_RATIO * float(np.median(misfit)), 3.0)
    for a, b in sorted(runs_of(is_outlier), key=lambda run: run[0] - run[1])[:_MAX_REFIT_RUNS]:
        frames = slice(a, b)
        try:
            other_roots, other_angles = data.poses(frames)
        except TrackingError:
            continue
        better = data.misfit(other_roots, other_angles, frames) < 0.9 * misfit[frames]
        roots[frames][better], angles[frames][better] = other_roots[better], other_angles[better]
    return roots, angles


def _interpolate_unobserved(
    data: MarkerTake, roots: NDArray, angles: NDArray, local: Certainty, rate: float
) -> tuple[NDArray, NDArray]:
    """Interpolate unobserved angles and roots from adjacent frames; observed ones stay."""
    tree, x = data.body.tree, data.x
    std = local.dof_std
    lost = ~((std[:, :3].max(axis=1) < _MAX_ROOT_STD) & (std[:, 3:6].max(axis=1) < _MAX_ANGLE_STD))
    max_std = np.minimum(np.where(tree.prismatic, _MAX_ROOT_STD, _MAX_ANGLE_STD), UNOBSERVED_STD_RATIO * tree.spread)
    observed = (std[:, 6:] < max_std) & ~lost[:, None]
    ever_observed = observed.any(axis=0)
    if lost.all() or (observed[:, ever_observed].all() and not lost.any()):
        return roots, angles
    frames = np.arange(len(x))
    interpolated = angles.copy()
    for d in np.flatnonzero(ever_observed):
        interpolated[:, d] = np.interp(frames, frames[observed[:, d]], angles[observed[:, d], d])
    measured_roots, (roots, _) = roots, bridged(roots, interpolated, lost, _VELOCITY_MEMORY_S * rate)
    before, measured_angles = data.misfit(roots, angles), angles
    roots, angles = np.array(roots), np.where(observed | ~ever_observed, angles, interpolated)
    refitted = ~lost & ~observed[:, ever_observed].all(axis=1)
    for a, b in runs_of(refitted):
        inside = bool(((angles[a:b] >= tree.lower) & (angles[a:b] <= tree.upper)).all())  # else in another chart
        fit = fit_sequence(  # adapt the observed angles to the interpolated ones
            data.body, BodyState(roots[a], angles[a]), data.points, x[a:b], sigma=data.sigma, loss=data.loss,
            limits=data.limits and inside, posture=1.0, usual=interpolated[a:b],
        )  # fmt: skip
        roots[a:b], angles[a:b] = fit.Ts_world_root, fit.angles
    worse = refitted & (data.misfit(roots, angles) > before + _MAX_MISFIT_INCREASE)
    roots[worse], angles[worse] = measured_roots[worse], measured_angles[worse]
    return roots, unwrap(tree, angles) if refitted.any() else angles


def _motion(
    data: MarkerTake, roots: NDArray, angles: NDArray, certainty: Certainty, markers: Markers, up: str | None
) -> Motion:
    """Assemble the motion; its quality is the share of a segment's evidence that agrees."""
    body, points, x = data.body, data.points, data.x
    dof_std = np.array(certainty.dof_std)
    dof_std[:, 6:][dof_std[:, 6:] > UNOBSERVED_STD_RATIO * body.tree.spread] = np.inf
    values = x - body.trajectories(roots, angles, points)
    squares = np.square(values / data.sigma[:, None]).sum(axis=2)
    quality = of_points(body, points, squares).segment_quality(body.tree)
    residuals = Residuals(points.names, points.segments, values, certainty.factors, "m", x, np.zeros(len(x), bool))
    return Motion(
        body=body, rate=markers.rate, times=markers.times, Ts_world_root=roots, angles=angles, dof_std=dof_std,
        joint_std=certainty.joint_std, quality=quality.mean(axis=1), segment_quality=quality,
        residuals={"markers": residuals}, up=up or markers.up or upright(roots),
        name=Path(markers.source).stem or "markers",
    )  # fmt: skip


def upright(roots: NDArray) -> str:
    """The world axis nearest to the mean vertical axis of the roots (F, 4, 4)."""
    mean = roots[:, :3, 1].mean(axis=0)
    return max(UP_AXES, key=lambda axis: float(np.dot(mean, UP_AXES[axis])))
