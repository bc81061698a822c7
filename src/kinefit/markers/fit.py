"""Labelled markers on a body of the subject's size: joint angles of every frame (its size: `marker_subject`)."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState
from kinefit.bodies.marker_sets import find_placement
from kinefit.errors import TrackingError
from kinefit.findings import runs_of
from kinefit.frame.results import UNOBSERVED_STD_RATIO
from kinefit.losses import Loss
from kinefit.markers.poses import columns, sequence_both_ways
from kinefit.markers.valleys import PointTake, profiled, settled_by_motion
from kinefit.motion import UP_AXES, Motion, Residuals
from kinefit.observations import Markers
from kinefit.sensors.points.markers import of_points
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.smoothing.gaps import bridged
from kinefit.smoothing.unwrap import unwrap
from kinefit.solvers.sequence import Certainty, fit_sequence

_TOLD = 0.35  # [rad] an angle less sure than that is not observed by its frame, but by those before and after
_HELD = 0.1  # [m] likewise for the root
_MEMORY = 0.3  # [s] in which the velocity of a body that is not seen forgets itself
_WORSE = 0.3  # standard deviations that a frame's markers may fit worse for following its neighbours
_OFF = 4.0  # times the take's median misfit from which a frame is tried anew, from nowhere
_MOST_RUNS = 50  # of such frames


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
    """Motion of a body from labelled markers, each frame from the last, the first with no pose given.

    What a frame does not show (a limb whose markers are hidden) follows from the frames before and after it, and what
    no frame observes stays at the body's prior mean; error bars and quality say so.

    Parameters
    ----------
    body : Body, of the subject's size, its markers at their own places: from `fit_marker_subject`.
    markers : Markers
        Labels that the set does not have are left out; prefix ("Anna:LASI"), case and marks do not count.
    marker_set : str
        Default: the set that shares most labels, of the body's own first.
    sigma : scalar or (K,) for each marker of the set that is used [m], along each axis.
    loss : Loss of a marker, so that a wrong label or a ghost does not pull.
    up : vertical axis of the world; default: the file's where it says so, else the one along which the body stands.

    Raises
    ------
    ObservationError
        Fewer than four labels are known to the body.
    TrackingError
        No frame shows enough markers to start from.
    """
    whole = find_placement(body, markers.names, marker_set)
    points = whole.points
    if np.ndim(sigma) and marker_set is not None and len(np.asarray(sigma)) != len(points):
        own = body.marker_sets.get(str(marker_set), points)
        sigma = np.asarray(sigma, float)[[own.index(n) for n in points.names]]
    x = columns(markers, points.names)
    sigma = np.broadcast_to(np.asarray(sigma, float), len(points))
    data = _MarkerData(body, points, x, sigma, loss, limits)
    roots, angles = _tried_anew(data, *data.poses(slice(None)))
    roots, angles, sure, wide, flat = profiled(data, roots, angles, markers.rate)
    roots, angles = settled_by_motion(data, roots, unwrap(body.tree, angles), flat, markers.rate)
    roots, angles = _bridged(data, roots, angles, sure, markers.rate)
    return _motion(data, roots, angles, wide, markers, up)

@dataclass(frozen=True, eq=False)
class _MarkerData(PointTake):
    """Markers on a body."""

    def poses(self, frames: slice) -> tuple[NDArray, NDArray]:
        """Roots and angles of some frames, with no pose given."""
        return sequence_both_ways(
            self.body, self.points, self.x[frames], self.sigma, loss=self.loss, limits=self.limits
        )  # fmt: skip

    def misfit(self, roots: NDArray, angles: NDArray, frames: slice = slice(None)) -> NDArray:
        """Mean misfit of each of these frames' markers in standard deviations, none counting for more than ten."""
        off = np.linalg.norm(self.x[frames] - self.body.trajectories(roots, angles, self.points), axis=2) / self.sigma
        seen = np.isfinite(off)
        return np.where(seen, np.minimum(np.nan_to_num(off), 10.0), 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)


