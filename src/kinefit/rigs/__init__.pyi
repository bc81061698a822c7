"""Public names: Calibrations."""

from kinefit.rigs.board.calibrate import calibrate_board as calibrate_board
from kinefit.rigs.people.calibrate import calibrate_people as calibrate_people
