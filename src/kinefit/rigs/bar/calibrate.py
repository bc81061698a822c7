"""Calibrate cameras with a bar: intrinsics, poses and scale from two targets at a known distance (P4, section 2.2).

Reports of a calibration with a bar: every camera's parameters with standard deviations.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import log_so3
from kinefit.rigs.bar.bundle import INTERIOR, BarBundle, BarProblem, adjust_bar, bar_bundle
from kinefit.rigs.bar.start import MIN_PLACES, first_pairs, inlier_distance, on_floor, place, resect, with_focal
from kinefit.rigs.bar.targets import BarViews
from kinefit.rigs.board.extrinsics import coverage, known_camera
from kinefit.solving.bundle.cameras import FOCAL

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


LENGTH_SIGMA = 1e-4  # [m] of a bar measured with a calliper or a good rule
_MIN_LENGTH = 0.01  # [m]
_MAX_LENGTH = 20.0  # [m]
_MAX_RELATIVE_STD = 0.03  # of the focal length, or of the cameras' distances: with more it is a guess
_OUTLIER_SIGMAS = 6.0  # none of 10,000 normal errors
_MAX_SCATTER = 0.02  # of the length: more is no rigid bar, or unsynchronised cameras
_MAX_DISTANCE_SIGMAS = 4.0  # of a second length
_TAPE_SIGMA = 0.005  # of a distance between lenses measured with a tape


@dataclass(frozen=True, eq=False)
class BarCalibration:
    """Result of a calibration with a bar.

    Parameters
    ----------
    rig : Rig
    length : float [m] of the bar.
    cameras : {camera: BarCameraReport}
    sigma_px : float [px] estimated standard deviation of a target's coordinate.
    scatter : float [m] standard deviation of the distance of the targets from place to place.
    frames, x_world : (F,) int used, and (F, 2, 3) [m] the ends in them, in no constant order.
    uv, residuals : (F, C, 2, 2) [px] used targets, and measured minus projected; NaN if unused.
    ambiguous : int, places discarded because two orders of the targets fit alike.
    left_out : int, places discarded for other reasons.
    world : str
        Description of the origin and the vertical axis.
    advice : tuple of str
        What else to record.
    covariance : (C · 15, C · 15), as in `BarBundle`, in the gauge of the first camera.
    """

    rig: Rig
    length: float
    cameras: dict[str, BarCameraReport]
    sigma_px: float
    scatter: float
    frames: NDArray
    x_world: NDArray
    uv: NDArray
    residuals: NDArray
    ambiguous: int
    left_out: int
    world: str
    advice: tuple[str, ...]
    covariance: NDArray


@checked
def calibrate_bar(
    seen: Mapping[str, BarViews],
    length: float,
    *,
    interiors: Rig | None = None,
    length_sigma: float = LENGTH_SIGMA,
    floor: Sequence[int] = (),
    known_distance: tuple[str, str, float] | None = None,
) -> BarCalibration:
    """Calibrate cameras with a bar; the distance of its targets gives the scale.

    Parameters
    ----------
    seen : {camera: BarViews} of `find_bars` or `read_centroids`; images of one number are of one time.
    length : float [m]
        Distance of the targets, from centre to centre.
    interiors : Rig, optional
        Known intrinsics, kept (their poses are not used); default: intrinsics are calibrated too.
    length_sigma : float [m]
        Standard deviation of `length`.
    floor : frames in which the bar lies on the floor, in two directions or more: the targets' height is zero, z up.
        Default: the world is the first camera's frame.
    known_distance : (camera, camera, float [m]), optional
        A second length, from lens to lens, as a check of the bar's.

    Raises
    ------
    CalibrationError
        Too few places, targets that do not match, an arrangement that does not determine the intrinsics or the poses,
        a length that a second one contradicts.
    """
    names = list(seen)
    check_bar(length, length_sigma)
    check_cameras(names)
    cameras = [_camera(name, views, interiors) for name, views in seen.items()]
    frames = np.array(sorted({frame for views in seen.values() for frame in views.ends}))
    uv = np.full((len(frames), len(names), 2, 2), np.nan)
    for c, views in enumerate(seen.values()):
        for frame, ends in views.ends.items():
            uv[np.searchsorted(frames, frame), c] = ends
    bundle, used_uv, used, ambiguous = _adjusted(cameras, uv, length, interiors is not None)
    _check(bundle, length, interiors is not None, seen)
    if known_distance is not None:
        _check_second(bundle, length, length_sigma, known_distance)
    rig, T_new_world, world = on_floor(bundle.rig, bundle.x_world, frames[used], floor)
    reports = reports_of(rig, bundle, used_uv, seen, length, length_sigma)
    x_world = bundle.x_world @ T_new_world[:3, :3].T + T_new_world[:3, 3]
    return BarCalibration(
        rig, length, reports, bundle.sigma, bundle.scatter, frames[used], x_world, used_uv, bundle.residuals,
        int(ambiguous.sum()), int((~used & ~ambiguous).sum()), world, tuple(advice_of(rig, reports)),
        bundle.covariance.reshape(15 * len(rig), -1),
    )


def check_bar(length: float, length_sigma: float = LENGTH_SIGMA) -> None:
    """Raise CalibrationError for an implausible length [m] of a bar."""
    if not (_MIN_LENGTH < length < _MAX_LENGTH and 0 < length_sigma < length):
        known = "" if 0 < length_sigma < length else f", known to {length_sigma:g} m"
        metres = next((length * unit for unit in (0.001, 0.01) if 0.1 < length * unit < _MAX_LENGTH), 0.9)
        remedy = f"Give it in metres, such as {metres:g}."
        raise CalibrationError(f"a bar of {length:g} m{known}", place="length", remedy=remedy)


def check_cameras(names: Collection[str]) -> None:
    """Raise CalibrationError for fewer than two cameras."""
    if len(names) < 2:
        problem = f"{len(names)} camera: a bar calibrates two or more together"
        raise CalibrationError(problem, remedy="Give recordings of two or more cameras at the same times.")


def _camera(name: str, views: BarViews, interiors: Rig | None) -> Camera:
    if interiors is None:
        return with_focal(Camera(name, views.size, np.eye(3)), 1.0, False)
    return known_camera(interiors, name, views.size)


def _adjusted(
    cameras: list[Camera], uv: NDArray, length: float, known: bool
) -> tuple[BarBundle, NDArray, NDArray, NDArray]:
    """Bundle of all cameras; used pixels (U, C, 2, 2), used places (F,) bool, ambiguous places (F,) bool."""
    pairs = first_pairs(cameras, uv, known, length)
    best: tuple[float, list[int], Rig] | None = None
    for pair in pairs[:6]:
        rig, sigma, shares = _grown(Rig(pair.cameras), uv[:, [pair.first, pair.second]], length, known)
        cost = sigma / max(shares[0], 1e-3) ** 2
        if best is None or cost < best[0]:
            best = (cost, [pair.first, pair.second], rig)
    assert best is not None
    _, members, rig = best
    while len(members) < len(cameras):
        known_places = place(rig, uv[:, members], length, _limit(rig, known), 0.1 * length)
        trials = {}
        for c in set(range(len(cameras))) - set(members):
            both = np.isfinite(known_places.x_world).all(axis=(1, 2)) & np.isfinite(uv[:, c]).all(axis=(1, 2))
            trials[c] = (*resect(cameras[c], known_places.x_world[both], uv[both, c], known), int(both.sum()))
        c = max(trials, key=lambda c: trials[c][1] * trials[c][2])
        camera, share, count = trials[c]
        before, members, rig = rig.names, [*members, c], Rig((*rig, camera))
        if share > 0.0:
            rig, _, shares = _grown(rig, uv[:, members], length, known)
            share = shares[-1]
        if share < 0.5:
            raise CalibrationError(
                f"it shares {count} places with the cameras before it ({', '.join(before)}), of which "
                f"{100 * share:.0f} % agree", place=f"camera {cameras[c].name}",
                remedy=f"Check that it is in step. Wave the bar in {MIN_PLACES} places that two cameras see.",
            )  # fmt: skip
    rig = Rig(tuple(rig[camera.name] for camera in cameras))
    rig = rig.moved(rig.cameras[0].T_camera_world)
    sigma = 1.0
    for n in range(4):
        limit = _limit(rig, known) if n == 0 else max(_OUTLIER_SIGMAS * sigma * np.sqrt(2), 0.05)
        placed = place(rig, uv, length, limit, (0.05, 0.02, 0.01, 0.01)[n] * length)
        used = np.isfinite(placed.x_world).all(axis=(1, 2))
        _check_count(int(used.sum()), len(uv))
        found = adjust_bar(
            rig, placed.x_world[used], BarProblem(placed.uv[used], length, sigma, (1e-3, 1e-3, 1e-4, 1e-4)[n] * length),
            interiors=not known, rounds=3 if n < 3 else 8, iterations=20,
        )  # fmt: skip
        rig, sigma = found[0].rig, found[2].sigma
    return bar_bundle(*found), placed.uv[used], used, placed.ambiguous


def _limit(rig: Rig, known: bool) -> float:
    return max(inlier_distance(camera, known) * (camera.matrix[0, 0] if known else max(camera.size)) for camera in rig)


def _grown(rig: Rig, uv: NDArray, length: float, known: bool) -> tuple[Rig, float, NDArray]:
    """A rig adjusted twice to the places that it triangulates; noise [px], share (C,) of places that fit a camera."""
    sigma, seen = 1.0, np.isfinite(uv).all(axis=(2, 3))
    shared, fits = seen & (seen.sum(axis=1) >= 2)[:, None], np.zeros_like(seen)
    for n in range(2):
        placed = place(rig, uv, length, _limit(rig, known), (0.2, 0.05)[n] * length)
        used = np.isfinite(placed.x_world).all(axis=(1, 2))
        if used.sum() < MIN_PLACES:
            return rig, np.inf, np.zeros(len(rig))
        fits = np.isfinite(placed.uv).all(axis=(2, 3))
        found = adjust_bar(
            rig, placed.x_world[used], BarProblem(placed.uv[used], length, sigma, 5e-3 * length),
            interiors=not known, rounds=2, iterations=15,
        )  # fmt: skip
        rig, sigma = found[0].rig, found[2].sigma
    return rig, sigma, fits.sum(axis=0) / np.maximum(shared.sum(axis=0), 1)


def _check_count(used: int, total: int) -> None:
    if used < MIN_PLACES:
        raise CalibrationError(
            f"the cameras agree on {used} of {total} places of the bar",
            remedy="Check that the videos are in step and the targets the brightest moving spots. Use 50 places.",
        )  # fmt: skip


def _check(bundle: BarBundle, length: float, known: bool, seen: Mapping[str, BarViews]) -> None:
    if bundle.scatter > _MAX_SCATTER * length:
        raise CalibrationError(
            f"the distance of the two targets scatters by {100 * bundle.scatter / length:.1f} % from place to place",
            remedy="Check that the videos are in step and the two brightest spots always on one stiff bar.",
        )
    std = np.sqrt(np.einsum("cpcp->cp", bundle.covariance))
    for c, camera in enumerate(bundle.rig):
        used = int(np.isfinite(bundle.residuals[:, c]).all(axis=(1, 2)).sum())
        if used < MIN_PLACES:
            raise CalibrationError(
                f"only {used} of its {len(seen[camera.name].ends)} images of the bar agree with the other cameras",
                place=f"camera {camera.name}", remedy="Check that it is in step. Wave the bar in view of two cameras.",
            )  # fmt: skip
        if not known and not std[c, FOCAL] < _MAX_RELATIVE_STD * camera.matrix[0, 0]:
            raise CalibrationError(
                f"the focal length is not determined: {camera.matrix[0, 0]:.0f} px may be off by "
                f"{100 * std[c, FOCAL] / camera.matrix[0, 0]:.0f} %", place=f"camera {camera.name}",
                remedy="Wave the bar near and far, in all directions, move the cameras apart, or give --interiors.",
            )  # fmt: skip
    farthest = max(float(np.linalg.norm(camera.centre_world)) for camera in bundle.rig)
    position_std = float(np.sqrt((std[:, :3] ** 2).sum(axis=1)).max())
    if position_std > _MAX_RELATIVE_STD * farthest:
        raise CalibrationError(
            f"the cameras' positions have a standard deviation of {position_std:.2f} m, at {farthest:.2f} m apart",
            remedy="Wave the bar near and far and in all directions, and set the cameras 20 degrees apart or more.",
        )


def _check_second(bundle: BarBundle, length: float, sigma: float, known: tuple[str, str, float]) -> None:
    a, b, metres = known
    found = float(np.linalg.norm(bundle.rig[a].centre_world - bundle.rig[b].centre_world))
    if not metres > 0:
        raise CalibrationError(f"a distance of {metres} m", place=f"{a} to {b}", remedy="Give it in metres.")
    relative_std = np.hypot(_TAPE_SIGMA, sigma / length)
    if abs(np.log(found / metres)) > _MAX_DISTANCE_SIGMAS * relative_std:
        raise CalibrationError(
            f"with a bar of {length:g} m they are {found:.3f} m apart, not {metres:g} m",
            place=f"cameras {a} and {b}",
            remedy=f"Measure both again, from centre to centre; a bar of {length * metres / found:.4g} m would agree.",
        )
