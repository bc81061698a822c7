"""`kinefit movements`."""

import csv

from click.testing import CliRunner
from tests.exporters.movements.synthetic import SQUAT, crouching, times_down

from kinefit.cli import main
from kinefit.exporters import write_motion


def run(*args):
    return CliRunner().invoke(main, ["movements", *map(str, args)])


def test_squats_are_printed_and_written(tmp_path):
    write_motion(crouching(times_down(2), SQUAT), tmp_path / "squats" / "motion.npz")
    told = run(tmp_path / "squats")
    assert told.exit_code == 0, told.output
    assert "squat: 2" in told.stdout and "depth [m]" in told.stdout
    with open(tmp_path / "squats" / "movements.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["kind"] for row in rows] == ["squat", "squat"] and float(rows[0]["depth [m]"]) > 0.2
    assert run(tmp_path / "squats", "-o", tmp_path / "other.csv").exit_code == 0 and (tmp_path / "other.csv").is_file()


def test_a_motion_without_one_says_so(tmp_path):
    write_motion(crouching(0.0 * times_down(1), SQUAT), tmp_path / "motion.npz")
    told = run(tmp_path)
    assert told.exit_code == 0 and "no jump, squat or rise from a seat" in told.stdout
    assert run(tmp_path / "none.npz").exit_code == 2
