"""Labelled markers on a body of known size: the plain fit (body scale, offsets and labels are found elsewhere)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences import point_rows
from kinefit.errors import ObservationError, TrackingError
from kinefit.motion import Motion, Residuals
from kinefit.observations import Markers
from kinefit.solvers.equations import covariance, joint_std, normal_equations
from kinefit.solvers.losses import Loss, geman_mcclure
from kinefit.solvers.sequence import fit_sequence
from kinefit.tracking.initialise import pose_from_points


def fit_markers(
    body: Body,
    markers: Markers,
    marker_set: str | None = None,
    *,
    sigma: ArrayLike = 0.005,
    loss: Loss | None = None,
    limits: bool = True,
    up: str | None = None,
) -> Motion:
    """Motion of a body from labelled markers, each frame from the last, the first with no pose given.

    Parameters
    ----------
    body : Body, of the subject's size.
    markers : Markers
        Labels may carry a subject's prefix ("Anna:LASI"); labels that the set does not have are left out.
    marker_set : str
        Default: the body's set that shares most labels.
    sigma : scalar or one for each marker used [m]
    loss : default Geman-McClure, so that a wrong label or a ghost does not pull.
    up : vertical axis of the world; default: the file's where it says so, else y.

    Raises
    ------
    ObservationError
        Fewer than four labels are known to the body.
    TrackingError
        No frame shows enough markers to start from.
    """
    points, columns = _matched(body, markers, marker_set)
    x = markers.positions[:, columns]
    first, state = _start(body, points, x)
    loss = loss or geman_mcclure()
    after = fit_sequence(body, state, points, x[first:], sigma=sigma, loss=loss, limits=limits)
    before = fit_sequence(body, state, points, x[:first][::-1], sigma=sigma, loss=loss, limits=limits)
    roots = np.concatenate([before.Ts_world_root[::-1], after.Ts_world_root])
    angles = np.concatenate([before.angles[::-1], after.angles])
    return _motion(body, markers, points, x, roots, angles, sigma, loss, up)


def known_markers(body: Body, markers: Markers, marker_set: str | None = None) -> tuple[str, tuple[str, ...]]:
    """The body's marker set that a recording's labels belong to, and the labels without a subject's prefix.

    "" where the labels are the body's own landmarks.

    Raises
    ------
    ObservationError
        None of its labels is known to the body.
    """
    labels = tuple(name.rpartition(":")[2] for name in markers.names)
    sets = {marker_set: body.markers(marker_set)} if marker_set else {**body.marker_sets, "": body.landmarks}
    shared = {name: sum(n in points.names for n in labels) for name, points in sets.items()}
    best = max(shared, key=lambda name: shared[name])
    if not shared[best]:
        raise ObservationError(
            f"none of its labels is known to body '{body.name}'", file=markers.source or None,
            remedy=f"Marker sets of the body: {', '.join(body.marker_sets) or 'none'}; or name its landmarks.",
        )
    return best, labels


def _matched(body: Body, markers: Markers, marker_set: str | None) -> tuple[PointSet, list[int]]:
    labels = [name.rpartition(":")[2] for name in markers.names]
    sets = {marker_set: body.markers(marker_set)} if marker_set else body.marker_sets
    best: PointSet | None = None
    columns: list[int] = []
    for points in sets.values():
        known = [n for n in points.names if n in labels]
        if len(known) > len(columns):
            best, columns = points.select(tuple(known)), [labels.index(n) for n in known]
    if best is None or len(columns) < 4:
        raise ObservationError(
            f"only {len(columns)} of its labels are known to body '{body.name}'",
            file=markers.source or None,
            remedy=f"Marker sets of the body: {', '.join(body.marker_sets) or 'none'}; add one to a body file.",
        )
    return best, columns


def _start(body: Body, points: PointSet, x: NDArray) -> tuple[int, BodyState]:
    seen = np.isfinite(x).all(axis=2).sum(axis=1)
    order = np.argsort(-seen, kind="stable")
    for frame in order[:5]:
        try:
            state, _ = pose_from_points(body, points, x[frame])
        except TrackingError:
            continue
        return int(frame), state
    raise TrackingError("no frame shows enough markers to start from", remedy="Six markers in one frame are the least.")


def _motion(
    body: Body,
    markers: Markers,
    points: PointSet,
    x: NDArray,
    roots: NDArray,
    angles: NDArray,
    sigma: ArrayLike,
    loss: Loss,
    up: str | None,
) -> Motion:
    frames, dofs, segments = len(x), body.tree.n_dofs, len(body.tree.segments)
    dof_std, joints = np.empty((frames, dofs)), np.empty((frames, segments, 3))
    weights = np.zeros((frames, len(points)))
    for f in range(frames):
        state = BodyState(roots[f], angles[f])
        equations = normal_equations(body, state, point_rows(body, state, points, x[f], sigma=sigma), loss=loss)
        weights[f, equations.rows.group] = equations.factor
        spread = covariance(equations)
        dof_std[f], joints[f] = spread.std, joint_std(body, state, spread)
    quality = np.stack([_share(weights, points.segments == s) for s in range(segments)], axis=1)
    values = x - body.trajectories(roots, angles, points)
    return Motion(
        body=body,
        rate=markers.rate,
        times=markers.times,
        Ts_world_root=roots,
        angles=angles,
        dof_std=dof_std,
        joint_std=joints,
        quality=weights.mean(axis=1),
        segment_quality=quality,
        residuals={
            "markers": Residuals(points.names, points.segments, values, weights, "m", x, np.zeros(frames, bool))
        },
        up=up or markers.up or "y",
        name=Path(markers.source).stem or "markers",
    )


def _share(weights: NDArray, mine: NDArray) -> NDArray:
    return weights[:, mine].mean(axis=1) if mine.any() else np.zeros(len(weights))
