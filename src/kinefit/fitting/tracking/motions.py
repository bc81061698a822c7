"""From tracked frames to a motion: smoothed where that is asked for, with lasting errors in its deviations.

What a live session keeps of each frame, so that it becomes a motion like any other.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import check_shape
from kinefit._mapped import release, room
from kinefit.bodies import Body, BodyState
from kinefit.bodies.motion import UP_AXES, Motion, Residuals
from kinefit.errors import ObservationError, choices
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.smoothing.border import Border, shape_errors
from kinefit.fitting.smoothing.online.fixed_lag import FixedLag, KnownNoise
from kinefit.fitting.smoothing.sensor_noise import noise_of_sensors
from kinefit.fitting.smoothing.smoother import as_tracked, smooth_results
from kinefit.fitting.smoothing.spool import STRETCH, Spool
from kinefit.fitting.smoothing.tracked_frames import TrackedFrames, TrackerLike
from kinefit.fitting.smoothing.uncertainty import (
    MOTION_CORRELATION_TIME,
    asked_frames,
    with_systematic_errors,
)
from kinefit.fitting.smoothing.unwrap import unwrap
from kinefit.fitting.subject.subject import Subject, SubjectFit
from kinefit.fitting.tracking.cameras import CAMERAS, LOOKS, as_record, cameras_apart, composed, contradictions
from kinefit.fitting.tracking.recording import spread
from kinefit.geometry.losses import SQUARED
from kinefit.observations.arrays import numbers
from kinefit.sensors.base import Leftover, Matched, leftovers_at
from kinefit.sensors.points.keypoints import KeypointMatched, KeypointMeasurement, Layout, pixels_and_others, pixels_of
from kinefit.sensors.scene import Scene


@dataclass(frozen=True, eq=False)
class Estimation:
    """How the poses of single frames become a motion.

    Parameters
    ----------
    smooth : fit all frames together with a motion prior
    contacts : hold the soles still where they rest on a level floor, when smoothing
    eye : (3,) [m] of the camera that is the only sensor: soles are then held where they hardly move in its image
    level : whether the vertical was measured; otherwise soles are held on the plane that they rest on, when smoothing
    lag : [s], instead of smoothing: each frame knows of those before it, and of later ones so far ahead alone
    noise : that is known beforehand, for a lag
    """

    smooth: bool = True
    contacts: bool = False
    eye: NDArray | None = None
    level: bool = True
    lag: float | None = None
    noise: KnownNoise | None = None


def motion_of(
    frames: TrackedFrames, subject: Subject, how: Estimation, *, up: str = "z",
    name: str = "motion", more: Mapping[str, Any] | None = None, found: Sequence[SubjectFit] = (),
) -> Motion:  # fmt: skip
    """The motion of what was tracked.

    Parameters
    ----------
    frames : TrackedFrames
    subject : Subject, with the body; its lengths are taken for exact where it does not tell how sure they are.
    up, name : of the motion
    more : further entries of `Motion.provenance`
    found : what all sensors were fitted with together, with its covariance
    """
    tracker, results = frames.tracker, frames.results
    body, settings, rate = tracker.body, tracker.settings, tracker.rate
    smooth, lag, eye = how.smooth, how.lag, how.eye
    provenance: dict[str, Any] = dict(more or {})
    matched: Sequence[tuple[Matched, ...]] | None = None  # of all sensors but keypoints and packed markers
    if smooth:
        held = how.contacts or eye is not None or not how.level
        border = next(filter(None, map(Border.of, found)), None)
        done = smooth_results(
            frames, contacts=held, up=up, eye=eye, level=how.level, border=border
        )
        results, take = done.results, done.take
        provenance["smoothing"] = done.provenance
        matched = done.matched
        if done.border is not None:
            found = [done.border.applied(one) for one in found]
            provenance["shape"] = dict(item for one in found for item in one.record().items())
    else:
        if lag is not None:
            results, matched, provenance["fixed lag"] = _behind(frames, lag, how.noise)
        take = as_tracked(replace(frames, results=results))
        if take.others is not None and lag is None:
            of = take.others
            matched = Spool(of.matched(of.scene(f, take.roots, take.angles)) for f in range(len(results)))
    others, channels, markers = take.others, take.pixels.channels, take.markers
    packed, weight = set(markers.sensors), take.pixels.weights(body, take.roots, take.angles)
    if lag is not None and packed and matched is not None:
        matched = Spool(tuple(m for m in several if m.sensor not in packed) for several in matched)

    def seen(f: int) -> tuple[Scene, list[Matched]]:
        """A frame's scene, with the body where it is when each sensor measured, and all that was matched in it."""
        r = results[f]
        scene = tracker.scene_of(r.state, r.time) if others is None else others.scene(f, take.roots, take.angles)
        return scene, [*r.matched, *(() if matched is None else matched[f])]

    def with_markers(f: int) -> tuple[Scene, list[Matched]]:
        """The same, with packed markers."""
        scene, several = seen(f)
        return scene, [*several, *markers.matched(f, (), scene)]

    provenance["contradictions"] = contradictions(*zip(*(with_markers(int(f)) for f in spread(len(results), LOOKS))))
    residuals = markers.residuals(body, take.roots, take.angles)
    if not packed or channels.sources or (others is not None and others.scale):
        again = seen if smooth or lag is not None else None
        residuals = _residuals(frames.results, again, packed) | residuals
    take.pixels.release()
    release(weight)
    stated = {name: float(np.median(channels.sigma[channels.source == q])) for q, name in enumerate(channels.sources)}
    provenance["contradictions"] |= cameras_apart(residuals, stated)
    # the tracker's own frames hold the surfaces' errors already
    noise_of_others = noise_of_sensors(
        take, matched, half=round(MOTION_CORRELATION_TIME * rate), surfaces=smooth or lag is not None,
        frames=asked_frames(len(results), rate),
    )  # fmt: skip
    if take.others is not None or packed:
        provenance["sensor noise"] = noise_of_others.summary()

    def weighed(f: int) -> tuple[Scene, list[Matched]]:
        """The same with keypoints as they took part."""
        scene, several = with_markers(f)
        pixels, others = pixels_and_others(several)
        return scene, [*(replace(m, weight=weight[f], loss=SQUARED) for m in pixels), *others]

    scale = take.scale
    answers = [partial(shape_errors, one, settings, weighed, scale=scale) for one in found]
    if cameras := as_record(found):
        provenance[CAMERAS] = composed(provenance.get(CAMERAS, {}), cameras)
    elsewhere = any(one.cameras is not None for one in found)
    last, detectors, lasting = with_systematic_errors(
        results, subject, take, weight, noise_of_others, answers,
        cameras=None if elsewhere else settings.camera_errors, smoothed=smooth,
    )  # fmt: skip
    if channels.sources:
        provenance["detector noise"] = detectors.summary("px", 2, channels.sources)
    if channels.view_bias is not None and subject.view_bias is not None:
        provenance["view bias"] = subject.view_bias.as_record()
    provenance["length_std_m"] = subject.length_std
    alone = "filtered" if frames.markers is None else "each frame alone"
    provenance["estimate"] = "smoothed" if smooth else alone if lag is None else "fixed lag"
    arrays = _arrays(last, body, len(results), frames.looked)
    return Motion(
        body=body, rate=rate, times=frames.times, **arrays, residuals=residuals, up=up,
        name=name, provenance=provenance, lasting=lasting,
    )  # fmt: skip


