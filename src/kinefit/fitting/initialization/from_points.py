"""An initial pose from triangulated points: bone lengths first, then the pose.

An initial pose from joints annotated manually in images of one time: points, bone lengths, pose (P4-9).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.limbs import rigid_pairs
from kinefit.errors import TrackingError, choices
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate
from kinefit.geometry.losses import SQUARED, Loss, geman_mcclure
from kinefit.images.photogrammetry.intersection import intersect
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

    turns = (se3.exp(np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0])) for angle in (0.0, np.pi))
    starts = [near] if near else [body.default_state(aligned_root(body, points, x_world) @ T) for T in turns]
    rough = [start if near else fitted(start, SQUARED, 60)[1] for start in starts]
    fits = [fitted(start, geman_mcclure() if robust else SQUARED, 40) for start in rough]
    state = min(fits, key=lambda fit: fit[0])[1]
    residuals = np.linalg.norm(body.positions(state, points)[known] - x_world[known], axis=1)
    return state, float(np.median(residuals))


_MAX_GAP = 0.08  # [m] between rays of a joint: annotations of a thick limb differ by 2 to 4 cm between views
_MIN_POINTS = 3  # for a pose
_CLICK_SIGMA_PX = 3.0  # of a manual annotation
_PARALLEL_RAYS_SIGMA = 0.5  # [m] of a point with nearly parallel rays
_POINT_SIGMA = 0.005  # [m] of a joint in the fit: small, so that the posture prior does not move it
_MAX_NAMED = 4  # joints in a message
_ENDS = ("skull_vertex", "nose_tip", "digit_2", "heel", "metacarpal_phalanx_2", "metacarpal_phalanx_5")


def clickable(body: Body) -> tuple[str, ...]:
    """Names of landmarks for manual annotation: joint centres, and ends of head, hands and feet."""
    points = body.landmarks
    is_centre = (np.linalg.norm(points.points, axis=1) < 1e-9) & ((points.segments > 0) | ~body.tree.root_free)
    return tuple(n for n, c in zip(points.names, is_centre) if c or n.split("_", 1)[-1] in _ENDS or n in _ENDS)


def check_landmarks(body: Body, names: Iterable[str]) -> None:
    """Raise TrackingError for a name of no landmark of the body."""
    unknown = [name for name in names if name not in body.landmarks.names]
    if unknown:
        raise TrackingError(choices(f"landmark of body '{body.name}'", unknown[0], clickable(body)))


def clicked_points(rig: Rig, names: Sequence[str], uv: NDArray) -> tuple[NDArray, NDArray]:
    """Triangulate manual annotations, check that they agree, and estimate their covariance.

    Parameters
    ----------
    rig : C cameras
    names : (N,) of the points
    uv : (N, C, 2) [px] in the calibrated images; NaN where not annotated

    Returns
    -------
    (N, 3) [m], (N, 3, 3) [m²]; NaN where a point is unknown

    Raises
    ------
    TrackingError
        Too few points, or rays that do not intersect. Names the points and, with three cameras, the camera that is off
        and by how much.
    CalibrationError
        The cameras stand in one place.
    """
    x = triangulate(rig, uv)
    if np.isfinite(x).all(axis=1).sum() < _MIN_POINTS:
        remedy = f"Click {_MIN_POINTS} or more points, each in two images or more."
        raise TrackingError(f"{np.isfinite(x).all(axis=1).sum()} points can be triangulated", remedy=remedy)
    miss, px = _click_errors(rig, x, uv)
    inconsistent = np.flatnonzero(np.nanmax(np.where(np.isfinite(miss), miss, 0.0), axis=1) > 0.5 * _MAX_GAP)
    problems, blamed = [], list[tuple[int, float]]()
    for n in map(int, inconsistent):
        used = np.flatnonzero(np.isfinite(uv[n]).all(axis=1))
        errors = {int(c): _errors_without(rig, uv[n], int(c)) for c in used} if len(used) > 2 else {}
        views = [c for c, (away, _, rest) in errors.items() if rest < 0.5 * _MAX_GAP and away > _MAX_GAP]
        if len(views) == 1:
            away, pixels, _ = errors[views[0]]
            blamed.append((views[0], pixels))
            problems.append(f"{names[n]}: camera {rig.names[views[0]]} is off by {pixels:.0f} px ({100 * away:.0f} cm)")
        elif miss[n][used].max() > 0.5 * _MAX_GAP and (not errors or all(e[0] > _MAX_GAP for e in errors.values())):
            cameras = ", ".join(f"{rig.names[c]} {px[n, c]:.0f} px" for c in used)
            problems.append(f"{names[n]}: rays pass each other by {200 * miss[n][used].max():.0f} cm ({cameras})")
    if problems:
        raise TrackingError(
            f"clicked points do not meet: {'; '.join(problems[:_MAX_NAMED])}" + "; ..." * (len(problems) > _MAX_NAMED),
            remedy=_remedy(rig, blamed, len(x)),
        )
    covariance = intersect(rig, uv, np.tile(_CLICK_SIGMA_PX**2 * np.eye(2), (*uv.shape[:2], 1, 1))).covariance
    is_parallel = np.isfinite(x).all(axis=1) & ~np.isfinite(covariance).all(axis=(1, 2))  # nearly parallel rays
    return x, np.where(is_parallel[:, None, None], _PARALLEL_RAYS_SIGMA**2 * np.eye(3), covariance)


def _click_errors(rig: Rig, x: NDArray, uv: NDArray) -> tuple[NDArray, NDArray]:
    """(N, C) [m] and (N, C) [px] errors of the annotations in each camera to points (N, 3) [m]; NaN where none."""
    px = np.stack([np.linalg.norm(camera.project(x) - uv[:, c], axis=1) for c, camera in enumerate(rig)], axis=1)
    depth = np.stack([(x @ camera.T_camera_world[2, :3]) + camera.T_camera_world[2, 3] for camera in rig], axis=1)
    focal = np.array([np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]) for camera in rig])
    return px * np.abs(depth) / focal, px


def _errors_without(rig: Rig, uv: NDArray, camera: int) -> tuple[float, float, float]:
    """Error [m], [px] of one camera's annotation (C, 2) to the others' point; largest error [m] of the others."""
    others = np.array(uv)
    others[camera] = np.nan
    x = triangulate(rig, others[None])
    if not np.isfinite(x).all():
        return 0.0, 0.0, np.inf
    miss, px = _click_errors(rig, x, uv[None])
    rest = np.delete(miss[0], camera)
    return float(miss[0, camera]), float(px[0, camera]), float(np.nanmax(rest))


def _remedy(rig: Rig, blamed: Sequence[tuple[int, float]], count: int) -> str:
    """The remedy for annotations that disagree."""
    for camera in {c for c, _ in blamed}:
        off = [px for c, px in blamed if c == camera]
        if len(off) > 0.5 * count:
            return (
                f"Camera {rig.names[camera]} is off in {len(off)} of {count} points, by {np.median(off):.0f} px "
                "(median): its image is of another time, or its calibration is wrong."
            )  # fmt: skip
    return "Click these again, the same joint and side in every image."


def clicked_start(
    body: Body, names: Sequence[str], x_world: NDArray, covariance: NDArray | None = None
) -> tuple[Body, BodyState, float]:
    """Fit a body's lengths and pose to annotated points; returns body, state, and the median residual [m].

    Short bones, whose lengths are uncertain, mostly follow the others: see `first_scales`.

    Parameters
    ----------
    body : generic body
    names : (N,) names of landmarks
    x_world : (N, 3) [m]; NaN where unknown
    covariance : (N, 3, 3) [m²] of the points; default: exact

    Raises
    ------
    TrackingError
        The body lacks a landmark, no bone lies between two points, or the size is impossible.
    """
    check_landmarks(body, names)
    points = body.landmarks.select(tuple(names))
    fitted = body.scaled(first_scales(body, points, x_world[None], covariance=covariance))
    points = fitted.landmarks.select(tuple(names))
    state, residual = pose_from_points(
        fitted, points, x_world, sigma=_POINT_SIGMA, fewest=_MIN_POINTS, robust=False, covariance=covariance
    )
    return fitted, state, residual
