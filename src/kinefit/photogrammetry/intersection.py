"""Forward intersection: places in several images to points in space, with their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape
from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Rig
from kinefit.geometry.triangulation import triangulate

_STEPS = 5  # of Gauss-Newton, from the point of equal weights, which is nearly there
_DONE = 1e-9  # [m] of a step, after which there is none
_SINGULAR = 1e-15  # of the cube of its trace: a determinant at which rays are parallel but for rounding
_ANGLE = np.deg2rad(0.5)  # between rays, below which a distance is 100 times less certain than a direction

_EXACT = 1e-6  # [px] no match is surer: images that are equal have no residuals


@dataclass(frozen=True, eq=False)
class Intersections:
    """Points in space where rays meet.

    Parameters
    ----------
    x_world : (N, 3) [m]; NaN where fewer than two cameras saw the point
    covariance : (N, 3, 3) [m²], of the places in the images; what is wrong with the calibration comes on top
    parallax : (N,) [px] RMS distance of the rays' images from the places: what the calibration leaves over
    """

    x_world: NDArray
    covariance: NDArray
    parallax: NDArray

    @property
    def std(self) -> NDArray:
        """(N, 3) [m] standard deviations along the world's axes."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def intersect(rig: Rig, uv: NDArray, covariance: NDArray) -> Intersections:
    """Points of least squared error, weighted by the covariance of each place.

    Parameters
    ----------
    uv : (N, C, 2) [px] in the cameras of the rig; NaN where not seen
    covariance : (N, C, 2, 2) [px²]

    Raises
    ------
    ObservationError
        Shapes that do not fit.
    CalibrationError
        Cameras whose rays are all but parallel where they meet: nothing tells a distance.
    """
    check_shape(uv, ("N", len(rig), 2), "places")
    check_shape(covariance, (*uv.shape, 2), "covariances of places")
    seen = np.isfinite(uv).all(axis=2) & np.isfinite(covariance).all(axis=(2, 3))
    points = triangulate(rig, np.where(seen[..., None], uv, np.nan))
    good = np.isfinite(points).all(axis=1) & (seen.sum(axis=1) >= 2)
    x = np.where(good[:, None], points, np.nan)
    _check_angles(rig, x)
    weight = np.zeros_like(covariance)
    weight[seen] = np.linalg.inv(covariance[seen] + _EXACT**2 * np.eye(2))
    normal = np.full((len(x), 3, 3), np.nan)
    for _ in range(_STEPS):
        normal, right = np.zeros((len(x), 3, 3)), np.zeros((len(x), 3))
        for c, camera in enumerate(rig):
            at, J = camera.project_with_jacobian(x)
            use = seen[:, c] & np.isfinite(at).all(axis=1)
            JW = np.einsum("nij,nik->njk", J[use], weight[use, c])
            normal[use] += JW @ J[use]
            right[use] += np.einsum("njk,nk->nj", JW, uv[use, c] - at[use])
        good &= np.linalg.det(normal) > _SINGULAR * np.trace(normal, axis1=1, axis2=2) ** 3
        step = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
        x[good] += step
        if not len(step) or np.abs(step).max() < _DONE:
            break
    out = np.full((len(x), 3, 3), np.nan)
    out[good] = np.linalg.inv(normal[good])
    x[~good] = np.nan
    gaps = np.stack([((camera.project(x) - uv[:, c]) ** 2).sum(axis=1) for c, camera in enumerate(rig)], axis=1)
    square = np.where(seen, gaps, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    return Intersections(x, out, np.where(good, np.sqrt(square), np.nan))


def _check_angles(rig: Rig, x: NDArray) -> None:
    """Refuse cameras that stand in one place, as seen from the points."""
    middle = x[np.isfinite(x).all(axis=1)]
    if not len(middle):
        return
    rays = np.array([camera.centre_world - np.median(middle, axis=0) for camera in rig])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    widest = np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))
    if widest < _ANGLE:
        problem = f"the rays of cameras {', '.join(rig.names)} meet at {np.rad2deg(widest):.2f} degrees at most"
        raise CalibrationError(problem, remedy="Put the cameras further apart, or check the calibration.")
