"""All movements of a motion and their table."""

import numpy as np
import pytest
from tests.exporters.movements.synthetic import RATE, SEAT, SQUAT, crouching, jumping, times_down

from kinefit.bodies import load_body
from kinefit.errors import ObservationError
from kinefit.exporters.movements import find_movements, movement_table
from kinefit.simulation import known_motion


@pytest.mark.parametrize(
    ("motion", "kinds"),
    [(lambda: crouching(times_down(2), SQUAT), ["squat"] * 2), (lambda: jumping()[0], ["jump"]),
     (lambda: crouching(times_down(2), SEAT), ["sit to stand"] * 2), (lambda: crouching(np.zeros(200), SEAT), [])],
)  # fmt: skip
def test_movements_are_told_apart(motion, kinds):
    found = find_movements(motion())
    assert [one.kind for one in found] == kinds
    table = movement_table(found)
    assert table["kind"].tolist() == kinds and table["start [s]"].tolist() == sorted(one.start for one in found)
    for name, column in table.items():
        assert len(column) == len(found), name


def test_a_body_without_feet_is_refused():
    arm = load_body("arm")
    still = known_motion(arm, RATE, np.tile(np.eye(4), (9, 1, 1)), np.zeros((9, len(arm.tree.coordinates))))
    with pytest.raises(ObservationError, match="no landmark l_hip"):
        find_movements(still)
