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
        if not parts:
            return self
        return replace(self, points=joined(parts))


def known_points(body: Body, keypoint_set: str) -> PointSet:
    """Points of a keypoint set on a body; the body's landmarks for no set ("")."""
    return body.keypoints(keypoint_set) if keypoint_set else body.landmarks


def joined(parts: Sequence[PointSet]) -> PointSet:
    """Several point sets as one."""
    return PointSet(
        tuple(n for p in parts for n in p.names),
        np.concatenate([p.segments for p in parts]),
        np.concatenate([p.points for p in parts]),
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
    x = body.positions(state, channels.points)[channels.column]
    out = np.empty((len(x), 2))
    for c, camera in enumerate(channels.rig):
        in_camera = channels.camera == c
        out[in_camera] = camera.project(x[in_camera])
    return out


def exchange(channels: Channels, frame: NDArray, swapped: NDArray) -> NDArray:
    """Values (N, ...) of one frame with left and right exchanged in the sources marked in swapped (Q,)."""
    order = np.where(swapped[channels.source], channels.partner, np.arange(len(channels.partner)))
    return frame[order]
