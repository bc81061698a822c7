"""Pose from silhouettes as Rosenhahn and Klette print it (P1 4.1): contour, occluding contour, pairs, rays, again.

1. The image's silhouette comes from a threshold on colour and the Laplace operator.
2. The model's 3D silhouette comes from its projection in a virtual image, anew in every cycle.
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
from kinefit.bodies.surfaces import body_mesh
from kinefit.bodies.surfaces.triangles import BodyMesh
from kinefit.correspondences.outlines import outline_pairs, outline_rows
from kinefit.correspondences.rims import RimFinder
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.images.silhouette import colour_silhouette
from kinefit.rows import Rows
from kinefit.solvers.least_squares import gauss_newton

__all__ = ["PaperFit", "contour_points", "pose_from_contours", "track_contours"]

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
    body: Body,
    state: BodyState,
    rig: Rig,
    contours: Mapping[str, NDArray],
    *,
    mesh: BodyMesh | None = None,
    finder: RimFinder | None = None,
    reach: float = 60.0,
    cycles: int = 30,
    tolerance: float = 1e-4,
) -> PaperFit:
    """Pose and joint angles from the contours in some cameras (P1 4.1).

    Parameters
    ----------
    state : BodyState to begin with, the last frame's.
    contours : camera -> (4, N) as `contour_points` gives them, in the image of the calibration.
    mesh, finder : made once for the body; default: `body_mesh(body)`.
    reach : float [px] beyond which no points are paired.
    tolerance : float, of a step (metres and radians) that ends the cycles.

    Raises
    ------
    ObservationError
        No contour has a point near the occluding contour of the body.
    """
    mesh = body_mesh(body) if mesh is None else mesh
    finder = RimFinder(mesh) if finder is None else finder
    error, done = np.nan, 0
    while done < cycles:
        done += 1
        vertices = mesh.posed(body.tree.forward(state.T_world_root, state.angles)[0])
        parts = [_rows(body, state, rig[name], points, vertices, finder, reach) for name, points in contours.items()]
        rows = Rows.concat(*parts)
        if not len(rows):
            raise ObservationError("no contour is near the body", remedy="Start nearer to it, or widen the reach.")
        step = gauss_newton(body, state, rows, damping=1e-6 * float(np.sum(rows.weight)))
        error = float(np.sqrt(2.0 * np.mean(rows.residual**2)))
        state = step.state
        if step.norm < tolerance:
            break
    return PaperFit(state, error, done)


def _rows(
    body: Body, state: BodyState, camera: Camera, contour: NDArray, vertices: NDArray, finder: RimFinder, reach: float
) -> Rows:
    rim = finder.find(vertices, camera)
    rim = rim.chosen(~rim.inner)
    pairs = outline_pairs(rim.outline, np.ascontiguousarray(contour), reach=reach, angle=_ANY_WAY, both=False)
    return outline_rows(body, state, rim, vertices, camera, contour, pairs, by="rays")


def track_contours(
    body: Body,
    start: BodyState,
    rig: Rig,
    images: Iterable[Mapping[str, NDArray]],
    colours: Mapping[str, Sequence[ArrayLike]],
) -> Iterator[PaperFit]:
    """Frame after frame, each from the last one's pose: images camera -> (H, W, 3), colours camera -> (low, high)."""
    mesh, state = body_mesh(body), start
    finder = RimFinder(mesh)
    for seen in images:
        contours = {name: contour_points(image, *colours[name]) for name, image in seen.items()}
        fit = pose_from_contours(body, state, rig, contours, mesh=mesh, finder=finder)
        state = fit.state
        yield fit
