"""The input of smoothing: tracked frames of a take, their keypoints, and costs of what all other sensors measured.

Near the states where a frame's rows were made, the cost of its measurements is c − 2 gᵀδ + δᵀHδ. So a round costs one
match and one linearisation of each frame, whatever the sensors. The motion prior and the packed points are not
approximated: the solver evaluates them at every step.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.fitting.frame.fit import rows_of
from kinefit.fitting.frame.results import FrameResult, evidence_of, segments_not_shown
from kinefit.fitting.smoothing.packed import PackedMarkers, PackedPixels
from kinefit.fitting.smoothing.spool import Spool
from kinefit.sensors.base import Matched, Measurement, matched_by
from kinefit.sensors.points.keypoints import pixels_of
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.correspondences.closures import every_closure
from kinefit.solving.equations import normal_equations, robust_factors
from kinefit.solving.rows import AnyRows, DofRows, Rows
from kinefit.solving.trajectory import _kernels_smoothing
from kinefit.solving.trajectory.smoothing import Equations, MakeEquations

SceneOf = Callable[[BodyState, float], Scene]
ApartRows = Callable[[Scene], Sequence[AnyRows]]


class TrackerLike(Protocol):
    """The attributes of a tracker that smoothing needs."""

    @property
    def body(self) -> Body:
        """The tracked body."""

    @property
    def rate(self) -> float:
        """Frame rate [Hz]."""

    @property
    def settings(self) -> TrackSettings:
        """The tracker's settings."""

    @property
    def scene_of(self) -> SceneOf:
        """(state, time) -> scene."""

    @property
    def apart(self) -> ApartRows:
        """Scene -> rows against collisions of the body with itself."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """Quadratic costs of T frames about their states.

    Parameters
    ----------
    H, g, cost : (T, n, n), (T, n), (T,)
    roots, angles : (T, 4, 4), (T, D) states at which the frames were linearised
    matched : T lists of matches; empty if they are not kept
    rows : (T,) number of rows that agree
    unsupported : (T, n, n) part of H without evidence, from segments that a surface sensor does not show, see
        `segments_not_shown`; None if it was not computed
    """

    H: NDArray
    g: NDArray
    cost: NDArray
    roots: NDArray
    angles: NDArray
    matched: Sequence[tuple[Matched, ...]]
    rows: NDArray
    unsupported: NDArray | None = None

    def equations(self, roots: NDArray, angles: NDArray) -> Equations:
        """Equations at other states (T, 4, 4), (T, D), dense."""
        delta = np.empty(self.g.shape)
        _kernels_smoothing.differences(self.roots, roots, self.angles, angles, delta)
        moved = np.einsum("tij,tj->ti", self.H, delta)
        cost = self.cost - 2.0 * np.einsum("ti,ti->t", self.g, delta) + np.einsum("ti,ti->t", moved, delta)
        return np.array(self.H), self.g - moved, cost

    def part(self, frames: slice) -> Linearised:
        """The costs of some frames."""
        names = ("H", "g", "cost", "roots", "angles", "matched", "rows")
        unsupported = None if self.unsupported is None else self.unsupported[frames]
        return replace(self, **{name: getattr(self, name)[frames] for name in names}, unsupported=unsupported)

    def followed_by(self, later: Linearised) -> Linearised:
        """These costs and those of later frames, without matches."""
        names = ("H", "g", "cost", "roots", "angles", "rows")
        both = {name: np.concatenate([getattr(self, name), getattr(later, name)]) for name in names}
        unsupported = None
        if self.unsupported is not None and later.unsupported is not None:
            unsupported = np.concatenate([self.unsupported, later.unsupported])
        return replace(self, **both, matched=(), unsupported=unsupported)


@dataclass(frozen=True, eq=False)
class TrackedFrames:
    """T consecutive tracked frames, and the tracker.

    Parameters
    ----------
    results : T kept frames, see `FrameResult.kept`; the matches of keypoints all in one layout
    times : (T,) [s]
    tracker : of the same body, rate and settings in all frames
    markers : labelled markers, if these are the only sensor and all frames were fitted as one sequence
    packed : sensors whose measurements are left out here: they are packed blocks of points, as the keypoints are
    points : (T,) int, number of rows of these blocks in every frame
    scale : {sensor: factor on its standard deviation} of all others, estimated from the take
    values : {sensor: {name: value}} of their own unknowns, besides those of the scenes
    looked : (T,) bool, frames in which a sensor looked; None for all
    """

    results: Sequence[FrameResult]
    times: NDArray
    tracker: TrackerLike
    markers: PackedMarkers | None = field(default=None, kw_only=True)
    packed: Collection[str] = field(default=(), kw_only=True)
    points: NDArray = field(default_factory=lambda: np.zeros(0, int), kw_only=True)
    scale: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    values: Mapping[str, Mapping[str, float]] = field(default_factory=dict, kw_only=True)
    looked: NDArray | None = field(default=None, kw_only=True)

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
        scene = self.tracker.scene_of(state, float(self.times[f]))
        values = {**scene.values, **self.values}
        return scene.at(state, measurements=self.measurements(f), velocity=velocity, values=values)

    def matched(self, scene: Scene) -> tuple[Matched, ...]:
        """The measurements of a frame, matched at its scene."""
        return tuple(matched_by(m, scene, self.tracker.settings.near) for m in scene.measurements)

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
        F, n = len(chosen), self.tracker.body.tree.n_dofs
        H, g, cost, rows = np.zeros((F, n, n)), np.zeros((F, n)), np.zeros(F), np.zeros(F)
        unsupported = np.zeros((F, n, n)) if judge else None
        for k, f in enumerate(chosen):
            scene = self.scene(f, roots, angles)
            matched = self.matched(scene)
            if keep is not None:
                keep.append(matched)
            parts = rows_of(scene, matched, self.tracker.settings, self.scale, points=int(self.points[f]))
            rows[k] = sum(int(np.sum(squares_of(r)[1] > 0.25)) for r in parts)
            if matched:
                parts += self.tracker.apart(scene)
            parts += every_closure(self.tracker.body, scene.state)
            if parts:
                equations = normal_equations(self.tracker.body, scene.state, parts)
                H[k], g[k], cost[k] = equations.matrix, equations.gradient, equations.cost
            if unsupported is None or not any(m.shows_surface for m in matched):
                continue
            without = [segments_not_shown(m, e) for m, e in zip(matched, evidence_of(scene, matched))]
            if any(w is not None and w.any() for w in without):
                points = int(self.points[f])
                supported = rows_of(scene, matched, self.tracker.settings, self.scale, points=points, without=without)
                unsupported[k] = H[k] - normal_equations(self.tracker.body, scene.state, supported).matrix
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

    def packed_pixels(self, roots: NDArray, angles: NDArray) -> PackedPixels:
        """Keypoints of all frames as one block, with the tracker's swaps, without bias at states (T, 4, 4), (T, D)."""
        rig = self.tracker.scene_of(self.results[0].state, 0.0).rig
        matches = (pixels_of(r.matched) for r in self.results)
        found = PackedPixels.of(matches, rig, len(self.results), self.tracker.settings.loss)
        return found.swapped_as(found.swapped, self.tracker.body, roots, angles)

    def packed_markers(self) -> PackedMarkers:
        """Labelled markers of all frames as one block; joints that move with morphs need rows instead."""
        if self.markers is not None:
            return self.markers
        morphing = self.tracker.scene_of(self.results[0].state, 0.0).morphing is not None
        measured = (() if morphing else r.measurements for r in self.results)
        return PackedMarkers.of(self.tracker.body, measured, self.times, self.tracker.settings.marker_loss)


def with_quadratic(body: Body, make: MakeEquations, more: Linearised) -> MakeEquations:
    """Equations of keypoints with the quadratic costs of other sensors added: packed along the tree -> dense."""
    chain, depth = body.tree.chain, body.tree.depth

    def both(roots: NDArray, angles: NDArray) -> Equations:
        packed, g, cost = make(roots, angles)
        C, more_g, more_cost = more.equations(roots, angles)
        _kernels_smoothing.add_packed(packed, chain, depth, C)
        return C, g + more_g, cost + more_cost

    return both


def squares_of(rows: AnyRows) -> tuple[NDArray, NDArray]:
    """Squared residuals (R,) of rows, in variances, and robust factors (R,); both empty for other kinds of rows."""
    if not isinstance(rows, Rows | DofRows):
        return np.zeros(0), np.zeros(0)
    return rows.weight * rows.residual**2, robust_factors(rows)[0]
