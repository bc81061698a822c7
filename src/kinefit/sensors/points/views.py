"""How views differ: bias by direction of view, swapped sides, hands seen from one side, and rays that meet.

A detector puts a hip nearer to what it sees of the person: in front it is somewhere else on the body than from behind.
Of each keypoint that is a shift e [m] in the axes of the trunk, a function of the unit direction d from the point to
the camera in the same axes (x forward, y up, z to the right):

    e(d) = C^T phi(d),   phi(d) = (x, y, z, x^2 - z^2, x z)

Its constant part is where the point sits on the body (`PointOffsets`), and its part along the ray shows nowhere. Left
and right are mirror images: e_left(d) = M e_right(M d), M = diag(1, 1, -1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, KinematicTree, PointSet
from kinefit.bodies.limbs import finger_groups
from kinefit.geometry.camera import Rig
from kinefit.geometry.lines import triangulate_robust
from kinefit.sensors import _kernels
from kinefit.sensors.channels import Channels, exchange

TERMS = 5
MIRRORED = np.outer((1.0, 1.0, -1.0, 1.0, -1.0), (1.0, 1.0, -1.0))
"""(5, 3) signs of the coefficients of the point on the other side."""


def directions(d: NDArray) -> NDArray:
    """phi (..., 5) of unit directions (..., 3) in the trunk's axes."""
    x, z = d[..., 0], d[..., 2]
    return np.concatenate([d, (x * x - z * z)[..., None], (x * z)[..., None]], axis=-1)


def trunks(tree: KinematicTree) -> NDArray:
    """(S,) int: of every segment the nearest one from it to the root that is neither of the left nor of the right."""
    out = np.arange(len(tree.segments))
    for s, name in enumerate(tree.segments):
        if name.endswith(("_l", "_r")) and tree.parents[s] >= 0:
            out[s] = out[tree.parents[s]]
    return out


@dataclass(frozen=True, eq=False)
class ViewBias:
    """Biases of a detector's keypoints.

    Parameters
    ----------
    sets : {keypoint set: {point: (5, 3) [m] coefficients C in the axes of its trunk's segment}}
    followed : {keypoint set: {point: share 0..1 of its lasting errors that C follows in the take it was learnt from}}
    """

    sets: Mapping[str, Mapping[str, NDArray]] = field(default_factory=dict)
    followed: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def known_to(self, channels: Channels) -> Channels:
        """Channels that know it; the same where there is nothing to know."""
        if not self.sets:
            return channels
        bias, followed = np.zeros((len(channels.points), TERMS, 3)), np.zeros(len(channels.points))
        for name, span in channels.sets.items():
            known, share = self.sets.get(name, {}), self.followed.get(name, {})
            for k in range(span.start, span.stop):
                point = channels.points.names[k]
                bias[k], followed[k] = known.get(point, 0.0), share.get(point, 0.0)
        return replace(channels, view_bias=bias[channels.column], view_followed=followed[channels.column])

    def as_record(self) -> dict[str, Any]:
        """The same [m] as lists, for `Motion.provenance`."""
        return {s: {n: np.round(c, 5).tolist() for n, c in points.items()} for s, points in self.sets.items()}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> ViewBias:
        """Of what `as_record` gave."""
        return cls({s: {n: np.array(c, float) for n, c in points.items()} for s, points in record.items()})


def view_offset(
    coefficients: NDArray, trunk: NDArray, x_world: NDArray, frames: NDArray, rig: Rig, camera: NDArray
) -> NDArray:
    """Offsets (N, 2) [px] at which keypoints are seen from their points; 0 where a point cannot be seen.

    Parameters
    ----------
    coefficients : (N, 5, 3) [m]
    trunk : (N,) segment in whose axes they are
    x_world : (N, 3) [m] the points
    frames : (S, 12) of the segments, rotation first
    camera : (N,) of the rig
    """
    moved = np.empty(x_world.shape)
    _kernels.shifted(coefficients, trunk, x_world, frames, rig.packed, camera, moved)
    out: NDArray = rig.project(moved, camera) - rig.project(x_world, camera)
    out[~np.isfinite(out)] = 0.0
    return out


