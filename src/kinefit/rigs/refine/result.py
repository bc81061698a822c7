"""Result of a refinement: the rig, its changes, and their uncertainty.

Track one person with a rig, and prepare the measurements for a bundle adjustment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.fitting.multiview.association import choose_people, person_records
from kinefit.fitting.subject.keypoints import fit_subject
from kinefit.fitting.subject.parameters import PointOffsets
from kinefit.fitting.subject.subject import Subject
from kinefit.fitting.tracking.recording import Recording, spread
from kinefit.fitting.tracking.video import track
from kinefit.geometry.camera import Rig
from kinefit.observations import Keypoints
from kinefit.rigs.refine.gauge import aligned, covariance_in_gauge
from kinefit.sensors.channels import Channels, make_channels
from kinefit.solving.bundle.adjust import Bundle, BundleState, adjust
from kinefit.solving.bundle.cameras import COLUMNS, FOCAL, TIME, PointPixels, camera_jacobian, departure
from kinefit.solving.bundle.shape import PROPORTIONS, BodyProblem, PixelFrames, ShapeParameters, shape_parameters

_MIN_INLIER_WEIGHT = 0.25  # of the robust loss (Geman-McClure: within its scale)
_POINT_SIGMA = 0.01  # [m] default of a detector's points about the body's
_MIN_QUALITY = 0.3  # of a frame that counts


@dataclass(frozen=True, eq=False)
class PersonSighting:
    """One person as tracked with a rig.

    Parameters
    ----------
    channels : Channels of the generic body's points.
    subject : Subject
    motion : Motion
    uv : (F, N, 2) [px] with swaps of left and right corrected, NaN if unobserved.
    confidence : (F, N) of them.
    """

    channels: Channels
    subject: Subject
    motion: Motion
    uv: NDArray
    confidence: NDArray

    @property
    def residuals(self) -> NDArray:
        """(F, N, 2) [px] measured minus fitted."""
        return np.concatenate([self.motion.residuals[name].values for name in self.channels.sources], axis=1)

    @property
    def weights(self) -> NDArray:
        """(F, N) robust weight in 0..1."""
        return np.concatenate([self.motion.residuals[name].weights for name in self.channels.sources], axis=1)

    @property
    def trusted(self) -> NDArray:
        """(F, N, 2) [px] residuals of inliers; NaN for outliers."""
        return np.where((self.weights > _MIN_INLIER_WEIGHT)[..., None], self.residuals, np.nan)


def one_person(rig: Rig, keypoints: Sequence[Keypoints]) -> list[Keypoints]:
    """The keypoints of the tracked person alone."""
    return [record.of_one(person) for record, person in zip(keypoints, choose_people(rig, keypoints), strict=True)]


def shifted(record: Keypoints, offset: float) -> Keypoints:
    """One person's keypoints, shifted to correct a clock that is late by `offset` [s].

    Frame f becomes frame f − offset · rate, interpolated linearly between two frames with the point.
    """
    if offset == 0.0:
        return record
    at = np.arange(len(record)) - offset * record.rate
    low = np.floor(at + 1e-9).astype(int)
    share = np.clip(at - low, 0.0, 1.0)[:, None, None]
    inside = (low >= 0) & (low + (share[:, 0, 0] > 1e-6) < len(record))
    a, b = np.clip(low, 0, len(record) - 1), np.clip(low + 1, 0, len(record) - 1)
    b = np.where(share[:, 0, 0] > 1e-6, b, a)
    points = (1 - share[..., None]) * record.points[a] + share[..., None] * record.points[b]
    confidence = np.minimum(record.confidence[a], record.confidence[b])
    points = np.where(inside[:, None, None, None], points, np.nan)
    confidence = np.where(inside[:, None, None] & np.isfinite(points).all(axis=-1), confidence, 0.0)
    return replace(record, points=points, confidence=confidence, lifted=None)


@dataclass(frozen=True, eq=False)
class PersonTrial:
    """Keypoints of the person who calibrates the cameras, with the options of the fit.

    Parameters
    ----------
    keypoints : records of the same number of frames and the same rate.
    body : Body, generic.
    up : str, vertical axis of the world.
    sigma : float [px] standard deviation of a keypoint of full confidence.
    """

    keypoints: Sequence[Keypoints]
    body: Body
    up: str
    sigma: float


def sight(rig: Rig, trial: PersonTrial, offsets: Mapping[str, float]) -> PersonSighting:
    """Track one person with a rig whose cameras' clocks are late by `offsets` [s]."""
    body, alone = trial.body, [shifted(k, offsets.get(k.camera, 0.0)) for k in one_person(rig, trial.keypoints)]
    channels = make_channels(body, rig, person_records(alone, choose_people(rig, alone)), [trial.sigma] * len(alone))
    subject = fit_subject(body, channels)
    recording = Recording.of_keypoints(rig, alone, sigma=trial.sigma, up=trial.up)
    motion = track(recording, body, subject=subject, smooth=False)
    uv = np.concatenate([motion.residuals[name].measured for name in channels.sources], axis=1)
    own = np.all((uv == channels.uv) | (np.isnan(uv) & np.isnan(channels.uv)), axis=-1)
    confidence = np.where(own, channels.confidence, channels.confidence[:, channels.partner])
    return PersonSighting(channels, subject, motion, uv, np.where(np.isfinite(uv).all(axis=-1), confidence, 0.0))


