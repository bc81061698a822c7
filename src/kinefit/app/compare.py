"""Two results side by side: ranges of motion with their change, angles, and both motions in one 3D scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kinefit.app.scene import ScenePage
from kinefit.batch.viewed import gather
from kinefit.exporters.curves import curves, spoken
from kinefit.exporters.report.angles import Extremes, ranges_of, with_error


@dataclass(frozen=True)
class RangeChange:
    """How the range of motion of one angle changed.

    Parameters
    ----------
    angle : name in words, with its side
    before, after, change : [deg] "value ± two standard deviations"; "" where it is not observed
    is_clear : whether the change is larger than its two standard deviations
    """

    angle: str
    before: str
    after: str
    change: str
    is_clear: bool


class Comparison:
    """Two motions, of which the first is that before.

    Parameters
    ----------
    before, after : folders of results

    Attributes
    ----------
    ranges : tuple of RangeChange
    angles : {name: (before, after), two Curve} that both motions have
    times : of both, (F,) [s] from the first frame on
    scene : ScenePage with both

    Raises
    ------
    KinefitError
        A motion cannot be read.
    """

    def __init__(self, before: Path, after: Path) -> None:
        self._files = before / "motion.npz", after / "motion.npz"
        self._written = self._changed()
        content = gather(self._files)
        first, second = content.motions
        self.ranges = _changes(ranges_of(first), ranges_of(second))
        known = {curve.name: curve for curve in curves(first) if curve.unit == "deg"}
        self.angles = {curve.name: (known[curve.name], curve) for curve in curves(second) if curve.name in known}
        self.times = first.times - first.times[0], second.times - second.times[0]
        self.scene = ScenePage(content)

    @property
    def is_current(self) -> bool:
        """Whether both motions are as they were when they were read."""
        return self._changed() == self._written

    def points(self, angle: str, number: int, most: int) -> list[list[float]]:
        """[s, deg] of an angle of the motion 0 or 1, at most `most` points of it."""
        curve, times = self.angles[angle][number], self.times[number]
        step = max(1, -(-len(times) // most))
        return np.column_stack([times, curve.values])[::step].round(3).tolist()

    def close(self) -> None:
        """Close the scene."""
        self.scene.close()

    def _changed(self) -> list[int]:
        return [file.stat().st_mtime_ns if file.exists() else 0 for file in self._files]


def _changes(
    before: dict[str, dict[str, Extremes | None]], after: dict[str, dict[str, Extremes | None]]
) -> tuple[RangeChange, ...]:  # fmt: skip
    found = []
    for stem in before:
        for side in before[stem]:
            a, b = before[stem][side], after.get(stem, {}).get(side)
            change = (b.span[0] - a.span[0], float(np.hypot(a.span[1], b.span[1]))) if a and b else None
            spans = a and a.span, b and b.span, change
            first, second, third = (with_error(*span) if span else "" for span in spans)
            is_clear = change is not None and abs(change[0]) > change[1]
            name = f"{spoken(stem)}, {side}" if side else spoken(stem)
            found.append(RangeChange(name, first, second, third, is_clear))
    return tuple(found)
