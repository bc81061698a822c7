"""Tracked points of a surface: each sticks to the place of the body where it was first seen (P4-5, P4-11).

A point that was not seen before is drawn to the nearest surface, as one of a cloud. Once the limb rests in the cloud,
so that places of points on it no longer wander from step to step, they are anchored where they lie on its segment; from
then on each says in all three directions where that place is, so that turns about a limb's own axis are seen. Anchors
are what the sensor learnt, not parameters: skin slides on the bone by `slide`. How a limb was turned about its bone
when its first points were anchored they never tell: that deviation lasts, for all of its points together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.surfaces import SurfaceAnchors
from kinefit.correspondences import surface_rows
from kinefit.errors import ObservationError
from kinefit.observations import SurfacePointFrame
from kinefit.rows import AnyRows, Rows
from kinefit.sensors.base import Leftover, Matched, Measurement, Sensor, by_segments
from kinefit.sensors.checks import of_kind
from kinefit.sensors.scene import Scene
from kinefit.sensors.surfaces.surface_match import SurfacePairs

_SETTLED = 0.05  # of the slide, by which places on a limb may wander from step to step: 0.5 mm, a degree of a thin arm
_PATIENCE = 10  # steps after which a limb counts as settled: a cloud does not tell a round one's turn at all
_AGREES = 3.0  # standard deviations from the surface within which a new point is anchored
Anchor = tuple[int, NDArray]


class SurfacePointSensor(Sensor):
    """A surface that is tracked: skin, a sleeve. Give it to `Tracker(..., sensors=[...])` or to a `Recording`.

    Parameters
    ----------
    name : as its frames are named
    slide : float [m] standard deviation by which the surface slides on the bone, and the body's surface is off
    most : int, points that are used at a time, spread evenly
    """

    state_attributes = ("anchors", "turns", "_last", "_waited")

    def __init__(self, name: str, *, slide: float = 0.01, most: int = 400) -> None:
        if not (0 < slide < np.inf) or most < 1:
            raise ObservationError(f"a slide of {slide} m, {most} points", remedy="Give positive numbers.")
        self.name, self.slide, self.most = name, float(slide), int(most)
        self.anchors: Mapping[int, Anchor] = {}
        self.turns: Mapping[int, NDArray] = {}  # of segments, until they got their first anchor; see `Matched`
        self._last: Mapping[int, Anchor] = {}  # places of points on limbs that have not settled
        self._waited: Mapping[int, int] = {}  # steps of each such limb

    def prepare(self, frame: SurfacePointFrame, scene: Scene) -> SurfacePointMeasurement:
        """Points with an anchor first, then new ones, no more than `most`."""
        of_kind(frame, SurfacePointFrame, f"a frame of the sensor '{self.name}'", "Give what it saw in such a record.")
        known = np.array([int(i) in self.anchors for i in frame.ids], bool)
        order = np.concatenate([np.flatnonzero(known), np.flatnonzero(~known)])
        if len(order) > self.most:
            order = order[np.linspace(0, len(order) - 1, self.most).astype(int)]
        mean = np.trace(frame.covariance[order], axis1=1, axis2=2) / 3.0
        ids = frame.ids[order]
        anchors = {int(i): self.anchors[int(i)] for i in ids if int(i) in self.anchors}
        turns = {s: self.turns[s] for s in {s for s, _ in anchors.values()} & set(self.turns)}
        return SurfacePointMeasurement(
            frame.sensor, frame.time, ids, frame.x_world[order], mean + self.slide**2, self.slide, anchors, turns
        )

    def learn(self, measurement: SurfacePointMeasurement, scene: Scene, sure: bool) -> None:
        """Anchor new points on limbs that have settled; let go of those that left the limb they were given to.

        A point is let go where its place on the segment is far from where it is seen, while most points of the same
        segment agree: it belongs to another limb, or its path went astray. Its next frame gives it to the nearest.
        """
        if not sure:
            return
        lost = measurement.strayed(scene)
        if lost:
            self.anchors = {i: anchor for i, anchor in self.anchors.items() if i not in lost}
        new = measurement.new
        near = measurement.near(scene, new, _AGREES * self.slide)
        f = scene.frames[near.segment]
        gap = measurement.x_world[new][near.group] - f[:, 9:]
        rest = np.einsum("nji,nj->ni", f[:, :9].reshape(-1, 3, 3), gap)
        ids = measurement.ids[new][near.group]
        found = {int(i): (int(s), x) for i, s, x in zip(ids, near.segment, rest)}
        known = {s for s, _ in self.anchors.values()}
        settled = known | {s for s in {s for s, _ in found.values()} - known if self._rests(s, found)}
        self._last = {i: anchor for i, anchor in found.items() if anchor[0] not in settled}
        added = {i: anchor for i, anchor in found.items() if anchor[0] in settled}
        seen = {s for s, _ in found.values()} - known
        self.turns = {**self.turns, **{s: self._surest(s, scene) for s in seen}}
        if added:
            self.anchors = {**self.anchors, **added}

    def _surest(self, segment: int, scene: Scene) -> NDArray:
        """How surely a limb that waits for anchors was turned about its bone when that was known best."""
        now, before = _turn(scene, segment), self.turns.get(segment) if self._waited.get(segment, 0) > 1 else None
        return now if before is None or not before.any() or now @ now < before @ before else before

    def _rests(self, segment: int, found: Mapping[int, Anchor]) -> bool:
        """Whether places of points on a segment have stopped to wander, or have been waited for long enough."""
        waited = self._waited.get(segment, 0) + 1
        self._waited = {**self._waited, segment: waited}
        both = [i for i, (s, _) in found.items() if s == segment and self._last.get(i, (-1, None))[0] == segment]
        moved = [float(np.linalg.norm(found[i][1] - self._last[i][1])) for i in both]
        return waited > _PATIENCE or (len(moved) > 2 and float(np.median(moved)) < _SETTLED * self.slide)


def _turn(scene: Scene, segment: int) -> NDArray:
    """(3,) [rad] in its frame: standard deviation of how a segment is turned about its bone, by the scene's state."""
    bone = scene.body.segment_ends().get(segment)
    if bone is None or scene.covariance is None or not np.any(bone):
        return np.zeros(3)
    J = scene.segment_jacobian(segment)
    bone = bone / np.linalg.norm(bone)
    by = scene.frames[segment, :9].reshape(3, 3) @ bone @ J[3:]
    return np.asarray(bone * np.sqrt(max(by @ scene.covariance @ by, 0.0)))


