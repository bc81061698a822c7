"""A start from joints that somebody clicked in the images of one time: points, bone lengths, pose (P4-9)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import TrackingError, choices
from kinefit.geometry.camera import Rig
from kinefit.geometry.triangulation import triangulate
from kinefit.initialization.from_points import first_scales, pose_from_points
from kinefit.photogrammetry.intersection import intersect

_BESIDE = 0.08  # [m] at the point: in a thick limb a joint is clicked 2 to 4 cm beside another view's; no more
_FEWEST = 3  # points that fix a pose
_CLICK = 3.0  # [px] by which a person misses a joint
_VAGUE = 0.5  # [m] of a point whose rays are all but parallel
_SIGMA = 0.005  # [m] of a clicked joint: they agree already, and no posture prior is to move them
_LISTED = 4  # joints that a message names
_ENDS = ("skull_vertex", "nose_tip", "digit_2", "heel", "metacarpal_phalanx_2", "metacarpal_phalanx_5")


def clickable(body: Body) -> tuple[str, ...]:
    """Landmarks that a person can click: centres of joints, and ends of the head, the hands and the feet."""
    points = body.landmarks
    centres = (np.linalg.norm(points.points, axis=1) < 1e-9) & ((points.segments > 0) | ~body.tree.root_free)
    return tuple(n for n, centre in zip(points.names, centres) if centre or n.split("_", 1)[-1] in _ENDS or n in _ENDS)


def clicked_points(rig: Rig, names: Sequence[str], uv: NDArray) -> tuple[NDArray, NDArray]:
    """Points in space of clicks, which must agree, and their covariance.

    Parameters
    ----------
    rig : Rig of C cameras
    names : (N,) of the points
    uv : (N, C, 2) [px] in the calibrations' images; NaN where not clicked

    Returns
    -------
    (N, 3) [m], (N, 3, 3) [m²]; NaN where a point is not known

    Raises
    ------
    TrackingError
        Rays that do not meet: it names the points, and where three cameras see one, the camera that is off and by how
        much.
    CalibrationError
        Cameras that stand in one place.
    """
    x = triangulate(rig, uv)
    if np.isfinite(x).all(axis=1).sum() < _FEWEST:
        remedy = f"Click {_FEWEST} or more points, each in two images or more."
        raise TrackingError(f"{np.isfinite(x).all(axis=1).sum()} points are known in space", remedy=remedy)
    miss, px = _missed(rig, x, uv)
    bad = np.flatnonzero(np.nanmax(np.where(np.isfinite(miss), miss, 0.0), axis=1) > 0.5 * _BESIDE)
    told, blamed = [], list[tuple[int, float]]()
    for n in map(int, bad):
        seen = np.flatnonzero(np.isfinite(uv[n]).all(axis=1))
        off = {int(c): _without(rig, uv[n], int(c)) for c in seen} if len(seen) > 2 else {}
        agree = [c for c, (away, _, rest) in off.items() if rest < 0.5 * _BESIDE and away > _BESIDE]
        if len(agree) == 1:
            away, pixels, _ = off[agree[0]]
            blamed.append((agree[0], pixels))
            told.append(f"{names[n]}: camera {rig.names[agree[0]]} is off by {pixels:.0f} px ({100 * away:.0f} cm)")
        elif miss[n][seen].max() > 0.5 * _BESIDE and (not off or all(a > _BESIDE for a, _, _ in off.values())):
            cameras = ", ".join(f"{rig.names[c]} {px[n, c]:.0f} px" for c in seen)
            told.append(f"{names[n]}: rays pass each other by {200 * miss[n][seen].max():.0f} cm ({cameras})")
    if told:
        raise TrackingError(
            f"clicked points do not meet: {'; '.join(told[:_LISTED])}" + "; ..." * (len(told) > _LISTED),
            remedy=_remedy(rig, blamed, len(x)),
        )
    covariance = intersect(rig, uv, np.tile(_CLICK**2 * np.eye(2), (*uv.shape[:2], 1, 1))).covariance
    vague = np.isfinite(x).all(axis=1) & ~np.isfinite(covariance).all(axis=(1, 2))  # rays that are all but parallel
    return x, np.where(vague[:, None, None], _VAGUE**2 * np.eye(3), covariance)


def _missed(rig: Rig, x: NDArray, uv: NDArray) -> tuple[NDArray, NDArray]:
    """(N, C) [m] at the point and [px] by which each camera's click is beside points (N, 3); NaN where none."""
    px = np.stack([np.linalg.norm(camera.project(x) - uv[:, c], axis=1) for c, camera in enumerate(rig)], axis=1)
    depth = np.stack([(x @ camera.T_camera_world[2, :3]) + camera.T_camera_world[2, 3] for camera in rig], axis=1)
    focal = np.array([np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]) for camera in rig])
    return px * np.abs(depth) / focal, px


def _without(rig: Rig, uv: NDArray, camera: int) -> tuple[float, float, float]:
    """How far a camera's click (C, 2) is from the point of all others: [m], [px]; and by what those miss it [m]."""
    others = np.array(uv)
    others[camera] = np.nan
    x = triangulate(rig, others[None])
    if not np.isfinite(x).all():
        return 0.0, 0.0, np.inf
    miss, px = _missed(rig, x, uv[None])
    rest = np.delete(miss[0], camera)
    return float(miss[0, camera]), float(px[0, camera]), float(np.nanmax(rest))


def _remedy(rig: Rig, blamed: Sequence[tuple[int, float]], count: int) -> str:
    """What to do about clicks that do not meet."""
    for camera in {c for c, _ in blamed}:
        mine = [px for c, px in blamed if c == camera]
        if len(mine) > 0.5 * count:
            return (
                f"Camera {rig.names[camera]} is off in {len(mine)} of {count} points, by {np.median(mine):.0f} px in "
                "the middle: its image is of another time, or its calibration is wrong."
            )  # fmt: skip
    return "Click these again, the same joint and side in every image."


def clicked_start(
    body: Body, names: Sequence[str], x_world: NDArray, covariance: NDArray | None = None
) -> tuple[Body, BodyState, float]:
    """Body of the clicked lengths, its pose, and the median distance left [m].

    A foot of 10 cm, clicked to 2 cm, tells less of its length than all other bones do.

    Parameters
    ----------
    body : Body
    names : (N,) landmarks
    x_world : (N, 3) [m]; NaN where unknown
    covariance : (N, 3, 3) [m²] of these; exact without it

    Raises
    ------
    TrackingError
        A landmark that the body does not have; no bone between two points; points that make no person.
    """
    unknown = [name for name in names if name not in body.landmarks.names]
    if unknown:
        raise TrackingError(choices(f"landmark of body '{body.name}'", unknown[0], clickable(body)))
    points = body.landmarks.select(tuple(names))
    fitted = body.scaled(first_scales(body, points, x_world[None], covariance=covariance))
    points = fitted.landmarks.select(tuple(names))
    state, left = pose_from_points(
        fitted, points, x_world, sigma=_SIGMA, fewest=_FEWEST, robust=False, covariance=covariance
    )
    return fitted, state, left
