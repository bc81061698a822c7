"""Points of a whole take as packed blocks, which the compiled solvers evaluate exactly: keypoints [px], markers [m]."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.motion import Residuals
from kinefit.fitting.smoothing.shared_errors import SharedErrors
from kinefit.fitting.smoothing.spool import STRETCH, stretches
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.observations import by_record
from kinefit.sensors.base import Matched, Measurement, matched_by
from kinefit.sensors.channels import Channels, joined
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.points.keypoints import KeypointMatched, pixels_of
from kinefit.sensors.points.markers import MarkerMeasurement, MarkerSensor, markers_of, of_points
from kinefit.sensors.points.views import find_swaps, limb_groups, trunks, view_offset
from kinefit.sensors.scene import Scene
from kinefit.solving.trajectory.sequence import SeenPoints
from kinefit.solving.trajectory.smoothing import unpacked

MIN_INLIER_FACTOR = 0.25
"""Robust factor (Geman-McClure: within its scale) above which a residual is noise."""

_MAX_TIME_GAP_S = 1e-6  # of a marker from its frame; with a larger gap the body is moved, which only rows can do


@dataclass(frozen=True, eq=False)
class PackedPoints(ABC):
    """K points of the body, measured in T frames along A axes.

    Parameters
    ----------
    points : PointSet of the K points on the body
    values : (T, K, A) [px] or [m] as used
    loss : Loss of a point, in standard deviations
    """

    points: PointSet
    values: NDArray
    loss: Loss

    of_frames: ClassVar[tuple[str, ...]]
    """Names of the arrays with a line for each frame."""

    @property
    @abstractmethod
    def weight(self) -> NDArray:
        """(T, K) [1/px²] or [1/m²] weights by the estimated standard deviations, 0 where unobserved."""

    @property
    @abstractmethod
    def seen(self) -> NDArray:
        """(T, K) bool: where a point was observed."""

    @abstractmethod
    def squares(self, gaps: NDArray) -> NDArray:
        """(T, K) squared lengths of `gaps` (T, K, A), in the variances of the loss; NaN where unobserved."""

    @abstractmethod
    def fitted(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, K, A) the points as the sensors would see them at states (T, 4, 4), (T, D)."""

    @abstractmethod
    def for_solver(self, weight: NDArray, loss: Loss) -> SeenPoints:
        """The points for the solver, with weights (T, K) and a loss."""

    @abstractmethod
    def matched(self, f: int, tracked: Iterable[Matched], scene: Scene) -> tuple[Matched, ...]:
        """The matches of frame `f` at a scene; `tracked` are those that the tracker found in it."""

    def part(self, frames: slice) -> Self:
        """The points of some frames."""
        return replace(self, **{name: getattr(self, name)[frames] for name in self.of_frames})

    def release(self) -> None:
        """Give back the memory of the measurements: they lie in files where they are many."""
        release(*(getattr(self, name) for name in self.of_frames))

    def gaps(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, K, A) measured minus fitted at states (T, 4, 4), (T, D); NaN where unobserved."""
        return np.where(self.seen[..., None], self.values - self.fitted(body, roots, angles), np.nan)

    def factors(self, gaps: NDArray) -> NDArray:
        """(T, K) robust factors of `gaps` (T, K, A); 0 where unobserved."""
        squares = self.squares(gaps)
        known = np.isfinite(squares)
        return np.where(known, self.loss.factor(np.where(known, squares, 0.0)), 0.0)

    def stretched(self, body: Body, roots: NDArray, angles: NDArray) -> Iterator[tuple[slice, Self, NDArray]]:
        """Stretches of frames, with their points and the `gaps` at states (T, 4, 4), (T, D)."""
        for some in stretches(len(roots)):
            part = self.part(some)
            yield some, part, part.gaps(body, roots[some], angles[some])
            self.release()

    def inliers(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, K) bool: points whose residuals at states (T, 4, 4), (T, D) are noise."""
        out = np.zeros(self.values.shape[:2], bool)
        for some, part, gaps in self.stretched(body, roots, angles):
            out[some] = part.factors(gaps) > MIN_INLIER_FACTOR
        return out

    def weights(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, K) `weight`, times robust factors at states (T, 4, 4), (T, D)."""
        out = room(self.values.shape[:2])
        for some, part, gaps in self.stretched(body, roots, angles):
            out[some] = part.factors(gaps) * part.weight
            release(out)
        return out

    def information(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, n, n) information on the pose at states (T, 4, 4), (T, D)."""
        points = self.for_solver(self.weights(body, roots, angles), SQUARED)
        return unpacked(points.equations(body)(roots, angles)[0], body.tree)


