"""`kinefit retarget`: what kinefit itself exported comes back, by the commands."""

import numpy as np
import pytest
from click.testing import CliRunner

import kinefit
from kinefit.bodies.motion import rotation_between_up
from kinefit.cli import main
from kinefit.exporters import write_motion
from kinefit.exporters.skeletons.common import NAMES
from kinefit.simulation import cut, squat_and_wave


def run(*args):
    told = CliRunner().invoke(main, [str(arg) for arg in args])
    assert told.exit_code == 0, told.output


@pytest.fixture
def moved(tmp_path):
    motion = cut(squat_and_wave(), 20, 26)
    write_motion(motion, tmp_path / "motion.npz")
    return motion


def joints(motion):
    """(F, S, 3) [m] joint centres, y up."""
    return motion.segment_poses()[:, :, :3, 3] @ rotation_between_up(motion.up, "y").T


@pytest.mark.parametrize("names", NAMES)
def test_an_exported_bvh_is_read_back_under_all_names(moved, tmp_path, names):
    """Joints are where they were; a shoulder may be raised by its girdle or by its arm, which bones do not tell."""
    run("export", tmp_path / "motion.npz", "--to", "bvh", "--names", names, "-o", tmp_path / "walk.bvh")
    run("retarget", tmp_path / "walk.bvh", "-o", tmp_path / "back.npz")
    back = kinefit.read_motion(tmp_path / "back.npz")
    assert len(back) == len(moved) and back.rate == pytest.approx(moved.rate, rel=1e-6)
    gap = np.linalg.norm(joints(back) - joints(moved), axis=2)
    assert np.median(gap) < 0.002 and gap.max() < 0.03


def test_sensors_are_simulated_of_an_exported_bvh(moved, tmp_path):
    run("export", tmp_path / "motion.npz", "--to", "bvh", "-o", tmp_path / "walk.bvh")
    run("simulate", tmp_path / "walk.bvh", "-o", tmp_path / "seen", "--sensor", "tof", "--frames", "1:3", "--no-room")
    assert len(kinefit.read_motion(tmp_path / "seen" / "truth" / "motion.npz")) == 2


def test_an_exported_glb_is_a_character_of_known_names(moved, tmp_path):
    run("export", tmp_path / "motion.npz", "--to", "glb", "-o", tmp_path / "character.glb")
    run("export", tmp_path / "motion.npz", "--retarget", tmp_path / "character.glb", "-o", tmp_path / "again.glb")
    assert (tmp_path / "again.glb").stat().st_size > 1000
