"""What all sensors together say of each segment: it is where it is thought to be, it is not, or nothing sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import KinematicTree
from kinefit.motion import BELIEVED

# On a rendered body tracked into 260 lost part-frames, 99 % are flagged at 0.03 % false alarms with it and BELIEVED;
# 0.2 to 0.3 and 0.5 to 0.7 give 97 to 100 % at 0.01 to 0.1 %.
SHOWN = 0.25  # of a segment's outline that must be seen: with less nothing holds it but prediction and prior
AGREES = 3.0  # standard deviations within which a measurement speaks for its segment


@dataclass(frozen=True, eq=False)
class Evidence:
    """For and against each segment's place; what several sensors say adds up.

    Parameters
    ----------
    agreeing, contrary : (S,), or (F, S) of many frames
        In outlines of the segment: 1 where a depth image shows all of it. A keypoint or a marker counts `SHOWN`, which
        is just enough to call a segment seen.
    elsewhere : (S,) bool, optional
        Segments that several cameras together show to be at another place, however much speaks for a part of them.
    unplaced : (S,) bool, optional
        Segments that may be centimetres away though what is seen of them agrees: they could be slid along themselves,
        or something as large is seen elsewhere. Their quality is 0 where no other sensor supports them.
    """

    agreeing: NDArray
    contrary: NDArray
    elsewhere: NDArray | None = None
    unplaced: NDArray | None = None

    def __add__(self, other: Evidence) -> Evidence:
        told = [e for e in (self.elsewhere, other.elsewhere) if e is not None]
        elsewhere = np.logical_or.reduce(told) if told else None
        doubts = [a.unplaced & ~b._supported for a, b in ((self, other), (other, self)) if a.unplaced is not None]
        unplaced = np.logical_or.reduce(doubts) if doubts else None
        return Evidence(self.agreeing + other.agreeing, self.contrary + other.contrary, elsewhere, unplaced)

    @property
    def _supported(self) -> NDArray:
        supported = (self.agreeing >= SHOWN - 1e-9) & (self.agreeing > self.contrary)
        return np.asarray(supported if self.unplaced is None else supported & ~self.unplaced)

    @classmethod
    def none(cls, segments: int) -> Evidence:
        """Nothing was seen."""
        return cls(np.zeros(segments), np.zeros(segments))

    @property
    def balance(self) -> float:
        """How much more speaks for the body's place than against it, in outlines."""
        return float(self.agreeing.sum() - self.contrary.sum())

    @property
    def quality(self) -> NDArray:
        """(S,) in 0..1: share of what is seen of a segment that speaks for it; 0 where nothing is."""
        seen = self.agreeing + self.contrary
        return self.agreeing / np.where(seen > 0.0, seen, 1.0)

    def segment_quality(self, tree: KinematicTree) -> NDArray:
        """`quality`, (..., S); an unobserved segment has the lower one of its parent and its best child.

        Of an unplaced one it is 0: what is beside it may agree as well where it is not.
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
        """(S,) bool: no sensor sees enough of the segment to say anything; the prediction and the prior hold it."""
        return self.agreeing + self.contrary < SHOWN - 1e-9

    @property
    def lost(self) -> NDArray:
        """(S,) bool: it is seen, and less than half of that speaks for it, or cameras agree that it is elsewhere."""
        contradicted = self.quality < BELIEVED
        if self.elsewhere is not None:
            contradicted |= self.elsewhere
        return ~self.hidden & contradicted
