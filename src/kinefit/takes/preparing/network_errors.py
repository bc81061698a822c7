"""How exact a network's points are: each camera of a calibrated take against where the others place its points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from kinefit.errors import TakeError
from kinefit.fitting.multiview.association import choose_people, person_records
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate_robust
from kinefit.observations import Keypoints
from kinefit.readers.landmarks.networks import NetworkSigma, extent_px, write_sigma
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import load_observations

_MIN_CAMERAS = 3  # one is left out, two place its points
_MAX_MISS = 0.05  # of a person's extent: by which other cameras miss a point that they place together
_BINS = 8  # of confidences, equally many points in each
_MIN_BIN_POINTS = 50  # whose median is certain to a tenth
_RAYLEIGH_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))  # of a distance in two axes, in standard deviations of one


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Distances of points in cameras from where other cameras place them.

    Parameters
    ----------
    names : (K,) of all points
    camera, point : (N,) int, number in the rig, number in the names
    confidence : (N,)
    off : (N,) as shares of the person's extent in the image
    off_m : (N,) [m] at the point's depth
    """

    names: tuple[str, ...]
    camera: NDArray
    point: NDArray
    confidence: NDArray
    off: NDArray
    off_m: NDArray

    def of(self, chosen: NDArray) -> HeldOutErrors:
        """Some of them, (N,) bool."""
        arrays = (self.camera, self.point, self.confidence, self.off, self.off_m)
        return HeldOutErrors(self.names, *(array[chosen] for array in arrays))


def held_out_errors(rig: Rig, keypoints: Sequence[Keypoints]) -> HeldOutErrors:
    """Errors of all cameras' points, each by robust triangulation of the others', of the main person in view.

    Raises
    ------
    TrackingError
        No person is seen in any frame.
    """
    records = person_records(keypoints, choose_people(rig, keypoints))
    numbers = [rig.index(record.camera) for record in records]
    uv = np.stack([record.points[:, 0] for record in records], axis=2)  # (F, K, C, 2)
    confidence = np.stack([record.confidence[:, 0] for record in records], axis=2)
    confidence = np.where(np.isfinite(uv).all(axis=-1), confidence, 0.0)
    extent = np.stack([extent_px(r.points, r.confidence)[:, 0] for r in records], axis=1)  # (F, C)
    found = [np.zeros((5, 0))]
    for c, number in enumerate(numbers):
        others = [k for k in range(len(numbers)) if k != c]
        cameras = Rig(tuple(rig.cameras[numbers[k]] for k in others))
        limit = _MAX_MISS * float(np.nanmedian(extent[:, others]))
        x, _, _ = triangulate_robust(
            cameras, uv[:, :, others].reshape(-1, len(others), 2), confidence[:, :, others].reshape(-1, len(others)),
            max_residual_px=limit,
        )  # fmt: skip
        camera = rig.cameras[number]
        gap = np.linalg.norm(camera.project(x).reshape(uv[:, :, c].shape) - uv[:, :, c], axis=2)
        depth = (x @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]).reshape(gap.shape)
        rows = np.stack([
            np.full(gap.shape, float(number)), np.broadcast_to(np.arange(gap.shape[1]), gap.shape),
            confidence[:, :, c], gap / extent[:, c, None], gap * depth / camera.matrix[0, 0],
        ])  # fmt: skip
        known = np.isfinite(rows).all(axis=0) & (rows[2] > 0) & (depth > 0)
        found.append(rows[:, known])
    numbers_of, point, *rest = np.concatenate(found, axis=1)
    return HeldOutErrors(records[0].names, numbers_of.astype(int), point.astype(int), *rest)


def sigma_of_confidence(errors: HeldOutErrors) -> NetworkSigma | None:
    """Standard deviation by confidence, falling, from the median of each of some bins; and a factor of each point.

    None for too few points.
    """
    count = min(_BINS, len(errors.off) // _MIN_BIN_POINTS)
    if count < 1:
        return None
    overall = np.median(errors.off)
    factors = np.ones(len(errors.names))
    for k in np.flatnonzero(np.bincount(errors.point, minlength=len(factors)) >= _MIN_BIN_POINTS):
        factors[k] = np.median(errors.off[errors.point == k]) / overall
    off = errors.off / factors[errors.point]
    edges = np.unique(np.quantile(errors.confidence, np.linspace(0.0, 1.0, count + 1)[1:-1]))
    own = np.searchsorted(edges, errors.confidence, "right")
    bins, size = np.unique(own, return_counts=True)
    middle = np.array([np.median(errors.confidence[own == b]) for b in bins])
    sigma = np.array([np.median(off[own == b]) for b in bins]) / _RAYLEIGH_MEDIAN
    falling = isotonic_regression(sigma, weights=size, increasing=False).x
    middle, first = np.unique(np.clip(middle, 0.0, 1.0), return_index=True)
    points = dict(zip(errors.names, factors.tolist()))
    return NetworkSigma(confidence=middle.tolist(), sigma=np.maximum(falling[first], 1e-6).tolist(), points=points)


def calibrate_network(take: Take, network: Path) -> tuple[Path, NetworkSigma, int]:
    """Write how exact a network is, from a take with its detections as keypoints, one entry a camera.

    Returns the file, what it states, and the number of points from which it was estimated.

    Raises
    ------
    TakeError
        Fewer than three calibrated cameras see somebody, or in too few frames.
    KinefitError
        What reading the take raises.
    """
    cameras = {entry.camera for entry in take.keypoints}
    seen = load_observations(take, calibrated=False)
    if len(cameras) < _MIN_CAMERAS or seen.rig is None:
        problem = f"{len(cameras)} cameras see somebody; one is left out, and two have to place its points"
        raise TakeError(problem, file=take.path, remedy="Calibrate with a take of three cameras or more.")
    errors = held_out_errors(seen.rig, seen.keypoints)
    found = sigma_of_confidence(errors)
    if found is None:
        problem = f"{len(errors.off)} points are placed by other cameras, {_MIN_BIN_POINTS} are needed"
        remedy = "Use a longer take, and check its calibration (kinefit check)."
        raise TakeError(problem, file=take.path, remedy=remedy)
    return write_sigma(found, network), found, len(errors.off)