def body_model(sighting: PersonSighting, body: Body) -> tuple[ShapeParameters, NDArray]:
    """The generic body's lengths and points as parameters with their prior, and their fitted values (P,)."""
    subject, points = sighting.subject, sighting.channels.points
    found = () if subject.fit is None else subject.fit.parameters
    stds = [float(np.max(p.std)) for p in found if isinstance(p, PointOffsets)]
    model = shape_parameters(body, points, subject.scales, PROPORTIONS, max(stds, default=_POINT_SIGMA))
    moved = sighting.channels.with_points(subject.body).points.points
    moved = moved - sighting.channels.with_points(body.scaled(subject.scales)).points.points
    theta, first = model.mean.copy(), len(subject.scales)
    theta[:first] = subject.scales
    moved[:, 2] *= model.mirror
    theta[first + model.shift[:, None] + np.arange(3)] = moved
    return model, theta


def spread_frames(sighting: PersonSighting, most: int) -> NDArray:
    """(K,) at most `most` frames with a reliable pose, evenly spaced over the take."""
    good = np.flatnonzero(sighting.motion.quality > _MIN_QUALITY)
    return good[spread(len(good), most)]


def pixel_frames(sighting: PersonSighting, frames: NDArray) -> PixelFrames:
    """Measurements of some frames (K,) int, with the velocities of the pixels.

    Errors of a detector's points on one segment in one view are correlated (an occluded shoulder, a blurred face). n
    points of correlation ρ count as n / (1 + (n − 1) ρ) independent ones (the design effect: L. Kish, Survey sampling,
    1965); the residuals give ρ.
    """
    c = sighting.channels
    group = _groups(sighting)
    share = 1.0 / (1.0 + (np.bincount(group)[group] - 1) * residual_correlation(sighting))
    weight = sighting.confidence / np.square(c.sigma)
    uv, velocity = np.nan_to_num(sighting.uv[frames]), velocities(sighting)[frames]
    return PixelFrames(c.points, c.camera, c.column, uv, weight[frames], share, velocity)


def _groups(sighting: PersonSighting) -> NDArray:
    """(N,) int: channels of one source on one segment."""
    c = sighting.channels
    key = c.source * len(sighting.motion.body.tree.segments) + c.points.segments[c.column]
    return np.unique(key, return_inverse=True)[1]


def residual_correlation(sighting: PersonSighting) -> float:
    """Correlation, a number 0..1, of the residuals of points on one segment in one view."""
    values = sighting.trusted
    seen = np.isfinite(values).all(axis=-1)
    values, group = np.where(seen[..., None], values, 0.0), _groups(sighting)
    member = (group[:, None] == np.arange(group.max(initial=0) + 1)).astype(float)
    count, square = seen @ member, np.sum(values**2, axis=-1) @ member
    total = np.einsum("fnd,ng->fgd", values, member)
    cross, pairs = np.sum(total**2, axis=-1) - square, count * (count - 1)
    power = square.sum(axis=0) / np.maximum(count.sum(axis=0), 1)
    expected = float(np.sum(pairs * power))
    return float(np.clip(cross.sum(where=count > 1) / expected, 0.0, 1.0)) if expected > 0 else 0.0


