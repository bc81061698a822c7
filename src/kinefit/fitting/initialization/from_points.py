"""An initial pose from triangulated points: bone lengths first, then the pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.limbs import rigid_pairs
from kinefit.errors import TrackingError
from kinefit.geometry import se3
from kinefit.geometry.losses import SQUARED, Loss, geman_mcclure
from kinefit.solving.bundle.shape import PROPORTIONS
from kinefit.solving.correspondences import prior_rows
from kinefit.solving.least_squares import levenberg_marquardt
from kinefit.solving.rows import AnyRows, Rows
from kinefit.solving.trajectory.sequence import fit_sequence

_NUMBER_WORDS = {3: "three", 6: "six"}


def first_scales(
    body: Body, points: PointSet, x_world: NDArray, *, height: float | None = None, covariance: NDArray | None = None
) -> NDArray:
    """(G,) scales of a body's scale groups from the median lengths of bones over frames.

    Groups without a measured bone follow the person's height if given, or else the median of the other groups. With a
    covariance, all groups are means of the measured scale and the common one, weighted by the inverse variances of the
    measurement and of human proportions.

    Parameters
    ----------
    points : K points of the body
    x_world : (F, K, 3) [m]; NaN where unknown
    height : [m] of the person
    covariance : (K, 3, 3) [m²] of the points

    Raises
    ------
    TrackingError
        No bone can be measured in any frame, or the size is impossible (wrong unit).
    """
    ratios: dict[int, list[tuple[float, float]]] = {}
    weighted = covariance is not None
    for i, j, group, length in rigid_pairs(body, points):
        gaps = x_world[:, i] - x_world[:, j]
        distances = np.linalg.norm(gaps, axis=1)
        if np.isfinite(distances).any():
            weight = length if covariance is None else length**2 / _variance_along(gaps, covariance[i] + covariance[j])
            ratios.setdefault(group, []).append((float(np.nanmedian(distances)) / length, weight))
    if not ratios:
        raise TrackingError(
            "no bone of the body can be measured: two cameras see too few keypoints at once",
            remedy="Check the calibration (its unit and its camera names) and that the cameras are in step.",
        )
    means = {g: float(np.average([r for r, _ in v], weights=[w for _, w in v])) for g, v in ratios.items()}
    sums = {g: sum(w for _, w in v) for g, v in ratios.items()}
    prior = PROPORTIONS**-2
    if height and body.stature:
        size = height / body.stature
    elif weighted:
        size = float(np.average(list(means.values()), weights=[1.0 / (1.0 / w + 1.0 / prior) for w in sums.values()]))
    else:
        size = float(np.median(list(means.values())))
    if weighted:
        means = {g: (sums[g] * m + prior * size) / (sums[g] + prior) for g, m in means.items()}
    if not 0.2 < size < 5.0:
        raise TrackingError(
            f"the person would be {float(f'{size:.2g}'):g} times the body's size: the calibration's unit is wrong",
            remedy=f"Set unit = {_unit_for(size)} under [calibration], or correct it there.",
        )
    return np.array([np.clip(means.get(g, size), 0.6 * size, 1.6 * size) for g in range(len(body.scale_groups))])


def _variance_along(gaps: NDArray, covariance: NDArray) -> float:
    """[m²] variance of a difference with covariance (3, 3) along the median of its values (F, 3)."""
    direction = np.nanmedian(gaps, axis=0)
    return float(direction @ covariance @ direction / (direction @ direction))


def _unit_for(times: float) -> str:
    """The probable unit of a calibration that makes a person `times` too large."""
    units = {"mm": 1e3, "cm": 1e2, "dm": 1e1, "inch": 39.37}
    name, factor = min(units.items(), key=lambda u: abs(np.log(u[1] / times)))
    return f'"{name}"' if abs(np.log(factor / times)) < 0.7 else "what its numbers are in"


def aligned_root(body: Body, points: PointSet, x_world: NDArray) -> NDArray:
    """T_world_root (4, 4) that fits the body in rest pose to points (K, 3) [m], weighted towards the trunk (Kabsch)."""
    rest, known = body.points_rest(points), np.isfinite(x_world).all(axis=1)
    depth = np.zeros(len(body.tree.segments))
    for s in range(1, len(depth)):
        depth[s] = depth[body.tree.parents[s]] + 1
    near = np.exp(-np.linalg.norm(rest[:, [0, 2]], axis=1) / 0.2) * np.where(rest[:, 1] < -0.1, 0.05, 1.0)
    w = np.where(known, near / (1 + 0.2 * depth[points.segments]), 0.0)
    return se3.aligned(rest, np.where(known[:, None], x_world, 0.0), w)


def pose_from_points(
    body: Body, points: PointSet, x_world: NDArray, *, sigma: float | NDArray = 0.03, near: BodyState | None = None,
    fewest: int = 6, robust: bool = True, covariance: NDArray | None = None,
) -> tuple[BodyState, float]:
    """Fit a body's state to points; returns it and the median residual [m].

    Two starts are tried: the prior mean fitted to the points, and the same turned by 180 degrees about the vertical.
    The lower cost wins. A fixed root is fitted like a free one.

    Parameters
    ----------
    x_world : (K, 3) [m]; NaN where unknown
    sigma : [m] standard deviation along each axis, one or (K,)
    near : a close start, the only one then
    fewest : least number of known points
    robust : whether single points may be wrong
    covariance : (K, 3, 3) [m²] of the points, instead of `sigma`

    Raises
    ------
    TrackingError
        Fewer than six (`fewest`) points are known.
    """
    body = replace(body, tree=replace(body.tree, root_free=True))
    known = np.isfinite(x_world).all(axis=1)
    if known.sum() < fewest:
        problem = f"fewer than {_NUMBER_WORDS.get(fewest, fewest)} points can be triangulated"
        raise TrackingError(problem, remedy="Start where more cameras see the body.")

    if covariance is not None:
        values, vectors = np.linalg.eigh(covariance[known])
        axes, variances = vectors.swapaxes(1, 2).reshape(-1, 3), values.ravel()
        point_rows = np.arange(known.sum()).repeat(3)

    def rows(state: BodyState) -> list[AnyRows]:
        x = body.positions(state, points)[known].repeat(3, axis=0)
        gap = np.einsum("ni,ni->n", axes, x_world[known].repeat(3, axis=0) - x)
        segments = points.segments[known].repeat(3)
        return [Rows.of(segments, x, axes, gap, 1.0 / variances, point_rows), prior_rows(body, state)]

    def fitted(start: BodyState, loss: Loss, steps: int) -> tuple[float, BodyState]:
        if covariance is not None:
            found = levenberg_marquardt(body, start, rows, loss=loss, max_iterations=steps, tolerance=1e-4)
            return found.equations.cost, found.state
        fit = fit_sequence(
            body, start, points, x_world[None], sigma=sigma, loss=loss, posture=1.0, damping=0.1, max_iterations=steps,
            tolerance=1e-4,
        )  # fmt: skip
        return float(fit.costs[0]), BodyState(fit.Ts_world_root[0], fit.angles[0])

    starts = (
        [near] if near else [body.default_state(aligned_root(body, points, x_world) @ _turn(a)) for a in (0.0, np.pi)]
    )
    rough = [start if near else fitted(start, SQUARED, 60)[1] for start in starts]
    fits = [fitted(start, geman_mcclure() if robust else SQUARED, 40) for start in rough]
    state = min(fits, key=lambda fit: fit[0])[1]
    residuals = np.linalg.norm(body.positions(state, points)[known] - x_world[known], axis=1)
    return state, float(np.median(residuals))


def _turn(angle: float) -> NDArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
