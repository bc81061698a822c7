"""Pose from silhouettes as Rosenhahn and Klette print it (P1 2.4): contour, occluding contour, pairs, rays, again.

1. The image's silhouette comes from a threshold on colour and the Laplace operator.
2. The model's 3D silhouette comes from its projection in a virtual image, anew in every cycle; of its low frequencies
   first, where that is asked for. Skins and bodies that morph are posed as such.
3. Each point of it is paired with the nearest contour point (ICP), which stands for a ray of projection.
4. The motor of the pose and the joint angles follow from (M X M̃) × L = 0 for all pairs at once; until nothing moves.

The tracker (`Tracker` with `SilhouetteFrame`) beside it lets outlines glide along each other, looks which way
they face, pairs in both directions, weighs outliers down, predicts, judges every segment, and fits any other sensor
along.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.morphs.morphing import MorphedPose, Morphing
from kinefit.correspondences.contours.morphed import morphed_rows
from kinefit.correspondences.contours.outlines import outline_pairs
from kinefit.correspondences.contours.rims import RimFinder
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import perpendiculars
from kinefit.images.silhouette import colour_silhouette
from kinefit.rows import DofRows, Rows
from kinefit.solvers.least_squares import gauss_newton

__all__ = ["PaperFit", "contour_points", "pose_from_contours", "track_contours"]

_PIXELS = 2.0  # [px] standard deviation of a contour point
_ANY_WAY = np.pi  # pairs are the nearest points, whichever way outlines face there


@dataclass(frozen=True, eq=False)
class PaperFit:
    """One frame.

    Parameters
    ----------
    state : BodyState
    error : float [m] root mean square distance of the contour's points from their rays.
    cycles : int
    """

    state: BodyState
    error: float
    cycles: int


def contour_points(image: ArrayLike, low: ArrayLike, high: ArrayLike) -> NDArray:
    """Contour (4, N) of what has a colour between low and high (3,): u, v [px]; the normals are not used, so zero."""
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
    """Pose and joint angles from the contours in some cameras (P1 2.4).

    Parameters
    ----------
    model : Body, with its skin and its morphs, or what was made of it once.
    state : BodyState to begin with, the last frame's.
    contours : camera -> (4, N) as `contour_points` gives them, in the image of the calibration.
    levels : how many approximations of the model's surface follow each other, low frequencies first, the surface
        itself last (`Morphing.levels`); 1 is the surface alone.
    reach : float [px] beyond which no points are paired.
    cycles : int, at most, of each approximation.
    tolerance : float, of a step (metres and radians) that ends the cycles of one.

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
    """Two rows a pair: a point of the rim should lie on the ray of the contour's point."""
    rim = finder.find(pose.vertices, camera)
    rim = rim.chosen(~rim.inner)
    i, k = outline_pairs(rim.outline, np.ascontiguousarray(contour), reach=reach, angle=_ANY_WAY, both=False)
    if not len(i):
        return []
    chosen = rim.chosen(i)
    x, ray = chosen.on(pose.vertices), camera.ray(contour[:2, k].T)
    share = np.stack([1.0 - chosen.share, chosen.share], axis=1)
    depth = x @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    sigma = np.maximum(depth, 1e-3) * _PIXELS / np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
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
    """Frame after frame, each from the last one's pose: images camera -> (H, W, 3), colours camera -> (low, high)."""
    model, state = Morphing(body), start
    for seen in images:
        contours = {name: contour_points(image, *colours[name]) for name, image in seen.items()}
        fit = pose_from_contours(model, state, rig, contours, levels=levels)
        state = fit.state
        yield fit
