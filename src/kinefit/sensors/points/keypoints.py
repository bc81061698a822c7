"""2D keypoints of all cameras at one time: points of the body on rays, left-right swaps corrected (P2 2.3)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate_robust
from kinefit.geometry.losses import Loss
from kinefit.observations import KEYPOINTS, KeypointFrame, Keypoints
from kinefit.sensors.base import Hints, Leftover, Matched, Measurement, Sensor
from kinefit.sensors.channels import Channels, known_points, make_channels
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, MIN_VISIBLE_OUTLINE, Evidence, moves_points
from kinefit.sensors.points import views
from kinefit.sensors.scene import Scene
from kinefit.sensors.visibility.occlusion import MIN_VISIBLE_CONFIDENCE, Hidden, hidden_points
from kinefit.solving.correspondences import _kernels
from kinefit.solving.least_squares import PixelPoints
from kinefit.solving.rows import AnyRows

Stream = tuple[str, str, tuple[str, ...]]
"""Camera, keypoint set and names of the keypoints that one detector gives frame after frame."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Which points of which cameras a body's keypoints are, frame after frame; see `Channels`.

    Parameters
    ----------
    channels : Channels, of which the measurements are not used
    body : Body
    streams : the detector's stream of every source; empty unless made from streams
    """

    channels: Channels
    body: Body
    streams: tuple[Stream, ...] = ()

    @cached_property
    def points(self) -> PointSet:
        """A point of the body for every channel (N,)."""
        return self.channels.each

    @cached_property
    def groups(self) -> NDArray:
        """(N,) channels that change sides together."""
        return views.limb_groups(self.body, self.channels)

    @cached_property
    def informs(self) -> NDArray:
        """(S, N) 0 or 1: channels that constrain a segment; see `informing`."""
        return informing(self.body, self.channels)

    @cached_property
    def hands(self) -> tuple[views.HandViews, ...]:
        """The hands with fingers, and which channels are on them."""
        return views.HandViews.of(self.body, self.channels, self.points)

    @cached_property
    def parts(self) -> list[tuple[str, NDArray, tuple[str, ...], NDArray]]:
        """Of each source its label, its channels (K,), and their names and segments (K,)."""
        points, sources = self.points, self.channels.sources
        of = [np.flatnonzero(self.channels.source == q) for q in range(len(sources))]
        return [(s, k, tuple(points.names[i] for i in k), points.segments[k]) for s, k in zip(sources, of)]

    @cached_property
    def trunk(self) -> NDArray:
        """(N,) segment in whose frame a channel's view bias is given."""
        return views.trunks(self.body.tree)[self.points.segments]

    def bias(self, scene: Scene) -> NDArray | None:
        """(N, 2) [px] bias of each keypoint in the image at a scene's state; None without a `view_bias`."""
        bias = self.channels.view_bias
        if bias is None:
            return None
        x = scene.positions(self.points_of(scene.body))
        return views.view_offset(bias, self.trunk, x, scene.frames, scene.rig, self.channels.camera)

    def points_of(self, body: Body) -> PointSet:
        """`points` of another body with the same segments; cached for the latest body."""
        if body is self.body:
            return self.points
        if self._latest.get("body") is not body:
            self._latest.update(body=body, points=self.channels.with_points(body).each)
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

    @property
    def of_streams(self) -> list[tuple[str, str, str]]:
        """(N,) camera, keypoint set and point of every channel."""
        return [(*self.streams[q][:2], name) for q, name in zip(self.channels.source, self.points.names)]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """(N,) source and point of every channel."""
        return tuple(f"{self.channels.sources[q]} {name}" for q, name in zip(self.channels.source, self.points.names))


def projected(scene: Scene, layout: Layout) -> NDArray:
    """(N, 2) [px] projections of every channel's point at a scene's state; NaN behind the camera."""
    return scene.once(
        layout, lambda: scene.rig.project(scene.positions(layout.points_of(scene.body)), layout.channels.camera)
    )


