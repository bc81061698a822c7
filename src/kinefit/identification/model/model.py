"""The marker model of a subject: segments, joints, and the distribution of distances (P5 2)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError


@dataclass(frozen=True, eq=False)
class MarkerJoint:
    """The joint of two marker segments.

    Parameters
    ----------
    parent, child : int, indices of segments
    in_parent, in_child : (3,) [m]
        The joint in each segment's frame, which is that of the model's reference positions.
    spread : float [m]
        Standard deviation of the difference of both in training: skin motion and fitting errors.
    marker : int or None
        The marker that both segments share at the joint (P5 2: "joint"); None for a virtual joint.
    exercised : float [rad]
        Range of the joint in training; 0 for a model of one frame.
    ranges : 3 floats [rad]
        Ranges about three orthogonal axes, the largest first.
    turn, give : (3, 3), (3, 3) [rad²], or None without training motion
        Centre of the child's turns in the parent's frame, and their covariance about it in the child's axes.
    """

    parent: int
    child: int
    in_parent: NDArray
    in_child: NDArray
    spread: float = 0.01
    marker: int | None = None
    exercised: float = 0.0
    ranges: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: NDArray | None = None
    give: NDArray | None = None


@dataclass(frozen=True, eq=False)
class MarkerModel:
    """A subject's markers as a tree of nearly rigid segments.

    Parameters
    ----------
    name : str of the subject
    labels : (M,)
    reference : (M, 3) [m] positions in one frame, or each segment's mean shape fitted to one; all finite
    segments : (k,) int each, markers of a segment, the root first; a marker at a joint may be in two
    names : of the segments
    joints : MarkerJoint, one for each segment but the root; parents come before children
    mean, deviation : (M, M) [m]
        Distances and their standard deviations in training; prior deviations in a model of one frame.
    low, high : (M, M) [m]
        Least and largest distance in training. Across joints that training did not exercise (all, in a model of one
        frame) widened towards what the segment tree allows. Equal to `mean` within segments of one frame.
    gaps : labels visible in less than a tenth of the training frames

    Raises
    ------
    ObservationError
        A label appears twice, or shapes disagree.
    """

    name: str
    labels: tuple[str, ...]
    reference: NDArray
    segments: tuple[tuple[int, ...], ...]
    names: tuple[str, ...]
    joints: tuple[MarkerJoint, ...]
    mean: NDArray
    deviation: NDArray
    low: NDArray
    high: NDArray
    gaps: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        count = len(self.labels)
        duplicates = sorted({n for n in self.labels if self.labels.count(n) > 1})
        if duplicates:
            raise ObservationError(f"labels appear twice: {', '.join(duplicates)}", remedy="Name every marker once.")
        if np.shape(self.reference) != (count, 3) or not np.isfinite(self.reference).all():
            raise ObservationError(
                f"reference positions of shape {np.shape(self.reference)}, or not finite, for {count} labels",
                remedy="Give a frame in which every marker is visible.",
            )
        for table in ("mean", "deviation", "low", "high"):
            if np.shape(getattr(self, table)) != (count, count):
                raise ObservationError(f"`{table}` is not {count} x {count}", remedy="Give one value a pair of labels.")
        if len(self.joints) != max(len(self.segments) - 1, 0) or len(self.names) != len(self.segments):
            raise ObservationError(
                f"{len(self.segments)} segments, {len(self.names)} names, {len(self.joints)} joints",
                remedy="Give a name for each segment, and a joint for each but the root.",
            )

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def parents(self) -> tuple[int, ...]:
        """(S,) parent of each segment, -1 for the root."""
        found = {j.child: j.parent for j in self.joints}
        return tuple(found.get(s, -1) for s in range(len(self.segments)))
