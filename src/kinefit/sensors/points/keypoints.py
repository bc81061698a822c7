"""2D keypoints of all cameras at one time: points of the body on rays, left and right put right (P2 2.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.correspondences import _kernels
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.geometry.triangulation import triangulate_robust
from kinefit.losses import Loss
from kinefit.observations import KeypointFrame, Keypoints
from kinefit.rows import AnyRows
from kinefit.sensors.base import Hints, Leftover, Matched, Measurement, Sensor
from kinefit.sensors.channels import Channels, known_points, make_channels
from kinefit.sensors.evidence import AGREES, SHOWN, Evidence
from kinefit.sensors.points.left_right import find_swaps, limb_groups
from kinefit.sensors.points.triangulation import triangulated_frame
from kinefit.sensors.points.view_bias import beside, trunks
from kinefit.sensors.scene import Scene
from kinefit.sensors.visibility.occlusion import SEEN, Hidden, hidden_points

NAME = "keypoints"


@dataclass(frozen=True, eq=False)
class Layout:
    """Which points of which cameras a body's keypoints are, frame after frame; see `Channels`.

    Parameters
    ----------
    channels : Channels, of which the measurements are not used
    body : Body
    """

    channels: Channels
    body: Body

    @cached_property
    def points(self) -> PointSet:
        """A point of the body for every channel (N,)."""
        return self._of(self.channels)

    @cached_property
    def groups(self) -> NDArray:
        """(N,) channels that change sides together."""
        return limb_groups(self.body, self.channels)

    @cached_property
    def informs(self) -> NDArray:
        """(S, N) 0 or 1: channels that show where a segment is."""
        return informing(self.body, self.channels)

    @cached_property
    def parts(self) -> list[tuple[str, NDArray, tuple[str, ...], NDArray]]:
        """Of each source its label, its channels, and their names and segments."""
        points, sources = self.points, self.channels.sources
        of = [np.flatnonzero(self.channels.source == q) for q in range(len(sources))]
        return [(s, k, tuple(points.names[i] for i in k), points.segments[k]) for s, k in zip(sources, of)]

    @cached_property
    def trunk(self) -> NDArray:
        """(N,) segment in whose axes a channel's bias by view is."""
        return trunks(self.body.tree)[self.points.segments]

    def beside(self, scene: Scene) -> NDArray | None:
        """(N, 2) [px] how far beside its point each keypoint is seen at a scene's state; None for nothing known."""
        bias = self.channels.view_bias
        if bias is None:
            return None
        x = scene.positions(self.points_of(scene.body))
        return beside(bias, self.trunk, x, scene.frames, scene.rig, self.channels.camera)

    def points_of(self, body: Body) -> PointSet:
        """The same of another body of this make; those of the body that was asked for last are kept."""
        if body is self.body:
            return self.points
        if self._latest.get("body") is not body:
            self._latest.update(body=body, points=self._of(self.channels.with_points(body)))
        return self._latest["points"]

    @cached_property
    def _latest(self) -> dict[str, Any]:
        return {}

    @cached_property
    def places(self) -> tuple[tuple[str, str], ...]:
        """(N,) keypoint set and name of every channel's point."""
        c = self.channels
        known = [(name, point) for name, span in c.sets.items() for point in c.points.names[span]]
        return tuple(known[k] for k in c.column)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """(N,) source and point of every channel."""
        return tuple(f"{self.channels.sources[q]} {name}" for q, name in zip(self.channels.source, self.points.names))

    @staticmethod
    def _of(channels: Channels) -> PointSet:
        if not len(channels.column):
            return channels.points
        names = tuple(channels.points.names[c] for c in channels.column)
        owner, place = channels.points.segments, channels.points.points
        return PointSet(names, owner[channels.column], place[channels.column])


