"""An initial pose from joints annotated manually in images of one time: points, bone lengths, pose (P4-9)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import TrackingError, choices
from kinefit.fitting.initialization.from_points import first_scales, pose_from_points
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate
from kinefit.images.photogrammetry.intersection import intersect

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
    unknown = [name for name in names if name not in body.landmarks.names]
    if unknown:
        raise TrackingError(choices(f"landmark of body '{body.name}'", unknown[0], clickable(body)))
    points = body.landmarks.select(tuple(names))
    fitted = body.scaled(first_scales(body, points, x_world[None], covariance=covariance))
    points = fitted.landmarks.select(tuple(names))
    state, residual = pose_from_points(
        fitted, points, x_world, sigma=_POINT_SIGMA, fewest=_MIN_POINTS, robust=False, covariance=covariance
    )
    return fitted, state, residual
