"""Tracked points of a surface: each is anchored to the point of the body where it was first seen (P4-5, P4-11).

A new point is pulled to the nearest surface, like a point of a cloud. Once a limb has converged, so that its points no
longer move on the segment from step to step, they are anchored there. From then on each point constrains all three
directions, so that rotations about a limb's own axis are observable. The sensor learns the anchors; they are no
parameters: skin slides on the bone by `slide`. The rotation of a limb about its bone at the time of its first anchors
stays unobserved: it is a systematic error that all of its points share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.surfaces.places import SurfaceAnchors
from kinefit.errors import ObservationError
from kinefit.observations import SurfacePointFrame
from kinefit.sensors.base import Leftover, Matched, Measurement, Sensor, by_segments, of_kind
from kinefit.sensors.scene import Scene
from kinefit.sensors.surfaces.point_cloud import SurfacePairs
from kinefit.solving.correspondences import surface_rows
from kinefit.solving.rows import AnyRows, Rows

_MAX_WANDER = 0.05  # of the slide, from step to step on a converged limb: 0.5 mm, a degree of a thin arm
_MAX_WAIT_STEPS = 10  # until a limb counts as converged: a cloud never fixes the rotation of a round one
_MAX_ANCHOR_SIGMAS = 3.0  # from the surface, of a point that is anchored
Anchor = tuple[int, NDArray]


class SurfacePointSensor(Sensor):
    """A tracked surface, such as skin or a sleeve. Give it to `Tracker(..., sensors=[...])` or to a `Recording`.

    Parameters
    ----------
    name : as its frames are named
    slide : float [m] standard deviation of the surface's sliding on the bone and of the body's surface
    most : int, largest number of points used at a time, spread evenly

    Raises
    ------
    ObservationError
        A slide or a number that is not positive.
    """

    state_attributes = ("anchors", "turns", "_last", "_waited")

    def __init__(self, name: str, *, slide: float = 0.01, most: int = 400) -> None:
        if not (0 < slide < np.inf) or most < 1:
            raise ObservationError(f"slide is {slide} m, most is {most}", remedy="Give positive numbers.")
        self.name, self.slide, self.most = name, float(slide), int(most)
        self.anchors: Mapping[int, Anchor] = {}
        self.turns: Mapping[int, NDArray] = {}  # of segments until their first anchor; see `Matched`
        self._last: Mapping[int, Anchor] = {}  # of points on limbs that have not converged
        self._waited: Mapping[int, int] = {}  # steps of each such limb

    def prepare(self, frame: SurfacePointFrame, scene: Scene) -> SurfacePointMeasurement:
        """The measurement of one frame: anchored points first, then new ones, at most `most`."""
        of_kind(frame, SurfacePointFrame, f"a frame of the sensor '{self.name}'", "Give its data in such a record.")
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
        """Anchor new points on converged limbs; discard the anchors of points that have left their limb.

        An anchor is discarded if it is far from the measured point while most points of its segment agree: the point
        is another limb's, or its track has drifted. In the next frame it is matched to the nearest surface.
        """
        if not sure:
            return
        lost = measurement.strayed(scene)
        if lost:
            self.anchors = {i: anchor for i, anchor in self.anchors.items() if i not in lost}
        new = measurement.new
        near = measurement.near(scene, new, _MAX_ANCHOR_SIGMAS * self.slide)
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
        self.turns = {**self.turns, **{s: self._least_turn(s, scene) for s in seen}}
        if added:
            self.anchors = {**self.anchors, **added}

    def _least_turn(self, segment: int, scene: Scene) -> NDArray:
        """(3,) [rad] smallest rotation uncertainty of a limb about its bone while it waits for anchors."""
        now, before = _turn(scene, segment), self.turns.get(segment) if self._waited.get(segment, 0) > 1 else None
        return now if before is None or not before.any() or now @ now < before @ before else before

    def _rests(self, segment: int, found: Mapping[int, Anchor]) -> bool:
        """Whether points have stopped moving on a segment, or it has waited for `_MAX_WAIT_STEPS`."""
        waited = self._waited.get(segment, 0) + 1
        self._waited = {**self._waited, segment: waited}
        both = [i for i, (s, _) in found.items() if s == segment and self._last.get(i, (-1, None))[0] == segment]
        moved = [float(np.linalg.norm(found[i][1] - self._last[i][1])) for i in both]
        return waited > _MAX_WAIT_STEPS or (len(moved) > 2 and float(np.median(moved)) < _MAX_WANDER * self.slide)


def _turn(scene: Scene, segment: int) -> NDArray:
    """(3,) [rad] in its frame: standard deviation of a segment's rotation about its bone, from the scene's state."""
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
    variance : (N,) [m²], slide included
    slide : float [m]
    anchors : {id: (segment, (3,) [m] in its frame)} of its points at that time
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
        """Ids of points far from their anchors, on segments whose median distance is within one standard deviation."""
        index = [k for k, i in enumerate(self.ids) if int(i) in self.anchors]
        if not index:
            return set()
        anchors = [self.anchors[int(i)] for i in self.ids[index]]
        segment = np.array([s for s, _ in anchors])
        f = scene.frames[segment]
        at = np.einsum("nij,nj->ni", f[:, :9].reshape(-1, 3, 3), np.array([x for _, x in anchors])) + f[:, 9:]
        off = np.linalg.norm(self.x_world[index] - at, axis=1) / np.sqrt(3.0 * self.variance[index])
        out: set[int] = set()
        for s in np.unique(segment):
            on_segment = np.flatnonzero(segment == s)
            if np.median(off[on_segment]) < 1.0:
                out |= {int(self.ids[index[k]]) for k in on_segment if off[k] > _MAX_ANCHOR_SIGMAS}
        return out

    def near(self, scene: Scene, index: ArrayLike, reach: float) -> Rows:
        """Rows of points index (M,) to the nearest surface within a distance [m]; groups count in `index`."""
        chosen = np.asarray(index, int)
        return surface_rows(
            scene.body, scene.state, np.ascontiguousarray(self.x_world[chosen]), max_distance=reach,
            sigma=float(np.sqrt(self.variance[chosen].mean())) if len(chosen) else 1.0, frames=scene.frames,
        )  # fmt: skip

    def match(self, scene: Scene, reach: float) -> SurfacePointMatched:
        """Match points to their anchors, new ones to the nearest surface; a loss scale of at least `reach` [m]."""
        new = self.new
        old = np.setdiff1d(np.arange(len(self.ids)), new)
        pairs, scale = [], max(reach, _MAX_ANCHOR_SIGMAS * self.slide)
        if len(old):
            known = [self.anchors[int(i)] for i in self.ids[old]]
            segment, rest = np.array([s for s, _ in known]), np.array([x for _, x in known])
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
    """Tracked points with their correspondences on the body.

    Parameters
    ----------
    pairs : of anchored points along three axes, and of new ones along the surface's normal
    lasts : share 0..1 of the variance that is systematic: the slide's
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
        parts = [pairs.on_segments(scene) for pairs in self.pairs]
        residual = np.concatenate([np.zeros(0), *(rows.residual for rows in parts)])
        segment = np.concatenate([np.zeros(0, np.int64), *(rows.segment for rows in parts)])
        return [by_segments(self.sensor, scene.body, residual, segment, "m")]
