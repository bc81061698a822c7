"""Pose from silhouettes as published by Rosenhahn and Klette (P1 2.4): contour, occluding contour, pairs, rays.

1. The image's silhouette comes from a threshold on colour and the Laplace operator.
2. The model's 3D silhouette comes from its projection in a rendered image, in every cycle; optionally from its low
   frequencies first. Skins and morphing bodies are posed as such.
3. Each of its points is paired with the nearest contour point (ICP), which defines a projection ray.
4. The motor of the pose and the joint angles solve (M X M̃) × L = 0 for all pairs; this is iterated to convergence.

The tracker (`Tracker` with `SilhouetteFrame`) lets contours slide along each other, compares their normals, pairs in
both directions, and has robust weights, prediction, the quality of every segment, and other sensors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.morphs.morphing import MorphedPose, Morphing
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import perpendiculars
from kinefit.images.silhouette import colour_silhouette
from kinefit.solving.correspondences.contours.outlines import RimFinder, morphed_rows, outline_pairs
from kinefit.solving.least_squares import gauss_newton
from kinefit.solving.rows import DofRows, Rows

__all__ = ["PaperFit", "contour_points", "pose_from_contours", "track_contours"]

_CONTOUR_SIGMA_PX = 2.0  # of a contour point
_MAX_NORMAL_ANGLE = np.pi  # pairs are the nearest points, whatever their normals


@dataclass(frozen=True, eq=False)
class PaperFit:
    """Result of one frame.

    Parameters
    ----------
    state : BodyState
    error : float [m] root mean square distance of the rim's points from their rays.
    cycles : int, number of iterations
    """

    state: BodyState
    error: float
    cycles: int


def contour_points(image: ArrayLike, low: ArrayLike, high: ArrayLike) -> NDArray:
    """Contour (4, N) of pixels with colours between low and high (3,): u, v [px]; normals are not used and zero."""
    _, contour = colour_silhouette(image, low, high)
    v, u = np.nonzero(contour)
    return np.stack([u, v, np.zeros(len(u)), np.zeros(len(u))]).astype(float)


def pose_from_contours(
    model: Body | Morphing,
    state: BodyState,
    rig: Rig,
    contours: Mapping[str, NDArray],
    *,
    levels: int = 1,
    reach: float = 60.0,
    cycles: int = 30,
    tolerance: float = 1e-4,
) -> PaperFit:
    """Estimate pose and joint angles from the contours in some cameras (P1 2.4).

    Parameters
    ----------
    model : Body with its skin and its morphs, or a `Morphing` of it.
    state : BodyState, initial: the last frame's.
    contours : camera -> (4, N) from `contour_points`, in the image of the calibration.
    levels : number of approximations of the model's surface, low frequencies first, the surface itself last
        (`Morphing.levels`); 1 is the surface alone.
    reach : float [px], largest distance of a pair.
    cycles : int, largest number of iterations for each approximation.
    tolerance : float [m, rad] of a step at which they end.

    Raises
    ------
    ObservationError
        No contour has a point near the occluding contour of the body.
    """
    whole = Morphing(model) if isinstance(model, Body) else model
    error, done = np.nan, 0
    for shape in whole.levels(levels):
        finder = RimFinder(shape.mesh)
        for _ in range(cycles):
            pose, parts = shape.pose(state), []
            for name, points in contours.items():
                parts += _rows(pose, rig[name], points, finder, reach)
            count = sum(len(rows) for rows in parts)
            if not count:
                raise ObservationError("no contour is near the body", remedy="Start nearer to it, or widen the reach.")
            weight = sum(float(np.sum(rows.weight)) for rows in parts)
            step = gauss_newton(whole.body, state, parts, damping=1e-6 * weight)
            error = float(np.sqrt(2.0 * sum(float(np.sum(rows.residual**2)) for rows in parts) / count))
            state, done = step.state, done + 1
            if step.norm < tolerance:
                break
    return PaperFit(state, error, done)


def _rows(
    pose: MorphedPose, camera: Camera, contour: NDArray, finder: RimFinder, reach: float
) -> list[Rows | DofRows]:
    """Two rows for each pair: a point of the rim should lie on the ray of the contour's point."""
    rim = finder.find(pose.vertices, camera)
    rim = rim.chosen(~rim.inner)
    i, k = outline_pairs(rim.outline, np.ascontiguousarray(contour), reach=reach, angle=_MAX_NORMAL_ANGLE, both=False)
    if not len(i):
        return []
    chosen = rim.chosen(i)
    x, ray = chosen.on(pose.vertices), camera.ray(contour[:2, k].T)
    share = np.stack([1.0 - chosen.share, chosen.share], axis=1)
    depth = x @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    sigma = np.maximum(depth, 1e-3) * _CONTOUR_SIGMA_PX / np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
    return [
        morphed_rows(pose, chosen.vertices, n, np.sum((camera.centre_world - x) * n, axis=1), share=share, sigma=sigma)
        for n in perpendiculars(ray)
    ]


def track_contours(
    body: Body,
    start: BodyState,
    rig: Rig,
    images: Iterable[Mapping[str, NDArray]],
    colours: Mapping[str, Sequence[ArrayLike]],
    *,
    levels: int = 1,
) -> Iterator[PaperFit]:
    """Track a body frame by frame, each from the last pose; images: camera -> (H, W, 3), colours: -> (low, high)."""
    model, state = Morphing(body), start
    for seen in images:
        contours = {name: contour_points(image, *colours[name]) for name, image in seen.items()}
        fit = pose_from_contours(model, state, rig, contours, levels=levels)
        state = fit.state
        yield fit
