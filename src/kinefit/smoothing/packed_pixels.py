"""Keypoints of a whole take as one packed block of pixels, which the compiled solvers evaluate exactly."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.geometry.camera import Rig
from kinefit.losses import Loss
from kinefit.sensors.base import Matched
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.keypoints import KeypointMatched, pixels_of
from kinefit.sensors.points.views import beside, find_swaps, limb_groups, trunks
from kinefit.sensors.scene import Scene
from kinefit.smoothing.spool import STRETCH, stretches


@dataclass(frozen=True, eq=False)
class PackedPixels:
    """N channels of keypoints in T frames.

    Parameters
    ----------
    channels : as measured, in all frames of the take
    uv : (T, N, 2) [px] as used: sides as `swapped` has them, without the detectors' bias by view
    confidence : (T, N) as used, 0 where undetected
    swapped : (T, N) bool, channels whose left and right are exchanged
    loss : Loss of a keypoint, in its standard deviations
    """

    channels: Channels
    uv: NDArray
    confidence: NDArray
    swapped: NDArray
    loss: Loss

    @classmethod
    def of(cls, matches: Iterable[Sequence[KeypointMatched]], rig: Rig, frames: int, loss: Loss) -> PackedPixels:
        """Keypoints of so many frames, in one layout, with sides as they were matched, as measured."""
        channels, known = Channels.none(rig, frames), None
        swapped = np.zeros((frames, 0), bool)
        for f, several in enumerate(matches):
            if f % STRETCH == 0:
                release(channels.uv, channels.confidence)
            for m in several:
                if not swapped.size:
                    N = len(m.swapped)
                    uv, confidence, swapped = room((frames, N, 2)), room((frames, N)), np.zeros((frames, N), bool)
                    uv[:] = np.nan
                    channels = replace(m.measurement.layout.channels, uv=uv, confidence=confidence)
                of = m.measurement
                channels.uv[f], channels.confidence[f], swapped[f] = of.uv, of.confidence, m.swapped
                if of.sides_known is not None:
                    known = np.zeros(swapped.shape, bool) if known is None else known
                    known[f] = of.sides_known
        return cls(replace(channels, sides_known=known), channels.uv, channels.confidence, swapped, loss)

    @cached_property
    def points(self) -> PointSet:
        """The body's point of each channel (N,)."""
        of, column = self.channels.points, self.channels.column
        return PointSet(tuple(of.names[c] for c in column), of.segments[column], of.points[column])

    def part(self, frames: slice) -> PackedPixels:
        """The keypoints of some frames."""
        return replace(self, **{name: getattr(self, name)[frames] for name in ("uv", "confidence", "swapped")})

    def release(self) -> None:
        """Give back the memory of what was used: it lies in files where it is much."""
        release(self.channels.uv, self.channels.confidence, self.uv, self.confidence)

    def swapped_as(self, swapped: NDArray, body: Body, roots: NDArray, angles: NDArray) -> PackedPixels:
        """The keypoints as measured with the channels `swapped` (T, N), without bias at states (T, 4, 4), (T, D)."""
        uv, confidence = _exchanged(self.channels, swapped)
        uv = _without_bias(body, self.channels, uv, roots, angles)
        return replace(self, uv=uv, confidence=confidence, swapped=swapped)

    def find_swaps(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, N) bool: channels to exchange with their left-right partner, by states (T, 4, 4), (T, D)."""
        channels, out = self.channels, np.zeros(self.swapped.shape, bool)
        if not len(channels.column):
            return out
        groups = limb_groups(body, channels)
        for some in stretches(len(out)):
            at = roots[some], angles[some]
            given = replace(self, channels=channels.part(range(*some.indices(len(out)))))
            given = given.swapped_as(np.zeros(given.channels.confidence.shape, bool), body, *at)
            weight, fitted = given.confidence / np.square(channels.sigma), given.fitted(body, *at)
            known = given.channels.sides_known if given.channels.sides_known is not None else [None] * len(fitted)
            out[some] = [find_swaps(channels, groups, *one) for one in zip(given.uv, weight, fitted, known)]
        return out

    def fitted(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, N, 2) [px] projections of the points at states (T, 4, 4), (T, D)."""
        x = body.trajectories(roots, angles, self.points)
        uv = self.channels.rig.project(x.reshape(-1, 3), np.tile(self.channels.camera, len(x)))
        return uv.reshape(*x.shape[:2], 2)

    def gaps(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, N, 2) [px] measured minus fitted at states (T, 4, 4), (T, D); NaN where undetected."""
        return np.where((self.confidence > 0)[..., None], self.uv - self.fitted(body, roots, angles), np.nan)

    def factors(self, gaps: NDArray, sigma: NDArray) -> NDArray:
        """(T, N) robust factors of `gaps` (T, N, 2), 0 where undetected, with sigma (N,) [px]."""
        r2 = np.square(gaps).sum(axis=2)
        used = np.isfinite(r2)
        s2 = np.where(used, self.confidence * r2 / np.square(sigma), 0.0)
        return np.where(used, self.loss.factor(s2), 0.0)

    def factors_at(self, body: Body, roots: NDArray, angles: NDArray, sigma: NDArray) -> NDArray:
        """(T, N) robust factors at states (T, 4, 4), (T, D), 0 where undetected, with sigma (N,) [px]."""
        out = room(self.confidence.shape)
        for some in stretches(len(roots)):
            part = self.part(some)
            out[some] = part.factors(part.gaps(body, roots[some], angles[some]), sigma)
            release(self.uv, self.confidence, out)
        return out

    def weights(self, body: Body, roots: NDArray, angles: NDArray, sigma: NDArray) -> NDArray:
        """(T, N) [1/px²] weights, robust factors at states (T, 4, 4), (T, D) included, with sigma (N,) [px]."""
        out = self.factors_at(body, roots, angles, sigma)
        for some in stretches(len(out)):
            out[some] *= self.confidence[some] / np.square(sigma)
        release(out, self.confidence)
        return out

    def matched(self, f: int, tracked: Iterable[Matched], scene: Scene) -> tuple[KeypointMatched, ...]:
        """The matches of keypoints among those of frame `f`, with the sides and the bias as used here."""
        weight = self.confidence[f] / np.square(self.channels.sigma)
        uv = np.where(weight[:, None] > 0, self.uv[f], np.nan)
        return tuple(
            replace(m, uv=uv, weight=weight, swapped=self.swapped[f], beside=m.measurement.layout.beside(scene))
            for m in pixels_of(tracked)
        )


def _exchanged(channels: Channels, swapped: NDArray) -> tuple[NDArray, NDArray]:
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


def _without_bias(body: Body, channels: Channels, uv: NDArray, roots: NDArray, angles: NDArray) -> NDArray:
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
