"""The person's shape by the silhouettes of a take."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.observations import Frame, SilhouetteFrame
from kinefit.subject.keypoints import Progress
from kinefit.subject.silhouettes import CylinderFamily, ShapeFit, fit_silhouettes
from kinefit.tracking.fusion import FusionTracker

_TRIED = 100  # steps that are tracked to find the person's shape ...
_POSES = 8  # ... and how many of them it is found from: twice as many change no half axis by more than its deviation


@dataclass(frozen=True, eq=False)
class Shaped:
    """A body of the person's shape, and where it was in the first step that it was found in."""

    body: Body
    start: tuple[int, BodyState]
    fit: ShapeFit


def shaped_by_silhouettes(
    tracker: FusionTracker, steps: Callable[[int], Sequence[Frame]], times: NDArray, *,
    start: tuple[int, BodyState] | None = None, progress: Progress | None = None,
) -> Shaped | None:  # fmt: skip
    """The person's shape: the first steps are tracked with the body as it is, then it is fitted to some of them.

    Parameters
    ----------
    tracker : FusionTracker, fresh; of no use afterwards.
    steps, times, start : as for `run_steps`

    Returns
    -------
    Shaped, or None where the body was not found, or is not of cylinders.
    """
    begin = 0
    if start is not None:
        begin, state = start
        tracker.start_at(state)
    found: dict[int, BodyState] = {}
    last = min(begin + _TRIED, len(times))
    for i in range(begin, last):
        result = tracker.update(steps(i), float(times[i]))
        if result is not None:
            found[i] = result.state
        if progress:
            progress("shape", i + 1 - begin, last - begin)
    told = {i: [f for f in steps(i) if isinstance(f, SilhouetteFrame)] for i in _spread(sorted(found), _POSES)}
    told = {i: several for i, several in told.items() if several}
    if not told:
        return None
    usual = tracker.settings.silhouette
    names = {f"silhouette {f.sensor}" for several in told.values() for f in several}
    sigma = float(np.mean([tracker.accuracy.get(name, usual) for name in names]))
    family = CylinderFamily(tracker.body)
    fit = fit_silhouettes(family, tracker.rig, list(told.values()), [found[i] for i in told], sigma=sigma)
    first = min(found)
    return Shaped(fit.body, (first, fit.states[0] if first == min(told) else found[first]), fit)


def _spread(steps: list[int], count: int) -> list[int]:
    return [steps[k] for k in dict.fromkeys(np.linspace(0, len(steps) - 1, count).astype(int))] if steps else []

