"""Look at some images of a video, and at those between where the motion or the people ask for it.

Detectors err alike in neighbouring images, so that every one of them tells little more than every fourth at 60 Hz. The
fit knows how a body moves on between two looks; points are not interpolated here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.following import Follower, PersonDetection

LOOK_RATE = 15.0
"""[Hz] of the images that are looked at for certain, about."""

_MAX_MISS = 0.1  # [sides of the region] off where three looks lead: noise alone is 0.02 to 0.05, 0.09 at most
_MAX_MIDDLE_MISS = 0.05  # [sides of the region] of the middle image off a parabola; noise alone is 0.01 to 0.02
_FAST_POINTS = 3  # landmarks that are that far off: a hand has four, a foot three
_MIN_CONFIDENCE = 0.5  # of these, in all looks

Adder = Callable[[NDArray[np.uint8], list[PersonDetection]], list[PersonDetection]]


@dataclass
class SparseLooks:
    """The people in the images of one camera, most of which are not looked at.

    Parameters
    ----------
    follower : Follower
    frames : range
        Images that are looked at for certain; and so are the first and the last one.
    add : adds to the people in an image, such as hands.
    """

    follower: Follower
    frames: range
    add: Adder
    _history: list[dict[int, PersonDetection]] = field(default_factory=list)  # of the last looks, a step apart

    def people(self, images: Iterable[NDArray[np.uint8]]) -> Iterator[list[PersonDetection] | None]:
        """The people in every image (H, W, 3) RGB; None for one that was not looked at."""
        gap: list[NDArray[np.uint8]] = []
        for number, image in enumerate(images):
            gap.append(image)
            if number == 0 or number in self.frames:
                yield from self._after(gap)
                gap = []
        if gap:
            yield from self._after(gap)

    def _after(self, gap: Sequence[NDArray[np.uint8]]) -> list[list[PersonDetection] | None]:
        """Look at the last image of a gap after the last look, and at others if that one asks for it."""
        before, count = self.follower.copy(), len(gap)
        people = self._update(gap[-1], count)
        last, now = (self._history or [{}])[-1], {p.column: p for p in people}
        if count > 1 and last.keys() != now.keys():  # somebody came, left or was lost
            self.follower, self._history = before, []
            each = [self._update(image) for image in gap]
            self._history = [{p.column: p for p in each[-1]}]
            return list(each)
        out: list[list[PersonDetection] | None] = [None] * (count - 1) + [people]
        if count == self.frames.step:
            nodes = [*self._history[-3:], now]
            if count > 1 and len(nodes) == 4 and self._miss(nodes, (1.0, -3.0, 3.0), now) > _MAX_MISS:
                middle = count // 2
                out[middle - 1] = seen = self._between(before, gap[middle - 1], middle / count)
                t = middle / count
                parabola = 0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)
                found = {p.column: p for p in seen}
                deep = self._miss([*nodes[1:], found], parabola, found) > _MAX_MIDDLE_MISS
                for k in range(count - 1) if deep else ():
                    if out[k] is None:
                        out[k] = self._between(before, gap[k], (k + 1) / count)
            self._history = nodes[-3:]
        else:
            self._history = [now]
        return out

    def _update(self, image: NDArray[np.uint8], frames: int = 1) -> list[PersonDetection]:
        return self.add(image, self.follower.update(image, frames))

    def _between(self, before: Follower, image: NDArray[np.uint8], share: float) -> list[PersonDetection]:
        return self.add(image, self.follower.between(before, image, share))

    def _miss(
        self, looks: Sequence[dict[int, PersonDetection]], weights: Sequence[float], of: dict[int, PersonDetection]
    ) -> float:
        """How far [sides of the region] the last of four looks is from a weighted sum of the three before.

        Of the person and the landmark, all but the two farthest, that it is largest for.
        """
        worst, sides = 0.0, self.follower.sides
        for column, person in of.items():
            known = [look[column] for look in looks[:3] if column in look]
            if len(known) < 3 or column not in sides:
                continue
            off = person.points - sum(w * p.points for w, p in zip(weights, known))
            sure = np.min([p.confidence for p in (*known, person)], axis=0) > _MIN_CONFIDENCE
            far = np.sort(np.linalg.norm(off, axis=1) * sure)[-_FAST_POINTS]
            worst = max(worst, float(far) / sides[column])
        return worst
