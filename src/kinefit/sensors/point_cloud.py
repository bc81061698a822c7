"""A cloud of points of one time, made ready once, so that every iteration makes its rows quickly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.correspondences import surface_rows
from kinefit.observations import PointCloud
from kinefit.rows import Rows
from kinefit.sensors import _kernels_depth_image as kernels
from kinefit.sensors.depth_image import AGREES
from kinefit.sensors.depth_view import DepthView, camera_at, splat, view_of
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surface import Surface

_PRIMES = np.array((73856093, 19349663, 83492791))  # that number cells of space (Teschner et al., VMV 2003)


class CloudMeasurement:
    """Points on some surface, on the body, or on one segment of it (P2 2.3), towards the body's surface.

    Parameters
    ----------
    frame : PointCloud
    surface, vertices, sigma, settings : see `DepthMeasurement`

    Raises
    ------
    BodyError
        A segment that the body does not have.
    """

    def __init__(
        self, frame: PointCloud, surface: Surface, vertices: NDArray, sigma: float, settings: TrackSettings
    ) -> None:
        self.sensor, self.surface, self.sigma, self._eye = frame.sensor, surface, sigma, frame.viewpoint
        self._segment = None if frame.segment is None else np.int64(surface.body.tree.segment(frame.segment))
        self._certain = frame.on_body or frame.segment is not None
        x = frame.points
        if not self._certain:
            low, high = vertices.min(axis=0) - settings.reach, vertices.max(axis=0) + settings.reach
            x = x[((x > low) & (x < high)).all(axis=1)]
        every = max(len(x) // settings.points, 1)
        self._points = np.ascontiguousarray(x[::every])
        cells = np.floor(np.clip(self._points, -1e6, 1e6) / settings.patch).astype(np.int64)
        patches = len(np.unique(cells @ _PRIMES))
        self._point_sigma = sigma * np.sqrt(max(len(self._points) / max(patches, 1), 1.0))

    def rows(self, state: BodyState, bound: float) -> list[Rows]:
        """One row a point; those known to be the body's are sought twice as far."""
        bound = max(2.0 * bound if self._certain else bound, AGREES * self.sigma)
        rows = self._near(state, bound)
        kernels.soften(rows.data, bound / 2.0)
        rows.group[:] = -1  # softened already
        return [rows]

    def _near(self, state: BodyState, reach: float) -> Rows:
        return surface_rows(
            self.surface.body, state, self._points, max_distance=reach, sigma=self._point_sigma, viewpoint=self._eye,
            segment=self._segment,
        )  # fmt: skip

    def evidence(self, state: BodyState) -> Evidence:
        """For a segment, as much as there are points near it, of those that its share of the surface should have."""
        rows = self._near(state, AGREES * self.sigma)
        count, none = len(self._points), np.zeros(len(self.surface.areas))
        if self._segment is not None:
            share, told = len(rows) / max(count, 1), Evidence(none, none.copy())
            told.agreeing[self._segment], told.contrary[self._segment] = share, (1.0 - share) * bool(count)
            return told
        expected = np.maximum(count * self.surface.areas / max(self.surface.areas.sum(), 1e-12), 1.0)
        return Evidence(np.minimum(np.bincount(rows.segment, minlength=len(none)) / expected, 1.0), none)

    def view(self) -> DepthView | None:
        """The points as a camera at the sensor would show them."""
        if not len(self._points):
            return None
        coarse, small = splat(self._points, camera_at(self._points, self._eye))
        return view_of(coarse, coarse > 0, small) if (coarse > 0).any() else None
