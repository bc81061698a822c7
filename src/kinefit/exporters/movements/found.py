"""All movements of a motion, and their table."""

from __future__ import annotations

from kinefit.bodies.motion import Motion
from kinefit.errors import ObservationError
from kinefit.exporters.movements.course import Course, Repetition
from kinefit.exporters.movements.jumps import jumps
from kinefit.exporters.movements.sit_to_stand import rises
from kinefit.exporters.movements.squats import squats
from kinefit.exporters.tables import Table, quantity_table


def find_movements(motion: Motion) -> list[Repetition]:
    """Jumps, squats and rises from a seat, in the order of their times.

    Raises
    ------
    ObservationError
        The body has no hips, heels or balls of the feet, or the motion fewer than three frames.
    """
    course = Course(motion)
    lacking = [name for name in course.landmarks if name not in motion.body.landmarks.names]
    if lacking or len(motion) < 3:
        problem = f"the body has no landmark {lacking[0]}" if lacking else "fewer than three frames"
        raise ObservationError(problem, remedy="Give a motion of a person's whole body, such as humanoid.")
    flights = jumps(course)
    return sorted([*flights, *squats(course, flights), *rises(course)], key=lambda one: one.start)


def movement_table(found: list[Repetition]) -> Table:
    """Columns (rows,): kind, start and stop [s], each quantity with its standard deviation; NaN where it has none."""
    quantities = dict.fromkeys(name for one in found for name in one.values)
    return quantity_table(found, ("kind", "start", "stop"), quantities)
