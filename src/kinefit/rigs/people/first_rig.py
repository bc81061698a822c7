"""A first rig from pixels that cameras have in common, with no pose known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import triangulate_robust

_MIN_COMMON_KEYPOINTS = 50  # keypoints that two cameras must have in common
_MAX_KEYPOINTS = 4000  # of them that take part
_MIN_RAY_ANGLE = np.radians(3.0)  # angle between two cameras' rays below which they tell no distance
_MAX_INLIER_SIGMAS = 3.0  # standard deviations of a keypoint that agrees


def first_rig(rig: Rig, uv: NDArray, sigma: float) -> Rig:
    """Poses of all cameras of a rig up to place, turn and scale; the poses it has are not used.

    The pair with the most keypoints that agree, seen from the most different sides, comes first (essential matrix by
    consensus: D. Nister, An efficient solution to the five-point relative pose problem, 2004); then, one by one, the
    camera that sees the most of the points known so far (V. Lepetit et al., EPnP, 2009).

    Parameters
    ----------
    uv : (P, C, 2) [px] of points that one or more cameras saw, NaN where unseen.
    sigma : float [px] standard deviation of a pixel.

    Raises
    ------
    CalibrationError
        Too few points in common, no pair of cameras far enough apart, or a camera that agrees with no other.
    """
    flat = np.stack([_normalised(camera, uv[:, c]) for c, camera in enumerate(rig)], axis=1)
    pairs = {
        (i, j): found
        for i in range(len(rig)) for j in range(i + 1, len(rig))
        if (found := _relative_pose(rig, flat, i, j, sigma)) is not None
    }
    if not pairs:
        raise CalibrationError(
            "no two cameras see enough of the same person from different sides",
            remedy="Place the cameras 20 degrees apart or more, and record someone who moves about in view of all.",
        )
    first = max(pairs, key=lambda pair: pairs[pair][1])
    poses: dict[int, NDArray] = {first[0]: np.eye(4), first[1]: pairs[first][0]}
    while len(poses) < len(rig):
        x = _points(rig, poses, uv, sigma)
        trials = {c: _laid_on(rig.cameras[c], flat[:, c], x, sigma) for c in range(len(rig)) if c not in poses}
        best = max(trials, key=lambda c: trials[c][1])
        if trials[best][1] < _MIN_COMMON_KEYPOINTS:
            names = ", ".join(rig.names[c] for c in trials)
            raise CalibrationError(
                f"the keypoints of {names} agree with no other camera", place=f"camera {rig.names[best]}",
                remedy="Check that its intrinsics are right, and that it is in step and sees the same person.",
            )
        poses[best] = trials[best][0]
    return Rig(tuple(camera.with_pose(poses[c]) for c, camera in enumerate(rig)))


def _normalised(camera: Camera, uv: NDArray) -> NDArray:
    """(P, 2) undistorted, on the plane at distance 1; NaN where unseen."""
    ray = camera.with_pose(np.eye(4)).ray(uv)
    return np.where(ray[:, 2:] > 1e-6, ray[:, :2] / np.where(ray[:, 2:] > 1e-6, ray[:, 2:], 1.0), np.nan)


def _thinned(index: NDArray) -> NDArray:
    return index[np.unique(np.linspace(0, len(index) - 1, min(len(index), _MAX_KEYPOINTS)).astype(int))]


def _relative_pose(rig: Rig, flat: NDArray, i: int, j: int, sigma: float) -> tuple[NDArray, float] | None:
    """T_j_i (4, 4), translation of length 1, and how good a start the pair is; None where it is none."""
    both = _thinned(np.flatnonzero(np.isfinite(flat[:, [i, j]]).all(axis=(1, 2))))
    if len(both) < _MIN_COMMON_KEYPOINTS:
        return None
    a, b = np.ascontiguousarray(flat[both, i]), np.ascontiguousarray(flat[both, j])
    focal = np.mean([rig.cameras[c].matrix[0, 0] for c in (i, j)])
    cv2.setRNGSeed(0)
    E, mask = cv2.findEssentialMat(
        a, b, np.eye(3), method=cv2.RANSAC, prob=0.99999, threshold=_MAX_INLIER_SIGMAS * sigma / focal, maxIters=3000
    )
    if E is None or E.shape != (3, 3):
        return None
    count, R, t, mask = cv2.recoverPose(E, a, b, np.eye(3), mask=mask)
    if count < _MIN_COMMON_KEYPOINTS:
        return None
    T = se3.transform(R, t.ravel())
    agreed = mask.ravel() > 0
    rays = np.stack([np.append(p, 1.0) for p in a[agreed]]), np.stack([np.append(p, 1.0) for p in b[agreed]]) @ R
    cosine = np.sum(rays[0] * rays[1], axis=1) / np.linalg.norm(rays[0], axis=1) / np.linalg.norm(rays[1], axis=1)
    angle = float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return (T, count * np.sin(angle)) if _MIN_RAY_ANGLE < angle < np.pi - _MIN_RAY_ANGLE else None


def _points(rig: Rig, poses: dict[int, NDArray], uv: NDArray, sigma: float) -> NDArray:
    """(P, 3) points on which two of the cameras known so far agree, NaN elsewhere."""
    known = sorted(poses)
    part = Rig(tuple(rig.cameras[c].with_pose(poses[c]) for c in known))
    return triangulate_robust(part, uv[:, known], max_residual_px=_MAX_INLIER_SIGMAS * sigma)[0]


def _laid_on(camera: Camera, flat: NDArray, x: NDArray, sigma: float) -> tuple[NDArray, int]:
    """T_camera_world (4, 4) of a camera that sees points x (P, 3), and how many agree."""
    both = _thinned(np.flatnonzero(np.isfinite(flat).all(axis=1) & np.isfinite(x).all(axis=1)))
    if len(both) < _MIN_COMMON_KEYPOINTS:
        return np.eye(4), 0
    cv2.setRNGSeed(0)
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(x[both]), np.ascontiguousarray(flat[both]), np.eye(3), None, iterationsCount=1000,
        reprojectionError=_MAX_INLIER_SIGMAS * sigma / camera.matrix[0, 0], confidence=0.9999, flags=cv2.SOLVEPNP_EPNP,
    )
    if not ok or inliers is None or len(inliers) < _MIN_COMMON_KEYPOINTS:
        return np.eye(4), 0
    chosen = both[inliers.ravel()]
    turn, shift = cv2.solvePnPRefineLM(x[chosen], flat[chosen], np.eye(3), None, turn, shift)
    return se3.transform(se3.exp_so3(turn.ravel()), shift.ravel()), len(chosen)
