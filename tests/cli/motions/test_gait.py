"""`kinefit gait`."""

import json

import pytest
from click.testing import CliRunner
from tests.exporters.report.test_cycles import walk

from kinefit.cli import main
from kinefit.exporters import write_motion
from kinefit.simulation import cut, squat_and_wave


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("gait")
    for name, motion in (("monday", walk()), ("tuesday", cut(walk(), 0, 400)), ("squat", squat_and_wave())):
        write_motion(motion, root / name / "motion.npz")
    return root


def run(*args):
    return CliRunner().invoke(main, ["gait", *map(str, args)])


def test_walks_give_a_table_and_files(folder, tmp_path):
    told = run(folder / "monday", folder / "tuesday" / "motion.npz", folder / "squat", "-o", tmp_path, "--report")
    assert told.exit_code == 0, told.output
    assert "stride time [s]" in told.stdout and "squat is left out: no foot steps" in told.stderr
    assert {file.name for file in tmp_path.iterdir()} >= {"gait.csv", "gait.json", "gait.html"}
    assert json.loads((tmp_path / "gait.json").read_text())["trials"] == ["monday", "tuesday"]


def test_one_walk_has_its_files_beside_it_and_json_alone(folder):
    told = run(folder / "monday", "--json")
    assert told.exit_code == 0, told.output
    found = json.loads(told.stdout)
    assert found["straight"]["quantities"]["step length [m]"]["left"]["n"] > 2
    assert found["files"]["csv"] == str(folder / "monday" / "gait.csv") and (folder / "monday" / "gait.csv").is_file()
    assert not (folder / "monday" / "gait.html").exists()


def test_a_reference_is_a_band_of_the_page(folder, tmp_path):
    table = tmp_path / "adults.csv"
    table.write_text("coordinate,percent,mean,sd\nknee_angle,0,10,5\nknee_angle,100,10,5\n")
    told = run(folder / "monday", "-o", tmp_path, "--report", "--reference", table)
    assert told.exit_code == 0, told.output
    assert '"legendgroup":"norm"' in (tmp_path / "gait.html").read_text()
    table.write_text("angle,percent,mean,sd\nknee_angle,0,10,5\n")
    told = run(folder / "monday", "-o", tmp_path, "--report", "--reference", table)
    assert told.exit_code == 2 and "coordinate" in told.stderr


@pytest.mark.parametrize(
    ("words", "answer"),
    [(["monday", "--reference", "a.csv"], "--reference needs --report"), (["squat"], "no foot steps"),
     ([""], "monday, squat, tuesday"), (["monday/none.npz"], "no such motion file")],
)  # fmt: skip
def test_what_cannot_be_is_refused(folder, tmp_path, words, answer):
    told = run(folder / words[0], *words[1:], "-o", tmp_path / "out")
    assert told.exit_code == 2 and answer in told.stderr
    assert not (tmp_path / "out").exists()