def _arrays(results: Iterable[FrameResult], body: Body, frames: int, looked: NDArray | None) -> dict[str, Any]:
    """Arrays of a motion of so many frames; between two looks its quality is the lower one of both."""
    segments, D = len(body.tree.segments), len(body.tree.coordinates)
    shapes = {
        "Ts_world_root": (4, 4), "angles": (D,), "dof_std": (6 + D,), "joint_std": (segments, 3), "quality": (),
        "segment_quality": (segments,),
    }  # fmt: skip
    out = {name: np.empty((frames, *shape)) for name, shape in shapes.items()}
    for f, r in enumerate(results):
        out["Ts_world_root"][f], out["angles"][f] = r.state.T_world_root, r.state.angles
        for name in ("dof_std", "joint_std", "quality", "segment_quality"):
            out[name][f] = getattr(r, name)
    if looked is not None and 0 < np.count_nonzero(looked) < frames:
        at, skipped = np.flatnonzero(looked), np.flatnonzero(~looked)
        after = np.searchsorted(at, skipped)
        ends = [at[np.clip(k, 0, len(at) - 1)] for k in (after - 1, after)]
        for name in ("quality", "segment_quality"):
            out[name][skipped] = np.minimum(*(out[name][k] for k in ends))
    for array in out.values():
        array.flags.writeable = False  # for a motion to take them as they are
    return out