@dataclass(frozen=True, eq=False)
class PackedPixels(PackedPoints):
    """N channels of keypoints in T frames: `values` are the pixels as used, without the detectors' bias by view.

    Parameters
    ----------
    channels : as measured, in all frames of the take
    confidence : (T, N) as used, 0 where undetected
    swapped : (T, N) bool, channels whose left and right are exchanged
    sigma : (N,) [px] noise of every channel at full confidence, as estimated
    errors : what the points of a segment have in common of their errors, as estimated
    """

    channels: Channels
    confidence: NDArray
    swapped: NDArray
    sigma: NDArray
    errors: SharedErrors

    of_frames = ("values", "confidence", "swapped")

    @classmethod
    def of(cls, matches: Iterable[Sequence[KeypointMatched]], rig: Rig, frames: int, loss: Loss) -> PackedPixels:
        """Keypoints of so many frames, in one layout, with sides as they were matched, as measured."""
        channels, known = Channels.none(rig, frames), None
        swapped = np.zeros((frames, 0), bool)
        for f, several in enumerate(matches):
            if f % STRETCH == 0:
                release(channels.uv, channels.confidence)
            for m in several:
                if not swapped.size:
                    N = len(m.swapped)
                    uv, confidence, swapped = room((frames, N, 2)), room((frames, N)), np.zeros((frames, N), bool)
                    uv[:] = np.nan
                    channels = replace(m.measurement.layout.channels, uv=uv, confidence=confidence)
                of = m.measurement
                channels.uv[f], channels.confidence[f], swapped[f] = of.uv, of.confidence, m.swapped
                if of.sides_known is not None:
                    known = np.zeros(swapped.shape, bool) if known is None else known
                    known[f] = of.sides_known
        errors = SharedErrors.none(len(channels.sigma))
        return cls(
            channels.each, channels.uv, loss, replace(channels, sides_known=known), channels.confidence, swapped,
            np.array(channels.sigma), errors,
        )  # fmt: skip

    @property
    def weight(self) -> NDArray:
        """(T, N) [1/px²] weights by the estimated standard deviations, 0 where undetected."""
        return np.asarray(self.confidence / np.square(self.sigma))

    @property
    def seen(self) -> NDArray:
        """(T, N) bool: detected channels."""
        return self.confidence > 0.0

    def squares(self, gaps: NDArray) -> NDArray:
        """(T, N) squared lengths of `gaps` (T, N, 2), in estimated variances; NaN where undetected."""
        return np.asarray(self.confidence * np.square(gaps).sum(axis=2) / np.square(self.sigma))

    def for_solver(self, weight: NDArray, loss: Loss) -> SeenPoints:
        """The keypoints for the solver, with weights (T, N) [1/px²] and a loss."""
        c, errors = self.channels, self.errors
        return SeenPoints(
            c.rig, self.points, c.camera, self.values, weight / (1.0 - errors.share), loss, member=errors.member,
            shared=errors.variance,
        )  # fmt: skip

    def with_noise(self, sigma: NDArray, share: NDArray) -> PackedPixels:
        """The keypoints with noise `sigma` (N,) [px], of whose variance the points of a segment have a share (N,)."""
        return replace(self, sigma=sigma, errors=SharedErrors.of(self.channels, share, sigma))

    def release(self) -> None:
        """Give back the memory of the measurements and of what was used of them."""
        super().release()
        release(self.channels.uv, self.channels.confidence)

    def swapped_as(self, swapped: NDArray, body: Body, roots: NDArray, angles: NDArray) -> PackedPixels:
        """The keypoints as measured with the channels `swapped` (T, N), without bias at states (T, 4, 4), (T, D)."""
        uv, confidence = _exchanged(self.channels, swapped)
        uv = _without_bias(body, self.channels, uv, roots, angles)
        return replace(self, values=uv, confidence=confidence, swapped=swapped)

    def find_swaps(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, N) bool: channels to exchange with their left-right partner, by states (T, 4, 4), (T, D)."""
        channels, out = self.channels, np.zeros(self.swapped.shape, bool)
        if not len(channels.column):
            return out
        groups = limb_groups(body, channels)
        for some in stretches(len(out)):
            at = roots[some], angles[some]
            given = replace(self, channels=channels.part(range(*some.indices(len(out)))))
            given = given.swapped_as(np.zeros(given.channels.confidence.shape, bool), body, *at)
            weight, fitted = given.confidence / np.square(channels.sigma), given.fitted(body, *at)
            known = given.channels.sides_known if given.channels.sides_known is not None else [None] * len(fitted)
            out[some] = [find_swaps(channels, groups, *one) for one in zip(given.values, weight, fitted, known)]
        return out

    def fitted(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, N, 2) [px] projections of the points at states (T, 4, 4), (T, D)."""
        x = body.trajectories(roots, angles, self.points)
        uv = self.channels.rig.project(x.reshape(-1, 3), np.tile(self.channels.camera, len(x)))
        return uv.reshape(*x.shape[:2], 2)

    def matched(self, f: int, tracked: Iterable[Matched], scene: Scene) -> tuple[KeypointMatched, ...]:
        """The matches of keypoints among those of frame `f`, with the sides and the bias as used here."""
        weight = self.confidence[f] / np.square(self.channels.sigma)
        uv = np.where(weight[:, None] > 0, self.values[f], np.nan)
        return tuple(
            replace(m, uv=uv, weight=weight, swapped=self.swapped[f], view_offset=m.measurement.layout.bias(scene))
            for m in pixels_of(tracked)
        )