def informing(body: Body, channels: Channels) -> NDArray:
    """(S, N) 0 or 1: channels that constrain a segment: those on it and those at its children's joints.

    A segment without any has those of its children.
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


class KeypointSensor(Sensor):
    """The detectors of all cameras of a rig, as one sensor: only together they distinguish left from right.

    Parameters
    ----------
    rig : Rig
    sigma : {camera: standard deviation [px] of a keypoint with confidence 1}; "CAMERA SET" for one of several detectors
    default_sigma : float [px] of a camera that none is given for
    loss : Loss of a keypoint, in its standard deviations
    near : float [m] correspondence distance at which the loss holds as it is; it is wider while all is far off
    view_bias : bias of the detectors by direction of view, as a subject fit estimated it; default: none
    """

    name = KEYPOINTS
    together = places_points = True

    def __init__(
        self, rig: Rig, sigma: Mapping[str, float], default_sigma: float, loss: Loss, near: float,
        view_bias: views.ViewBias | None = None,
    ) -> None:  # fmt: skip
        self.rig, self.sigma, self.default_sigma, self.loss, self.near = rig, sigma, default_sigma, loss, near
        self.view_bias = view_bias or views.ViewBias()
        self._layouts: dict[tuple[object, ...], tuple[Layout, NDArray]] = {}

    def prepare(self, frame: Sequence[KeypointFrame], scene: Scene) -> KeypointMeasurement:
        """Of the frames of all cameras at one time.

        Raises
        ------
        BodyError, CalibrationError
            A keypoint set that the body does not have, a camera that the rig does not have.
        """
        layout, place = self.layout(scene.body, [(f.sensor, f.keypoint_set, f.names) for f in frame])
        uv = np.concatenate([*(f.uv for f in frame), [[np.nan, np.nan]]])[place]
        confidence = np.concatenate([*(f.confidence for f in frame), [0.0]])[place]
        time = float(np.mean([f.time for f in frame]))
        sides_known = np.concatenate([*(np.full(len(f.names), f.sides_known) for f in frame), [False]])[place]
        confidence = np.where(confidence < np.inf, confidence, 0.0)
        return KeypointMeasurement(self, layout, uv, confidence, time, sides_known if sides_known.any() else None)

    def layout(self, body: Body, streams: Sequence[Stream]) -> tuple[Layout, NDArray]:
        """The layout of frames of these streams, made once.

        And (N,) int where among the names of all streams, one after the other, each channel's point is, -1 for nowhere.
        """
        key = (id(body), *streams)
        if key not in self._layouts:
            used, records = [], []
            for k, (camera, keypoint_set, names) in enumerate(streams):
                self.rig.index(camera)
                if set(names) & set(known_points(body, keypoint_set).names):
                    used.append(k)
                    empty = np.zeros((1, 1, len(names)))
                    records.append(Keypoints(camera, keypoint_set, names, 1.0, np.zeros((*empty.shape, 2)), empty))
            channels = Channels.none(self.rig, 1)
            if records:
                sigma = keypoint_sigma(records, self.sigma, self.default_sigma)
                channels = self.view_bias.known_to(make_channels(body, self.rig, records, sigma))
            given = [(k, name) for k, (*_, names) in enumerate(streams) for name in names]
            found = {point: i for i, point in reversed(list(enumerate(given)))}  # a name counts where it is first
            wanted = [(used[q], channels.points.names[c]) for q, c in zip(channels.source, channels.column)]
            place = np.array([found.get(point, -1) for point in wanted], np.int64)
            if len(self._layouts) > 16:
                self._layouts.clear()
            self._layouts[key] = Layout(channels, body, tuple(streams[k] for k in used)), place
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
    sides_known : (N,) bool, channels that `match` exchanges with no partner; None: none
    """

    def __init__(
        self, sensor: KeypointSensor, layout: Layout, uv: NDArray, confidence: NDArray, time: float,
        sides_known: NDArray | None = None,
    ) -> None:  # fmt: skip
        self.sensor, self.time, self.of, self.layout = KEYPOINTS, time, sensor, layout
        seen = np.isfinite(uv).all(axis=1) & (confidence > 0)
        self.confidence = np.where(seen, confidence, 0.0)
        self.weight = self.confidence / np.square(layout.channels.sigma)
        self.uv = np.where(seen[:, None], uv, np.nan)
        self.sides_known = sides_known

    def match(self, scene: Scene, reach: float) -> KeypointMatched:
        """Left and right of each source as they fit the body better; which points another sensor saw to be hidden."""
        channels = self.layout.channels
        fitted = projected(scene, self.layout)
        view_offset = self.layout.bias(scene)
        looked_for = fitted if view_offset is None else fitted + view_offset
        swapped = views.find_swaps(channels, self.layout.groups, self.uv, self.weight, looked_for, self.sides_known)
        order = np.where(swapped, channels.partner, np.arange(len(swapped)))
        uv, weight = np.ascontiguousarray(self.uv[order]), np.ascontiguousarray(self.weight[order])
        if view_offset is not None:
            uv -= view_offset
        hidden: tuple[Hidden, ...] = ()
        if scene.measurements:
            sure = self.confidence[order] >= MIN_VISIBLE_CONFIDENCE
            hidden = tuple(hidden_points(scene, self.layout.points_of(scene.body), channels.camera, sure))
        loss, near = self.of.loss, self.of.near
        if reach > near:
            loss = replace(loss, scale=loss.scale * reach / near)
        return KeypointMatched(self, uv, weight, swapped, loss, hidden, view_offset)

    def hints(self, scene: Scene) -> Hints:
        """Points on which two cameras agree, and a ray of each point from a camera that sees it."""
        channels = self.layout.channels.with_points(scene.body)
        x, _ = views.triangulated_frame(channels, self.uv, self.confidence)
        return Hints(channels.points, x, views.rays(channels, self.uv, self.weight > 0))


