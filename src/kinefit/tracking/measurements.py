"""Keypoints and markers of one time, made ready once, so that every iteration makes their rows quickly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences import _kernels, targets
from kinefit.geometry.camera import Rig
from kinefit.observations import KeypointFrame, MarkerFrame
from kinefit.rows import AnyRows


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a sensor says of a state, segment by segment.

    Parameters
    ----------
    agreeing, contrary : (S,) how much of what the sensor can see of each segment agrees, and how much does not.
    hidden : (S,) how much of it is hidden from the sensor by something in front.
    """

    agreeing: NDArray
    contrary: NDArray
    hidden: NDArray

    def __add__(self, other: Evidence) -> Evidence:
        return Evidence(self.agreeing + other.agreeing, self.contrary + other.contrary, self.hidden + other.hidden)


class Measurement(Protocol):
    """What one sensor saw at one time, ready to make rows."""

    def rows(self, state: BodyState, bound: float) -> list[AnyRows]:
        """Rows at a state; `bound` [m] within which correspondences are sought."""
        ...

    def evidence(self, state: BodyState) -> Evidence:
        """How well a state agrees with it."""
        ...


class KeypointMeasurement:
    """2D keypoints of one camera: points of the body on rays (P2 2.3, point to line).

    Parameters
    ----------
    sigma : float [px] standard deviation of a keypoint with confidence 1.
    """

    def __init__(self, frame: KeypointFrame, body: Body, rig: Rig, sigma: float) -> None:
        self._body, self._packed = body, rig.packed
        known = body.keypoints(frame.keypoint_set) if frame.keypoint_set else body.landmarks
        here = [k for k, name in enumerate(frame.names) if name in known.names]
        seen = np.isfinite(frame.uv[here]).all(axis=1) & (frame.confidence[here] > 0)
        here = [k for k, ok in zip(here, seen) if ok]
        self.points = known.select(tuple(frame.names[k] for k in here))
        self.uv = np.ascontiguousarray(frame.uv[here])
        self._camera = np.full(len(here), rig.index(frame.sensor))
        self._weight = np.ascontiguousarray(frame.confidence[here]) / sigma**2

    def rows(self, state: BodyState, bound: float) -> list[AnyRows]:
        """Two rows a keypoint."""
        return [
            targets.fill(
                _kernels.pixel_rows, 2, self._body, state, self.points, self._packed, self._camera, self.uv, self._weight
            )
        ]

    def evidence(self, state: BodyState) -> Evidence:
        """A keypoint speaks for its segment within three standard deviations."""
        rows = self.rows(state, 0.0)[0]
        assert hasattr(rows, "group")
        square = np.bincount(rows.group, rows.weight * rows.residual**2, len(self.points))
        return _of_points(self._body, self.points, square)


class MarkerMeasurement:
    """Labelled markers: point to point.

    Parameters
    ----------
    sigma : float [m]
    """

    def __init__(self, frame: MarkerFrame, body: Body, sigma: float) -> None:
        self._body = body
        known = body.markers(frame.marker_set) if frame.marker_set else body.landmarks
        here = [
            k for k, name in enumerate(frame.names) if name in known.names and np.isfinite(frame.positions[k]).all()
        ]
        self.points = known.select(tuple(frame.names[k] for k in here))
        self.x_world = np.ascontiguousarray(frame.positions[here])
        self._weight = np.full(len(here), 1.0 / sigma**2)

    def rows(self, state: BodyState, bound: float) -> list[AnyRows]:
        """Three rows a marker."""
        return [targets.fill(_kernels.point_rows, 3, self._body, state, self.points, self.x_world, self._weight)]

    def evidence(self, state: BodyState) -> Evidence:
        """A marker speaks for its segment within three standard deviations."""
        gap = self.x_world - self._body.positions(state, self.points)
        return _of_points(self._body, self.points, self._weight * np.square(gap).sum(axis=1))


def _of_points(body: Body, points: PointSet, square: NDArray) -> Evidence:
    """Evidence of points with squared residuals (K,) in variances; one point is as much as a tenth of a segment's surface."""
    count = len(body.tree.segments)
    agreeing = np.bincount(points.segments, square < 9.0, count)
    return Evidence(agreeing, np.bincount(points.segments, square >= 9.0, count), np.zeros(count))
