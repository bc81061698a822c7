"""Whether the views of a hand agree: its fingers are tracked together, or lost together.

Fingers can be fitted to any single view. Where two views contradict each other, the points of one of them agree, and
half of all points seem enough. So views are counted here, in place of points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.bodies.limbs import finger_groups
from kinefit.sensors.channels import Channels

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