_MAX_OFFSET_M = 0.02  # median of a hand's points, beyond which a view shows it elsewhere; a finger is 0.016 wide
_MIN_OFFSET_SIGMAS = 1.5  # of the points, below which that is noise: its own median is 1.2
_MIN_SHARE = 0.5  # of a hand's points that a view must have to show its fingers


@dataclass(frozen=True, eq=False)
class HandViews:
    """A hand's fingers and the channels on them.

    Parameters
    ----------
    palm : int, segment that the fingers hang on
    fingers : (K,) int, their segments
    views : of each source (V,) int, the channels on them
    """

    palm: int
    fingers: NDArray
    views: tuple[NDArray, ...]

    @classmethod
    def of(cls, body: Body, channels: Channels, points: PointSet) -> tuple[HandViews, ...]:
        """The hands of a body that some channel's point (N,) lies on."""
        out = []
        for palm, names in finger_groups(body).items():
            fingers = np.array([body.tree.segment(name) for name in names])
            on = np.isin(points.segments, fingers)
            views = [np.flatnonzero(on & (channels.source == q)) for q in range(len(channels.sources))]
            if on.any():
                out.append(cls(body.tree.segment(palm), fingers, tuple(v for v in views if len(v))))
        return tuple(out)


def join_fingers(
    hands: Sequence[HandViews], agreeing: NDArray, contrary: NDArray, offset: NDArray, sigma: NDArray
) -> None:
    """Let the fingers of each hand agree or be contradicted together, in place.

    They are contradicted where at least as many views show them elsewhere as where they are, or where the palm is lost.
    They count as unseen where no view shows half of their points.

    Parameters
    ----------
    hands : HandViews
    agreeing, contrary : (S,) as `Evidence` has them
    offset : (N,) [m] distance of each channel's point from the body's at its depth, NaN where unseen
    sigma : (N,) [m] its standard deviation
    """
    for hand in hands:
        votes = []
        for view in hand.views:
            seen = view[np.isfinite(offset[view])]
            if len(seen) >= _MIN_SHARE * len(view):
                limit = max(_MAX_OFFSET_M, _MIN_OFFSET_SIGMAS * float(np.median(sigma[seen])))
                votes.append(bool(np.median(offset[seen]) <= limit))
        if not votes:
            agreeing[hand.fingers] = contrary[hand.fingers] = 0.0
        elif 2 * sum(votes) <= len(votes) or contrary[hand.palm] > agreeing[hand.palm]:
            contrary[hand.fingers] += agreeing[hand.fingers]
            agreeing[hand.fingers] = 0.0


_TRUNCATE = 9.0  # squared standard deviations beyond which a point says no more
_ODDS = 8.0  # how much cheaper the exchange must be: e⁻⁴ against the detector having erred


def limb_groups(body: Body, channels: Channels) -> NDArray:
    """(N,) int: channels that swap together, by the branch of the tree they are on (legs; trunk with arms)."""
    tree = body.tree
    branches: dict[str, int] = {}
    out = np.zeros(len(channels.column), np.int64)
    for n, k in enumerate(channels.column):
        s = int(channels.points.segments[k])
        while tree.parents[s] > 0:
            s = int(tree.parents[s])
        name = tree.segments[s]
        name = name[:-2] if name.endswith(("_l", "_r")) else name
        out[n] = branches.setdefault(name, len(branches))
    return out


