"""A start with no pose given: triangulated points -> bone lengths -> pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.rigid_pairs import rigid_pairs
from kinefit.correspondences import prior_rows
from kinefit.errors import TrackingError
from kinefit.geometry import se3
from kinefit.losses import SQUARED, Loss, geman_mcclure
from kinefit.rows import AnyRows, Rows
from kinefit.solvers.bundle.shape import PROPORTIONS
from kinefit.solvers.least_squares import levenberg_marquardt
from kinefit.solvers.sequence import fit_sequence

_NUMBERS = {3: "three", 6: "six"}


def first_scales(
    body: Body, points: PointSet, x_world: NDArray, *, height: float | None = None, covariance: NDArray | None = None
) -> NDArray:
    """(G,) scales from the median lengths of bones over frames: x_world (F, K, 3) [m], NaN where unknown.

    Groups without a bone to measure follow the person's height [m] where it is given, else the median of the others.
    Where the points' `covariance` (K, 3, 3) [m²] is given, so do those whose bones are short against it: means of what
    was measured and of what people's proportions vary by, weighted by their variances.

    Raises
    ------
    TrackingError
        No bone can be measured in any frame.
    """
    ratios: dict[int, list[tuple[float, float]]] = {}
    sure = covariance is not None
    for i, j, group, length in rigid_pairs(body, points):
        gaps = x_world[:, i] - x_world[:, j]
        distances = np.linalg.norm(gaps, axis=1)
        if np.isfinite(distances).any():
            weight = length if covariance is None else length**2 / _along(gaps, covariance[i] + covariance[j])
            ratios.setdefault(group, []).append((float(np.nanmedian(distances)) / length, weight))
    if not ratios:
        raise TrackingError(
            "no bone of the body can be measured: too few keypoints are seen by two cameras at once",
            remedy="Check the calibration (its unit and its camera names) and that the cameras are in step.",
        )
    means = {g: float(np.average([r for r, _ in v], weights=[w for _, w in v])) for g, v in ratios.items()}
    told = {g: sum(w for _, w in v) for g, v in ratios.items()}
    people = PROPORTIONS**-2
    if height and body.stature:
        whole = height / body.stature
    elif sure:
        whole = float(np.average(list(means.values()), weights=[1.0 / (1.0 / w + 1.0 / people) for w in told.values()]))
    else:
        whole = float(np.median(list(means.values())))
    if sure:
        means = {g: (told[g] * m + people * whole) / (told[g] + people) for g, m in means.items()}
    if not 0.2 < whole < 5.0:
        raise TrackingError(
            f"the person would be {float(f'{whole:.2g}'):g} times the body's size: the calibration's unit is wrong",
            remedy=f"Set unit = {_unit_for(whole)} under [calibration], or correct what stands there.",
        )
    return np.array([np.clip(means.get(g, whole), 0.6 * whole, 1.6 * whole) for g in range(len(body.scale_groups))])


def _along(gaps: NDArray, covariance: NDArray) -> float:
    """[m²] variance (3, 3) of a difference along the median of its values (F, 3)."""
    way = np.nanmedian(gaps, axis=0)
    return float(way @ covariance @ way / (way @ way))


def _unit_for(times: float) -> str:
    """The unit that a calibration is probably in whose numbers make a person so many times too large."""
    units = {"mm": 1e3, "cm": 1e2, "dm": 1e1, "inch": 39.37}
    name, factor = min(units.items(), key=lambda u: abs(np.log(u[1] / times)))
    return f'"{name}"' if abs(np.log(factor / times)) < 0.7 else "what its numbers are in"


def aligned_root(body: Body, points: PointSet, x_world: NDArray) -> NDArray:
    """T_world_root (4, 4) that lays the resting body on known points (K, 3) best, trunk before limbs (Kabsch)."""
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
    """State of a body from points (K, 3) [m], and the median distance left [m].

    `sigma` [m] along each axis, one or (K,), or else a `covariance` (K, 3, 3) [m²] of each.
    `robust`: single points may be wrong. With no pose given two starts are tried, the prior mean laid on the points and
    turned about its long axis; the cheaper end wins. `near` is a start that is known to be close, the only one then.
    A root that stays where it is put is put here: it is found as a free one is.

    Raises
    ------
    TrackingError
        Fewer than six (`fewest`) points are known.
    """
    body = replace(body, tree=replace(body.tree, root_free=True))
    known = np.isfinite(x_world).all(axis=1)
    if known.sum() < fewest:
        problem = f"fewer than {_NUMBERS.get(fewest, fewest)} points are known in space"
        raise TrackingError(problem, remedy="Start where more cameras see the body.")

    if covariance is not None:
        values, vectors = np.linalg.eigh(covariance[known])
        axes, variances = vectors.swapaxes(1, 2).reshape(-1, 3), values.ravel()
        own = np.arange(known.sum()).repeat(3)

    def rows(state: BodyState) -> list[AnyRows]:
        x = body.positions(state, points)[known].repeat(3, axis=0)
        gap = np.einsum("ni,ni->n", axes, x_world[known].repeat(3, axis=0) - x)
        segments = points.segments[known].repeat(3)
        return [Rows.of(segments, x, axes, gap, 1.0 / variances, own), prior_rows(body, state)]

    def fitted(start: BodyState, loss: Loss, most: int) -> tuple[float, BodyState]:
        if covariance is not None:
            found = levenberg_marquardt(body, start, rows, loss=loss, max_iterations=most, tolerance=1e-4)
            return found.equations.cost, found.state
        fit = fit_sequence(
            body, start, points, x_world[None], sigma=sigma, loss=loss, posture=1.0, damping=0.1, max_iterations=most,
            tolerance=1e-4,
        )  # fmt: skip
        return float(fit.costs[0]), BodyState(fit.Ts_world_root[0], fit.angles[0])

    starts = (
        [near] if near else [body.usual_state(aligned_root(body, points, x_world) @ _turn(a)) for a in (0.0, np.pi)]
    )
    rough = [start if near else fitted(start, SQUARED, 60)[1] for start in starts]
    fits = [fitted(start, geman_mcclure() if robust else SQUARED, 40) for start in rough]
    state = min(fits, key=lambda fit: fit[0])[1]
    left = np.linalg.norm(body.positions(state, points)[known] - x_world[known], axis=1)
    return state, float(np.median(left))


def _turn(angle: float) -> NDArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
