"""Rows of a body's skin points, which are blended between segments and moved by morphs (P1 2.4, 3)."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.bodies.morphs.morphing import MorphedPose
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.solving.correspondences.contours.outlines import Rim
from kinefit.solving.rows import DofRows, Rows


def morphed_rows(
    pose: MorphedPose,
    index: ArrayLike,
    direction: ArrayLike,
    residual: ArrayLike,
    *,
    share: ArrayLike | None = None,
    sigma: ArrayLike = 0.01,
) -> Rows | DofRows:
    """One row for each skin point, r ≈ n·∂x/∂δ δ, with the derivative of morphs.

    Returns plain `Rows`, which are faster, if every node has one owner and nothing morphs.

    Parameters
    ----------
    pose : MorphedPose, of `Morphing(body).pose(state)`.
    index : (K,) int, nodes of the mesh; or (K, C), the nodes that each point lies between, such as a face's corners.
    direction : (K, 3) unit, in the world.
    residual : (K,) [m] how much further along it each point should lie; NaN for none.
    share : (K, C) barycentric coordinates.
    sigma : scalar or (K,) [m]

    Raises
    ------
    ObservationError
        Arrays of other shapes, or a sigma that is not positive.
    """
    chosen = np.asarray(index, np.int64)
    chosen = chosen[:, None] if chosen.ndim == 1 else chosen
    n, r = shaped(direction, (len(chosen), 3), "directions"), shaped(residual, (len(chosen),), "residuals")
    deviation = np.broadcast_to(np.asarray(sigma, float), r.shape)
    if not np.all(deviation > 0):
        raise ObservationError("a standard deviation that is not positive", remedy="Give metres above 0.")
    part = np.ones(chosen.shape) if share is None else np.asarray(share, float)
    known = np.isfinite(r) & np.isfinite(n).all(1)
    ids, weight = np.flatnonzero(known), 1.0 / deviation[known] ** 2
    if len(ids) < len(r):
        chosen, n, r, part = chosen[ids], n[ids], r[ids], part[ids]
    skin = pose.morphing.skin
    if pose.morphing.is_rigid and (skin.owners[chosen, 0] == skin.owners[chosen[:, :1], 0]).all():
        x = np.einsum("kc,kci->ki", part, pose.vertices[chosen])
        return Rows.of(skin.owners[chosen[:, 0], 0], x, n, r, weight, ids)
    owner = skin.owners[chosen].astype(np.int64)  # (K, C, owners of a node)
    segment = owner[:, 0, 0] if (owner == owner[:, :1, :1]).all() else None
    return DofRows(cache(lambda: pose.along(chosen, n, part)), r, weight, ids, segment=segment)


def on_moved_joints(pose: MorphedPose, rows: Rows) -> DofRows:
    """Convert rows of points on segments, made with `pose.frames`, to rows with the derivative of moving joints."""
    arm = rows.point - pose.state.T_world_root[:3, 3]
    a = np.concatenate([rows.direction, np.cross(arm, rows.direction)], axis=1)
    J = np.empty((len(rows), pose.morphing.body.tree.n_dofs))
    for s in np.unique(rows.segment):
        of = rows.segment == s
        J[of] = a[of] @ pose.segment_jacobian(int(s))
    return DofRows(J, rows.residual, rows.weight, rows.group, rows.loss, rows.segment)


def morphed_outline_rows(
    pose: MorphedPose,
    rim: Rim,
    camera: Camera,
    image: NDArray,
    *,
    sigma: float = 2.0,
) -> Rows | DofRows:
    """Rows as of `outline_rows` by pixels, for a skin that is blended or morphs.

    Parameters
    ----------
    pose : MorphedPose
    rim : Rim of `pose.vertices` in this camera, N points.
    camera : Camera
    image : (4, N) the matched point of the silhouette's contour for each: u, v [px], normal.
    sigma : float [px] standard deviation of a pair.

    Raises
    ------
    ObservationError
        A sigma that is not positive.
    """
    if not sigma > 0:
        raise ObservationError(f"a standard deviation of {sigma} px", remedy="Give a positive number of pixels.")
    n, away, size = toward_tangents(rim.on(pose.vertices), camera, image)
    share = np.stack([1.0 - rim.share, rim.share], axis=1)
    return morphed_rows(pose, rim.vertices, n, away, share=share, sigma=sigma / size)


def toward_tangents(x_world: NDArray, camera: Camera, image: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Displacement of points (N, 3) [m] that moves their pixels to the tangents of a contour (4, N).

    Returns
    -------
    direction : (N, 3) unit, in the world, along which the pixel moves fastest across the tangent.
    residual : (N,) [m] distance along it; size : (N,) [px/m] speed of the pixel.
    """
    u, v, a, b = image
    pixel, J = camera.project_with_jacobian(x_world)
    slope = a[:, None] * J[:, 0] + b[:, None] * J[:, 1]
    size = np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
    return slope / size[:, None], (a * (u - pixel[:, 0]) + b * (v - pixel[:, 1])) / size, size