def find_swaps(
    channels: Channels, groups: NDArray, uv: NDArray, weight: NDArray, fitted: NDArray,
    sides_known: NDArray | None = None,
) -> NDArray:  # fmt: skip
    """(N,) bool: channels of one frame to exchange with their partner.

    Parameters
    ----------
    groups : (N,) int from `limb_groups`.
    uv, fitted : (N, 2) [px] measured, and where the body would be seen.
    weight : (N,) [1/px²], 0 where unseen.
    sides_known : (N,) bool, channels that stay as they are; None: none
    """
    partner = channels.partner
    paired = partner != np.arange(len(partner))
    as_is, turned = _cost(uv - fitted, weight), _cost(uv - fitted[partner], weight)
    key = channels.source * (groups.max(initial=0) + 1) + groups
    gain = np.bincount(key[paired], (as_is - turned)[paired], minlength=key.max(initial=0) + 1)
    swapped: NDArray = paired & (gain[key] > _ODDS)
    return swapped if sides_known is None else swapped & ~sides_known


def _cost(gap: NDArray, weight: NDArray) -> NDArray:
    cost = np.minimum(weight * (gap[:, 0] ** 2 + gap[:, 1] ** 2), _TRUNCATE)
    cost[np.isnan(cost)] = 0.0
    return cost


def triangulated(channels: Channels, frames: NDArray, *, max_residual_px: float = 30.0) -> NDArray:
    """(F, K, 3) [m] points of some frames on which two cameras agree, NaN elsewhere; see `triangulated_frame`."""
    return np.stack(
        [
            triangulated_frame(channels, channels.uv[f], channels.confidence[f], max_residual_px=max_residual_px)[0]
            for f in frames
        ]
    )


def triangulated_frame(
    channels: Channels, uv: NDArray, confidence: NDArray, *, max_residual_px: float = 30.0
) -> tuple[NDArray, NDArray]:
    """Points (K, 3) [m] of one frame on which two cameras agree, NaN elsewhere; and which sources were exchanged.

    Where exchanging left and right in some sources makes more of them agree, it is done: one source after the other,
    the best first. (Q,) bool says which.
    """
    swapped = np.zeros(len(channels.sources), bool)
    best, support = _agreed(channels, uv, confidence, swapped, max_residual_px)
    while swapped.sum() < (len(swapped) - 1) // 2:
        trials = []
        for q in np.flatnonzero(~swapped):
            trial = swapped.copy()
            trial[q] = True
            trials.append((*_agreed(channels, uv, confidence, trial, max_residual_px), trial))
        x, more, trial = max(trials, key=lambda t: t[1])
        if more < support + 0.02 * len(channels.points):  # for nothing, believe the detector
            break
        best, support, swapped = x, more, trial
    return best, swapped


def rays(channels: Channels, uv: NDArray, seen: NDArray) -> NDArray:
    """(K, 2, 3) origin [m] and direction in the world of a ray on which each point of one frame lies; NaN where unseen.

    Of several cameras that see a point, the last.
    """
    out = np.full((len(channels.points), 2, 3), np.nan)
    for number in np.unique(channels.camera[seen]):
        camera, own = channels.rig.cameras[number], seen & (channels.camera == number)
        out[channels.column[own], 0], out[channels.column[own], 1] = camera.centre_world, camera.ray(uv[own])
    return out


def _agreed(
    channels: Channels, uv: NDArray, confidence: NDArray, swapped: NDArray, limit: float
) -> tuple[NDArray, float]:
    """Triangulated points of one frame, and the confidence of the views that agree, summed by how well they do."""
    uv, confidence = exchange(channels, uv, swapped), exchange(channels, confidence, swapped)
    view = np.full((len(channels.points), len(channels.rig), 2), np.nan)
    trust = np.zeros(view.shape[:2])
    use = np.isfinite(uv).all(axis=1) & (confidence > 0.1)
    view[channels.column[use], channels.camera[use]] = uv[use]
    trust[channels.column[use], channels.camera[use]] = confidence[use]
    x, inliers, residual = triangulate_robust(channels.rig, view, trust, max_residual_px=limit)
    closeness = np.where(inliers, 1.0 - np.square(np.where(inliers, residual, 0.0) / limit), 0.0)
    return x, float(np.sum(closeness * trust))
