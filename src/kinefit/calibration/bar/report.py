"""What a calibration with a bar tells of every camera, with standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.calibration.bar.bundle import INTERIOR, POSE, BarBundle
from kinefit.calibration.bar.targets import BarViews
from kinefit.geometry.camera import Rig
from kinefit.geometry.se3 import log_so3

_ENOUGH = 50  # places of one camera; fewer leave the distortion to chance
_ENOUGH_COVERED = 0.4  # of the image
_SURE = 0.005  # of the focal length, one standard deviation
_CELLS = 8  # along each side of the image, for the share of it that was covered
_PRIOR = 0.5  # share of the information from which on a parameter is told to be an assumption


@dataclass(frozen=True, eq=False)
class BarCameraReport:
    """How well one camera was calibrated.

    Parameters
    ----------
    rms_px : float [px] of one coordinate, measured minus seen.
    places, used : int
        Images in which the bar was found, and of these the ones that agree.
    coverage : float
        Share of the image (cells of an 8 x 8 grid) in which targets were used.
    names, values, std : (P,)
        Parameters: fx, fy, cx, cy [px], k1, k2, p1, p2, k3, then x, y, z [m] of the camera's place and rx, ry, rz
        [rad] of its turn about its own axes, with standard deviations; 0 for what was given or defines the world.
        Those of places hold what is unsure about the bar's length.
    assumed : tuple of str
        Parameters that the recording tells less of than the assumption of a usual lens.
    """

    rms_px: float
    places: int
    used: int
    coverage: float
    names: tuple[str, ...]
    values: NDArray
    std: NDArray
    assumed: tuple[str, ...]

    def std_of(self, name: str) -> float:
        """Standard deviation of one parameter."""
        return float(self.std[self.names.index(name)])


def reports_of(
    rig: Rig, bundle: BarBundle, uv: NDArray, seen: Mapping[str, BarViews], length: float, sigma: float
) -> dict[str, BarCameraReport]:
    """Reports of all cameras; rig is the one of the bundle, in the world wanted."""
    interior = len(bundle.covariance) // len(rig) - POSE
    out = {}
    for c, camera in enumerate(rig):
        old = bundle.rig.cameras[c]
        mine = slice(c * (POSE + interior), (c + 1) * (POSE + interior))
        cov, share = bundle.covariance[mine, mine], bundle.prior_share[mine]
        # x' = exp(v, w) x in the camera: its place moves by -Rᵀ v in the old world; turned to the new one
        R_new = camera.T_world_camera[:3, :3]
        place_cov = R_new @ cov[:3, :3] @ R_new.T
        baseline = old.centre_world - bundle.rig.cameras[0].centre_world
        turn = R_new @ old.T_camera_world[:3, :3]
        scaled = (sigma / length) * (turn @ baseline)
        std = np.concatenate([
            np.sqrt(np.diag(cov)[POSE:]) if interior else np.zeros(len(INTERIOR)),
            np.sqrt(np.diag(place_cov) + scaled**2), np.sqrt(np.diag(cov)[3:6]),
        ])  # fmt: skip
        distortion = np.zeros(5)
        distortion[: min(5, camera.distortion.size)] = camera.distortion[:5]
        K = camera.matrix
        values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], distortion, camera.centre_world])
        values = np.concatenate([values, log_so3(camera.T_camera_world[:3, :3])])
        left = bundle.residuals[:, c]
        used = np.isfinite(left).all(axis=(1, 2))
        names = (*INTERIOR, "x", "y", "z", "rx", "ry", "rz")
        assumed = tuple(name for name, part in zip(INTERIOR, share[POSE:]) if part > _PRIOR) if interior else ()
        out[camera.name] = BarCameraReport(
            float(np.sqrt(np.nanmean(left**2))), len(seen[camera.name].ends), int(used.sum()),
            _coverage(uv[used, c].reshape(-1, 2), camera.size), names, values, std, assumed,
        )
    return out


def _coverage(uv: NDArray, size: tuple[int, int]) -> float:
    cells = np.clip((uv + 0.5) / size * _CELLS, 0, _CELLS - 1).astype(int)
    return len(np.unique(cells, axis=0)) / _CELLS**2


def advice_of(rig: Rig, reports: Mapping[str, BarCameraReport]) -> list[str]:
    """What to record more of."""
    out = []
    for camera in rig:
        report = reports[camera.name]
        if report.used < _ENOUGH:
            out.append(f"{camera.name}: {report.used} places; record {_ENOUGH} or more.")
        if report.std_of("fx") and report.coverage < _ENOUGH_COVERED:
            out.append(
                f"{camera.name}: the bar covered {100 * report.coverage:.0f} % of the image; the distortion "
                "elsewhere is a guess."
            )
        if report.std_of("fx") > _SURE * camera.matrix[0, 0]:
            part = 100 * report.std_of("fx") / camera.matrix[0, 0]
            out.append(f"{camera.name}: focal length known to {part:.1f} % only; wave the bar nearer and farther.")
        if report.assumed:
            names = ", ".join(report.assumed)
            out.append(f"{camera.name}: {names} rest on what lenses usually have; cover its image better.")
    return out