def velocities(sighting: PersonSighting) -> NDArray:
    """(F, N, 2) [px/s] velocities of every channel's tracked point; 0 behind the camera."""
    c, motion = sighting.channels, sighting.motion
    x = motion.positions(c.with_points(motion.body).points)
    x_dot = np.gradient(x, 1.0 / motion.rate, axis=0) if len(x) > 1 else np.zeros_like(x)
    out = np.zeros(sighting.uv.shape)
    for k, camera in enumerate(c.rig):
        own = c.camera == k
        _, J = camera.project_with_jacobian(x[:, c.column[own]])
        out[:, own] = (J @ x_dot[:, c.column[own]][..., None])[..., 0]
    return np.nan_to_num(out)


def static_pixels(
    rig: Rig, points: Mapping[str, Mapping[str, tuple[float, float]]], sigma: float
) -> tuple[tuple[str, ...], PointPixels]:
    """Names and pixels of static points {name: {camera: (u, v)}} [px], with a standard deviation [px]."""
    names = tuple(points)
    rows = [(rig.index(c), p, uv) for p, name in enumerate(names) for c, uv in points[name].items()]
    return names, PointPixels(
        np.array([r[0] for r in rows], int), np.array([r[1] for r in rows], int),
        np.array([r[2] for r in rows], float).reshape(-1, 2), np.full(len(rows), sigma**-2),
    )


def correlation_time(values: NDArray) -> float:
    """Correlation time of the errors (F, N, 2) of channels, a number of frames: 1 for white noise, at most F.

    Integrated autocorrelation, over lags until the mean correlation falls below zero (the initial positive sequence:
    C. Geyer, Practical Markov chain Monte Carlo, 1992).
    """
    seen = np.isfinite(values).all(axis=-1)
    x = np.where(seen[..., None], values, 0.0)
    power = np.sum(x * x) / max(int(seen.sum()), 1)
    total = 1.0
    for lag in range(1, len(x)):
        pairs = int(np.sum(seen[lag:] & seen[:-lag]))
        rho = np.sum(x[lag:] * x[:-lag]) / pairs / power if pairs and power > 0 else 0.0
        if rho <= 0.0:
            break
        total += 2.0 * rho * (1.0 - lag / len(x))
    return float(min(total, len(x)))


MAX_STATIC_SIGMA_PX = 3.0
"""Standard deviation of a static point's residual near the person, up to which a rig is reliable."""


