"""A start from rays on which points lie, such as those of one camera's keypoints, and from other sensors' rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState, PointSet
from kinefit.correspondences import prior_rows
from kinefit.rows import AnyRows
from kinefit.sensors.base import Measurement
from kinefit.sensors.scene import Scene
from kinefit.solvers.least_squares import levenberg_marquardt

_HEADINGS = 4
"""Headings about the vertical at which fits begin: from each a fit reaches minima within 45 degrees."""

_MIN_POINTS = 6
_ITERATIONS, _TOLERANCE = 60, 1e-4


def starts_from_rays(
    scene: Scene, points: PointSet, rays: NDArray, measurements: Sequence[Measurement], up: NDArray
) -> list[BodyState]:
    """States that fit all measurements, in order of increasing cost; none where fewer than six rays are known.

    The body begins upright on the mean ray, as far away as its size on the rays says, at several headings. The rows of
    all measurements then decide: rays alone leave a body that is smaller and nearer, a range or a contact does not.

    Parameters
    ----------
    scene : of the body, in any state
    points : PointSet of K points
    rays : (K, 2, 3) origin [m] and unit direction in the world of the ray on which each point lies; NaN where unknown
    measurements : of which all rows are used
    up : (3,) unit, upwards in the world
    """
    known = np.isfinite(rays).all(axis=(1, 2))
    if known.sum() < _MIN_POINTS:
        return []
    body, (origin, direction) = scene.body, rays[known].swapaxes(0, 1)
    rest = body.positions(body.usual_state(np.eye(4)), points)[known]
    axis = direction.mean(axis=0)
    axis /= np.linalg.norm(axis)
    angle = np.sqrt(np.mean(np.sum(np.square(direction - axis), axis=1)))

    def rows(state: BodyState) -> list[AnyRows]:
        here = scene.at(state, measurements=tuple(measurements))
        return [*(r for m in measurements for r in m.match(here, np.inf).rows(here)), prior_rows(body, state)]

    fits = []
    for heading in _headings(axis, up):
        T = np.eye(4)
        T[:3, :3] = np.stack([heading, up, np.cross(heading, up)], axis=1)
        x = rest @ T[:3, :3].T
        across = (x - x.mean(axis=0)) @ (np.eye(3) - np.outer(axis, axis))
        distance = np.sqrt(np.mean(np.sum(np.square(across), axis=1))) / max(angle, 1e-6)
        T[:3, 3] = origin.mean(axis=0) + distance * axis - x.mean(axis=0)
        start = body.usual_state(T)
        fits.append(levenberg_marquardt(body, start, rows, max_iterations=_ITERATIONS, tolerance=_TOLERANCE))
    return [fit.state for fit in sorted(fits, key=lambda fit: fit.equations.cost)]


def _headings(axis: NDArray, up: NDArray) -> list[NDArray]:
    """(3,) horizontal directions, the first of them against the viewing axis."""
    forward = (axis @ up) * up - axis
    if np.linalg.norm(forward) < 1e-6:  # seen from above
        forward = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    forward /= np.linalg.norm(forward)
    side = np.cross(up, forward)
    return [np.cos(a) * forward + np.sin(a) * side for a in 2.0 * np.pi * np.arange(_HEADINGS) / _HEADINGS]