class KeypointSensor(Sensor):
    """The detectors of all cameras of a rig, as one sensor: only together they distinguish left from right.

    Parameters
    ----------
    rig : Rig
    sigma : {camera: standard deviation [px] of a keypoint with confidence 1}
    usual : float [px] default, of a camera that none is given for
    loss : Loss of a keypoint, in its standard deviations
    near : float [m] correspondence distance at which the loss holds as it is; it is wider while all is far off
    """

    name = NAME

    def __init__(self, rig: Rig, sigma: Mapping[str, float], usual: float, loss: Loss, near: float) -> None:
        self.rig, self.sigma, self.usual, self.loss, self.near = rig, sigma, usual, loss, near
        self._layouts: dict[tuple[object, ...], tuple[Layout, list[tuple[int, NDArray]]]] = {}

    def prepare(self, frame: KeypointFrame | Sequence[KeypointFrame], scene: Scene) -> KeypointMeasurement:
        """Of the frames of all cameras at one time.

        Raises
        ------
        BodyError, CalibrationError
            A keypoint set that the body does not have, a camera that the rig does not have.
        """
        frames = [frame] if isinstance(frame, KeypointFrame) else list(frame)
        layout, columns = self._layout(scene.body, frames)
        parts = [(frames[k], c, c >= 0) for k, c in columns]
        uv = np.concatenate([np.zeros((0, 2)), *(np.where(has[:, None], f.uv[c], np.nan) for f, c, has in parts)])
        confidence = np.concatenate([np.zeros(0), *(np.where(has, f.confidence[c], 0.0) for f, c, has in parts)])
        time = float(np.mean([f.time for f in frames]))
        return KeypointMeasurement(self, layout, uv, np.where(confidence < np.inf, confidence, 0.0), time)

    def _layout(self, body: Body, frames: Sequence[KeypointFrame]) -> tuple[Layout, list[tuple[int, NDArray]]]:
        """Channels of some frames; and of each frame that has any the places of their names in it, -1 for none."""
        key = (id(body), *((f.sensor, f.keypoint_set, f.names) for f in frames))
        if key not in self._layouts:
            used, records = [], []
            for k, f in enumerate(frames):
                self.rig.index(f.sensor)
                if set(f.names) & set(known_points(body, f.keypoint_set).names):
                    empty = np.zeros((1, 1, len(f.names)))
                    used.append(k)
                    uv = np.zeros((*empty.shape, 2))
                    records.append(Keypoints(f.sensor, f.keypoint_set, f.names, 1.0, uv, empty))
            sigma = [self.sigma.get(r.camera, self.usual) for r in records]
            channels = Channels.none(self.rig, 1)
            if records:
                channels = make_channels(body, self.rig, records, [np.zeros(1, np.int64)] * len(records), sigma)
            columns = []
            for q, k in enumerate(used):
                names = [channels.points.names[c] for c in channels.column[channels.source == q]]
                has = frames[k].names
                columns.append((k, np.array([has.index(n) if n in has else -1 for n in names], np.int64)))
            if len(self._layouts) > 16:
                self._layouts.clear()
            self._layouts[key] = Layout(channels, body), columns
        return self._layouts[key]


class KeypointMeasurement(Measurement):
    """Keypoints of one time in a layout.

    Parameters
    ----------
    sensor : KeypointSensor
    layout : Layout of N channels
    uv : (N, 2) [px], NaN where unseen
    confidence : (N,)
    time : float [s]
    """

    def __init__(self, sensor: KeypointSensor, layout: Layout, uv: NDArray, confidence: NDArray, time: float) -> None:
        self.sensor, self.time, self.of, self.layout = NAME, time, sensor, layout
        seen = np.isfinite(uv).all(axis=1) & (confidence > 0)
        self.confidence = np.where(seen, confidence, 0.0)
        self.weight = self.confidence / np.square(layout.channels.sigma)
        self.uv = np.where(seen[:, None], uv, np.nan)

    def match(self, scene: Scene, reach: float) -> KeypointMatched:
        """Left and right of each source as they fit the body better; which points another sensor saw to be hidden."""
        channels = self.layout.channels
        fitted = projected(scene, self.layout)
        beside = self.layout.beside(scene)
        looked_for = fitted if beside is None else fitted + beside
        swapped = find_swaps(channels, self.layout.groups, self.uv, self.weight, looked_for)
        order = np.where(swapped, channels.partner, np.arange(len(swapped)))
        uv, weight = np.ascontiguousarray(self.uv[order]), np.ascontiguousarray(self.weight[order])
        if beside is not None:
            uv -= beside
        hidden: tuple[Hidden, ...] = ()
        if scene.measurements:
            sure = self.confidence[order] >= SEEN
            hidden = tuple(hidden_points(scene, self.layout.points_of(scene.body), channels.camera, sure))
        loss = self.of.loss
        loss = replace(loss, scale=loss.scale * max(reach / self.of.near, 1.0))
        return KeypointMatched(self, uv, weight, swapped, loss, hidden, beside)

    def hints(self, scene: Scene) -> Hints:
        """Points on which two cameras agree."""
        channels = self.layout.channels.with_points(scene.body)
        x, _ = triangulated_frame(channels, self.uv, self.confidence)
        return Hints(channels.points, x)


