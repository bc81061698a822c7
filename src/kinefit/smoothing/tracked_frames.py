"""The input of smoothing: tracked frames of a take, their keypoints, and costs of what all other sensors measured.

Near the states where a frame's rows were made, the cost of its measurements is c − 2 gᵀδ + δᵀHδ. So a round costs one
match and one linearisation of each frame, whatever the sensors. The motion prior and the packed points are not
approximated: the solver evaluates them at every step.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.bodies import Body, BodyState
from kinefit.correspondences.closures import every_closure
from kinefit.frame.fit import rows_of
from kinefit.frame.results import FrameResult, evidence_of
from kinefit.frame.trust import segments_not_shown
from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched, Measurement, matched_by
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.keypoints import pixels_of
from kinefit.sensors.points.packed_markers import PackedMarkers
from kinefit.sensors.points.views import beside, trunks
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.linearised import Linearised, squares_of
from kinefit.smoothing.spool import STRETCH, Spool, stretches
from kinefit.solvers.equations import normal_equations

SceneOf = Callable[[BodyState, float], Scene]
ApartRows = Callable[[Scene], Sequence[AnyRows]]


@dataclass(frozen=True, eq=False)
class TrackedFrames:
    """T consecutive tracked frames, and what smoothing knows of the tracker: see `lag_frame.TrackerLike`.

    Parameters
    ----------
    results : T kept frames, see `FrameResult.kept`; the matches of keypoints all in one layout
    times : (T,) [s]
    body : Body
    rate : float [Hz]
    settings : TrackSettings
    scene_of : (state, time) -> scene
    apart : scene -> rows against collisions of the body with itself
    markers : labelled markers, if these are the only sensor and all frames were fitted as one sequence
    packed : sensors whose measurements are left out here: they are packed blocks of points, as the keypoints are
    points : (T,) int, number of rows of these blocks in every frame
    scale : {sensor: factor on its standard deviation} of all others, estimated from the take
    values : {sensor: {name: value}} of their own unknowns, besides those of the scenes
    """

    results: Sequence[FrameResult]
    times: NDArray
    body: Body
    rate: float
    settings: TrackSettings
    scene_of: SceneOf
    apart: ApartRows
    markers: PackedMarkers | None = field(default=None, kw_only=True)
    packed: Collection[str] = field(default=(), kw_only=True)
    points: NDArray = field(default_factory=lambda: np.zeros(0, int), kw_only=True)
    scale: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    values: Mapping[str, Mapping[str, float]] = field(default_factory=dict, kw_only=True)

    def part(self, frames: slice) -> Self:
        """Some of the frames."""
        return replace(self, **{name: getattr(self, name)[frames] for name in ("results", "times", "points")})

    def measurements(self, f: int) -> tuple[Measurement, ...]:
        """Measurements of frame `f` that are not packed."""
        return tuple(m for m in self.results[f].measurements if m.sensor not in self.packed)

    def scene(self, f: int, roots: NDArray, angles: NDArray) -> Scene:
        """The scene of one frame at states (T, 4, 4), (T, D), with their velocity there."""
        state, (a, b) = BodyState(roots[f], angles[f]), (max(f - 1, 0), min(f + 1, len(roots) - 1))
        velocity = None
        if b > a:
            step = BodyState(roots[a], angles[a]).difference(BodyState(roots[b], angles[b]))
            velocity = step / max(float(self.times[b] - self.times[a]), 1e-6)
        scene = self.scene_of(state, float(self.times[f]))
        values = {**scene.values, **self.values}
        return scene.at(state, measurements=self.measurements(f), velocity=velocity, values=values)

    def matched(self, scene: Scene) -> tuple[Matched, ...]:
        """The measurements of a frame, matched at its scene."""
        return tuple(matched_by(m, scene, self.settings.near) for m in scene.measurements)

    def linearised(
        self, roots: NDArray, angles: NDArray, *, frames: range | None = None,
        keep: Spool[tuple[Matched, ...]] | None = None, judge: bool = False,
    ) -> Linearised:  # fmt: skip
        """Match and linearise frames at states (T, 4, 4), (T, D).

        Parameters
        ----------
        frames : numbers of the frames; default: all
        keep : spool to which their matches are appended
        judge : whether `Linearised.unsupported` is computed
        """
        chosen = range(len(roots)) if frames is None else frames
        F, n = len(chosen), self.body.tree.n_dofs
        H, g, cost, rows = np.zeros((F, n, n)), np.zeros((F, n)), np.zeros(F), np.zeros(F)
        unsupported = np.zeros((F, n, n)) if judge else None
        for k, f in enumerate(chosen):
            scene = self.scene(f, roots, angles)
            matched = self.matched(scene)
            if keep is not None:
                keep.append(matched)
            parts = rows_of(scene, matched, self.settings, self.scale, points=int(self.points[f]))
            rows[k] = sum(int(np.sum(squares_of(r)[1] > 0.25)) for r in parts)
            if matched:
                parts += self.apart(scene)
            parts += every_closure(self.body, scene.state)
            if parts:
                equations = normal_equations(self.body, scene.state, parts)
                H[k], g[k], cost[k] = equations.matrix, equations.gradient, equations.cost
            if unsupported is None or not any(m.shows_surface for m in matched):
                continue
            without = [segments_not_shown(m, e) for m, e in zip(matched, evidence_of(scene, matched))]
            if any(w is not None and w.any() for w in without):
                points = int(self.points[f])
                supported = rows_of(scene, matched, self.settings, self.scale, points=points, without=without)
                unsupported[k] = H[k] - normal_equations(self.body, scene.state, supported).matrix
        span = slice(chosen.start, chosen.stop)
        return Linearised(H, g, cost, np.array(roots[span]), np.array(angles[span]), keep or (), rows, unsupported)

    def windows(
        self, roots: NDArray, angles: NDArray, spans: Sequence[slice],
        keep: Spool[tuple[Matched, ...]] | None = None, *, judge: bool = False,
    ) -> Iterator[Linearised]:  # fmt: skip
        """Linearise overlapping windows one after the other; frames that two of them share are linearised once.

        Parameters
        ----------
        roots, angles : (T, 4, 4), (T, D)
        spans : slices of the windows
        keep : spool to which the matches of all frames are appended, each once
        judge : see `linearised`
        """
        last, first, done = None, 0, 0
        for span in spans:
            new = self.linearised(roots, angles, frames=range(done, span.stop), keep=keep, judge=judge)
            last = new if last is None else last.part(slice(span.start - first, None)).followed_by(new)
            first, done = span.start, span.stop
            yield last

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

    def packed_markers(self) -> PackedMarkers | None:
        """Labelled markers of all frames as one block; joints that move with morphs need rows instead."""
        if self.markers is not None or not len(self.results):
            return self.markers
        if self.scene_of(self.results[0].state, 0.0).morphing is not None:
            return None
        measured = (r.measurements for r in self.results)
        return PackedMarkers.of(self.body, measured, self.times, self.settings.marker_loss)


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
