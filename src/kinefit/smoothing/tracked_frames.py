"""The input of smoothing: tracked frames of a take, and their keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.bodies import Body, BodyState
from kinefit.frame.results import FrameResult
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.keypoints import pixels_of
from kinefit.sensors.points.packed_markers import PackedMarkers
from kinefit.sensors.points.views import beside, trunks
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.linearised import ApartRows, SceneOf
from kinefit.smoothing.spool import STRETCH, Spool, stretches


@dataclass(frozen=True, eq=False)
class TrackedFrames:
    """F consecutive tracked frames.

    Parameters
    ----------
    results : F kept frames, see `FrameResult.kept`; the matches of keypoints all in one layout
    times : (F,) [s]
    rate : float [Hz]
    scene_of, apart : of the tracker, see `lag_frame.TrackerLike`
    markers : labelled markers, if these are the only sensor and all frames were fitted as one sequence
    """

    results: Sequence[FrameResult]
    times: NDArray
    rate: float
    scene_of: SceneOf
    apart: ApartRows
    markers: PackedMarkers | None = field(default=None, kw_only=True)

    def pixels(self) -> tuple[Channels, NDArray]:
        """Keypoints of all frames as measured, and (F, N) bool: channels whose left and right the tracker swapped."""
        F, layout, swapped = len(self.results), None, np.zeros((len(self.results), 0), bool)
        uv, confidence, sides_known = room((F, 0, 2)), room((F, 0)), None
        for f, result in enumerate(self.results):
            if f % STRETCH == 0:
                release(uv, confidence)
            for m in pixels_of(result.matched):
                if layout is None:
                    layout, N = m.measurement.layout, len(m.swapped)
                    uv, confidence, swapped = room((F, N, 2)), room((F, N)), np.zeros((F, N), bool)
                    uv[:] = np.nan
                uv[f], confidence[f], swapped[f] = m.measurement.uv, m.measurement.confidence, m.swapped
                if m.measurement.sides_known is not None:
                    sides_known = np.zeros((F, N), bool) if sides_known is None else sides_known
                    sides_known[f] = m.measurement.sides_known
        if layout is None:
            return Channels.none(self.scene_of(self.results[0].state, 0.0).rig, F), swapped
        return replace(layout.channels, uv=uv, confidence=confidence, sides_known=sides_known), swapped

    def packed_markers(
        self, body: Body, settings: TrackSettings
    ) -> tuple[PackedMarkers | None, Sequence[FrameResult]]:
        """Labelled markers of all frames as one block, and the frames with the measurements of all other sensors.

        Joints that move with morphs need rows: there are then no packed markers.
        """
        markers = self.markers
        if markers is not None:
            return markers, self.results
        if len(self.results) and self.scene_of(self.results[0].state, 0.0).morphing is None:
            measured = (r.measurements for r in self.results)
            markers = PackedMarkers.of(body, measured, self.times, settings.marker_loss)
        if markers is None:
            return None, self.results
        packed = set(markers.sensors)
        rest = (tuple(m for m in r.measurements if m.sensor not in packed) for r in self.results)
        return markers, Spool(replace(r, measurements=m) for r, m in zip(self.results, rest))


def correct_swaps(channels: Channels, swapped: NDArray) -> tuple[NDArray, NDArray]:
    """Pixels (F, N, 2) and confidences (F, N), 0 where undetected, with the channels `swapped` (F, N) exchanged."""
    if len(swapped) == len(channels.uv) and not swapped.any():
        undetected = ~np.isfinite(channels.uv).all(axis=2) & (channels.confidence != 0.0)
        return channels.uv, np.where(undetected, 0.0, channels.confidence) if undetected.any() else channels.confidence
    uv, confidence = room((*swapped.shape, 2)), room(swapped.shape)
    for some in stretches(len(swapped)):
        order = np.where(swapped[some], channels.partner, np.arange(swapped.shape[1]))
        uv[some] = np.take_along_axis(channels.uv[some], order[:, :, None], axis=1)
        ordered = np.take_along_axis(channels.confidence[some], order, axis=1)
        confidence[some] = np.where(np.isfinite(uv[some]).all(axis=2), ordered, 0.0)
    release(uv, confidence)
    return uv, confidence


def without_bias(body: Body, channels: Channels, uv: NDArray, roots: NDArray, angles: NDArray) -> NDArray:
    """Pixels (T, N, 2) minus the detectors' bias by view at states (T, 4, 4), (T, D); unchanged if no bias is known."""
    if channels.view_bias is None:
        return uv
    points = channels.points
    trunk, out = trunks(body.tree)[points.segments][channels.column], room(uv.shape)
    for some in stretches(len(out)):
        for f in range(*some.indices(len(out))):
            x = body.positions(BodyState(roots[f], angles[f]), points)[channels.column]
            frames, _ = body.tree.forward(roots[f], angles[f])
            out[f] = uv[f] - beside(channels.view_bias, trunk, x, frames, channels.rig, channels.camera)
        release(uv, out)
    return out