@dataclass(frozen=True, eq=False)
class SurfacePointMeasurement(Measurement):
    """Points of one time.

    Parameters
    ----------
    sensor, time, ids, x_world : as of the frame
    variance : (N,) [m²] with the slide
    slide : float [m]
    anchors : {id: (segment, place in its frame (3,) [m])} of its points, as known then
    turns : {segment: (3,) [rad]} of those, see `Matched`
    """

    sensor: str
    time: float
    ids: NDArray
    x_world: NDArray
    variance: NDArray
    slide: float
    anchors: Mapping[int, Anchor]
    turns: Mapping[int, NDArray]
    settled = False

    @property
    def new(self) -> NDArray[np.int64]:
        """(M,) indices of points without an anchor."""
        return np.flatnonzero([int(i) not in self.anchors for i in self.ids])

    def strayed(self, scene: Scene) -> set[int]:
        """Points that are far from their anchors, on segments where the median is within one standard deviation."""
        index = [k for k, i in enumerate(self.ids) if int(i) in self.anchors]
        if not index:
            return set()
        told = [self.anchors[int(i)] for i in self.ids[index]]
        segment = np.array([s for s, _ in told])
        f = scene.frames[segment]
        at = np.einsum("nij,nj->ni", f[:, :9].reshape(-1, 3, 3), np.array([x for _, x in told])) + f[:, 9:]
        off = np.linalg.norm(self.x_world[index] - at, axis=1) / np.sqrt(3.0 * self.variance[index])
        out: set[int] = set()
        for s in np.unique(segment):
            mine = np.flatnonzero(segment == s)
            if np.median(off[mine]) < 1.0:
                out |= {int(self.ids[index[k]]) for k in mine if off[k] > _AGREES}
        return out

    def near(self, scene: Scene, index: ArrayLike, reach: float) -> Rows:
        """Rows of some points to the nearest surface, within a distance [m]; groups count among `index`."""
        chosen = np.asarray(index, int)
        return surface_rows(
            scene.body, scene.state, np.ascontiguousarray(self.x_world[chosen]), max_distance=reach,
            sigma=float(np.sqrt(self.variance[chosen].mean())) if len(chosen) else 1.0, frames=scene.frames,
        )  # fmt: skip

    def match(self, scene: Scene, reach: float) -> SurfacePointMatched:
        """Anchors where there are; nearest points of the surface for the others."""
        new = self.new
        old = np.setdiff1d(np.arange(len(self.ids)), new)
        pairs, scale = [], max(reach, _AGREES * self.slide)
        if len(old):
            told = [self.anchors[int(i)] for i in self.ids[old]]
            segment, rest = np.array([s for s, _ in told]), np.array([x for _, x in told])
            for axis in np.eye(3):
                anchors = SurfaceAnchors(scene.body, segment, rest, np.tile(axis, (len(old), 1)))
                x = np.ascontiguousarray(self.x_world[old])
                pairs.append(SurfacePairs(anchors, x, 1.0 / self.variance[old], scale, False))
        if len(new):
            x = np.ascontiguousarray(self.x_world[new])
            pairs.append(SurfacePairs.nearest(self.near(scene, new, scale), x, scene, scale))
        lasts = float(self.slide**2 / self.variance.mean()) if len(self.ids) else 0.0
        return SurfacePointMatched(tuple(pairs), lasts, self.sensor, self.turns)


@dataclass(frozen=True, eq=False)
class SurfacePointMatched(Matched):
    """Points with their places on the body.

    Parameters
    ----------
    pairs : of anchored points along three axes, and of new ones along the surface's normal
    lasts : share of the variance that lasts: the slide
    sensor : of the measurement
    turns : of the measurement
    """

    pairs: tuple[SurfacePairs, ...]
    lasts: float = 0.0
    sensor: str = ""
    turns: Mapping[int, NDArray] = field(default_factory=dict)
    of_points = False
    shows_surface = True

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a pair."""
        return [pairs.rows(scene) for pairs in self.pairs]

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [m] along the axes and normals, by segments."""
        told = [pairs.on_segments(scene) for pairs in self.pairs]
        residual = np.concatenate([np.zeros(0), *(rows.residual for rows in told)])
        segment = np.concatenate([np.zeros(0, np.int64), *(rows.segment for rows in told)])
        return [by_segments(self.sensor, scene.body, residual, segment, "m")]