@dataclass(frozen=True, eq=False)
class CameraChange:
    """Change of one camera by a refinement.

    Parameters
    ----------
    residual_before, residual_after : float [px] median over its keypoints, of the tracked body.
    bias_after : (2,) [px] median shift, measured minus fitted.
    turn, shift : float [rad], [m] by which it was rotated and moved.
    focal : float, change of the focal length as a share.
    time : float [s] to add to its times.
    turn_std, shift_std, focal_std, time_std : float
        Standard deviation of each, in the stated gauge; 0 if fixed.
    uncertainty : float [px] standard deviation of a static point's residual near the person.
    """

    residual_before: float
    residual_after: float
    bias_after: NDArray
    turn: float
    shift: float
    focal: float
    time: float
    turn_std: float
    shift_std: float
    focal_std: float
    time_std: float
    uncertainty: float


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined rig with its uncertainty.

    Parameters
    ----------
    rig : Rig
    time_offsets : {camera: [s]} to add to each camera's, the first camera's being 0.
    cameras : {camera: CameraChange}
    gauge : str, the rule that fixes position, rotation and scale of the world.
    frames : (F,) int used.
    confident : bool
        Whether `uncertainty` is at most 3 px in every camera.
    motion : Motion tracked with the new rig.
    point_std : float [m] standard deviation of a triangulated point near the person.
    static : {point: [px]} median residual of the given static points, triangulated with the new rig.
    from_scratch : bool, no poses were known before; then `turn` and `shift` are relative to an initial guess.
    """

    rig: Rig
    time_offsets: Mapping[str, float]
    cameras: Mapping[str, CameraChange]
    gauge: str
    frames: NDArray
    confident: bool
    motion: Motion
    point_std: float
    static: Mapping[str, float]
    from_scratch: bool = False

    def summary_lines(self) -> list[str]:
        """Lines of text that summarise the result."""
        known = f"points about the person known to {1e3 * self.point_std:.0f} mm"
        out = [f"{len(self.frames)} frames; {known}. {self.gauge}"]
        for name, c in self.cameras.items():
            turn, shift = f"± {np.degrees(c.turn_std):.2f}°", f"± {1e3 * c.shift_std:.0f} mm"
            if self.from_scratch:
                line = f"{name}: residual {c.residual_after:.1f} px; placed {shift}, {turn}"
            else:
                line = (
                    f"{name}: residual {c.residual_before:.1f} -> {c.residual_after:.1f} px; turned "
                    f"{np.degrees(c.turn):.2f} {turn}, moved {1e3 * c.shift:.0f} {shift}"
                )
            if c.focal_std:
                line += f", focal length {100 * c.focal:+.2f} ± {100 * c.focal_std:.2f} %"
            if c.time_std or c.time:
                line += f", clock {1e3 * c.time:+.1f} ± {1e3 * c.time_std:.1f} ms"
            out.append(f"{line}; static points known to {c.uncertainty:.1f} px")
        if not self.confident:
            out.append("Uncertain: more movement through the whole volume would place the cameras better.")
        return out


def changes_of(
    old: Rig, rig: Rig, first: PersonSighting, last: PersonSighting, covariance: NDArray, offsets: NDArray
) -> tuple[dict[str, CameraChange], float]:
    """Change of each camera, and the standard deviation [m] of a triangulated point.

    covariance (C · 16, C · 16) is of the cameras' parameters, offsets (C,) [s] of their clocks.
    """
    clock = np.zeros((len(rig), len(covariance)))  # relative to the first camera: a common delay has no effect
    clock[np.arange(len(rig)), np.arange(TIME, len(covariance), COLUMNS)] = 1.0
    clock[:, TIME] -= 1.0
    clock_std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", clock, covariance, clock), 0.0))
    pixel, distance = expected_errors(rig, covariance, places(last.motion))
    moved = departure(rig, old)
    out = {}
    for c, name in enumerate(rig.names):
        std = np.sqrt(np.maximum(np.diag(covariance)[c * COLUMNS : (c + 1) * COLUMNS], 0.0))
        before, after = (_camera_residuals(s, c) for s in (first, last))
        out[name] = CameraChange(
            residual_before=float(np.median(np.linalg.norm(before, axis=-1))),
            residual_after=float(np.median(np.linalg.norm(after, axis=-1))),
            bias_after=np.median(after, axis=0),
            turn=float(np.linalg.norm(moved[c, 3:6])),
            shift=float(np.linalg.norm(rig.cameras[c].centre_world - old.cameras[c].centre_world)),
            focal=float(np.expm1(moved[c, FOCAL])), time=float(offsets[c]),
            turn_std=float(np.linalg.norm(std[3:6])), shift_std=float(np.linalg.norm(std[:3])),
            focal_std=float(std[FOCAL]), time_std=float(clock_std[c]),
            uncertainty=float(pixel[c]),
        )  # fmt: skip
    return out, distance


def _camera_residuals(seen: PersonSighting, camera: int) -> NDArray:
    """(M, 2) [px] residuals of a camera's observed keypoints."""
    own = seen.residuals[:, seen.channels.camera == camera].reshape(-1, 2)
    own = own[np.isfinite(own).all(axis=1)]
    return own if len(own) else np.full((1, 2), np.inf)


def places(motion: Motion) -> NDArray:
    """(P, 3) [m] points spread over the box in which the person moved."""
    x = motion.segment_poses()[..., :3, 3].reshape(-1, 3)
    return np.stack(np.meshgrid(*np.linspace(x.min(axis=0), x.max(axis=0), 4).T), axis=-1).reshape(-1, 3)