@dataclass(frozen=True, eq=False)
class KeypointMatched(Matched):
    """Keypoints with left-right swaps corrected.

    Parameters
    ----------
    measurement : KeypointMeasurement
    uv, weight : (N, 2) [px] and (N,) [1/px²] as used, without the bias by view
    swapped : (N,) bool, channels exchanged with their partner
    loss : Loss
    hidden : what other sensors measured in front of points
    view_offset : (N, 2) [px] the bias by view that was taken out; None for none
    """

    measurement: KeypointMeasurement
    uv: NDArray
    weight: NDArray
    swapped: NDArray
    loss: Loss
    hidden: tuple[Hidden, ...] = ()
    view_offset: NDArray | None = None

    sensor = KEYPOINTS

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
            problem = f"keypoints have {len(channels.rig)} cameras, the scene {len(scene.rig)}"
            raise ObservationError(problem, remedy="Give the scene the rig of the keypoints' sensor.")
        rows = scene.rows_of(
            _kernels.pixel_rows, 2, points, scene.rig.packed, channels.camera, self.uv, self.weight
        )
        return [replace(rows, loss=self.loss), *(h.rows(scene, points) for h in self.hidden)]

    def packed(self, scene: Scene) -> PixelPoints | None:
        """Of a body whose joints stay where they are, where no other rows than those of pixels take part."""
        layout, body = self.measurement.layout, scene.body
        moving = body.closures or scene.morphing is not None
        if moving or self.hidden or np.ndim(self.loss.scale) or len(scene.rig) < len(layout.channels.rig):
            return None
        return PixelPoints(layout.points_of(body), layout.channels.camera, self.uv, self.weight, self.loss)

    def moves(self, scene: Scene) -> NDArray:
        """(D,) bool: coordinates that move a keypoint whose detection agrees with the fit."""
        inside = (self.weight > 0) & (self.squares(scene.at_time(self.time)) < AGREEMENT_SIGMAS**2)
        points, state = self.measurement.layout.points_of(scene.body), scene.state
        return moves_points(scene.body, points, inside[None], state.T_world_root[None], state.angles[None])[0]

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
        uv = uv if self.view_offset is None else uv + self.view_offset  # as it was measured
        factor = np.where(seen, self.loss.factor(self.squares(scene)), 0.0)
        return [
            Leftover(
                label, names, segments, values[mine], factor[mine], "px", uv[mine], bool(self.swapped[mine].any())
            )
            for label, mine, names, segments in layout.parts
        ]

    def evidence(self, scene: Scene) -> Evidence:
        """A keypoint speaks for the segments that it informs of within three standard deviations, else against.

        Fingers of a hand are judged together, see `hand_views`.
        """
        agrees = self.squares(scene) < AGREEMENT_SIGMAS**2
        seen, informs = self.weight > 0, self.measurement.layout.informs
        right, wrong = seen & agrees, seen & ~agrees
        agreeing, contrary = MIN_VISIBLE_OUTLINE * (informs @ right), MIN_VISIBLE_OUTLINE * (informs @ wrong)
        if hands := self.measurement.layout.hands:
            views.join_fingers(hands, agreeing, contrary, *self._metres(scene))
        return Evidence(agreeing, contrary, self._elsewhere(right, wrong))

    def _metres(self, scene: Scene) -> tuple[NDArray, NDArray]:
        """(N,) [m] distance of each point from the body's at its depth, NaN where unseen; its standard deviation."""
        layout = self.measurement.layout
        channels, x = layout.channels, scene.positions(layout.points_of(scene.body))
        to_camera = np.stack([c.T_camera_world[2] for c in channels.rig])[channels.camera]
        depth = np.einsum("ni,ni->n", to_camera[:, :3], x) + to_camera[:, 3]
        size = depth / np.array([c.matrix[0, 0] for c in channels.rig])[channels.camera]  # [m] of a pixel
        gap = np.where(self.weight > 0, np.linalg.norm(self.uv - projected(scene, layout), axis=1), np.nan)
        return size * gap, size * channels.sigma

    def _elsewhere(self, right: NDArray, wrong: NDArray) -> NDArray | None:
        """(S,) bool: segments whose points most views show elsewhere, two of these views in one place.

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
        uv = np.full((len(points), len(channels.rig), 2), np.nan)
        uv[row, channels.camera[which]] = self.uv[which]
        limit = AGREEMENT_SIGMAS * float(channels.sigma[which].max())
        there = np.isfinite(triangulate_robust(channels.rig, uv, max_residual_px=limit)[0]).all(axis=1)
        out[:] = False
        out[owner[which[there[row]]]] = True
        return out if out.any() else None


def keypoint_sigma(keypoints: Sequence[Keypoints], sigma: Mapping[str, float], default: float) -> list[float]:
    """[px] of each record, where {camera: standard deviation} or {"CAMERA SET": standard deviation} are given."""
    return [sigma.get(f"{k.camera} {k.keypoint_set}", sigma.get(k.camera, default)) for k in keypoints]


def pixels_of(matched: Iterable[Matched]) -> list[KeypointMatched]:
    """The matches of image points: packed blocks for compiled fits and the smoother."""
    return [m for m in matched if isinstance(m, KeypointMatched)]


def pixels_and_others(matched: Sequence[Matched]) -> tuple[list[KeypointMatched], list[Matched]]:
    """The matches of image points, and all others."""
    pixels = pixels_of(matched)
    return pixels, [m for m in matched if m not in pixels]
