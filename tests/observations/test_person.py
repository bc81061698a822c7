"""The choice of one person among several, as a take or an option states it."""

import pytest

from kinefit.errors import ObservationError
from kinefit.observations.recordings import PersonChoice


def test_the_forms_of_a_choice():
    assert PersonChoice.of(None).way == "first" and PersonChoice.of("moving").way == "moving"
    assert PersonChoice.of(12).number == PersonChoice.of("12").number == 12
    nearest = PersonChoice.of("nearest 1 2.5 -3")
    assert nearest.way == "nearest" and nearest.place.tolist() == [1.0, 2.5, -3.0]


WRONG = [0, -1, True, 1.5, "0", "second", "nearest 1 2", "nearest 1 2 nan", 1234567, "9" * 9999]


@pytest.mark.parametrize("wrong", WRONG)
def test_another_choice_is_an_error_and_no_other_number(wrong):
    with pytest.raises(ObservationError, match="a number from 1"):
        PersonChoice.of(wrong)
