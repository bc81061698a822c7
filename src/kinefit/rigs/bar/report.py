"""Reports of a calibration with a bar: every camera's parameters with standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Rig
from kinefit.geometry.se3 import log_so3
from kinefit.rigs.bar.bundle import INTERIOR, BarBundle
from kinefit.rigs.bar.targets import BarViews
from kinefit.rigs.board.intrinsics import coverage

_ADVISED_PLACES = 50  # of one camera; with fewer the distortion is poorly determined
_ADVISED_COVERAGE = 0.4  # of the image
_MAX_FOCAL_STD = 0.005  # of the focal length, without advice
_MAX_PRIOR = 0.5  # share of the information on a parameter; with more it is reported as an assumption


@dataclass(frozen=True, eq=False)
class BarCameraReport:
    """Quality of one camera's calibration.

    Parameters
    ----------
    rms_px : float [px] of one coordinate, measured minus projected.
    places, used : int
        Images with the bar, and those that agree.
    coverage : float
        Share 0..1 of the image (cells of an 8 x 8 grid) with used targets.
    names, values, std : (P,)
        Parameters: fx, fy, cx, cy [px], k1, k2, p1, p2, k3, then x, y, z [m] of the camera's centre and rx, ry, rz
        [rad] of its rotation about its own axes, with standard deviations; 0 if given or defining the world. Those of
        the centre include the uncertainty of the bar's length.
    assumed : tuple of str
        Parameters that the prior of a common lens constrains more than the recording.
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
        """Standard deviation of one parameter, in its unit: [px], [m] or [rad], see `names`."""
        return float(self.std[self.names.index(name)])


def reports_of(
    rig: Rig, bundle: BarBundle, uv: NDArray, seen: Mapping[str, BarViews], length: float, sigma: float
) -> dict[str, BarCameraReport]:
    """Reports of all cameras; rig in the final world, uv (F, C, 2, 2) [px], length and its sigma [m]."""
    out = {}
    for c, camera in enumerate(rig):
        old = bundle.rig.cameras[c]
        cov, share = bundle.covariance[c, :, c], bundle.prior_share[c]
        # x' = exp(v, w) x in the camera: its centre moves by -Rᵀ v in the old world; rotated to the new one
        R_new = camera.T_world_camera[:3, :3]
        place_cov = R_new @ cov[:3, :3] @ R_new.T
        baseline = old.centre_world - bundle.rig.cameras[0].centre_world
        turn = R_new @ old.T_camera_world[:3, :3]
        scaled = (sigma / length) * (turn @ baseline)
        std = np.concatenate([
            np.sqrt(np.diag(cov)[6:]), np.sqrt(np.diag(place_cov) + scaled**2), np.sqrt(np.diag(cov)[3:6]),
        ])  # fmt: skip
        distortion = np.zeros(5)
        distortion[: min(5, camera.distortion.size)] = camera.distortion[:5]
        K = camera.matrix
        values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], distortion, camera.centre_world])
        values = np.concatenate([values, log_so3(camera.T_camera_world[:3, :3])])
        left = bundle.residuals[:, c]
        used = np.isfinite(left).all(axis=(1, 2))
        names = (*INTERIOR, "x", "y", "z", "rx", "ry", "rz")
        assumed = tuple(name for name, part in zip(INTERIOR[2:], share[8:]) if part > _MAX_PRIOR)
        out[camera.name] = BarCameraReport(
            float(np.sqrt(np.nanmean(left**2))), len(seen[camera.name].ends), int(used.sum()),
            coverage(uv[used, c].reshape(-1, 2), camera.size), names, values, std, assumed,
        )
    return out


def advice_of(rig: Rig, reports: Mapping[str, BarCameraReport]) -> list[str]:
    """Advice on what else to record."""
    out = []
    for camera in rig:
        report = reports[camera.name]
        if report.used < _ADVISED_PLACES:
            out.append(f"{camera.name}: {report.used} places; record {_ADVISED_PLACES} or more.")
        if report.std_of("fx") and report.coverage < _ADVISED_COVERAGE:
            out.append(
                f"{camera.name}: the bar covered {100 * report.coverage:.0f} % of the image; the distortion "
                "elsewhere is a guess."
            )
        if report.std_of("fx") > _MAX_FOCAL_STD * camera.matrix[0, 0]:
            part = 100 * report.std_of("fx") / camera.matrix[0, 0]
            out.append(f"{camera.name}: focal length known to {part:.1f} % only; wave the bar nearer and farther.")
        if report.assumed:
            names = ", ".join(report.assumed)
            out.append(f"{camera.name}: {names} come mostly from the prior; cover its image better.")
    return out
