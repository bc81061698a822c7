"""Ground forces of steps on plates, over stance, in body weights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.masses import segment_masses
from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.exporters.gait.plates import GRAVITY
from kinefit.exporters.gait.record import headings
from kinefit.exporters.report import page as p
from kinefit.exporters.report.feet import footing

PERCENT = np.linspace(0.0, 100.0, 101)
"""Of stance, from contact to toe-off, at which forces are given."""

_COLOURS = {"left": p.LEFT_COLOUR, "right": p.RIGHT_COLOUR}


@dataclass(frozen=True, eq=False)
class StepForces:
    """The ground's force on a foot that stands alone on plates, from contact to toe-off.

    Parameters
    ----------
    side : "left" or "right"
    vertical, forward : (101,) [body weights] at `PERCENT`; forward is where the pelvis faces in the middle of stance
    """

    side: str
    vertical: NDArray
    forward: NDArray


def step_forces(motion: Motion) -> list[StepForces]:
    """Forces of all whole steps on the plates of a motion, in the order of their contacts."""
    weight = GRAVITY * float(segment_masses(motion.body).masses.sum())
    upright, facing = rotation_between_up(motion.up, "y"), headings(motion)
    plates, out = {plate.name: plate for plate in motion.plates}, list[StepForces]()
    for step in found.steps if (found := footing(motion)) else ():
        if not np.isfinite([step.contact, step.off]).all():
            continue
        times = step.contact + (step.off - step.contact) * PERCENT / 100.0
        force = np.sum([plates[name].at(times).force for name in step.plate.split(", ")], axis=0)
        heading = np.interp(times[len(times) // 2], motion.times, facing)
        ahead = np.array([np.cos(heading), 0.0, -np.sin(heading)]) @ upright
        out.append(StepForces(step.side, force @ upright[1] / weight, force @ ahead / weight))
    return out


def force_plots(motions: Iterable[Motion]) -> list[p.Html]:
    """A plot of the vertical and one of the forward force over stance, every step a line; none without such steps."""
    steps = [step for motion in motions if motion.plates for step in step_forces(motion)]
    out = []
    for what, text in (("vertical", "Vertical force"), ("forward", "Force forward (braking is negative)")):
        lines, sides = [], set[str]()
        for step in steps:
            lines.append(p.line(
                PERCENT, getattr(step, what), step.side, p.Stroke(_COLOURS[step.side], 1.5),
                legend=step.side not in sides,
            ))  # fmt: skip
            sides.add(step.side)
        axes = {"xaxis": {"title": {"text": "stance [%]"}}, "yaxis": {"title": {"text": "body weights"}}}
        out += [p.paragraph(f"{text}."), p.plot(lines, axes, label=text)] if lines else []
    return out
