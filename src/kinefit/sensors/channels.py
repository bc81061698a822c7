"""Channels: every keypoint of every camera as one flat list, the form in which a frame is tracked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import ObservationError, check_choice
from kinefit.geometry.camera import Rig
from kinefit.observations import Keypoints
from kinefit.observations.recordings import mirror_name
from kinefit.sensors.base import Matched
from kinefit.solving.rows import AnyRows, DofRows, Rows


@dataclass(frozen=True, eq=False)
class Channels:
    """N measurements a frame: one for each source (a camera's detector) and point.

    Parameters
    ----------
    rig : Rig
    points : PointSet of the K points of all keypoint sets in use, set after set.
    sets : {keypoint set: slice of its points}
    sources : (Q,) names, one for each Keypoints record.
    source, camera, column : (N,) int
        Which record, which camera of the rig, which of the K points.
    partner : (N,) int
        Channel of the same source with left and right exchanged; itself for a point in the middle.
    sigma : (N,) [px] standard deviation at full confidence.
    uv : (F, N, 2) [px], NaN where unobserved.
    confidence : (F, N) in 0..1
    sides_known : (F, N) bool, channels whose left and right are stated and stay; None: no channel's
    view_bias : (N, 5, 3) [m] bias of keypoints seen from each side of the body, see `ViewBias`; None if unknown.
    view_followed : (N,) share of a channel's systematic error that the bias has absorbed, and residuals no longer show.
    """

    rig: Rig
    points: PointSet
    sets: dict[str, slice]
    sources: tuple[str, ...]
    source: NDArray
    camera: NDArray
    column: NDArray
    partner: NDArray
    sigma: NDArray
    uv: NDArray
    confidence: NDArray
    sides_known: NDArray | None = None
    view_bias: NDArray | None = None
    view_followed: NDArray | None = None

    @property
    def weight(self) -> NDArray:
        """(F, N) [1/px²] confidence / σ², 0 where unobserved: half the confidence is twice the variance."""
        seen = np.isfinite(self.uv).all(axis=-1)
        return np.where(seen, self.confidence / np.square(self.sigma), 0.0)

    @property
    def each(self) -> PointSet:
        """The body's point of each channel (N,)."""
        names = tuple(self.points.names[c] for c in self.column)
        return PointSet(names, self.points.segments[self.column], self.points.points[self.column])

    def part(self, frames: Sequence[int]) -> Channels:
        """The same channels in some frames."""
        if len(frames) == len(self.uv) and np.array_equal(frames, np.arange(len(self.uv))):
            return self
        sides_known = None if self.sides_known is None else self.sides_known[frames]
        return replace(self, uv=self.uv[frames], confidence=self.confidence[frames], sides_known=sides_known)

    @classmethod
    def none(cls, rig: Rig, frames: int) -> Channels:
        """No keypoints in so many frames."""
        numbers, points = np.zeros(0, np.int64), PointSet((), np.zeros(0, np.int64), np.zeros((0, 3)))
        return cls(
            rig, points, {}, (), numbers, numbers, numbers, numbers, np.zeros(0), np.zeros((frames, 0, 2)),
            np.zeros((frames, 0)),
        )  # fmt: skip

    def with_points(self, body: Body) -> Channels:
        """The same measurements of another body's points."""
        parts = [known_points(body, name).select(self.points.names[span]) for name, span in self.sets.items()]
        return replace(self, points=joined(parts))


def known_points(body: Body, keypoint_set: str) -> PointSet:
    """Points of a keypoint set on a body; the body's landmarks for no set ("")."""
    return body.keypoints(keypoint_set) if keypoint_set else body.landmarks


def joined(parts: Sequence[PointSet]) -> PointSet:
    """Several point sets as one."""
    return PointSet(
        tuple(n for p in parts for n in p.names),
        np.concatenate([np.zeros(0, np.int64), *(p.segments for p in parts)]),
        np.concatenate([np.zeros((0, 3)), *(p.points for p in parts)]),
    )


def known_names(body: Body, rig: Rig, keypoints: Sequence[Keypoints]) -> dict[str, list[str]]:
    """{keypoint set: points of the body in some record}; raises as `make_channels`."""
    names: dict[str, list[str]] = {}
    for record in keypoints:
        check_choice("camera", record.camera, rig.names, ObservationError, file=record.source or None)
        known = known_points(body, record.keypoint_set).names
        used = names.setdefault(record.keypoint_set, [])
        used += [n for n in dict.fromkeys(record.names) if n in known and n not in used]
    for name, chosen in names.items():
        if not chosen:
            remedy = "Use another body, or another set in [[keypoints]]."
            raise ObservationError(f"body '{body.name}' has none of the points of {name}", remedy=remedy)
    return names


def make_channels(
    body: Body, rig: Rig, keypoints: Sequence[Keypoints], sigma: Sequence[float]
) -> Channels:
    """Channels of one person.

    Parameters
    ----------
    keypoints : Q records of the person alone, all of the same frames; see `multiview.association.person_records`.
    sigma : (Q,) [px] standard deviation of each record.

    Raises
    ------
    ObservationError, BodyError
        No keypoints; a camera that the rig does not have; a keypoint set that the body does not know.
    """
    if not keypoints:
        raise ObservationError("there are no keypoints to track", remedy="Add at least one [[keypoints]] to the take.")
    names = known_names(body, rig, keypoints)
    sets, parts, start = {}, [], 0
    for name, chosen in names.items():
        parts.append(known_points(body, name).select(tuple(chosen)))
        sets[name] = slice(start, start := start + len(chosen))
    source: list[int] = []
    camera: list[int] = []
    column: list[int] = []
    partner: list[int] = []
    spread: list[float] = []
    columns_of_all = sum(len(names[record.keypoint_set]) for record in keypoints)
    uv = room((len(keypoints[0]), columns_of_all, 2))
    confidence = room(uv.shape[:2])
    for q, record in enumerate(keypoints):
        span, chosen = sets[record.keypoint_set], names[record.keypoint_set]
        first = len(source)
        own = slice(first, first + len(chosen))
        mirrored = [mirror_name(n) for n in chosen]
        partner += [first + (chosen.index(m) if m in chosen else i) for i, m in enumerate(mirrored)]
        source += [q] * len(chosen)
        camera += [rig.index(record.camera)] * len(chosen)
        column += list(range(span.start, span.stop))
        spread += [float(sigma[q])] * len(chosen)
        lacking = np.array([n not in record.names for n in chosen], bool)
        columns = [0 if none else record.names.index(n) for n, none in zip(chosen, lacking)]
        uv[:, own] = np.where(lacking[:, None], np.nan, record.points[:, 0, columns])
        confidence[:, own] = np.where(lacking, 0.0, np.nan_to_num(record.confidence[:, 0, columns]))
        release(record.points, record.confidence, uv, confidence)
    stated = [record.sides_known for record in keypoints]
    sides = [np.zeros(len(uv), bool) if known is None else known for known in stated]
    twice = {r.camera for r in keypoints if sum(o.camera == r.camera for o in keypoints) > 1}
    labels = tuple(f"{r.camera} {r.keypoint_set}" if r.camera in twice else r.camera for r in keypoints)
    return Channels(
        rig, joined(parts), sets, labels, np.array(source), np.array(camera), np.array(column), np.array(partner),
        np.array(spread), uv, confidence,
        np.stack([sides[q] for q in source], axis=1) if any(known is not None for known in stated) else None,
    )  # fmt: skip


def fitted_pixels(body: Body, channels: Channels, state: BodyState) -> NDArray:
    """(N, 2) [px] projections of every channel's point at a state; NaN behind the camera."""
    return channels.rig.project(body.positions(state, channels.points)[channels.column], channels.camera)


def exchange(channels: Channels, frame: NDArray, swapped: NDArray) -> NDArray:
    """Values (N, ...) of one frame with left and right exchanged in the sources marked in swapped (Q,)."""
    order = np.where(swapped[channels.source], channels.partner, np.arange(len(channels.partner)))
    return frame[order]


_MIN_FRAMES = 10  # named measurements of a sensor; in fewer, no channel may have been seen twice

Channel = tuple[str | int, ...]
"""Part of the match (of numbered channels only), name or measurement id, number of rows; of a surface: the segment."""


class ChannelNames:
    """The channels of every sensor of a take; checks that their names stay the same from frame to frame."""

    def __init__(self) -> None:
        self._named: dict[str, bool] = {}
        self._numbered: dict[tuple[str, int], bytes] = {}
        self._names: dict[str, tuple[set[str], int, int]] = {}

    def channels(self, matched: Matched, parts: Sequence[AnyRows]) -> list[tuple[list[Channel], NDArray]]:
        """Channels of every part of a match, and (2, N) the channel and axis of each row.

        Parameters
        ----------
        matched : Matched; unless its rows are single points, their segments are the channels
        parts : its rows

        Raises
        ------
        ObservationError
            Names that are no text, or not each a different one; a measurement id without a name; a sensor that names
            its channels at some times only, or anew at every time; numbered channels that change.
        """
        sensor = matched.sensor
        out, used = list[tuple[list[Channel], NDArray]](), set[str]()
        if not matched.of_points:
            for rows in parts:
                segment = getattr(rows, "segment", None)
                ids, index = np.unique(np.zeros(len(rows)) if segment is None else segment, return_inverse=True)
                out.append(([(int(k),) for k in ids], np.stack([index, np.zeros_like(index)])))
            return out
        names = self.check_names(matched)
        for k, rows in enumerate(parts):
            ids, index, count = np.unique(_ids(rows), return_inverse=True, return_counts=True)
            if names is None:
                if len(ids) and self._numbered.setdefault((sensor, k), ids.tobytes()) != ids.tobytes():
                    raise ObservationError(
                        f"the channels of sensor '{sensor}' have no names, but their number changes",
                        remedy="Name the channel of each measurement id: RowsOf(rows, channels=names).",
                    )
            elif len(ids) and ids[-1] >= len(names):
                problem = f"sensor '{sensor}' names {len(names)} channels, but has rows of measurement id {ids[-1]}"
                raise ObservationError(problem, remedy="Give one name for each measurement id, `Rows.group`.")
            keys: list[Channel] = [(k, i) if names is None else (names[i],) for i in ids.tolist()]
            used.update(() if names is None else (names[i] for i in ids))
            axis = np.empty(len(index), np.int64)
            axis[np.argsort(index, kind="stable")] = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
            out.append(([(*key, rows) for key, rows in zip(keys, count.tolist())], np.stack([index, axis])))
        if used:
            self._check_return(sensor, used)
        return out

    def check_names(self, matched: Matched) -> Sequence[str] | None:
        """The names of a match's channels; raises ObservationError if no text, not unique or not always given."""
        names, sensor = matched.channels, matched.sensor
        if self._named.setdefault(sensor, names is not None) != (names is not None):
            raise ObservationError(
                f"sensor '{sensor}' names its channels in some measurements, but not in all",
                remedy="Name them in all. If two sensors have this name, give each its own.",
            )
        if names is not None and (isinstance(names, str) or not all(isinstance(n, str) for n in names)):
            raise ObservationError(f"channels of sensor '{sensor}' are not text", remedy="Give a list of names.")
        if names is not None and len(set(names)) < len(names):
            twice = next(n for n in names if list(names).count(n) > 1)
            raise ObservationError(f"sensor '{sensor}' has two channels '{twice}'", remedy="Give each another name.")
        return names

    def check_step(self, matched: Sequence[Matched]) -> None:
        """Raise ObservationError if two measurements of one time share a channel: two sensors use one name."""
        seen = set[tuple[str, float, str]]()
        for m in matched:
            if m.of_points:
                names = self.check_names(m)
                keys = {(m.sensor, m.time, name) for name in (("",) if names is None else names)}
                if both := seen & keys:
                    problem = f"two measurements of sensor '{m.sensor}' at {m.time:g} s"
                    problem += f" have a channel '{min(both)[2]}'" if names is not None else ""
                    raise ObservationError(problem, remedy="If two sensors have this name, give each its own.")
                seen |= keys

    def _check_return(self, sensor: str, used: set[str]) -> None:
        known, frames, total = self._names.get(sensor, (set(), 0, 0))
        known, frames, total = known | used if used - known else known, frames + 1, total + len(used)
        if frames >= _MIN_FRAMES and len(known) == total:
            raise ObservationError(
                f"sensor '{sensor}' has new channel names at every time: {', '.join(sorted(used)[:3])}",
                remedy="Name a channel after its source, such as a marker, not after its time.",
            )
        self._names[sensor] = known, frames, total


def _ids(rows: AnyRows) -> NDArray:
    """(N,) measurement id of each row; where rows have none, each is its own measurement."""
    if not isinstance(rows, Rows | DofRows):
        return np.arange(len(rows))
    return np.where(rows.group < 0, np.arange(len(rows)), rows.group) if rows.group.min(initial=0) < 0 else rows.group


class ChannelResiduals:
    """Residuals of the sensors of a take, frame by frame.

    A point's rows are the axes of its channel. All rows of a segment's surface are one axis of that segment's channel:
    their errors are alike over a patch.
    """

    def __init__(self) -> None:
        self._names = ChannelNames()
        self._columns: dict[str, dict[tuple[str | int, ...], int]] = {}
        self._entries: dict[str, list[NDArray]] = {}

    def add(
        self, frame: int, matched: Matched, parts: Sequence[AnyRows], values: Sequence[NDArray],
        weights: Sequence[NDArray],
    ) -> list[NDArray]:  # fmt: skip
        """Add the rows of one match; (2, N) the channel's number within its sensor and the axis of each row, by part.

        Parameters
        ----------
        frame : number of the frame
        matched : Matched
        parts : its rows
        values : of each part (N,) residuals
        weights : of each part (N,) for the mean of several rows of one axis; 0 excludes a row

        Raises
        ------
        ObservationError
            Channels whose identity is not certain, see `ChannelNames.channels`.
        """
        columns, out = self._columns.setdefault(matched.sensor, {}), []
        for (own, at), value, weight in zip(self._names.channels(matched, parts), values, weights):
            number = np.array([columns.setdefault(channel, len(columns)) for channel in own], np.int64)
            out.append(np.stack([number[at[0]], at[1]]))
            entries = np.vstack([np.full(len(value), frame), out[-1], value, weight])
            self._entries.setdefault(matched.sensor, []).append(entries[:, weight > 0.0])
        return out

    def arrays(self, frames: int) -> dict[str, tuple[NDArray, NDArray]]:
        """{sensor: residuals (F, C, A), NaN if unobserved, and (F, C, A) the number of rows of each mean}."""
        out = {}
        for sensor, parts in self._entries.items():
            found = np.concatenate(parts, axis=1)
            axes = int(found[2].max(initial=0)) + 1
            shape = frames, len(self._columns[sensor]), axes
            index = np.ravel_multi_index(tuple(found[:3].astype(np.int64)), shape)
            size = int(np.prod(shape))
            total, count = np.bincount(index, found[4], size), np.bincount(index, minlength=size)
            mean = np.bincount(index, found[4] * found[3], size) / np.where(count > 0, total, np.nan)
            out[sensor] = mean.reshape(shape), count.reshape(shape)
        return out
