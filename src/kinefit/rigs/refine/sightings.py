"""Track one person with a rig, and prepare the measurements for a bundle adjustment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.fitting.multiview.association import choose_people, person_records
from kinefit.fitting.subject.keypoints import fit_subject
from kinefit.fitting.subject.parameters import PointOffsets
from kinefit.fitting.subject.subject import Subject
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.video import track
from kinefit.geometry.camera import Rig
from kinefit.observations import Keypoints
from kinefit.sensors.channels import Channels, make_channels
from kinefit.solving.bundle.cameras import PointPixels
from kinefit.solving.bundle.shape import PROPORTIONS, PixelFrames, ShapeParameters, shape_parameters

Progress = Callable[[str, int, int], None]

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
    return good[np.unique(np.linspace(0, len(good) - 1, min(most, len(good))).astype(int))] if len(good) else good


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
