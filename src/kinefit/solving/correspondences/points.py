"""Point to point: a marker, a triangulated joint, a manually annotated 3D point."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.geometry.camera import Rig
from kinefit.observations import KEYPOINT_SIGMA
from kinefit.solving.correspondences import _kernels, targets
from kinefit.solving.rows import ParameterRows, Rows


def point_rows(body: Body, state: BodyState, points: PointSet, x_world: ArrayLike, *, sigma: ArrayLike = 0.01) -> Rows:
    """Three rows for each point: n = the world's axes, r = target − x (P2 3.2, "3D point to point").

    Parameters
    ----------
    points : PointSet of K points on the body.
    x_world : (K, 3) [m]
        Measured positions; NaN for none.
    sigma : scalar or (K,) [m]
        Standard deviation along each axis.
    """
    x, present = targets.array(x_world, 3, len(points), "measured points")
    return targets.fill(_kernels.point_rows, 3, body, state, points, x, targets.weights(sigma, present, "points"))


def ray_rows(body: Body, state: BodyState, points: PointSet, lines: ArrayLike, *, sigma: ArrayLike = 0.01) -> Rows:
    """Two rows for each point: its offset from the line along two directions normal to it (x × n − m, P3 eq. 4).

    Parameters
    ----------
    points : PointSet of K points on the body.
    lines : (K, 6)
        Plücker lines (n, m) in the world, see `geometry.lines`; NaN for none.
    sigma : scalar or (K,) [m]
        Standard deviation of the distance. For pixels use `pixel_rows`, whose weights account for the depth.
    """
    line, present = targets.array(lines, 6, len(points), "lines")
    targets.unit(line[:, :3], present, "directions of lines")
    w = targets.weights(sigma, present, "rays")
    return targets.fill(_kernels.ray_rows, 2, body, state, points, np.nan_to_num(line), w)


def plane_rows(
    body: Body, state: BodyState, points: PointSet, x_world: ArrayLike, normal: ArrayLike, *, sigma: ArrayLike = 0.01
) -> Rows:
    """One row for each point, along the plane's normal: r = n·(target − x) (P1 2.3, point-plane).

    Parameters
    ----------
    points : PointSet of K points on the body.
    x_world : (K, 3) [m]
        A point of each plane; NaN for none.
    normal : (K, 3)
        Unit normals.
    sigma : scalar or (K,) [m]
    """
    x, present = targets.array(x_world, 3, len(points), "points of planes")
    n, directed = targets.array(normal, 3, len(points), "normals")
    targets.unit(n, directed, "normals of planes")
    w = targets.weights(sigma, present & directed, "planes")
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    order = np.argsort(points.segments, kind="stable")
    data, segment, group = _kernels.buffers(len(points))
    _kernels.plane_rows(
        frames, points.segments[order], *(targets.lines(v[order]) for v in (body.points_rest(points), x, n)), w[order],
        0, data, segment, group, 0,
    )  # fmt: skip
    kept = data[7] > 0
    return Rows(np.ascontiguousarray(data[:, kept]), segment[kept], order[group[kept]])  # group: index of the point


def pixel_rows(
    body: Body,
    state: BodyState,
    points: PointSet,
    rig: Rig,
    camera: ArrayLike,
    uv: ArrayLike,
    *,
    sigma: ArrayLike = KEYPOINT_SIGMA,
) -> Rows:
    """Two rows for each pixel: g = ∂(u or v)/∂x with distortion, n = g/|g|, r = Δpx/|g|, w = |g|²/σ².

    Parameters
    ----------
    points : PointSet of K points on the body, one for each pixel (repeat a point that several cameras see).
    rig : Rig
    camera : (K,) int, or one for all, index of the camera in the rig.
    uv : (K, 2) [px]
        In the calibration's image frame; NaN for none.
    sigma : scalar or (K,) [px]
    """
    target, present = targets.array(uv, 2, len(points), "pixels")
    index = targets.cameras(rig, camera, len(points))
    w = targets.weights(sigma, present, "pixels")
    return targets.fill(_kernels.pixel_rows, 2, body, state, points, rig.packed, index, np.nan_to_num(target), w)


def image_line_rows(
    body: Body,
    state: BodyState,
    points: PointSet,
    rig: Rig,
    camera: ArrayLike,
    lines: ArrayLike,
    *,
    sigma: ArrayLike = 2.0,
) -> Rows:
    """One row for each point, whose pixel should lie on an image line; linearised with distortion, as `pixel_rows`.

    Parameters
    ----------
    points : PointSet of K points on the body.
    camera : (K,) int, or one for all, index in the rig.
    lines : (K, 3)
        a u + b v + c = 0 in the calibration's image frame, of any scale; NaN for none. Distortion bends a straight edge
        of the world: then give the tangent near the point.
    sigma : scalar or (K,) [px]
    """
    line, present = targets.array(lines, 3, len(points), "image lines")
    present &= np.hypot(np.nan_to_num(line[:, 0]), np.nan_to_num(line[:, 1])) > 0
    index = targets.cameras(rig, camera, len(points))
    w = targets.weights(sigma, present, "image lines")
    return targets.fill(_kernels.image_line_rows, 1, body, state, points, rig.packed, index, np.nan_to_num(line), w)


def edge_rows(
    body: Body,
    state: BodyState,
    starts: PointSet,
    ends: PointSet,
    rig: Rig,
    camera: ArrayLike,
    lines: ArrayLike,
    *,
    sigma: ArrayLike = 2.0,
) -> Rows:
    """Two rows for each edge of the body: both ends should project onto an image line (3D line - 2D line).

    A line lies in a plane when two of its points do, so P1's line-plane constraint is two point-plane ones.

    Parameters
    ----------
    starts, ends : PointSet of K points each.
    camera : (K,) int, or one for all, index in the rig.
    lines : (K, 3)
        a u + b v + c = 0, as for `image_line_rows`.
    sigma : scalar or (K,) [px]
    """
    a = image_line_rows(body, state, starts, rig, camera, lines, sigma=sigma)
    b = image_line_rows(body, state, ends, rig, camera, lines, sigma=sigma)
    both = Rows.concat(a, b)
    group = np.concatenate([a.group, b.group])  # the two ends of one edge share its robust weight
    order = np.argsort(group, kind="stable")
    return Rows(np.ascontiguousarray(both.data[:, order]), both.segment[order], group[order])


def limit_rows(body: Body, state: BodyState, *, sigma: float = 0.02) -> ParameterRows:
    """One row for each coordinate outside its range, towards the nearer limit. The solvers have hard limits.

    Parameters
    ----------
    sigma : float [rad or m]
        Standard deviation of a violation.
    """
    inside = np.clip(state.angles, body.tree.lower, body.tree.upper)
    violated = np.flatnonzero(inside != state.angles)
    w = targets.weights(sigma, np.ones(len(inside), bool), "limits")
    return ParameterRows(6 + violated, (inside - state.angles)[violated], w[violated])


def prior_rows(
    body: Body, state: BodyState, *, mean: ArrayLike | None = None, sigma: ArrayLike | None = None
) -> ParameterRows:
    """One row for each coordinate, towards a mean posture; with a full weight matrix if the body's prior has couplings.

    Parameters
    ----------
    mean : scalar or (D,) [rad or m]
        Default: the mean of the body's posture prior.
    sigma : scalar or (D,) [rad or m]
        Standard deviations, inf for a coordinate without prior; default: the body's posture prior with its couplings.
    """
    tree, count = body.tree, len(body.tree.coordinates)
    if mean is None and sigma is None:
        constrained, precision = tree.held_by_posture
        return ParameterRows(6 + constrained, (tree.usual - state.angles)[constrained], precision)
    w = targets.weights(tree.spread if sigma is None else sigma, np.ones(count, bool), "priors")
    constrained = np.flatnonzero(w > 0.0)
    gap = np.broadcast_to(np.asarray(tree.usual if mean is None else mean, float), count) - state.angles
    joint = sigma is None and tree.coupled
    return ParameterRows(6 + constrained, gap[constrained], tree.held_by_posture[1] if joint else w[constrained])


def prediction_rows(body: Body, state: BodyState, predicted: BodyState, *, sigma: NDArray) -> ParameterRows:
    """One row for each degree of freedom, towards a predicted state.

    For the root's rotation r ≈ δ holds to first order in r. Their sum of squares is exact if the three sigmas are
    equal.

    Parameters
    ----------
    predicted : BodyState
    sigma : (6 + D,) [m, rad]
        Standard deviation of the prediction; inf for a degree of freedom without prediction.
    """
    sigma = shaped(sigma, (body.tree.n_dofs,), "sigma of a prediction")
    w = targets.weights(sigma, np.ones(len(sigma), bool), "predictions")
    constrained = np.flatnonzero(w > 0.0)
    return ParameterRows(constrained, state.difference(predicted)[constrained], w[constrained])