@dataclass(frozen=True, eq=False)
class KeypointMatched(Matched):
    """Keypoints with left and right put right.

    Parameters
    ----------
    measurement : KeypointMeasurement
    uv, weight : (N, 2) [px] and (N,) [1/px²] as used, without the bias by view
    swapped : (N,) bool, channels exchanged with their partner
    loss : Loss
    hidden : what other sensors measured in front of points
    beside : (N, 2) [px] the bias by view that was taken out; None for none
    """

    measurement: KeypointMeasurement
    uv: NDArray
    weight: NDArray
    swapped: NDArray
    loss: Loss
    hidden: tuple[Hidden, ...] = ()
    beside: NDArray | None = None

    sensor = NAME

    @property
    def places(self) -> Sequence[tuple[str, str]] | None:  # type: ignore[override]
        """Of every channel; None where other rows than those of pixels take part."""
        return None if self.hidden else self.measurement.layout.places

    @property
    def channels(self) -> Sequence[str]:
        """Of every channel its source and point."""
        return self.measurement.layout.names

    @property
    def cameras(self) -> NDArray | None:  # type: ignore[override]
        """Of every channel; None where other rows than those of pixels take part."""
        return None if self.hidden else self.measurement.layout.channels.camera

    @property
    def key(self) -> bytes:
        """The same for matches that make the same rows."""
        return self.swapped.tobytes() + b"".join(h.key for h in self.hidden)

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """Two rows a keypoint; one more where it lies too deep behind what was measured in front of it."""
        layout = self.measurement.layout
        points, channels = layout.points_of(scene.body), layout.channels
        if len(scene.rig) < len(channels.rig):
            problem = f"keypoints of {len(channels.rig)} cameras in a scene of {len(scene.rig)}"
            raise ObservationError(problem, remedy="Give the scene the rig that the keypoints' sensor has.")
        rows = scene.rows_of(
            _kernels.pixel_rows, 2, points, scene.rig.packed, channels.camera, self.uv, self.weight
        )
        return [replace(rows, loss=self.loss), *(h.rows(scene, points) for h in self.hidden)]

    def squares(self, scene: Scene) -> NDArray:
        """(N,) squared distances in the image, in variances; 0 where unseen, inf where it could not be seen."""
        gap = self.uv - projected(scene, self.measurement.layout)
        out = np.where(self.weight > 0, self.weight * np.square(gap).sum(axis=1), 0.0)
        for h in self.hidden:
            out[h.far] = np.inf
        return np.where(np.isnan(out), np.inf, out)

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Of every point of every detector."""
        layout, seen = self.measurement.layout, self.weight > 0
        uv = np.where(seen[:, None], self.uv, np.nan)
        values = uv - projected(scene, layout)
        uv = uv if self.beside is None else uv + self.beside  # as it was measured
        factor = np.where(seen, self.loss.factor(self.squares(scene)), 0.0)
        return [
            Leftover(
                label, names, segments, values[mine], factor[mine], "px", uv[mine], bool(self.swapped[mine].any())
            )
            for label, mine, names, segments in layout.parts
        ]

    def evidence(self, scene: Scene) -> Evidence:
        """A keypoint speaks for the segments that it informs of within three standard deviations, else against."""
        agrees = self.squares(scene) < AGREES**2
        seen, informs = self.weight > 0, self.measurement.layout.informs
        right, wrong = seen & agrees, seen & ~agrees
        return Evidence(SHOWN * (informs @ right), SHOWN * (informs @ wrong), self._elsewhere(right, wrong))

    def _elsewhere(self, right: NDArray, wrong: NDArray) -> NDArray | None:
        """(S,) bool: segments whose own points most views show beside where they should be, two of them in one place.

        A joint's point counts for the segment beyond the joint alone: an elbow may be off where shoulder and hand are
        right.
        """
        layout = self.measurement.layout
        channels, owner = layout.channels, layout.points.segments
        count = len(layout.body.tree.segments)
        out = 2 * np.bincount(owner, wrong, count) > np.bincount(owner, wrong | right, count)
        which = np.flatnonzero(wrong & out[owner])
        if len(which) < 2:
            return None
        points, row = np.unique(channels.column[which], return_inverse=True)
        views = np.full((len(points), len(channels.rig), 2), np.nan)
        views[row, channels.camera[which]] = self.uv[which]
        limit = AGREES * float(channels.sigma[which].max())
        there = np.isfinite(triangulate_robust(channels.rig, views, max_residual_px=limit)[0]).all(axis=1)
        out[:] = False
        out[owner[which[there[row]]]] = True
        return out if out.any() else None


def projected(scene: Scene, layout: Layout) -> NDArray:
    """(N, 2) [px] where every channel's point is seen at a scene's state; NaN where it cannot be."""
    return scene.once(
        layout, lambda: scene.rig.project(scene.positions(layout.points_of(scene.body)), layout.channels.camera)
    )


def informing(body: Body, channels: Channels) -> NDArray:
    """(S, N) 0 or 1: channels that show where a segment is: those on it and those at its children's joints.

    A segment without any is known through its children.
    """
    tree = body.tree
    owner, place = channels.points.segments[channels.column], channels.points.points[channels.column]
    near = np.linalg.norm(place, axis=1) < 0.05
    out = np.zeros((len(tree.segments), len(owner)))
    for s in range(len(tree.segments)):
        out[s] = (owner == s) | (near & (tree.parents[owner] == s))
    for s in range(len(tree.segments) - 1, 0, -1):
        if not out[s].any():
            children = [c for c in range(len(tree.segments)) if tree.parents[c] == s]
            out[s] = np.max([out[c] for c in children], axis=0) if children else 0.0
    return out
