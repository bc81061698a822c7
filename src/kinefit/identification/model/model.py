"""What is known of a subject's markers: which distances hold, how much each gives, where segments meet (P5 2)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError


@dataclass(frozen=True, eq=False)
class MarkerJoint:
    """Where two marker segments meet.

    Parameters
    ----------
    parent, child : int, indexes of segments
    in_parent, in_child : (3,) [m]
        Its place in each segment's frame, that of the model's reference positions.
    spread : float [m]
        Standard deviation between the two, as seen in training; skin and fitting.
    marker : int or None
        The marker that both segments share there, if one does (P5 2: "joint"); None for a virtual joint.
    exercised : float [rad]
        Range that the joint went through in training; 0 where the model comes from one frame.
    ranges : 3 floats [rad]
        The same about each of three axes at right angles, the most turned about first.
    turn, give : (3, 3), (3, 3) [rad²], or None where no motion taught it
        Middle of the child's turns in the parent's frame, and the covariance of its turns about that, in the child's
        axes; a hinge's is small across its axis.
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
    reference : (M, 3) [m] positions of one frame (or the mean shape of each segment, put together); all finite.
    segments : each (k,) int, markers of a segment; a marker may be in two (a joint's). The first is the root.
    names : of the segments
    joints : MarkerJoint, one for each segment but the root; parents come before children.
    mean, deviation : (M, M) [m]
        Distances of markers, and their standard deviations in training; a model of one frame has deviations guessed.
    low, high : (M, M) [m]
        Least and largest distance in training; across joints that were not exercised (all, in a model of one frame)
        widened towards what the tree of segments allows. Equal to `mean` within segments of one frame.
    gaps : labels of which training showed less than a tenth.
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
        twice = sorted({n for n in self.labels if self.labels.count(n) > 1})
        if twice:
            raise ObservationError(f"labels appear twice: {', '.join(twice)}", remedy="Name every marker once.")
        if np.shape(self.reference) != (count, 3) or not np.isfinite(self.reference).all():
            raise ObservationError(
                f"reference positions of shape {np.shape(self.reference)}, or not finite, for {count} labels",
                remedy="Give a frame in which every marker is seen.",
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