def _tried_anew(data: _MarkerData, roots: NDArray, angles: NDArray) -> tuple[NDArray, NDArray]:
    """Frames that fit far worse than the others, fitted from nowhere where that does better."""
    roots, angles = roots.copy(), angles.copy()
    misfit = data.misfit(roots, angles)
    bad = misfit > max(_OFF * float(np.median(misfit)), 3.0)
    for a, b in sorted(runs_of(bad), key=lambda run: run[0] - run[1])[:_MOST_RUNS]:
        some = slice(a, b)
        try:
            other_roots, other_angles = data.poses(some)
        except TrackingError:
            continue
        better = data.misfit(other_roots, other_angles, some) < 0.9 * misfit[some]
        roots[some][better], angles[some][better] = other_roots[better], other_angles[better]
    return roots, angles


def _bridged(
    data: _MarkerData, roots: NDArray, angles: NDArray, sure: Certainty, rate: float
) -> tuple[NDArray, NDArray]:
    """Poses whose untold angles follow from the frames around them; the others stay as measured."""
    tree, x = data.body.tree, data.x
    lost = ~((sure.dof_std[:, :3].max(axis=1) < _HELD) & (sure.dof_std[:, 3:6].max(axis=1) < _TOLD))
    enough = np.minimum(np.where(tree.prismatic, _HELD, _TOLD), UNOBSERVED_STD_RATIO * tree.spread)
    told = (sure.dof_std[:, 6:] < enough) & ~lost[:, None]
    some = told.any(axis=0)
    if lost.all() or (told[:, some].all() and not lost.any()):
        return roots, angles
    frames = np.arange(len(x))
    meant = angles.copy()
    for d in np.flatnonzero(some):
        meant[:, d] = np.interp(frames, frames[told[:, d]], angles[told[:, d], d])
    held, (roots, _) = roots, bridged(roots, meant, lost, _MEMORY * rate)
    before, measured = data.misfit(roots, angles), angles
    roots, angles = np.array(roots), np.where(told | ~some, angles, meant)
    again = ~lost & ~told[:, some].all(axis=1)
    for a, b in runs_of(again):
        inside = bool(((angles[a:b] >= tree.lower) & (angles[a:b] <= tree.upper)).all())  # not in another chart
        fit = fit_sequence(  # the rest of the chain settles about what is now known
            data.body, BodyState(roots[a], angles[a]), data.points, x[a:b], sigma=data.sigma, loss=data.loss,
            limits=data.limits and inside, posture=1.0, usual=meant[a:b],
        )  # fmt: skip
        roots[a:b], angles[a:b] = fit.Ts_world_root, fit.angles
    worse = again & (data.misfit(roots, angles) > before + _WORSE)
    roots[worse], angles[worse] = held[worse], measured[worse]
    return roots, unwrap(tree, angles) if again.any() else angles


def _motion(
    data: _MarkerData, roots: NDArray, angles: NDArray, sure: Certainty, markers: Markers, up: str | None
) -> Motion:
    """Quality as of every other track: the share of what shows a segment that agrees with it."""
    body, points, x = data.body, data.points, data.x
    dof_std = np.array(sure.dof_std)
    dof_std[:, 6:][dof_std[:, 6:] > UNOBSERVED_STD_RATIO * body.tree.spread] = np.inf
    values = x - body.trajectories(roots, angles, points)
    squares = np.square(values / data.sigma[:, None]).sum(axis=2)
    quality = of_points(body, points, squares).segment_quality(body.tree)
    residuals = Residuals(points.names, points.segments, values, sure.factors, "m", x, np.zeros(len(x), bool))
    return Motion(
        body=body, rate=markers.rate, times=markers.times, Ts_world_root=roots, angles=angles, dof_std=dof_std,
        joint_std=sure.joint_std, quality=quality.mean(axis=1), segment_quality=quality,
        residuals={"markers": residuals}, up=up or markers.up or upright(roots),
        name=Path(markers.source).stem or "markers",
    )  # fmt: skip


def upright(roots: NDArray) -> str:
    """The world's axis along which the root's own vertical axis points on average."""
    mean = roots[:, :3, 1].mean(axis=0)
    return max(UP_AXES, key=lambda axis: float(np.dot(mean, UP_AXES[axis])))
