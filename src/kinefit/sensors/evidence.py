"""Evidence for and against the place of each segment, and which degrees of freedom the observed points move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, KinematicTree, PointSet
from kinefit.bodies.motion import BELIEVED
from kinefit.sensors import _kernels

# Of 260 lost part-frames of a rendered body, this and BELIEVED flag 99 % at 0.03 % false alarms; values of 0.2 to 0.3
# and 0.5 to 0.7 flag 97 to 100 % at 0.01 to 0.1 %.
MIN_VISIBLE_OUTLINE = 0.25  # share of a segment's contour: with less only prediction and prior constrain it
AGREEMENT_SIGMAS = 3.0  # a measurement within as many standard deviations supports its segment


@dataclass(frozen=True, eq=False)
class Evidence:
    """Support for and contradiction of each segment's place; evidence of several sensors adds up.

    Parameters
    ----------
    agreeing, contrary : (S,), or (F, S) of many frames
        In contours of the segment, 0 or more: 1 where a depth image shows all of it. A keypoint or a marker counts
        `MIN_VISIBLE_OUTLINE`, just enough for a segment to be observed.
    elsewhere : (S,) bool, optional
        Segments that several cameras together locate at another place, even if a part of them is supported.
    unplaced : (S,) bool, optional
        Segments that may be centimetres off although their visible part agrees: they can slide along their own axis,
        or the sensor sees an object of their size elsewhere. Their quality is 0 unless another sensor supports them.
    """

    agreeing: NDArray
    contrary: NDArray
    elsewhere: NDArray | None = None
    unplaced: NDArray | None = None

    def __add__(self, other: Evidence) -> Evidence:
        displaced = [e for e in (self.elsewhere, other.elsewhere) if e is not None]
        elsewhere = np.logical_or.reduce(displaced) if displaced else None
        doubts = [a.unplaced & ~b._supported for a, b in ((self, other), (other, self)) if a.unplaced is not None]
        unplaced = np.logical_or.reduce(doubts) if doubts else None
        return Evidence(self.agreeing + other.agreeing, self.contrary + other.contrary, elsewhere, unplaced)

    @property
    def _supported(self) -> NDArray:
        supported = (self.agreeing >= MIN_VISIBLE_OUTLINE - 1e-9) & (self.agreeing > self.contrary)
        return np.asarray(supported if self.unplaced is None else supported & ~self.unplaced)

    @classmethod
    def none(cls, segments: int) -> Evidence:
        """No evidence on a number of segments."""
        return cls(np.zeros(segments), np.zeros(segments))

    @property
    def balance(self) -> float:
        """Support minus contradiction, summed over all segments: a number of contours."""
        return float(self.agreeing.sum() - self.contrary.sum())

    @property
    def quality(self) -> NDArray:
        """(S,) in 0..1: share of a segment's evidence that supports it; 0 where there is none."""
        seen = self.agreeing + self.contrary
        return self.agreeing / np.where(seen > 0.0, seen, 1.0)

    def segment_quality(self, tree: KinematicTree) -> NDArray:
        """(..., S) in 0..1: `quality`, filled in for unobserved segments from their neighbours.

        An unobserved segment has the lower quality of its parent and its best child. An unplaced segment has 0: it may
        agree wherever it is along its axis.
        """
        own, hidden = self.quality, self.hidden
        out = own.copy()
        for s in np.flatnonzero(hidden.reshape(-1, hidden.shape[-1]).any(axis=0)):
            below = np.flatnonzero(tree.parents == s)
            if len(below) and tree.parents[s] >= 0:
                known = np.minimum(own[..., tree.parents[s]], own[..., below].max(axis=-1))
                out[..., s] = np.where(hidden[..., s], known, own[..., s])
        return out if self.unplaced is None else np.where(self.unplaced, 0.0, out)

    @property
    def hidden(self) -> NDArray:
        """(S,) bool: too little of the segment is observed; only the prediction and the prior constrain it."""
        return self.agreeing + self.contrary < MIN_VISIBLE_OUTLINE - 1e-9

    @property
    def lost(self) -> NDArray:
        """(S,) bool: observed, and less than half of the evidence agrees, or several cameras locate it elsewhere."""
        contradicted = self.quality < BELIEVED
        if self.elsewhere is not None:
            contradicted |= self.elsewhere
        return ~self.hidden & contradicted


# A detector's point is about a centimetre off the body's, the same way in every frame: a joint that moves no point by
# more than twice that for a radian only follows this error.
MIN_LEVER = 0.02  # [m/rad]


def levers(body: Body, points: PointSet, seen: NDArray, Ts_world_root: NDArray, angles: NDArray) -> NDArray:
    """(F, D) [m/rad] longest lever of each coordinate on the points seen in a frame; inf for prismatic joints.

    Parameters
    ----------
    points : PointSet of K points; seen : (F, K) bool.
    Ts_world_root, angles : (F, 4, 4), (F, D)
    """
    tree, rest, out = body.tree, body.points_rest(points), np.empty(angles.shape)
    for f in range(len(angles)):
        frames, screws = tree.forward(Ts_world_root[f], angles[f])
        _kernels.longest_levers(
            frames, screws, points.segments, rest, seen[f], Ts_world_root[f], tree.last_dof, tree.dof_parent, out[f]
        )
    return np.where(tree.prismatic, np.inf, out)


def moves_points(body: Body, points: PointSet, seen: NDArray, Ts_world_root: NDArray, angles: NDArray) -> NDArray:
    """(F, D) bool: coordinates that move a visible point by more than detectors err; arguments as of `levers`."""
    shortest = MIN_LEVER * body.offset_shares[body.tree.owners]
    return np.asarray(levers(body, points, seen, Ts_world_root, angles) > shortest)


def near(observed: NDArray, frames: int) -> NDArray:
    """(F, D) bool: coordinates observed in this frame or within a number of frames; observed (F, D) bool."""
    count = np.cumsum(np.concatenate([np.zeros((1, observed.shape[1]), int), observed]), axis=0)
    f = np.arange(len(observed))
    return np.asarray(count[np.minimum(f + frames + 1, len(observed))] > count[np.maximum(f - frames, 0)])