def expected_errors(rig: Rig, covariance: NDArray, x_world: NDArray) -> tuple[NDArray, float]:
    """Standard deviations of triangulated static points (P, 3) [m], median over the points.

    covariance (C · 16, C · 16) is of the cameras. Returns (C,) [px] those of the residual in each camera, and [m] that
    of the point.
    """
    J_camera = np.stack([camera_jacobian(camera, x_world) for camera in rig], axis=1)
    J_camera[..., TIME] = 0.0
    J_point = np.stack([camera.project_with_jacobian(x_world)[1] for camera in rig], axis=1)
    seen = np.isfinite(J_point).all(axis=(2, 3))
    seen &= (seen.sum(axis=1) >= 2)[:, None]
    J_point = np.where(seen[..., None, None], J_point, 0.0)
    pixel, distance = np.full((len(x_world), len(rig)), np.nan), np.full(len(x_world), np.nan)
    for p in np.flatnonzero(seen.any(axis=1)):
        J = np.zeros((2 * len(rig), covariance.shape[0]))
        for c in np.flatnonzero(seen[p]):
            J[2 * c : 2 * c + 2, c * COLUMNS : (c + 1) * COLUMNS] = J_camera[p, c]
        A = J_point[p].reshape(-1, 3)
        to_point = -np.linalg.pinv(A) @ J
        left = J + A @ to_point
        variance = np.einsum("ij,jk,ik->i", left, covariance, left).reshape(-1, 2).sum(axis=1)
        pixel[p, seen[p]] = np.sqrt(np.maximum(variance, 0.0))[seen[p]]
        distance[p] = np.sqrt(max(np.trace(to_point @ covariance @ to_point.T), 0.0))
    known = np.isfinite(pixel).any(axis=0)
    out = np.full(len(rig), np.inf)
    out[known] = np.nanmedian(pixel[:, known], axis=0)
    return out, float(np.nanmedian(distance)) if np.isfinite(distance).any() else np.inf


_MAX_JACKKNIFE_FRAMES = 40


def chance(bundle: Bundle, seen: PersonSighting, frames: NDArray) -> NDArray:
    """Covariance (C · 16, C · 16) of the cameras from random errors.

    Their variance and correlation time are those of the residuals without each channel's mean.
    """
    values = seen.trusted
    counts = np.isfinite(values).all(axis=-1).sum(axis=0)
    mean = np.nansum(values, axis=0) / np.maximum(counts, 1)[:, None]
    new = min(1.0, len(values) / max(len(frames), 1) / correlation_time(values - mean))  # independent share of frames
    share = seen.confidence / np.square(seen.channels.sigma)
    power = float(np.nanmean(np.sum((values - mean) ** 2, axis=-1) * share)) / 2.0
    return covariance_in_gauge(bundle.state.rig, bundle.S * new / max(power, 1e-12), bundle.prior.free.ravel())


def bias(problem: BodyProblem, bundle: Bundle) -> NDArray:
    """Covariance (C · 16, C · 16) of the cameras from systematic errors.

    A detector's points are biased against the anatomical ones, differently in each view. Grouped jackknife (M.
    Quenouille, 1956; J. Tukey, 1958): fit the cameras without the points of each segment in turn.
    """
    frames, state = problem.frames, bundle.state
    some = spread(len(frames.uv), _MAX_JACKKNIFE_FRAMES)
    owner = frames.points.segments[frames.column]
    groups = np.unique(owner)

    def fit(start: BundleState, without: int | None) -> BundleState:
        kept = np.ones(len(owner)) if without is None else (owner != without).astype(float)
        weight, velocity = frames.weight[some] * kept, frames.velocity[some]
        part = replace(frames, uv=frames.uv[some], weight=weight, velocity=velocity)
        start = replace(start, offsets=state.offsets)
        return adjust(start, bundle.prior, replace(problem, frames=part), iterations=6, tolerance=1e-3).state

    whole = fit(replace(state, states=[state.states[f] for f in some]), None)
    away = []
    for group in groups:
        part = fit(whole, int(group))
        row = departure(aligned(part.rig, whole.rig)[0], whole.rig)
        row[:, TIME] = part.offsets - whole.offsets
        away.append(row.ravel())
    deviation = np.array(away) - np.mean(away, axis=0)
    return (len(groups) - 1) / len(groups) * deviation.T @ deviation