@dataclass(frozen=True, eq=False)
class PackedMarkers(PackedPoints):
    """K labelled markers in T frames: `values` (T, K, 3) [m] are 0 where unobserved.

    Parameters
    ----------
    streams : Q marker sensors, each with a marker set
    source : (K,) int, number of each marker's stream
    stated : (T, K) [1/m²] weights by the stated standard deviations, 0 where unobserved
    times : (T,) [s]
    scale : {sensor: factor} on the standard deviations, estimated from the take
    """

    streams: tuple[tuple[MarkerSensor, str], ...]
    source: NDArray
    stated: NDArray
    times: NDArray
    scale: Mapping[str, float] = field(default_factory=dict)

    of_frames = ("values", "stated", "times")

    @classmethod
    def of(
        cls, body: Body, measurements: Iterable[Sequence[Measurement]], times: NDArray, loss: Loss
    ) -> PackedMarkers:
        """Markers of T frames with this loss, measured at the frames' times (T,) [s]."""
        streams, apart = dict[tuple[str, str], MarkerSensor](), set[str]()
        column, columns = dict[tuple[str, str, str], int](), dict[tuple[str, str, tuple[str, ...]], list[int]]()
        places, stated = room((len(times), 0, 3)), room((len(times), 0))
        for f, several in enumerate(measurements):
            for m in by_record(several)[MarkerMeasurement]:
                if abs(m.time - times[f]) > _MAX_TIME_GAP_S or m.of.loss != loss:
                    apart.add(m.sensor)
                key = m.sensor, m.marker_set
                own = columns.get((*key, m.names))
                if own is None:
                    streams.setdefault(key, m.of)
                    own = columns[*key, m.names] = [column.setdefault((*key, n), len(column)) for n in m.names]
                    places, stated = _wider(places, len(column)), _wider(stated, len(column))
                places[f, own], stated[f, own] = m.x_world, m.weight
            if f % STRETCH == 0:
                release(places, stated)
        used = [k for k, (name, _, _) in enumerate(column) if name not in apart]
        if len(used) < len(column):
            places, stated = places[:, used], stated[:, used]
        kept = [key for key in streams if key[0] not in apart]
        of = [(kept.index((name, marker_set)), one) for name, marker_set, one in column if name not in apart]
        points = joined([markers_of(body, kept[q][1]).select((one,)) for q, one in of])
        scale = {name: 1.0 for name, _ in kept}
        source = np.array([q for q, _ in of], np.int64)
        found = tuple((streams[key], key[1]) for key in kept)
        return cls(points, places, loss, found, source, stated, times, scale)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(self.scale)

    def columns(self, sensor: str) -> NDArray:
        """(K',) int: the markers of a sensor."""
        own = [q for q, (of, _) in enumerate(self.streams) if of.name == sensor]
        return np.flatnonzero(np.isin(self.source, own))

    @property
    def weight(self) -> NDArray:
        """(T, K) [1/m²] weights by the estimated standard deviations, 0 where unobserved."""
        factor = np.array([self.scale[sensor.name] for sensor, _ in self.streams], float)
        return np.asarray(self.stated / np.square(factor[self.source]))

    @property
    def measured(self) -> tuple[NDArray, NDArray]:
        """(T, K, 3) [m] as measured, NaN where unobserved, and (K,) [m] stated sigma, 1 of markers never observed."""
        x, weight = room(self.values.shape), self.stated.max(axis=0, initial=0.0)
        x[:] = np.where(self.seen[..., None], self.values, np.nan)
        return x, 1.0 / np.sqrt(np.where(weight > 0.0, weight, 1.0))

    def measurements(self, f: int) -> tuple[MarkerMeasurement, ...]:
        """The measurements of one frame."""
        out = list[MarkerMeasurement]()
        for q, (sensor, marker_set) in enumerate(self.streams):
            here = np.flatnonzero((self.source == q) & (self.stated[f] > 0.0))
            if len(here):
                names = tuple(self.points.names[k] for k in here)
                x = np.ascontiguousarray(self.values[f, here])
                out.append(MarkerMeasurement(sensor, names, x, marker_set, float(self.times[f])))
        return tuple(out)

    def matched(self, f: int, tracked: Iterable[Matched], scene: Scene) -> tuple[Matched, ...]:
        """The matches of frame `f` at a scene; markers are labelled, whatever the tracker found."""
        return tuple(matched_by(m, scene, m.of.near) for m in self.measurements(f))

    @property
    def seen(self) -> NDArray:
        """(T, K) bool: observed markers."""
        return self.stated > 0.0

    def squares(self, gaps: NDArray) -> NDArray:
        """(T, K) squared lengths of `gaps` (T, K, 3), in stated variances; NaN where unobserved."""
        return np.asarray(self.stated * np.square(gaps).sum(axis=2))

    def fitted(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, K, 3) [m] the markers on the body at states (T, 4, 4), (T, D)."""
        return body.trajectories(roots, angles, self.points)

    def for_solver(self, weight: NDArray, loss: Loss) -> SeenPoints:
        """The markers for the solver, with weights (T, K) [1/m²] and a loss."""
        return SeenPoints.in_metres(self.points, self.values, weight, loss)

    def evidence(self, body: Body, gaps: NDArray) -> Evidence:
        """Evidence of T frames from `gaps` (T, K, 3): that of all sensors, as `MarkerMatched.evidence` has it."""
        return of_points(body, self.points, self.squares(gaps))

    def residuals(self, body: Body, roots: NDArray, angles: NDArray) -> dict[str, Residuals]:
        """Residuals at states (T, 4, 4), (T, D), by sensor."""
        values, weights = room(self.values.shape), room(self.stated.shape)
        for some, part, gaps in self.stretched(body, roots, angles):
            values[some], weights[some] = gaps, part.factors(gaps)
            release(values, weights)
        measured = np.where(self.seen[..., None], self.values, np.nan)
        out = {}
        for sensor in self.sensors:
            own = self.columns(sensor)
            out[sensor] = Residuals(
                tuple(self.points.names[k] for k in own), self.points.segments[own], values[:, own], weights[:, own],
                "m", measured[:, own], np.zeros(len(values), bool),
            )  # fmt: skip
        return out


def _exchanged(channels: Channels, swapped: NDArray) -> tuple[NDArray, NDArray]:
    """Pixels (F, N, 2) and confidences (F, N), 0 where undetected, with the channels `swapped` (F, N) exchanged."""
    if len(swapped) == len(channels.uv) and not swapped.any():
        undetected = ~np.isfinite(channels.uv).all(axis=2) & (channels.confidence != 0.0)
        return channels.uv, np.where(undetected, 0.0, channels.confidence) if undetected.any() else channels.confidence
    uv, confidence = room((*swapped.shape, 2)), room(swapped.shape)
    for some in stretches(len(swapped)):
        order = np.where(swapped[some], channels.partner, np.arange(swapped.shape[1]))
        uv[some] = np.take_along_axis(channels.uv[some], order[:, :, None], axis=1)
        ordered = np.take_along_axis(channels.confidence[some], order, axis=1)
        confidence[some] = np.where(np.isfinite(uv[some]).all(axis=2), ordered, 0.0)
    release(uv, confidence)
    return uv, confidence


def _without_bias(body: Body, channels: Channels, uv: NDArray, roots: NDArray, angles: NDArray) -> NDArray:
    """Pixels (T, N, 2) minus the detectors' bias by view at states (T, 4, 4), (T, D); unchanged if no bias is known."""
    if channels.view_bias is None:
        return uv
    points = channels.points
    trunk, out = trunks(body.tree)[points.segments][channels.column], room(uv.shape)
    for some in stretches(len(out)):
        for f in range(*some.indices(len(out))):
            x = body.positions(BodyState(roots[f], angles[f]), points)[channels.column]
            frames, _ = body.tree.forward(roots[f], angles[f])
            out[f] = uv[f] - view_offset(channels.view_bias, trunk, x, frames, channels.rig, channels.camera)
        release(uv, out)
    return out


def _wider(array: NDArray, count: int) -> NDArray:
    """An array (T, K, ...) with so many columns; new ones are 0."""
    if array.shape[1] == count:
        return array
    out = room((len(array), count, *array.shape[2:]))
    out[:, : array.shape[1]] = array
    return out
