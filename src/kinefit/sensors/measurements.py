"""Keypoints and markers of one time, made ready once, so that every iteration makes their rows quickly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.morphing import Morphing
from kinefit.correspondences import _kernels, targets
from kinefit.correspondences.morphed import on_moved_joints
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import DepthFrame, KeypointFrame, MarkerFrame
from kinefit.rows import AnyRows, DofRows, Rows
from kinefit.sensors.depth_view import DepthView
from kinefit.sensors.evidence import SHOWN, Evidence
from kinefit.sensors.occlusion import SEEN, THICK, InSight

_AGREES = 3.0  # standard deviations
_AT_JOINT = 0.05  # [m] from a joint: such a point tells of the segments on both sides of it


class Measurement(Protocol):
    """What one sensor saw at one time, ready to make rows."""

    sensor: str
    def rows(self, state: BodyState, bound: float) -> Sequence[AnyRows]:
        """Rows at a state; `bound` [m] within which correspondences are sought."""
        ...

    def evidence(self, state: BodyState) -> Evidence:
        """How well a state agrees with it."""
        ...

    def view(self) -> DepthView | None:
        """What a limb can be sought in, where it shows a surface."""
        ...


class KeypointMeasurement:
    """2D keypoints of one camera: points of the body on rays (P2 2.3, point to line).

    Parameters
    ----------
    sigma : float [px] standard deviation of a keypoint with confidence 1.
    morphing : Morphing of the body, where its joints move with its angles.
    depth : a depth frame of the same time, its camera beside this one, and its standard deviation [m], optional.

    Raises
    ------
    BodyError, CalibrationError
        A keypoint set that the body does not have, a camera that the rig does not have.
    """

    def __init__(
        self, frame: KeypointFrame, body: Body, rig: Rig, sigma: float, morphing: Morphing | None = None, *,
        depth: tuple[DepthFrame, Camera, float] | None = None,
    ) -> None:  # fmt: skip
        self.sensor, self._body, self._packed, self._morphing = frame.sensor, body, rig.packed, morphing
        seen = np.isfinite(frame.uv).all(axis=1) & (frame.confidence > 0) & (frame.confidence < np.inf)
        known = body.keypoints(frame.keypoint_set) if frame.keypoint_set else body.landmarks
        self.points, here = _known(known, frame.names, seen)
        self.uv = np.ascontiguousarray(frame.uv[here])
        self._camera = np.full(len(here), rig.index(frame.sensor))
        self._weight = np.ascontiguousarray(frame.confidence[here]) / sigma**2
        self._shown = np.flatnonzero(frame.confidence[here] >= SEEN)
        shown = self.points.select(tuple(self.points.names[k] for k in self._shown))
        self._sight = None if depth is None or not len(shown) else InSight(body, shown, *depth)

    def rows(self, state: BodyState, bound: float) -> list[Rows | DofRows]:
        """Two rows a keypoint; one more where it lies too deep behind what was measured before it."""
        rows = [self._pixels(state)]
        return rows if self._sight is None else [*rows, self._sight.rows(state)]

    def _pixels(self, state: BodyState) -> Rows | DofRows:
        given = self._packed, self._camera, self.uv, self._weight
        return _filled(_kernels.pixel_rows, 2, self._body, self._morphing, state, self.points, *given)

    def square(self, state: BodyState) -> NDArray:
        """(K,) squared distances in the image, in variances; inf for those that could not be seen where they are."""
        rows = self._pixels(state)
        square = np.bincount(rows.group, rows.weight * rows.residual**2, len(self.points))
        if self._sight is not None:
            square[self._shown[self._sight.behind(state) > THICK]] = np.inf
        return square

    def evidence(self, state: BodyState) -> Evidence:
        """A keypoint speaks for its segment within three standard deviations, and against it beyond."""
        return of_points(self._body, self.points, self.square(state))

    def view(self) -> None:
        """Points do not show limbs."""


class MarkerMeasurement:
    """Labelled markers: point to point.

    Parameters
    ----------
    sigma : float [m]
    morphing : Morphing of the body, where its joints move with its angles.

    Raises
    ------
    BodyError
        A marker set that the body does not have.
    """

    def __init__(self, frame: MarkerFrame, body: Body, sigma: float, morphing: Morphing | None = None) -> None:
        self.sensor, self._body, self._morphing = frame.sensor, body, morphing
        known = body.markers(frame.marker_set) if frame.marker_set else body.landmarks
        self.points, here = _known(known, frame.names, np.isfinite(frame.positions).all(axis=1))
        self.x_world = np.ascontiguousarray(frame.positions[here])
        self._weight = np.full(len(here), 1.0 / sigma**2)

    def rows(self, state: BodyState, bound: float) -> list[Rows | DofRows]:
        """Three rows a marker."""
        given = self.x_world, self._weight
        return [_filled(_kernels.point_rows, 3, self._body, self._morphing, state, self.points, *given)]

    def square(self, state: BodyState) -> NDArray:
        """(M,) squared distances, in variances."""
        morphing = self._morphing
        x = morphing.pose(state).positions(self.points) if morphing else self._body.positions(state, self.points)
        gap = self.x_world - x
        return np.asarray(self._weight * np.square(gap).sum(axis=1))

    def evidence(self, state: BodyState) -> Evidence:
        """A marker speaks for its segment within three standard deviations, and against it beyond."""
        return of_points(self._body, self.points, self.square(state))

    def view(self) -> None:
        """Points do not show limbs."""


def of_points(body: Body, points: PointSet, square: NDArray) -> Evidence:
    """Evidence of points with squared residuals (K,) in variances."""
    tree, out = body.tree, np.zeros((2, len(body.tree.segments)))
    for s, place, far in zip(points.segments, points.points, square >= _AGREES**2):
        out[int(far), s] += SHOWN
        if tree.parents[s] >= 0 and np.linalg.norm(place) < _AT_JOINT:
            out[int(far), tree.parents[s]] += SHOWN
    return Evidence(*out)


def _filled(
    kernel: Any, lines: int, body: Body, morphing: Morphing | None, state: BodyState, points: PointSet, *given: Any
) -> Rows | DofRows:
    """Rows of points of a body, on joints that move where they do."""
    if morphing is None:
        return targets.fill(kernel, lines, body, state, points, *given)
    pose = morphing.pose(state)
    return on_moved_joints(pose, targets.fill(kernel, lines, body, state, points, *given, frames=pose.frames))


def _known(points: PointSet, names: tuple[str, ...], seen: NDArray) -> tuple[PointSet, list[int]]:
    """Those of the named points that the body has and that were seen, and their places among the names."""
    has = set(points.names)
    here = [k for k, name in enumerate(names) if name in has and seen[k]]
    return points.select(tuple(names[k] for k in here)), here