def _behind(
    frames: TrackedFrames, lag: float, noise: KnownNoise | None
) -> tuple[Spool[FrameResult], Spool[tuple[Matched, ...]], dict[str, Any]]:
    """All frames as a live session has them a lag [s] behind, with angles that go on; and what there is to tell.

    Beside the results, which have the matches of keypoints alone, those of all other sensors.
    """
    behind, body = FixedLag(frames.tracker, lag, noise=noise), frames.tracker.body
    out, matched = Spool[FrameResult](), Spool[tuple[Matched, ...]]()

    def take(late: list[FrameResult]) -> None:
        for r in late:
            pixels, others = pixels_and_others(r.matched)
            matched.append(tuple(others))
            out.append(replace(r, matched=tuple(pixels)))

    for result in frames.results:
        take(behind.add(result, result.measurements, ahead=1))
    take(behind.finish())
    angles = unwrap(body.tree, np.stack([r.state.angles for r in out]))
    late = Spool(replace(r, state=BodyState(r.state.T_world_root, q)) for r, q in zip(out, angles))
    return late, matched, {"seconds": round(behind.seconds, 4), **behind.noise.as_record(body)}


def _residuals(
    tracked: Sequence[FrameResult], seen: Callable[[int], tuple[Scene, list[Matched]]] | None, without: Collection[str]
) -> dict[str, Residuals]:
    """Residuals of all sensors but some: as the frames were tracked, or of what was matched since."""
    remains = Remains(len(tracked))
    for f in range(len(tracked)):
        if f % STRETCH == 0:
            remains.release()
        if seen is None:
            remains.add(f, (rest for rest in tracked[f].leftovers if rest.label not in without))
            continue
        scene, matched = seen(f)
        remains.add(f, (rest for m in matched for rest in leftovers_at(m, scene)))
    remains.release()
    return remains.residuals()


@dataclass(eq=False)
class _OfSensor:
    """Columns of names, and arrays (F, K, ...) of which the last axis but one grows with them."""

    unit: str
    surface: bool
    swapped: NDArray
    arrays: dict[str, NDArray]
    place: dict[str, int] = field(default_factory=dict)
    segments: list[int] = field(default_factory=list)


class Remains:
    """Collects the residuals of F frames, in any order.

    Parameters
    ----------
    frames : F
    """

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._of: dict[str, _OfSensor] = {}

    def add(self, f: int, leftovers: Iterable[Leftover]) -> None:
        """Of frame `f`; of several of one sensor the last counts."""
        for rest in {rest.label: rest for rest in leftovers}.values():
            of = self._of.get(rest.label)
            if of is None:
                of = self._of[rest.label] = self._empty(rest)
            columns = self._columns(of, rest)
            for name, values in (("values", rest.values), ("weights", rest.weights), ("measured", rest.measured)):
                of.arrays[name][f, columns] = values
            of.swapped[f] = rest.swapped
            if of.surface and rest.rms is not None and rest.count is not None:
                of.arrays["rms"][f, columns], of.arrays["count"][f, columns] = rest.rms, rest.count

    def release(self) -> None:
        """Give back the memory of what was added so far: it lies in files where it is much."""
        for of in self._of.values():
            release(*of.arrays.values())

    def residuals(self, frames: Sequence[int] | None = None) -> dict[str, Residuals]:
        """Of all frames, or of some of them, by sensor."""
        which = slice(None) if frames is None or len(frames) == self._frames else np.asarray(frames, np.int64)
        return {
            label: Residuals(
                names=tuple(of.place), segments=np.array(of.segments, np.int64), unit=of.unit,
                swapped=of.swapped[which], **{name: array[which] for name, array in of.arrays.items()},
            )
            for label, of in self._of.items()
        }  # fmt: skip

    def _empty(self, rest: Leftover) -> _OfSensor:
        F, N = self._frames, rest.values.shape[1]
        arrays = {"values": np.empty((F, 0, N)), "weights": np.empty((F, 0)), "measured": np.empty((F, 0, N))}
        surface = rest.count is not None
        if surface:
            arrays |= {"rms": np.empty((F, 0)), "count": np.empty((F, 0))}
        return _OfSensor(rest.unit, surface, np.zeros(F, bool), arrays)

    def _columns(self, of: _OfSensor, rest: Leftover) -> list[int]:
        """Places of its names; new ones are unseen in all frames so far."""
        before = len(of.place)
        for name, segment in zip(rest.names, rest.segments):
            if name not in of.place:
                of.place[name] = len(of.place)
                of.segments.append(int(segment))
        more = len(of.place) - before
        if more:
            for name, array in of.arrays.items():
                of.arrays[name] = larger = room((len(array), before + more, *array.shape[2:]))
                larger[:, :before] = array
                larger[:, before:] = 0.0 if name in ("weights", "count") else np.nan
        return [of.place[name] for name in rest.names]


