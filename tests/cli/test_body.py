"""`kinefit body`: list, copy, check, picture."""

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from tests.solving.test_closed import LEG

from kinefit.bodies import catalogue, load_body
from kinefit.cli import main
from kinefit.exporters import write_motion
from kinefit.simulation.retarget import known_motion


@pytest.fixture
def kinefit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(main, ["body", *words])


def test_all_bodies_are_listed_with_their_gear(kinefit):
    told = kinefit()
    assert told.exit_code == 0
    for name in catalogue():
        assert f"\n{name} " in f"\n{told.output}"
    assert "5 closures; gear: right_pedal, right_crank, left_crank, left_pedal, bike" in " ".join(told.output.split())


def test_a_copy_is_a_body_and_overwrites_nothing(kinefit, tmp_path):
    assert kinefit("copy", "snowboarder").exit_code == 0
    assert load_body(tmp_path / "snowboarder.toml").closures == load_body("snowboarder").closures
    again = kinefit("copy", "snowboarder")
    assert again.exit_code == 2 and "already exists" in again.output
    assert kinefit("copy", "surfer").exit_code == 2


def test_a_body_is_checked(kinefit, tmp_path):
    told = kinefit("check", "cyclist").output
    for line in ("Gruebler: F = 29", "rank of the closures: 21 of 21 equations; mobility: 29", "both agree"):
        assert line in told
    (tmp_path / "leg.toml").write_text(LEG)
    told = kinefit("check", "leg.toml").output
    assert "Gruebler: F = 0" in told and "mobility: 1" in told and "over-constrained" in told and "along z" in told
    told = kinefit("check", "leg.toml", "--planar").output
    assert "Gruebler: F = 1" in told and "2 of 2 equations; mobility: 1" in told and "both agree" in told
    (tmp_path / "far.toml").write_text(LEG.replace("at = [0.0, 0.6, 0.0]", "at = [0.0, 1.6, 0.0]"))
    told = kinefit("check", "far.toml")
    assert told.exit_code == 2 and "'foot' by 700.0 mm" in " ".join(told.output.split())
    assert "mobility: 7" in kinefit("check", "arm").output


def test_a_picture_shows_a_closed_pose(kinefit, tmp_path):
    assert kinefit("picture", "golfer", "-o", "golfer.png").exit_code == 0
    picture = cv2.imread(str(tmp_path / "golfer.png"))
    assert picture.shape == (900, 900, 3) and (picture != 128).any(axis=2).mean() > 0.01
    assert kinefit("picture", "golfer", "-o", "golfer.txt").exit_code == 2


def test_a_body_gets_more_metaballs(kinefit, tmp_path):
    told = kinefit("refine", "arm_metaballs", "--balls", "6", "-o", "fine.npz")
    assert told.exit_code == 0 and 'body = "fine.npz"' in told.output
    fine, coarse = load_body(tmp_path / "fine.npz"), load_body("arm_metaballs")
    assert [len(s.centres) for s in fine.surfaces] == [6, 6, 6] and fine.tree.coordinates == coarse.tree.coordinates
    motion = known_motion(fine, 10.0, np.eye(4)[None], np.zeros((1, len(fine.tree.coordinates))))
    write_motion(motion, tmp_path / "motion.npz")
    assert kinefit("refine", "motion.npz", "--balls", "9", "-o", "finer.npz").exit_code == 0
    assert [len(s.centres) for s in load_body(tmp_path / "finer.npz").surfaces] == [9, 9, 9]
    told = kinefit("refine", "humanoid", "-o", "no.npz")
    assert told.exit_code == 2 and "no limb of two or more" in told.output