class Session:
    """Frames of a live session, one a step of its rate: steps that were dropped are kept as frames that see nothing.

    Parameters
    ----------
    rate : float [Hz]
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.clear()

    def __len__(self) -> int:
        return len(self._results)

    def clear(self) -> None:
        """Begin anew: another body, or another clock."""
        self._results = Spool[FrameResult]()

    def _append(self, one: FrameResult) -> None:
        self._results.append(one)
        self._last = one

    def add(self, result: FrameResult, scene: Scene) -> None:
        """Keep a result; a time before that of the last frame begins anew."""
        new = result.kept(scene)
        if not len(self):
            self._append(new)
            return
        last = self._last
        ahead = round((result.time - last.time) * self.rate)
        if result.time < last.time:
            self.clear()
            self._append(new)
        elif ahead == 0:
            self._results[-1] = self._last = last.joined(new)
        else:
            gap = result.time - last.time
            for k in range(1, ahead):
                self._append(unseen(last, last.time + gap * k / ahead))
            self._append(new)

    def frames(self, tracker: TrackerLike) -> TrackedFrames:
        """All of them, with the keypoints of whatever cameras in one layout."""
        results = in_one_layout(tracker.body, self._results[:])
        return TrackedFrames(results, np.array([r.time for r in results]), tracker)


def unseen(last: FrameResult, time: float) -> FrameResult:
    """Add a frame without measurements after a result."""
    segments = np.zeros(len(last.hidden), bool)
    return FrameResult(
        time, last.state, np.full_like(last.dof_std, np.inf), np.full_like(last.joint_std, np.inf),
        np.zeros_like(last.segment_quality), segments, ~segments, 0.0, 0,
    )  # fmt: skip


def in_one_layout(body: Body, results: Sequence[FrameResult]) -> Sequence[FrameResult]:
    """Results (F,) with their keypoints in one layout of all cameras, whatever cameras took part in each."""
    matches = [pixels_of(r.matched) for r in results]
    layouts = {id(m.measurement.layout): m.measurement.layout for several in matches for m in several}
    if len(layouts) < 2 and max(map(len, matches)) < 2:
        return results
    streams: dict[tuple[str, str], dict[str, None]] = {}
    for one in layouts.values():
        for camera, keypoint_set, names in one.streams:
            streams.setdefault((camera, keypoint_set), {}).update(dict.fromkeys(names))
    sensor = next(several[-1] for several in reversed(matches) if several).measurement.of
    layout, _ = sensor.layout(body, [(*key, tuple(names)) for key, names in streams.items()])
    place = {point: k for k, point in enumerate(layout.of_streams)}
    columns = {key: np.array([place[point] for point in one.of_streams], np.int64) for key, one in layouts.items()}
    return Spool(
        replace(r, matched=(_together(several, columns, layout, r.time),) if several else ())
        for r, several in zip(results, matches)
    )


def _together(
    several: Sequence[KeypointMatched], columns: dict[int, NDArray], layout: Layout, time: float
) -> KeypointMatched:
    """Matches of one time in another layout."""
    N = len(layout.points)
    uv, confidence, swapped, hidden = np.full((N, 2), np.nan), np.zeros(N), np.zeros(N, bool), []
    sides_known = np.zeros(N, bool)
    for m in several:
        column, of = columns[id(m.measurement.layout)], m.measurement
        seen = of.confidence > 0.0
        uv[column[seen]], confidence[column[seen]], swapped[column] = of.uv[seen], of.confidence[seen], m.swapped
        sides_known[column] = False if of.sides_known is None else of.sides_known
        hidden += [replace(h, index=column[h.index], far=column[h.far]) for h in m.hidden]
    measurement = KeypointMeasurement(several[0].measurement.of, layout, uv, confidence, time, sides_known)
    order = np.where(swapped, layout.channels.partner, np.arange(N))
    return KeypointMatched(
        measurement, np.ascontiguousarray(measurement.uv[order]), np.ascontiguousarray(measurement.weight[order]),
        swapped, several[0].loss, tuple(hidden),
    )  # fmt: skip


def axis_of(up: NDArray) -> str:
    """Name of the axis of the world that is nearest to a direction (3,)."""
    return max(UP_AXES, key=lambda name: float(np.dot(up, UP_AXES[name])))


def up_vector(up: str | ArrayLike) -> NDArray:
    """(3,) upwards in the world, of the name of an axis ("z", "-y", ...) or of three numbers.

    Raises
    ------
    ObservationError
        No such axis; not three numbers.
    """
    if isinstance(up, str) and up not in UP_AXES:
        raise ObservationError(choices("vertical axis", up, UP_AXES))
    vector = numbers(UP_AXES[up] if isinstance(up, str) else up, float, "up")
    check_shape(vector, (3,), "up")
    return vector
